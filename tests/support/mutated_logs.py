"""Randomly damaged bytes, messages and logs, reproducible from a random generator or from the mutation's number."""

import struct
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.writer import Attachment, LogWriter
from lowfc.contract.envelope import sequence_of
from lowfc.contract.messages import EVENT, FRAME, HEALTH, STEP, SURFACE, image, timestamp, wire

START_S = 1_767_225_600  # 2026-01-01T00:00:00Z
START_NS = START_S * 10**9
METADATA = {"lowfc": {"run": "night", "seed": "3"}}
ATTACHMENTS = (
    Attachment("lowfc.toml", "application/toml", b"[loop]\n"),
    Attachment("h.fits", "application/fits", bytes(range(256)) * 8),
)
MUTATIONS = 1000
MISPLACED = ("shuffled", "repeated", "removed", "swapped", "doubled")
"""Kinds of damage that move, repeat or remove whole records; without a summary, a missing record is not detected."""


def small_samples(frames: int = 40) -> list[Sample]:
    """Messages of some topics from two starts of their publishers; surfaces, Health and events are rare."""
    rng = np.random.default_rng(1)
    samples = []
    for number in range(frames):
        now_ns = START_NS + number * 1_000_000
        start_s, count = START_S + number // (frames // 2), number % (frames // 2)
        sequence = sequence_of(start_s, count)
        picture = image(rng.integers(0, 4000, (40, 40), dtype=np.uint16), now_ns, "sensor")
        step = wire.ControlStep(timestamp=timestamp(now_ns), frame_sequence=sequence, error_nm=[1.5, -2.0])
        bodies = [(FRAME.key, picture), (STEP.key, step)]
        if number % 7 == 3:
            surface = image(rng.random((16, 16)).astype(np.float32), now_ns, "dm")
            bodies += [(SURFACE.at("dm"), surface), (HEALTH.at("camera"), wire.Health(process="camera"))]
        samples += [Sample(key, body.SerializeToString(), sequence, now_ns, now_ns + 200) for key, body in bodies]
    return [*samples, Sample(EVENT.key, b"", sequence_of(START_S, 0), START_NS + 1, START_NS + 2)]


def small_log(path: Path, *, finished: bool = True) -> Path:
    """A log of twelve chunks: 180 kB, or 156 kB if unfinished."""
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


