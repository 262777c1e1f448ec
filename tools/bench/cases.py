"""What the accuracy bench measures: settings of camera, marker and motion, in named sets."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import pi

from tools.bench.film import Way
from tools.bench.picture import ANGLES_DEG, DISTANCES_M, Bench


@dataclass(frozen=True)
class Setting:
    """One run of the marker before the camera, measured with every noise and method."""

    name: str
    """Of the set, and what is special in it."""
    bench: Bench
    amplitude_mm: float = 10.0
    frequency_hz: float = 1.0
    """0 for a marker that rests."""
    exposure_ms: float = 0.0
    axis_deg: float = 0.0
    """From the marker's x to the table's motion in its plane; told to the process stage."""
    tilt_deg: float = 0.0
    """Of the table's motion out of the marker's plane; told to nobody."""
    sigma_t_us: float = 0.0
    """Of the frames' times, which say so."""
    sampling: str = "frame"
    noises_grey: tuple[float, ...] = (2.0,)
    methods: tuple[str, ...] = ("smooth",)
    samples: int = 2000
    seed: int = 1

    @property
    def velocity_mm_s(self) -> float:
        """At its most."""
        return 2 * pi * self.frequency_hz * self.swing_mm

    @property
    def swing_mm(self) -> float:
        return self.amplitude_mm if self.frequency_hz else 0.0

    @property
    def way(self) -> Way:
        return Way(self.swing_mm, self.axis_deg, self.tilt_deg)


@dataclass(frozen=True)
class Choice:
    """What the command line asks for; None leaves it to each set."""

    distances_m: Sequence[float] | None = None
    angles_deg: Sequence[float] | None = None
    amplitudes_mm: Sequence[float] | None = None
    frequencies_hz: Sequence[float] | None = None
    noises_grey: Sequence[float] | None = None
    methods: Sequence[str] | None = None
    samplings: Sequence[str] | None = None
    samples: int = 2000
    seed: int = 1

    def benches(
        self,
        distances_m: Sequence[float] = DISTANCES_M,
        angles_deg: Sequence[float] = ANGLES_DEG,
    ) -> Iterator[Bench]:
        for distance, angle in itertools.product(
            self.distances_m or distances_m, self.angles_deg or angles_deg
        ):
            yield Bench(distance_m=distance, angle_deg=angle)

    def setting(self, name: str, bench: Bench, **changes: object) -> Setting:
        wanted = {
            "noises_grey": tuple(self.noises_grey or (2.0,)),
            "methods": tuple(self.methods or ("smooth",)),
            "samples": self.samples,
            "seed": self.seed,
        }
        return Setting(name=name, bench=bench, **(wanted | changes))  # type: ignore[arg-type]


def paper(choice: Choice) -> Iterator[Setting]:
    """The paper's 25 distances and angles, 1 Hz, three amplitudes and noises."""
    for bench, amplitude, sampling in itertools.product(
        choice.benches(),
        choice.amplitudes_mm or (10.0, 1.0, 0.1),
        choice.samplings or ("frame", "field"),
    ):
        yield choice.setting(
            "paper",
            bench,
            amplitude_mm=amplitude,
            sampling=sampling,
            frequency_hz=(choice.frequencies_hz or (1.0,))[0],
            noises_grey=tuple(choice.noises_grey or (1.0, 2.0, 4.0)),
            methods=tuple(choice.methods or ("otsu", "smooth")),
        )


def fields(choice: Choice) -> Iterator[Setting]:
    """Fields of a marker at rest and in motion of 1 to 5 Hz, sharp and exposed for 1/60 s."""
    for bench in choice.benches():
        yield choice.setting("fields at rest", bench, frequency_hz=0.0, sampling="field")
        for frequency, exposure_ms in itertools.product(
            choice.frequencies_hz or (1.0, 2.0, 3.0, 4.0, 5.0), (0.0, 1000 / 60)
        ):
            yield choice.setting(
                "fields",
                bench,
                frequency_hz=frequency,
                exposure_ms=exposure_ms,
                amplitude_mm=(choice.amplitudes_mm or (10.0,))[0],
                sampling="field",
            )


def special(choice: Choice) -> Iterator[Setting]:
    """Little contrast, square pixels, a rolled camera, small discs."""
    changes = {
        "contrast 30..80": {"white_grey": 80.0},
        "640 x 480": {"width_px": 640, "pixel_aspect": 1.0},
        "roll 10 deg": {"roll_deg": 10.0},
        "discs of 12 px": {"fill": 12 / 480 * 200 / 50},
    }
    for (name, change), bench in itertools.product(changes.items(), choice.benches()):
        for sampling in choice.samplings or ("frame",):
            yield choice.setting(name, replace(bench, **change), sampling=sampling)  # type: ignore[arg-type]


def causes(choice: Choice) -> Iterator[Setting]:
    """What spoils a result, one cause at a time, at 8 m."""
    changes: dict[str, dict[str, float]] = {
        "nothing": {},
        "axis at 30 deg": {"axis_deg": 30.0},
        "plane 1 deg off the axis": {"tilt_deg": 1.0},
        "exposure 1/60 s": {"exposure_ms": 1000 / 60},
        "times 0.1 ms off": {"sigma_t_us": 100.0},
    }
    for (name, change), bench, frequency, sampling in itertools.product(
        changes.items(),
        choice.benches(distances_m=(8.0,), angles_deg=(0.0, 30.0, 60.0)),
        choice.frequencies_hz or (1.0, 5.0),
        choice.samplings or ("field",),
    ):
        yield choice.setting(name, bench, frequency_hz=frequency, sampling=sampling, **change)


def aruco(choice: Choice) -> Iterator[Setting]:
    """Corners of four ArUco tags in the discs' places, measured by OpenCV alone."""
    for bench, amplitude in itertools.product(
        choice.benches(), choice.amplitudes_mm or (10.0, 1.0, 0.1)
    ):
        yield choice.setting("aruco", bench, amplitude_mm=amplitude, methods=("aruco",))


SETS: dict[str, Callable[[Choice], Iterator[Setting]]] = {
    "paper": paper,
    "fields": fields,
    "special": special,
    "causes": causes,
    "aruco": aruco,
}
