"""The 16-byte attachment of every message: its sequence and publication time."""

import struct
from typing import NamedTuple

from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import LATEST_NS, SEQUENCE_BOUND
from lowfc.control.loop.inputs import COUNT_BITS

__all__ = ["COUNT_BITS", "Envelope", "count_of", "sequence_of", "start_of"]

_LAYOUT = struct.Struct("<QQ")
_COUNT_MASK = (1 << COUNT_BITS) - 1


class Envelope(NamedTuple):
    """Identity and time of one message.

    Attributes:
        sequence: the publisher's start in unix seconds << 32 | its count on this topic, from 0.
        publish_time_ns: time just before the put, nanoseconds since the epoch on the host's clock.
    """

    sequence: int
    publish_time_ns: int

    def encode(self) -> bytes:
        """Two little-endian unsigned 64-bit numbers: sequence, publish_time_ns."""
        return _LAYOUT.pack(self.sequence, self.publish_time_ns)

    @classmethod
    def decode(cls, data: bytes) -> "Envelope":
        """Decode 16 bytes without a check of the numbers; BadMessageError if `data` has another length."""
        if len(data) != _LAYOUT.size:
            raise BadMessageError(
                f"an envelope is {_LAYOUT.size} bytes (sequence and publish_time_ns, little-endian uint64), "
                f"got {len(data)}; attach one to every message"
            )
        return cls(*_LAYOUT.unpack(data))

    @classmethod
    def decode_checked(cls, data: bytes) -> tuple[int, int]:
        """Sequence and publication time of a received envelope; faster than `decode`.

        BadMessageError as for `decode`, and if the sequence is not below 2^64 - 2^33 or the time is above 2^62 ns.
        """
        sequence, publish_time_ns = _LAYOUT.unpack(data) if len(data) == _LAYOUT.size else cls.decode(data)
        if sequence >= SEQUENCE_BOUND or publish_time_ns > LATEST_NS:
            raise BadMessageError(
                f"an envelope's sequence is below 2^64 - 2^33 and its time at most 2^62 ns, got {sequence} and "
                f"{publish_time_ns} ns; the sequence is the publisher's start in unix seconds << 32 | its count"
            )
        return sequence, publish_time_ns


def sequence_of(start_s: int, count: int) -> int:
    """Sequence of message number `count` of a publisher that started at `start_s` (unix seconds).

    A count of 2^32, reached after 50 days at 1 kHz, carries into the start: sequences go on growing.
    """
    return (start_s << COUNT_BITS) + count


def start_of(sequence: int) -> int:
    """Start of the publisher, unix seconds; it grows with a restart, and by 1 with each 2^32 messages."""
    return sequence >> COUNT_BITS


def count_of(sequence: int) -> int:
    """Count of the message on this topic since its publisher started, from 0."""
    return sequence & _COUNT_MASK
