"""Frames out of a recording: whole ones, regions, unfinished files, and what cannot be used."""

from __future__ import annotations

import contextlib
import time
from fractions import Fraction

import numpy as np
import pytest
from google.protobuf import timestamp_pb2
from logbook import files, put_sample, recorder_for, running

from vdms_rt.capture.log import LogSource, recorded_set_up
from vdms_rt.config import Log
from vdms_rt.logfile.writer import LogMessage, LogWriter
from vdms_rt.model import (
    NTSC_FRAME_PERIOD_S,
    Damage,
    Frame,
    MarkerShape,
    Region,
    Scan,
    SourceEnded,
    SourceError,
    StampEvent,
)
from vdms_rt.setup import FieldSetUp, MarkerSetUp, SetUp, SetUpError, set_up_json
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.convert import pixels_bytes

HEIGHT, WIDTH, PERIOD_NS = 60, 80, 33_366_667
REGIONS = ((Region(4, 6, 20, 20), Region(50, 31, 21, 19)),)
RANDOM = np.random.default_rng(4)


def frames(count, scan=Scan.BOTTOM_FIRST, period_ns=PERIOD_NS, height=HEIGHT):
    """Return frames with a gap after the third, damage in the second, a new segment at the end."""
    return [
        Frame(
            seq=index + (5 if index > 2 else 0),
            stamp_ns=9_000 + index * period_ns,
            t_ns=1_000 + index * period_ns,
            sigma_t_ns=40 + index,
            utc_ns=1_700_000_000_000_000_000 + index,
            segment=int(index == count - 1),
            period_ns=period_ns,
            image=RANDOM.integers(0, 256, (height, WIDTH), dtype=np.uint8),
            scan=scan,
            damage=Damage.FLAGGED if index == 1 else Damage.NONE,
        )
        for index in range(count)
    ]


def recorded(directory, frames_, *, whole=True, before=()):
    """Return the file of a recording of these frames."""
    recorder, _ = recorder_for(directory, live=False)
    with running(recorder):
        for topic, key, data in before:
            recorder.put(topic, key, 0, data)
        for frame in frames_:
            put_sample(recorder, frame.seq)
            data = pixels_bytes(frame, ("m1",), REGIONS, 1, whole)
            recorder.put(topics.PIXELS, "vdms/lab/pixels", frame.t_ns, data)
    return files(directory)[0]


def opened(path, pace="fast"):
    return contextlib.closing(LogSource(Log(path=str(path), pace=pace)))


def read_all(source):
    """Return [(grab, image)] and what the source said at its end."""
    found = []
    while True:
        image = np.full((source.info.height_px, source.info.width_px), 77, np.uint8)
        try:
            grab = source.read(image, 5.0)
        except SourceEnded as end:
            return found, str(end)
        assert grab is not None
        found.append((grab, image))


def test_whole_frames_come_back_as_they_were(tmp_path):
    given = frames(6)
    source = LogSource(Log(path=str(recorded(tmp_path, given))))
    info = source.info
    assert (info.kind, info.width_px, info.height_px) == ("log", WIDTH, HEIGHT)
    assert info.frame_period_s == NTSC_FRAME_PERIOD_S
    assert info.scan is Scan.BOTTOM_FIRST
    assert info.stamp_event is StampEvent.MID_EXPOSURE
    assert info.sequence_counts_lost
    assert not info.live
    assert ("recorded device", "virtual") in info.facts
    assert ("recorded by", "vdms-rt 9.9") in info.facts
    found, end = read_all(source)
    source.close()
    source.close()
    assert end.endswith(".mcap ended after 6 frames")
    assert len(found) == len(given)
    for (grab, image), frame in zip(found, given, strict=True):
        assert np.array_equal(image, frame.image)
        tick = grab.tick
        assert (tick.index, tick.t_ns, tick.sigma_t_ns) == (frame.seq, frame.t_ns, frame.sigma_t_ns)
        assert (tick.segment, tick.utc_ns) == (frame.segment, frame.utc_ns)
        assert (grab.stamp_ns, grab.scan, grab.damage) == (frame.stamp_ns, frame.scan, frame.damage)


