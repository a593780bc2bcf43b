"""Checks of every publisher: envelope, sequence, publish time, Health, keys."""

from itertools import pairwise

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import nearest
from lowfc.contract.messages import EVENT, HEALTH, TOPICS, from_timestamp, wire
from lowfc.control.loop.wording import counted
from lowfc.programs.commissioning.checks import Check, Table, ok, warning, wrong
from lowfc.programs.commissioning.conformance.connection import NS_PER_S, CollectedMessages

LATE_NS = 20_000_000
"""Clock difference above which, by default, every frame of a camera of 100 Hz or more is refused as late."""

_MAX_EARLY_NS = 1_000_000  # largest time by which a message may seem to arrive before it was published
_DECADE_S = 10 * 365 * 86_400
_UNITS = {"microseconds": 1_000, "milliseconds": 1_000_000, "seconds": NS_PER_S}

PUBLISHER: Table[CollectedMessages] = Table()
"""Checks of the messages of the main topic."""
PROCESS: Table[CollectedMessages] = Table()
"""Checks of everything that the device publishes."""


@PUBLISHER.check("envelope", "a zenoh attachment of 16 bytes: sequence and publish_time_ns, little-endian uint64")
def _envelope(device: CollectedMessages) -> Check | None:
    messages = device.published
    invalid = [message.attachment for message in messages if message.envelope is None]
    if not invalid:
        return ok(f"on all of {len(messages)} messages") if messages else None
    sizes = sorted({"none" if attachment is None else f"{len(attachment)} bytes" for attachment in invalid})
    got = f"attachment of {len(invalid)} of {len(messages)} messages: {', '.join(sizes)}"
    return wrong(got, "attach it to every message; its bytes are in docs/reference/device_messages.md")


@PUBLISHER.check("sequence", "start of the publisher in unix seconds << 32 | count of its messages from 0")
def _sequence(device: CollectedMessages) -> Check | None:
    sequences = [envelope.sequence for envelope in device.envelopes]
    if not sequences:
        return None
    start, now_s = start_of(sequences[-1]), device.published[-1].receive_time_ns // NS_PER_S
    if start == 0:
        advice = "put the start into the upper 32 bits: without it messages after a restart are refused as old"
        return wrong(f"only a count ({sequences[-1]})", advice)
    if not now_s - _DECADE_S < start <= now_s + 1:
        swapped = int.from_bytes(sequences[-1].to_bytes(8, "little"), "big")
        big_endian = now_s - _DECADE_S < start_of(swapped) <= now_s + 1
        advice = "write it little-endian" if big_endian else "put the unix seconds of the publisher's start there"
        return wrong(f"upper 32 bits {start}, present time {now_s}", advice)
    steps = [later - earlier for earlier, later in pairwise(sequences) if start_of(earlier) == start_of(later)]
    not_above, gaps = sum(step <= 0 for step in steps), [step - 1 for step in steps if step > 1]
    if not_above:
        got = f"{not_above} of {len(steps)} not above the previous one"
        return wrong(got, "count every message of this topic, in one thread; such messages are refused")
    if gaps:
        got = f"{sum(gaps)} missing, in {counted(len(gaps), 'gap')} among {len(sequences)} messages"
        if len(gaps) > len(steps) // 10:
            advice = "count only the messages of this topic; if FRAMES_LOST reports lost frames, find their cause"
            return wrong(got, advice)
        return warning(got, "were they never published, or lost because this host is busy?")
    if len({start_of(sequence) for sequence in sequences}) > 1:
        return warning("the publisher restarted during the check", "repeat the check while it runs")
    return ok(f"{count_of(sequences[0])} to {count_of(sequences[-1])}, start {start}")


@PUBLISHER.check("publish time", "the host's clock just before publishing, increasing")
def _publish_time(device: CollectedMessages) -> Check | None:
    times = [envelope.publish_time_ns for envelope in device.envelopes]
    if not times:
        return None
    arrivals = [message.receive_time_ns for message in device.published]
    lag_ns = int(np.median([arrival - time for arrival, time in zip(arrivals, times, strict=True)]))
    if not -_MAX_EARLY_NS <= lag_ns <= LATE_NS:
        side = "before" if lag_ns > 0 else "after"
        got = f"{abs(lag_ns) / 1e6:.3g} ms {side} the arrival" if abs(lag_ns) < 3600 * NS_PER_S else f"{times[-1]} ns"
        return wrong(got, _clock_advice(times[-1], arrivals[-1], device.connection.offset_ns))
    not_later = sum(later <= earlier for earlier, later in pairwise(times))
    if not_later:
        got = f"{not_later} of {len(times) - 1} not later than the previous one"
        return wrong(got, "read the time for every message, from a clock that never steps")
    return ok(f"{lag_ns / 1e3:.0f} us before the arrival, median of {len(times)}")


def _clock_advice(time_ns: int, now_ns: int, offset_ns: int) -> str:
    for unit, factor in _UNITS.items():
        if abs(time_ns * factor - now_ns) < 3600 * NS_PER_S:
            return f"the unit is {unit}: use nanoseconds"
    if abs(time_ns + offset_ns - now_ns) < NS_PER_S:
        return f"this is CLOCK_MONOTONIC: add the offset of this boot, {offset_ns} ns (Health.clock_offset_ns)"
    return "use CLOCK_MONOTONIC plus the offset of this boot (Health.clock_offset_ns), which all processes share"


@PROCESS.check("health", f"{HEALTH.key} twice a second, with the counts of published messages")
def _health(device: CollectedMessages) -> Check:
    payloads = [message.payload for message in device.on(HEALTH.at(device.process))]
    cost = "without it a recorder cannot count lost messages, and views do not show the process"
    if not payloads:
        return warning(f"none of {device.process} in {device.seconds:.1f} s", f"publish it: {cost}")
    try:
        healths = [wire.Health.FromString(payload) for payload in payloads]
    except DecodeError:
        return wrong("it is not a lowfc.v1.Health", "encode the message as declared")
    first, last, rate_hz = healths[0], healths[-1], len(payloads) / device.seconds
    if last.process != device.process:
        return warning(f"process is {last.process!r}", f"name the process '{device.process}', as its key does")
    if device.seconds >= 2 and not 1 < rate_hz < 10:
        return warning(f"{rate_hz:.1f} a second", "publish it twice a second")
    if not any(count.published for count in last.topics):
        return warning("topics[].published is missing", f"count the messages of every topic: {cost}")
    if not from_timestamp(last.timestamp):
        return warning("no timestamp", "set it: a silent process is recognised by it")
    if last.driver_failures > first.driver_failures:
        failures = counted(last.driver_failures - first.driver_failures, "failure")
        return warning(
            f"{failures} of its driver: {device.driver_failure}", "correct this first: it may make other checks fail"
        )
    return ok(f"{len(payloads)} in {device.seconds:.1f} s, state {last.state!r}")


@PROCESS.check("topics", "only keys of the table of topics")
def _topics(device: CollectedMessages) -> Check:
    keys = {message.key for message in device.messages}
    unknown = sorted(key for key in keys if not any(topic.matches(key) for topic in TOPICS))
    if not unknown:
        return ok(f"{len(keys)} keys")
    candidates = [topic.key for topic in TOPICS if topic is not EVENT]  # EVENT's short key resembles many others
    got = ", ".join(f"{key}{nearest(key, candidates)}" for key in unknown)
    return wrong(got, "publish under the keys of the table; no process subscribes to others")
