"""How long a frame takes: our centroids and the whole process stage beside named alternatives.

Four regions of 120 x 120 pixels around the circles of the bench marker at 8 m and 30 degrees, which
moves by 5 mm, white noise of 2 grey levels. Everything runs in this one process, OpenCV on one
thread, in turns of ten frames, so that a busy machine slows all of them alike; a ratio is the
median over the turns. Every answer is compared with the truth: a method that misses the marker
stops the program.

    python -m tools.bench.speed [--rounds 60] [--json]
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi, sin
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.bench.picture import Bench, grabbed, woven
from vdms_rt.config import parse_config
from vdms_rt.measure.centroid import otsu_circle
from vdms_rt.measure.expect import Forecast, first_look
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.smooth import Slow, first_slow, measure, study
from vdms_rt.measure.validity import judge, learn
from vdms_rt.model import Damage, Displacement, Frame, Region, Scan
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan
from vdms_rt.process.step import begin, step

Image = NDArray[np.uint8]
Centres = NDArray[np.float64]

SIDE_PX = 120
TURN_FRAMES = 10
CYCLE_FRAMES = 40
AMPLITUDE_MM = 5.0
NOISE_GREY = 2.0
REFERENCE_PICTURES = 10
PERIOD_NS = 33_366_667
BENCH = Bench(distance_m=8.0, angle_deg=30.0)
TAG_MM = 60.0
"""Side of an ArUco tag, with its black rim; as large as the circles' distance lets it be seen with
a white rim in the same regions."""
REGIONS = tuple(
    Region(int(x), int(y), SIDE_PX, SIDE_PX)
    for x, y in np.rint(BENCH.centres_px()).astype(int) - SIDE_PX // 2
)
MAX_ERROR_PX = 0.5
MAX_ERROR_MM = 0.3


@dataclass(frozen=True)
class Scene:
    """One cycle of motion, as the cameras of all methods see it."""

    whole: list[Image]
    interlaced: list[Image]
    tags: list[Image]
    stills: list[Image]

    @classmethod
    def drawn(cls, cycle_frames: int = CYCLE_FRAMES) -> Scene:
        rng = np.random.default_rng(1)
        moments = [position_mm(i / cycle_frames) for i in range(cycle_frames)]
        fields = [
            [position_mm((i + part) / cycle_frames) for part in (-0.25, 0.25)]
            for i in range(cycle_frames)
        ]
        still = BENCH.still()
        return cls(
            whole=[grabbed(BENCH.still(x), NOISE_GREY, rng) for x in moments],
            interlaced=[
                grabbed(woven(*(BENCH.still(x) for x in pair)), NOISE_GREY, rng) for pair in fields
            ],
            tags=[grabbed(tag_picture(x), NOISE_GREY, rng) for x in moments],
            stills=[grabbed(still, NOISE_GREY, rng) for _ in range(4 * REFERENCE_PICTURES)],
        )


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    measure: Callable[[int], object]
    """Measure frame n; frames come in order."""
    error: Callable[[int, object], float]
    """How wrong that was, as a part of what is allowed."""


def position_mm(part: float) -> float:
    return AMPLITUDE_MM * sin(2 * pi * part)


def tag_picture(x_mm: float) -> NDArray[np.float64]:
    """Four ArUco tags in the places of the circles, on white, without noise."""
    fine, bits = 4, 6
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    scale = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1]])
    size = (BENCH.width_px * fine, BENCH.height_px * fine)
    canvas = np.full(size[::-1], BENCH.white_grey, np.float32)
    for tag, (x, y) in enumerate(BENCH.circles_mm):
        side = 20 * bits
        drawn = cv2.aruco.generateImageMarker(dictionary, tag, side).astype(np.float32) / 255
        drawn = BENCH.black_grey + (BENCH.white_grey - BENCH.black_grey) * drawn
        mm_per_dot = TAG_MM / side
        to_mm = np.array(
            [
                [mm_per_dot, 0, x + x_mm - TAG_MM / 2 + mm_per_dot / 2],
                [0, -mm_per_dot, y + TAG_MM / 2 - mm_per_dot / 2],
                [0, 0, 1],
            ]
        )
        cv2.warpPerspective(
            drawn,
            scale @ BENCH.homography @ to_mm,
            size,
            dst=canvas,
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_TRANSPARENT,
        )
    light = cv2.resize(canvas, (BENCH.width_px, BENCH.height_px), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(light, (0, 0), BENCH.blur_x_px, sigmaY=BENCH.blur_y_px).astype(float)


def views(image: Image) -> list[Image]:
    return [image[r.y_px : r.y_px + SIDE_PX, r.x_px : r.x_px + SIDE_PX] for r in REGIONS]


def in_frame(centres: Sequence[tuple[float, float]]) -> Centres:
    """Return centres of the views as those of the frame."""
    return np.array(centres) + [(r.x_px, r.y_px) for r in REGIONS]


def of_centres(name: str, frames: list[Image], find: Callable[[Image], Centres]) -> Row:
    """Return the row of a method that gives the centres in one frame."""
    count = len(frames)

    def error(n: int, centres: object) -> float:
        truth = BENCH.centres_px(position_mm(n / count))
        return float(np.abs(np.asarray(centres) - truth).max()) / MAX_ERROR_PX

    return Row(name, lambda n: find(frames[n % count]), error)


def opencv_moments(image: Image, binary: bool) -> Centres:
    centres = []
    for view in views(image):
        mask = cv2.threshold(view, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[1]
        m = cv2.moments(mask, binary)
        centres.append((m["m10"] / m["m00"], m["m01"] / m["m00"]))
    return in_frame(centres)


def our_otsu(image: Image) -> Centres:
    circles = [otsu_circle(image, region, white=True) for region in REGIONS]
    return np.array([(c.x_px, c.y_px) for c in circles])


def blob_detector() -> Callable[[Image], Centres]:
    """SimpleBlobDetector, told to look for bright blobs of any shape; its thresholds end below
    white, whose noise would tear the blobs apart."""
    wanted = cv2.SimpleBlobDetector_Params()
    wanted.maxThreshold = 180.0
    wanted.blobColor = 255
    wanted.minArea, wanted.maxArea = 500.0, float(SIDE_PX**2)
    wanted.filterByCircularity = wanted.filterByConvexity = wanted.filterByInertia = False
    detector = cv2.SimpleBlobDetector_create(wanted)
    return lambda image: in_frame([detector.detect(view)[0].pt for view in views(image)])


def aruco_detector() -> Callable[[Image], Centres]:
    """ArUco with sub-pixel corners; a tag's centre is where its diagonals cross."""
    wanted = cv2.aruco.DetectorParameters()
    wanted.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.ArucoDetector(dictionary, wanted)

    def find(image: Image) -> Centres:
        centres = []
        for view in views(image):
            a, b, c, d = detector.detectMarkers(view)[0][0][0].astype(float)
            along = np.linalg.solve(np.column_stack((c - a, b - d)), b - a)[0]
            centres.append(a + along * (c - a))
        return in_frame(centres)

    return find