def test_regions_come_back_in_a_black_picture(tmp_path):
    given = frames(3)
    with opened(recorded(tmp_path, given, whole=False)) as source:
        found, _ = read_all(source)
    for (_, image), frame in zip(found, given, strict=True):
        expected = np.zeros((HEIGHT, WIDTH), np.uint8)
        for r in REGIONS[0]:
            part = np.s_[r.y_px : r.y_px + r.height_px, r.x_px : r.x_px + r.width_px]
            expected[part] = frame.image[part]
        assert np.array_equal(image, expected)


def test_alternating_fields_keep_their_own_rows(tmp_path):
    given = [
        frame
        for pair in zip(
            frames(3, Scan.TOP, height=30), frames(3, Scan.BOTTOM, height=30), strict=True
        )
        for frame in pair
    ]
    with opened(recorded(tmp_path, given, whole=False)) as source:
        assert source.info.scan is Scan.TOP
        assert source.info.height_px == 30
        found, _ = read_all(source)
    assert [grab.scan for grab, _ in found] == [Scan.TOP, Scan.BOTTOM] * 3
    for (grab, image), frame in zip(found, given, strict=True):
        offset = 1 if grab.scan is Scan.BOTTOM else 0
        woven, expected = np.zeros((2, 60, WIDTH), np.uint8)
        woven[offset::2] = frame.image
        for r in REGIONS[0]:
            part = np.s_[r.y_px : r.y_px + r.height_px, r.x_px : r.x_px + r.width_px]
            expected[part] = woven[part]
        assert np.array_equal(image, expected[offset::2])


@pytest.mark.parametrize(
    ("period_ns", "period_s"),
    [(40_000_000, Fraction(1, 25)), (33_333_333, Fraction(33_333_333, 1_000_000_000))],
)
def test_the_frame_period_is_the_recorded_one(tmp_path, period_ns, period_s):
    path = recorded(tmp_path, frames(2, period_ns=period_ns))
    with opened(path) as source:
        assert source.info.frame_period_s == period_s


def test_an_unfinished_file_gives_what_reached_the_disk(tmp_path):
    given = frames(40)
    part = tmp_path / "cut.mcap.part"
    log = LogWriter(tmp_path / "cut.mcap")
    for index, frame in enumerate(given):
        data = pixels_bytes(frame, ("m1",), (), 1, True)
        log.add(LogMessage("vdms/lab/pixels", pb.Pixels, index, frame.t_ns, frame.t_ns, data))
        if index % 10 == 9:
            log.sync()
    log.abandon()
    with part.open("r+b") as file:
        file.truncate(part.stat().st_size - 900)
    with opened(part) as source:
        found, end = read_all(source)
    assert len(found) == 30
    assert all(np.array_equal(image, f.image) for (_, image), f in zip(found, given, strict=False))
    assert "ended after 30 frames;" in end
    assert "bytes of it were not readable" in end


def test_at_realtime_frames_come_at_their_own_pace_and_gaps_are_not_waited_for(tmp_path):
    given = frames(4)
    late = frames(6)[4:]
    for index, frame in enumerate(late):
        object.__setattr__(frame, "t_ns", 3_600_000_000_000 + index * PERIOD_NS)
    image = np.empty((HEIGHT, WIDTH), np.uint8)
    with opened(recorded(tmp_path, [*given, *late]), "realtime") as source:
        assert source.info.live
        assert source.read(image, 0.0) is not None
        started_s = time.monotonic()
        assert source.read(image, 0.0) is None
        found, _ = read_all(source)
    assert len(found) == 5
    assert time.monotonic() - started_s >= 0.09