def boundaries(data: bytes) -> list[int]:
    """Position of the first byte of each record in a log, and of the end of the last record."""
    starts = [len(MAGIC)]
    while starts[-1] + 9 <= len(data) - len(MAGIC) * data.endswith(MAGIC):  # an opcode and a length of eight bytes
        starts.append(starts[-1] + 9 + struct.unpack_from("<Q", data, starts[-1] + 1)[0])
    return starts


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Positions of the first byte and of the end of each chunk in a log."""
    starts = boundaries(data := path.read_bytes())
    return [(a, b) for a, b in pairwise(starts) if data[a] == Opcode.CHUNK]


def changed(path: Path, position: int, new: bytes) -> Path:
    """Replace bytes of a file; a negative `position` counts from its end."""
    data = bytearray(path.read_bytes())
    position %= len(data)
    assert data[position : position + len(new)] != new
    data[position : position + len(new)] = new
    path.write_bytes(data)
    return path


def flipped(path: Path, position: int, bit: int = 0) -> Path:
    """Flip a bit of the byte at `position` of a file; a negative `position` counts from its end."""
    return changed(path, position, bytes([path.read_bytes()[position] ^ 1 << bit]))


def mutated(data: bytes, number: int) -> tuple[str, bytes]:
    """Kind of damage and content of mutation `number` of a log; the content always differs from the log."""
    rng = np.random.default_rng(number)
    starts = boundaries(data)
    records = [data[a:b] for a, b in pairwise(starts)]
    indices = range(len(records))
    kinds = ("flipped", "flipped head", "cut", "zeroed", "random", "inserted", "deleted", *MISPLACED)
    kind = kinds[number % len(kinds)]
    changed = bytearray(data)
    first, second = (int(n) for n in sorted(rng.choice(len(records), 2, replace=False)))
    begin = int(rng.integers(len(data)))
    stop = min(len(data), begin + int(rng.choice([1, 4, 8, 100, 5000])))
    noise = rng.bytes(stop - begin)
    match kind:
        case "flipped":
            for _ in range(rng.integers(1, 5)):
                changed[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        case "flipped head":  # opcode, length, and header of a chunk
            at = int(rng.choice(starts[:-1])) + int(rng.integers(48))
            changed[min(at, len(data) - 1)] ^= 1 << int(rng.integers(8))
        case "cut":
            del changed[begin:]
        case "zeroed" | "random" | "inserted" | "deleted":
            new = {"zeroed": bytes(stop - begin), "random": noise, "inserted": noise + data[begin:stop], "deleted": b""}
            changed[begin:stop] = new[kind]
        case _:
            order = {
                "shuffled": rng.permutation(len(records)),
                "repeated": [*indices[: second + 1], *indices[first:]],
                "removed": [*indices[:first], *indices[second:]],
                "swapped": [*indices[:first], second, *indices[first + 1 : second], first, *indices[second + 1 :]],
                "doubled": [*indices[:first], first, *indices[first:]],
            }[kind]
            changed = bytearray(MAGIC + b"".join(records[index] for index in order) + data[starts[-1] :])
    if bytes(changed) == data:
        changed[number % len(data)] ^= 1
    return kind, bytes(changed)


ODD_BYTES = (b"", b"\0", b"\xff" * 8, b"\x80" + b"\xff" * 9, b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", b"\n")
ODD_INTS = (0, 1, 3, 127, 128, 255, 256, 65535, 65536, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 40, (1 << 64) - 1)
ODD_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 3e38, -3e38, 12.3, float("inf"), float("-inf"), float("nan"))
ODD_TEXTS = ("", "a", "dm", "mirror", "offset", "é", "\0", "x" * 5000, "../..", "{}", "%s", "status")
MAX_BYTES = 1 << 16  # longest field of bytes in a rewritten message
_BITS = {
    FieldDescriptor.CPPTYPE_INT32: 31,
    FieldDescriptor.CPPTYPE_ENUM: 31,
    FieldDescriptor.CPPTYPE_UINT32: 32,
    FieldDescriptor.CPPTYPE_INT64: 63,
    FieldDescriptor.CPPTYPE_UINT64: 64,
}
"""Bits of each integer type, without the sign."""


def damaged(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Bytes with one to eight changes: flipped, overwritten, inserted, deleted, repeated, cut off or spliced."""
    changed = bytearray(data)
    for _ in range(1 << rng.randrange(4)):
        at = rng.randrange(len(changed) + 1)
        match rng.randrange(8):
            case 0 if changed:
                changed[at % len(changed)] ^= 1 << rng.randrange(8)
            case 1:
                changed[at : at + rng.randrange(9)] = rng.choice(ODD_BYTES)
            case 2:
                changed[at:at] = rng.randbytes(rng.randrange(1, 17))
            case 3:
                del changed[at : at + rng.randrange(1, 65)]
            case 4:
                del changed[at:]
            case 5:
                other = rng.choice(others)
                changed[at:] = other[rng.randrange(len(other) + 1) :]
            case 6:
                changed[at:at] = changed[at : at + rng.randrange(1, 257)]
            case _:
                number = rng.choice(ODD_INTS)
                changed[at : at + 8] = struct.pack("<Q", number)
    return bytes(changed)


def rewritten(message: Message, rng: Random) -> bytes:
    """A valid message with extreme values in some of its fields."""
    for _ in range(1 << rng.randrange(3)):
        _alter(message, rng, 3)
    return message.SerializeToString()


def _alter(message: Message, rng: Random, depth: int) -> None:
    field = rng.choice(message.DESCRIPTOR.fields)
    inner = getattr(message, field.name)
    if rng.random() < 0.1:
        message.ClearField(field.name)
    elif field.type == FieldDescriptor.TYPE_MESSAGE:
        if depth and field.is_repeated:
            _alter(inner.add() if not inner or rng.random() < 0.3 else rng.choice(inner), rng, depth - 1)
        elif depth:
            inner.SetInParent()
            _alter(inner, rng, depth - 1)
    elif field.is_repeated:
        del inner[:]
        inner.extend(_odd(field, rng) for _ in range(rng.choice((0, 1, 2, 3, 14, 100))))
    elif field.type == FieldDescriptor.TYPE_BYTES:
        before = bytes(inner) or b"\0" * 64
        setattr(message, field.name, damaged(before, [before, *ODD_BYTES], rng)[:MAX_BYTES])
    else:
        setattr(message, field.name, _odd(field, rng))


def _odd(field: FieldDescriptor, rng: Random) -> object:
    if field.type == FieldDescriptor.TYPE_BYTES:
        return rng.randbytes(rng.randrange(65))
    match field.cpp_type:
        case FieldDescriptor.CPPTYPE_FLOAT | FieldDescriptor.CPPTYPE_DOUBLE:
            return rng.choice(ODD_FLOATS)
        case FieldDescriptor.CPPTYPE_BOOL:
            return rng.random() < 0.5
        case FieldDescriptor.CPPTYPE_STRING:
            return rng.choice(ODD_TEXTS)
    value = rng.choice(ODD_INTS) % (1 << _BITS[field.cpp_type])
    signed = field.cpp_type in (FieldDescriptor.CPPTYPE_INT32, FieldDescriptor.CPPTYPE_INT64)
    return -value if signed and rng.random() < 0.5 else value