def process_stage(method: str, sampling: str, scene: Scene) -> Row:
    """Return the row of the real process stage: pictures, step, and the displacements it gives."""
    listed = [[r.x_px, r.y_px, r.width_px, r.height_px] for r in REGIONS]
    config = parse_config(
        f'[process]\nmethod = "{method}"\n[setup]\nreference_pictures = {REFERENCE_PICTURES}\n'
        f'[[marker]]\nfind = "regions"\nregions_px = {listed}\n',
        "speed",
    )
    frames = scene.interlaced if sampling == "field" else scene.whole
    scan = Scan.BOTTOM_FIRST if sampling == "field" else Scan.PROGRESSIVE
    work = Workspace()
    progress = begin(
        Plan.of(config), 1, BENCH.width_px, BENCH.height_px, exposure_ns=0, period_ns=PERIOD_NS
    )

    def frame(seq: int, image: Image) -> Frame:
        t_ns = 10**9 + seq * PERIOD_NS
        return Frame(
            seq, t_ns, t_ns, 0, 0, 0, PERIOD_NS, image, scan, Damage.NONE, order_known=True
        )

    for seq, image in enumerate(scene.stills):
        for picture in pictures(frame(seq, image), sampling):
            progress, _, _ = step(progress, picture, work)
    if progress.phase is not Phase.MEASURING:
        raise SystemExit(f"the process stage with method {method} took no reference")
    first = len(scene.stills)

    def measure(n: int) -> list[Displacement]:
        nonlocal progress
        samples: list[Displacement] = []
        for picture in pictures(frame(first + n, frames[n % len(frames)]), sampling):
            progress, given, _ = step(progress, picture, work)
            samples += given
        return samples

    def error(n: int, samples: object) -> float:
        assert isinstance(samples, list)
        parts = (-0.25, 0.25) if sampling == "field" else (0.0,)
        if not all(s.valid for s in samples):
            return float("inf")
        truth = [position_mm((n + part) / len(frames)) for part in parts]
        given = [s.x_mm for s in samples]
        return float(np.abs(np.subtract(given, truth)).max()) / MAX_ERROR_MM

    counted = "two fields" if sampling == "field" else "whole frame"
    return Row(f"process stage, {method}, {counted}", measure, error)


