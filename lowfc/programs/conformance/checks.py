"""What `lowfc conformance` finds, and the checks that a camera's and a mirror's messages have in common."""

from collections.abc import Iterable, Sequence
from enum import StrEnum
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.contract.envelope import Envelope, count_of, start_of
from lowfc.contract.errors import BusError, nearest
from lowfc.contract.messages import EVENT, HEALTH, TOPICS, from_timestamp, topic_of, wire

NS = 1_000_000_000
LATE_NS = 20_000_000
"""A publisher's clock that is this far from ours makes every frame late (`control.late_ms`)."""

_AHEAD_NS = 1_000_000
_DECADE_S = 10 * 365 * 86_400
_UNITS = {"microseconds": 1_000, "milliseconds": 1_000_000, "seconds": NS}


class Status(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARNING = "warning"
    WRONG = "wrong"


class Check(NamedTuple):
    """One line of the report.

    Attributes:
        name: what was looked at.
        status: wrong is what breaks the contract; a warning is what costs something, or could not be tried.
        expected: what the contract says.
        got: what was found.
        advice: what to do about it; empty where it is ok.
    """

    name: str
    status: Status
    expected: str
    got: str
    advice: str = ""


class Heard(NamedTuple):
    """One message as it arrived, whatever is wrong with it.

    Attributes:
        key: where it was published.
        payload: its bytes.
        attachment: what should be its envelope; None without one.
        receive_time_ns: when it was received, by the host's clock.
    """

    key: str
    payload: bytes
    attachment: bytes | None
    receive_time_ns: int


def ok(name: str, expected: str, got: str) -> Check:
    """As the contract says."""
    return Check(name, Status.OK, expected, got)


def warning(name: str, expected: str, got: str, advice: str) -> Check:
    """Something that costs, or could not be tried."""
    return Check(name, Status.WARNING, expected, got, advice)


def wrong(name: str, expected: str, got: str, advice: str) -> Check:
    """Something that breaks the contract."""
    return Check(name, Status.WRONG, expected, got, advice)


def envelope_of(heard: Heard) -> Envelope | None:
    """Envelope of a message; None where it has none that can be read."""
    try:
        return None if heard.attachment is None else Envelope.decode(heard.attachment)
    except BusError:
        return None


def envelope_checks(messages: Sequence[Heard], offset_ns: int) -> list[Check]:
    """Check envelope, sequence and time of the put of one publisher's messages, of which there are some.

    Args:
        messages: of one topic, in the order of their arrival.
        offset_ns: what CLOCK_MONOTONIC is short of the epoch, on this host.
    """
    expected = "a zenoh attachment of 16 bytes: sequence and publish_time_ns, little-endian uint64"
    bare = [heard for heard in messages if envelope_of(heard) is None]
    if bare:
        sizes = sorted({"none" if one.attachment is None else f"{len(one.attachment)} bytes" for one in bare})
        got = f"{len(bare)} of {len(messages)} messages with {', '.join(sizes)}"
        return [wrong("envelope", expected, got, "attach it to every put; docs/hardware.md has its bytes")]
    envelopes = [found for heard in messages if (found := envelope_of(heard)) is not None]
    return [
        ok("envelope", expected, f"on all of {len(messages)} messages"),
        _sequence(envelopes, messages[-1].receive_time_ns),
        _put_time(envelopes, messages, offset_ns),
    ]


def _sequence(envelopes: Sequence[Envelope], now_ns: int) -> Check:
    name = "sequence"
    expected = "start of the publisher in unix seconds << 32 | count from 0, one more with each put"
    sequences = [envelope.sequence for envelope in envelopes]
    start, now_s = start_of(sequences[-1]), now_ns // NS
    if start == 0:
        got = f"a count alone ({sequences[-1]})"
        return wrong(name, expected, got, "put the start into the upper 32 bits: without it a restart looks old")
    if not now_s - _DECADE_S < start <= now_s + 1:
        swapped = int.from_bytes(sequences[-1].to_bytes(8, "little"), "big")
        big = now_s - _DECADE_S < start_of(swapped) <= now_s + 1
        advice = "write it little-endian" if big else "put unix seconds at the start of the publisher there"
        return wrong(name, expected, f"upper 32 bits {start}, now is {now_s}", advice)
    steps = [later - earlier for earlier, later in pairwise(sequences) if start_of(earlier) == start_of(later)]
    back, gaps = sum(step <= 0 for step in steps), sum(step > 1 for step in steps)
    if back:
        got = f"not above the one before it, {back} times of {len(steps)}"
        return wrong(name, expected, got, "count every put of this topic, in one thread; such messages are refused")
    if gaps:
        lost = sum(step - 1 for step in steps if step > 1)
        got = f"{lost} left out, in {gaps} gaps of {len(steps)} steps"
        if gaps > len(steps) // 10:
            return wrong(name, expected, got, "count the puts of this topic alone, and nothing else")
        return warning(name, expected, got, "were they never put, or lost here because this host is busy?")
    if len({start_of(sequence) for sequence in sequences}) > 1:
        return warning(name, expected, "the publisher restarted meanwhile", "let it run, and look again")
    got = f"{count_of(sequences[0])} to {count_of(sequences[-1])}, start {start}"
    return ok(name, expected, got)


def _put_time(envelopes: Sequence[Envelope], messages: Sequence[Heard], offset_ns: int) -> Check:
    name, expected = "publish time", "the host's clock just before the put, growing"
    times = [envelope.publish_time_ns for envelope in envelopes]
    lags = [heard.receive_time_ns - time for heard, time in zip(messages, times, strict=True)]
    lag_ns, now_ns = int(np.median(lags)), messages[-1].receive_time_ns
    if not -_AHEAD_NS <= lag_ns <= LATE_NS:
        got = f"{lag_ns / 1e6:.3g} ms before it arrived" if abs(lag_ns) < 3600 * NS else f"{times[-1]} ns"
        return wrong(name, expected, got, _clock_advice(times[-1], now_ns, offset_ns))
    back = sum(later <= earlier for earlier, later in pairwise(times))
    if back:
        got = f"not above the one before it, {back} times of {len(times) - 1}"
        return wrong(name, expected, got, "take it anew for every put, from a clock that never steps")
    return ok(name, expected, f"{lag_ns / 1e3:.0f} us before it arrived, in the middle of {len(times)}")


def _clock_advice(time_ns: int, now_ns: int, offset_ns: int) -> str:
    for unit, factor in _UNITS.items():
        if abs(time_ns * factor - now_ns) < 3600 * NS:
            return f"these are {unit}: give nanoseconds"
    if abs(time_ns + offset_ns - now_ns) < NS:
        return f"this is CLOCK_MONOTONIC: add the offset of this boot, {offset_ns} ns (Health.clock_offset_ns)"
    return "use CLOCK_MONOTONIC plus the offset of this boot (Health.clock_offset_ns), which all processes share"


def sent_on(messages: Iterable[Heard], key: str) -> list[Heard]:
    """Messages under one key."""
    return [heard for heard in messages if heard.key == key]


def health_check(messages: Iterable[Heard], process: str, elapsed_s: float) -> Check:
    """Whether a process says how it is: twice a second, under its role's name."""
    name, expected = "health", f"{HEALTH.at(process)} twice a second, with the counts of what was put"
    found: list[wire.Health] = []
    for heard in sent_on(messages, HEALTH.at(process)):
        try:
            found.append(wire.Health.FromString(heard.payload))
        except DecodeError:
            return wrong(name, expected, "it is no lowfc.v1.Health", "encode it with the message's declaration")
    cost = "without it a recorder cannot tell what it lost, nor a view that you are there"
    if not found:
        return warning(name, expected, f"none in {elapsed_s:.1f} s", f"publish it: {cost}")
    last = found[-1]
    if last.process != process:
        return warning(name, expected, f"process is {last.process!r}", f"name the process {process!r}, as its key does")
    rate_hz = len(found) / elapsed_s
    if elapsed_s >= 2 and not 1 < rate_hz < 10:
        return warning(name, expected, f"{rate_hz:.1f} a second", "publish it twice a second")
    if not any(count.published for count in last.topics):
        return warning(name, expected, "topics[].published is missing", f"count the puts of every topic: {cost}")
    if not from_timestamp(last.timestamp):
        return warning(name, expected, "no timestamp", "set it: who is silent is told by it")
    return ok(name, expected, f"{len(found)} in {elapsed_s:.1f} s, state {last.state!r}")


def key_check(messages: Iterable[Heard]) -> Check:
    """Whether every key that is published has a line in the table of topics."""
    name, expected = "topics", "only keys of the table of topics"
    keys = {heard.key for heard in messages}
    unknown = sorted(key for key in keys if not _known(key))
    if unknown:
        known = [topic.key for topic in TOPICS if topic is not EVENT]
        got = ", ".join(f"{key}{nearest(key, known)}" for key in unknown)
        return wrong(name, expected, got, "publish under the keys of the table; nobody hears the others")
    return ok(name, expected, f"{len(keys)} keys")


def _known(key: str) -> bool:
    try:
        return bool(topic_of(key))
    except KeyError:
        return False
