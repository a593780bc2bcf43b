"""Bytes and messages damaged at random, each from a generator that is passed in."""

import struct
from collections.abc import Sequence
from random import Random

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

ODD_BYTES = (
    b"",
    b"\0",
    b"\xff" * 8,
    b"\x7f" * 4,
    b"\x80" + b"\xff" * 9,
    b"\x00\x00\xc0\x7f",
    b"\x00\x00\x80\x7f",
    b"\n",
)
ODD_WHOLE = (
    0,
    1,
    2,
    3,
    127,
    128,
    255,
    256,
    65535,
    65536,
    (1 << 31) - 1,
    1 << 31,
    (1 << 32) - 1,
    1 << 40,
    (1 << 64) - 1,
)
ODD_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e38, -1e38, 1e308, float("inf"), float("-inf"), float("nan"))
MOST_BYTES = 1 << 16


def damaged(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Bytes with one to eight changes: flipped, overwritten, cut, repeated, spliced with another input."""
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
                number = rng.choice(ODD_WHOLE)
                changed[at : at + 8] = struct.pack("<Q", number)
    return bytes(changed)


def rewritten(message: Message, rng: Random) -> bytes:
    """A message that is whole, with odd values in some of its fields."""
    for _ in range(1 << rng.randrange(3)):
        _alter(message, rng, 3)
    return message.SerializeToString()


def _alter(message: Message, rng: Random, depth: int) -> None:
    field = rng.choice(message.DESCRIPTOR.fields)
    many = field.is_repeated
    if rng.random() < 0.1:
        message.ClearField(field.name)
    elif field.type == FieldDescriptor.TYPE_MESSAGE:
        if not depth:
            return
        if many:
            inner = getattr(message, field.name)
            _alter(inner.add() if not inner or rng.random() < 0.3 else rng.choice(inner), rng, depth - 1)
        else:
            inner = getattr(message, field.name)
            inner.SetInParent()
            _alter(inner, rng, depth - 1)
    elif many:
        values = [_odd(field, rng) for _ in range(rng.choice((0, 1, 2, 3, 14, 100)))]
        del getattr(message, field.name)[:]
        getattr(message, field.name).extend(values)
    elif field.type == FieldDescriptor.TYPE_BYTES:
        before = bytes(getattr(message, field.name)) or b"\0" * 64
        setattr(message, field.name, damaged(before, [before, *ODD_BYTES], rng)[:MOST_BYTES])
    else:
        setattr(message, field.name, _odd(field, rng))


def _odd(field: FieldDescriptor, rng: Random) -> object:
    match field.cpp_type:
        case FieldDescriptor.CPPTYPE_FLOAT | FieldDescriptor.CPPTYPE_DOUBLE:
            value = rng.choice((*ODD_FLOATS, rng.gauss(0, 100)))
            return value if field.cpp_type == FieldDescriptor.CPPTYPE_DOUBLE else max(min(value, 3e38), -3e38)
        case FieldDescriptor.CPPTYPE_BOOL:
            return rng.random() < 0.5
        case FieldDescriptor.CPPTYPE_STRING:
            if field.type == FieldDescriptor.TYPE_BYTES:
                return rng.randbytes(rng.randrange(65))
            return rng.choice(("", "a", "dm", "mirror", "offset", "é", "\0", "x" * 5000, "../..", "{}", "%s", "status"))
    bits = 32 if field.cpp_type in (FieldDescriptor.CPPTYPE_INT32, FieldDescriptor.CPPTYPE_UINT32) else 64
    whole = rng.choice(ODD_WHOLE) % (1 << bits)
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return whole % (1 << 31)
    if field.cpp_type in (FieldDescriptor.CPPTYPE_INT32, FieldDescriptor.CPPTYPE_INT64):
        return whole - (1 << bits) if whole >> (bits - 1) else whole
    return whole