def our_smooth(sampling: str, scene: Scene) -> Row:
    """Return the row of the smooth-weight centroids and their flags alone, told beforehand where
    the circles should be, as the process stage is by its track."""
    frames = scene.interlaced if sampling == "field" else scene.whole
    interlaced = sampling == "field"
    row_step = 2 if interlaced else 1
    # In a bottom-first frame the rows 1, 3, ... are the earlier field.
    parts = ((1, -0.25), (0, 0.25)) if interlaced else ((0, 0.0),)
    work = Workspace()
    found = first_look(
        tuple(map(tuple, BENCH.centres_px().tolist())), ((SIDE_PX / 3, SIDE_PX / 3),) * len(REGIONS)
    )
    stills = {
        offset: [
            study(image[offset::row_step], offset, row_step, found, first_slow(4), work)
            for image in scene.stills[:REFERENCE_PICTURES]
        ]
        for offset, _ in parts
    }
    learnt = learn(stills, row_step)
    expected, limits, slow = {}, {}, {}
    for offset, part in parts:
        appearance, limits[offset] = learnt[offset]
        forecast = Forecast(appearance, BENCH.homography, 0.0)
        slow[offset] = Slow(appearance.variance_grey2, appearance.edge_px)
        for n in range(len(frames)):
            pose = (position_mm((n + part) / len(frames)), 0.0, 0.0)
            expected[offset, n] = forecast.at(pose)

    def measure_all(n: int) -> list[list[tuple[float, float]]]:
        n %= len(frames)
        given = []
        for offset, _ in parts:
            at = expected[offset, n]
            readings, slow[offset] = measure(
                frames[n][offset::row_step], offset, row_step, at, slow[offset], work
            )
            flags = judge(
                readings,
                at,
                limits[offset],
                NOISE_GREY,
                BENCH.width_px,
                BENCH.height_px,
            )
            if any(flags):
                raise SystemExit(f"a circle is flagged that nothing disturbs: {flags}")
            given.append([(r.x_px, r.y_px) for r in readings])
        return given

    def error(n: int, given: object) -> float:
        assert isinstance(given, list)
        truth = [BENCH.centres_px(position_mm((n + part) / len(frames))) for _, part in parts]
        return float(np.abs(np.array(given) - truth).max()) / MAX_ERROR_PX

    counted = "two fields" if interlaced else "whole frame"
    return Row(f"smooth centroids and flags, {counted}", measure_all, error)


def rows(scene: Scene) -> list[Row]:
    """Return the table's lines; the first is what the others are compared with."""
    whole = scene.whole
    return [
        of_centres("OpenCV threshold(OTSU) + moments", whole, lambda i: opencv_moments(i, False)),
        of_centres("OpenCV, moments(binary)", whole, lambda i: opencv_moments(i, True)),
        of_centres("otsu_circle, flags and contrast too", whole, our_otsu),
        our_smooth("frame", scene),
        our_smooth("field", scene),
        process_stage("otsu", "frame", scene),
        process_stage("smooth", "frame", scene),
        process_stage("otsu", "field", scene),
        process_stage("smooth", "field", scene),
        of_centres("OpenCV SimpleBlobDetector", whole, blob_detector()),
        of_centres("OpenCV ArUco, sub-pixel corners", scene.tags, aruco_detector()),
    ]


def timed(table: list[Row], rounds: int) -> NDArray[np.float64]:
    """Return microseconds a frame, (rounds, rows).

    Raises SystemExit when a method does not find the marker.
    """
    spent_us = np.empty((rounds, len(table)))
    for turn in range(-1, rounds):
        frames = range((turn + 1) * TURN_FRAMES, (turn + 2) * TURN_FRAMES)
        for place in range(len(table)):
            row = (place + turn) % len(table)
            begin_ns = time.perf_counter_ns()
            results = [table[row].measure(n) for n in frames]
            spent_ns = time.perf_counter_ns() - begin_ns
            worst = max(table[row].error(n, r) for n, r in zip(frames, results, strict=True))
            if not worst < 1:
                raise SystemExit(f"{table[row].name} does not find the marker")
            if turn >= 0:
                spent_us[turn, row] = spent_ns / 1000 / TURN_FRAMES
    return spent_us


def machine() -> dict[str, str]:
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8") if sys.platform == "linux" else ""
    models = [line.split(":")[1].strip() for line in text.splitlines() if "model name" in line]
    return {
        "cpu": models[0] if models else sys.platform,
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=60, help="turns of ten frames (60)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    options = parser.parse_args(arguments)
    if options.rounds < 1:
        parser.error("--rounds must be at least 1")
    cv2.setNumThreads(1)
    table = rows(Scene.drawn())
    spent_us = timed(table, options.rounds)
    ratios = np.median(spent_us / spent_us[:, :1], axis=0)
    lines = [
        {
            "method": row.name,
            "us_per_frame": round(statistics.median(spent_us[:, i]), 1),
            "ratio": round(float(ratios[i]), 3),
        }
        for i, row in enumerate(table)
    ]
    about = machine()
    if options.json:
        print(json.dumps({"machine": about, "rounds": options.rounds, "rows": lines}, indent=1))
        return
    print(
        f"four regions of {SIDE_PX} x {SIDE_PX}, one thread, {options.rounds * TURN_FRAMES} frames"
    )
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print()
    print(f"{'method':42}{'us a frame':>12}{'ratio':>9}")
    for line in lines:
        print(f"{line['method']:42}{line['us_per_frame']:12.1f}{line['ratio']:9.2f}")


if __name__ == "__main__":
    main()
