"""What a subscriber gets: samples and notices, out of messages as they came."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from google.protobuf.message import DecodeError, Message

from vdms_rt.model import Displacement, Event, Health, Truth
from vdms_rt.wire import convert
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.topics import DISPLACEMENT, EVENT, HEALTH, TOPICS, TRUTH

SOURCES_REMEMBERED = 4096
SN_RANGE = 1 << 32
"""zenoh's sequence numbers wrap."""


Value: TypeAlias = Displacement | Truth | Health | Event | Message | bytes


@dataclass(frozen=True, slots=True, repr=False)
class Sample:
    """One message of a station."""

    station: str
    marker: str
    """Empty where the topic is of the whole station."""
    topic: str
    received_ns: int
    """When it came, on this computer's monotonic clock; what came while a callback ran, when that
    returned at the latest."""
    _value: Value | pb.Displacement

    @property
    def value(self) -> Value:
        """The message of the topic (`vdms_pb2`) where there is no type of ours, the bytes where the
        topic is not known. A displacement is made of its message when it is first asked for."""
        value = self._value
        if isinstance(value, pb.Displacement):
            value = convert.displacement_of(value)
            object.__setattr__(self, "_value", value)
        return value

    def __repr__(self) -> str:
        return (
            f"Sample(station={self.station!r}, marker={self.marker!r}, topic={self.topic!r}, "
            f"received_ns={self.received_ns}, value={self.value!r})"
        )


@dataclass(frozen=True, slots=True)
class Missed:
    """Displacements that this subscriber never got, first and last included."""

    station: str
    marker: str
    session: int
    first_seq: int
    last_seq: int
    on_the_way: int
    """How many of them the station had sent; it never had the others: lost frames."""

    @property
    def count(self) -> int:
        return self.last_seq - self.first_seq + 1

    def __str__(self) -> str:
        many = f"{self.count} samples, seq {self.first_seq} to {self.last_seq}"
        text = many if self.count > 1 else f"1 sample, seq {self.first_seq}"
        where = {0: "lost by the station", self.count: "lost on the way"}.get(
            self.on_the_way, f"{self.on_the_way} of them lost on the way"
        )
        return f"{self.station}/{self.marker}: missed {text}, {where}"


@dataclass(frozen=True, slots=True)
class Arrived:
    """A station's daemon runs and can be reached."""

    station: str

    def __str__(self) -> str:
        return f"{self.station}: arrived"


@dataclass(frozen=True, slots=True)
class Left:
    """A station's daemon stopped or cannot be reached any more."""

    station: str

    def __str__(self) -> str:
        return f"{self.station}: left"


@dataclass(frozen=True, slots=True)
class Unreadable:
    """Bytes that are not what their key promises."""

    key: str
    why: str

    def __str__(self) -> str:
        return f"{self.key}: cannot be read: {self.why}"


Notice: TypeAlias = Missed | Arrived | Left | Unreadable


class Raw(NamedTuple):
    """A message as it came."""

    key: str
    data: bytes
    received_ns: int
    source: str
    """Who numbered it: a publisher, or only its session where it is not `sequenced`."""
    number: int
    """zenoh's sequence number, or its time stamp where there is none."""
    sequenced: bool


class Reader:
    """Decodes, drops doubles and finds gaps. One thread uses it."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str], tuple[int, Raw]] = {}

    def read(self, item: Raw | Arrived | Left) -> Iterator[Sample | Notice]:
        """Return the sample, and before it what is missing there; nothing for a double. What is
        not a message comes back as it is."""
        if not isinstance(item, Raw):
            yield item
            return
        raw = item
        station, marker, topic = _parts(raw.key)
        try:
            value = _decode(topic, raw.data)
        except (DecodeError, ValueError) as error:
            yield Unreadable(raw.key, str(error))
            return
        if isinstance(value, pb.Displacement):
            of, seq = (raw.key, str(value.session)), value.seq
        else:
            of, seq = (raw.key, raw.source), raw.number
        last_seq, last = self._last.get(of, (None, raw))
        if last_seq is not None and seq <= last_seq:
            return
        self._remember(of, seq, raw)
        if isinstance(value, pb.Displacement) and last_seq is not None and seq > last_seq + 1:
            yield Missed(
                station,
                marker,
                value.session,
                first_seq=last_seq + 1,
                last_seq=seq - 1,
                on_the_way=_lost_between(last, raw, seq - last_seq - 1),
            )
        yield Sample(station, marker, topic, raw.received_ns, value)

    def _remember(self, of: tuple[str, str], seq: int, raw: Raw) -> None:
        self._last[of] = seq, raw
        if len(self._last) > SOURCES_REMEMBERED:
            self._last.pop(next(iter(self._last)))


def _lost_between(last: Raw, raw: Raw, missing: int) -> int:
    if raw.sequenced and raw.source == last.source:
        return min(missing, (raw.number - last.number) % SN_RANGE - 1)
    return missing


def _parts(key: str) -> tuple[str, str, str]:
    """Return station, marker and topic; what a key does not have is empty."""
    match key.split("/"):
        case [_, station, marker, topic]:
            return station, marker, topic
        case [_, station, topic]:
            return station, "", topic
        case _:
            return "", "", key


_MESSAGES = {topic.name: topic.message for topic in TOPICS}
_VALUES: dict[str, Callable[[bytes], pb.Displacement | Truth | Health | Event]] = {
    DISPLACEMENT.name: convert.displacement_message,
    TRUTH.name: convert.truth_from,
    HEALTH.name: convert.health_from,
    EVENT.name: convert.event_from,
}


def _decode(topic: str, data: bytes) -> Value | pb.Displacement:
    if topic in _VALUES:
        return _VALUES[topic](data)
    return _MESSAGES[topic].FromString(data) if topic in _MESSAGES else data