def test_pictures_that_change_their_size_end_it_with_a_sentence(tmp_path):
    path = recorded(tmp_path, [*frames(2), *frames(1, height=48)])
    image = np.empty((HEIGHT, WIDTH), np.uint8)
    with opened(path) as source:
        source.read(image, 0.0)
        source.read(image, 0.0)
        with pytest.raises(SourceError, match="from frame 3 on the pictures are 80 x 48 px"):
            source.read(image, 0.0)


def sentence_of(path):
    with pytest.raises(SourceError) as caught:
        LogSource(Log(path=str(path)))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))
    return str(caught.value)


def test_what_cannot_be_used_is_told_in_one_sentence(tmp_path):
    assert "no such file" in sentence_of(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("this is no MCAP at all")
    assert "not an MCAP file" in sentence_of(tmp_path / "text.mcap")

    recorder, _ = recorder_for(tmp_path / "samples")
    with running(recorder):
        put_sample(recorder, 0)
    no_pixels = files(tmp_path / "samples")[0]
    assert 'record.pixels = "regions"' in sentence_of(no_pixels)

    log = LogWriter(tmp_path / "foreign.mcap")
    log.add(LogMessage("clock", timestamp_pb2.Timestamp, 0, 0, 0, b""))
    log.close()
    assert "not one that vdms-rt recorded" in sentence_of(log.path)

    damaged = bytearray(recorded(tmp_path / "pixels", frames(1)).read_bytes())
    damaged[1500] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(damaged)
    assert "damaged, no pixels can be read: bytes" in sentence_of(tmp_path / "damaged.mcap")

    log = LogWriter(tmp_path / "newer.mcap")
    log.add(LogMessage("vdms/lab/pixels", pb.Pixels, 0, 0, 0, b"\xff\xff\xff"))
    log.close()
    assert "newer version" in sentence_of(log.path)

    log = LogWriter(tmp_path / "nothing.mcap")
    log.add(LogMessage("vdms/lab/pixels", pb.Pixels, 0, 0, 0, b""))
    log.close()
    assert "no size or no frame period" in sentence_of(log.path)


def test_the_recorded_set_up_is_the_one_that_the_pixels_name(tmp_path):
    shape = MarkerShape("m1", ((-60.0, 60.0), (60.0, 60.0), (-60.0, -60.0), (60.0, -60.0)), 50.0)
    marker = MarkerSetUp(
        shape=shape,
        regions=REGIONS[0],
        noise_px=0.01,
        homography=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        fields=(
            FieldSetUp(
                kind=Scan.TOP, reference_px=((1.25, 2.5),), area_px=(300.0,), contrast=(170.0,)
            ),
        ),
    )
    set_up = SetUp(
        revision=1,
        utc_ns=5,
        width_px=WIDTH,
        height_px=HEIGHT,
        scan=Scan.BOTTOM_FIRST,
        method="otsu",
        stills=30,
        markers=(marker,),
    )
    other = set_up.model_copy(update={"revision": 2})
    messages = [
        (topics.SETUP, "vdms/lab/setup", pb.SetUp(revision=s.revision, json=set_up_json(s)))
        for s in (set_up, other)
    ]
    before = [(topic, key, message.SerializeToString()) for topic, key, message in messages]
    path = recorded(tmp_path / "a", frames(2), before=before)
    assert recorded_set_up(Log(path=str(path))) == set_up

    assert recorded_set_up(Log(path=str(recorded(tmp_path / "b", frames(1))))) is None
    wrong = pb.SetUp(revision=1, json="{}").SerializeToString()
    path = recorded(tmp_path / "c", frames(1), before=[(topics.SETUP, "vdms/lab/setup", wrong)])
    with pytest.raises(SetUpError):
        recorded_set_up(Log(path=str(path)))
    with pytest.raises(SourceError, match="no such file"):
        recorded_set_up(Log(path=str(tmp_path / "none.mcap")))
