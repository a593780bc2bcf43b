"""A small log as the recorder writes it, and a thousand ways to damage it, each made from its number alone."""

import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from mcap.writer import MCAP0_MAGIC as MAGIC

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.reader import Logged
from lowfc.adapters.logs.writer import Attachment, LogWriter
from lowfc.contract.envelope import sequence_of
from lowfc.contract.messages import EVENT, FRAME, HEALTH, STEP, SURFACE, image, timestamp, wire

START_S = 1_767_225_600
START_NS = START_S * 10**9
METADATA = {"lowfc": {"run": "night", "seed": "3"}}
ATTACHMENTS = (
    Attachment("lowfc.toml", "application/toml", b"[loop]\n"),
    Attachment("h.fits", "application/fits", bytes(range(256)) * 8),
)
MUTATIONS = 1000
MISPLACED = ("shuffled", "repeated", "removed", "swapped", "doubled")
"""Damage to a log by moving whole records; without a summary nothing can tell that one is gone."""


def small_samples(frames: int = 40) -> list[Sample]:
    """Messages of some topics, of two starts of their publishers; the surface and the events are rare."""
    rng = np.random.default_rng(1)
    made = []
    for number in range(frames):
        now = START_NS + number * 1_000_000
        start_s, count = START_S + number // (frames // 2), number % (frames // 2)
        sequence = sequence_of(start_s, count)
        picture = image(rng.integers(0, 4000, (40, 40), dtype=np.uint16), now, "sensor")
        step = wire.ControlStep(timestamp=timestamp(now), frame_sequence=sequence, error_nm=[1.5, -2.0])
        bodies = [(FRAME.key, picture), (STEP.key, step)]
        if number % 7 == 3:
            surface = image(rng.random((16, 16)).astype(np.float32), now, "dm")
            bodies += [(SURFACE.at("dm"), surface), (HEALTH.at("camera"), wire.Health(process="camera"))]
        made += [Sample(key, m.SerializeToString(), sequence, now, now + 200) for key, m in bodies]
    return [*made, Sample(EVENT.key, b"", sequence_of(START_S, 0), START_NS + 1, START_NS + 2)]


def small_log(path: Path, *, finished: bool = True) -> Path:
    """A log of about 130 kB in twelve chunks."""
    log = LogWriter(path, START_NS, METADATA, ATTACHMENTS)
    for number, sample in enumerate(small_samples()):
        log.write(sample)
        if number % 8 == 7:
            log.flush()
    if finished:
        return log.finish({"recording": {"messages": str(log.messages)}})
    log.flush()
    log.abandon()
    return log.part


def identity(messages: list[Logged] | list[Sample]) -> list[tuple[str, bytes, int, int, int]]:
    """What a message is, as it was sent or as it was read."""
    return [
        (m.key, m.payload, m.sequence, m.publish_time_ns, m.log_time_ns if isinstance(m, Logged) else m.receive_time_ns)
        for m in messages
    ]


def boundaries(data: bytes) -> list[int]:
    """Where the records of a log begin, and where the last one ends."""
    found = [len(MAGIC)]
    while found[-1] + 9 <= len(data) - len(MAGIC) * data.endswith(MAGIC):
        found.append(found[-1] + 9 + struct.unpack_from("<Q", data, found[-1] + 1)[0])
    return found


def mutated(data: bytes, number: int) -> tuple[str, bytes]:
    """Mutation `number` of a log, and what kind of damage it is; never the log itself."""
    rng = np.random.default_rng(number)
    starts = boundaries(data)
    records = [data[a:b] for a, b in pairwise(starts)]
    end = data[starts[-1] :]

    def span() -> tuple[int, int]:
        begin = int(rng.integers(len(data)))
        return begin, min(len(data), begin + int(rng.choice([1, 4, 8, 100, 5000])))

    kinds = ("flipped", "flipped head", "cut", "zeroed", "random", "inserted", "deleted", *MISPLACED)
    kind = kinds[number % len(kinds)]
    changed = bytearray(data)
    first, second = (int(n) for n in sorted(rng.choice(len(records), 2, replace=False)))
    match kind:
        case "flipped":
            for _ in range(rng.integers(1, 5)):
                changed[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        case "flipped head":  # opcode, length, and what a chunk says of itself
            at = int(rng.choice(starts[:-1])) + int(rng.integers(48))
            changed[min(at, len(data) - 1)] ^= 1 << int(rng.integers(8))
        case "cut":
            del changed[rng.integers(len(data)) :]
        case "zeroed" | "random":
            begin, stop = span()
            changed[begin:stop] = bytes(stop - begin) if kind == "zeroed" else rng.bytes(stop - begin)
        case "inserted":
            begin, stop = span()
            changed[begin:begin] = rng.bytes(stop - begin)
        case "deleted":
            begin, stop = span()
            del changed[begin:stop]
        case "shuffled":
            order = rng.permutation(len(records))
            changed = bytearray(MAGIC + b"".join(records[n] for n in order) + end)
        case "repeated":
            changed = bytearray(MAGIC + b"".join([*records[: second + 1], *records[first:]]) + end)
        case "removed":
            changed = bytearray(MAGIC + b"".join([*records[:first], *records[second:]]) + end)
        case "swapped":
            records[first], records[second] = records[second], records[first]
            changed = bytearray(MAGIC + b"".join(records) + end)
        case "doubled":
            changed = bytearray(MAGIC + b"".join([*records[:first], records[first], *records[first:]]) + end)
    if bytes(changed) == data:
        changed[number % len(data)] ^= 1
    return kind, bytes(changed)


def mutations(data: bytes, numbers: range) -> Iterator[tuple[int, str, bytes]]:
    """Number, kind and bytes of each."""
    for number in numbers:
        yield number, *mutated(data, number)
