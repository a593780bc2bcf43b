"""Differences of two messages of one kind, field by field."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from lowfc.arrays import Array

_FLOAT32_FIELD = "actuators"
"""Field whose bytes hold little-endian float32, nm. In the repeated message `channels` it is compared exactly."""
_IN_NM = ("_nm", "actuators", "law_state")
"""Endings of the names of fields in nm; the state of a user's linear law, whatever its unit, is treated like nm."""
_MAX_SHOWN = 4


@dataclass(slots=True)
class Difference:
    """Difference between a logged message and the replayed one.

    Attributes:
        message: message type, such as ControlStep.
        taken: input number of the message.
        frame_sequence: sequence of the newest frame at this input.
        fields: one sentence for each field that differs.
        largest_nm: largest difference of a number in nm.
        otherwise: whether anything other than numbers in nm differs; then no tolerance applies.
    """

    message: str
    taken: int
    frame_sequence: int
    fields: list[str] = field(default_factory=list)
    largest_nm: float = 0.0
    otherwise: bool = False

    def within(self, tolerance_nm: float) -> bool:
        """Whether only numbers in nm differ, by no more than a tolerance; False without tolerance (0)."""
        return tolerance_nm > 0 and not self.otherwise and self.largest_nm <= tolerance_nm


def difference(input_number: int, frame_sequence: int, logged: Message, replayed: Message | None) -> Difference:
    """Compare a message of the log with the replayed message; `replayed` is None if the replay sent nothing."""
    found = Difference(logged.DESCRIPTOR.name, input_number, frame_sequence)
    if replayed is None:
        found.fields.append("the replay sends no such message")
        found.otherwise = True
    else:
        _compare(found, "", logged, replayed)
        if not found.fields:
            found.fields.append(
                "the bytes differ, but no value does: the sign of a zero, an empty part, or a field of another version"
            )
    return found


def _compare(found: Difference, prefix: str, logged: Message, replayed: Message) -> None:
    for descriptor in logged.DESCRIPTOR.fields:
        name = descriptor.name
        was, now = getattr(logged, name), getattr(replayed, name)
        before, after = _numbers(descriptor, was), _numbers(descriptor, now)
        if was == now or (before is not None and after is not None and np.array_equal(before, after, equal_nan=True)):
            continue
        if descriptor.type == FieldDescriptor.TYPE_MESSAGE and not descriptor.is_repeated:
            _compare(found, f"{prefix}{name}.", was, now)
            continue
        if before is None or after is None or before.shape != after.shape or not name.endswith(_IN_NM):
            found.fields.append(f"{prefix}{name}: log {_short(was)}, replay {_short(now)}")
            found.otherwise = True
            continue
        difference_nm = np.abs(after - before)
        indices = np.flatnonzero(difference_nm)
        shown = ", ".join(f"[{i}] log {before[i]:.9g}, replay {after[i]:.9g}" for i in indices[:_MAX_SHOWN])
        more = f" and {len(indices) - _MAX_SHOWN} more" if len(indices) > _MAX_SHOWN else ""
        found.fields.append(f"{prefix}{name}: {shown}{more}; largest difference {difference_nm.max():.3g} nm")
        found.largest_nm = max(found.largest_nm, float(difference_nm.max()))


def _numbers(descriptor: Any, value: Any) -> Array | None:
    """Numbers of a field as an array; None if it has no numbers or they are not finite."""
    found = None
    if descriptor.name == _FLOAT32_FIELD:
        found = np.frombuffer(value, "<f4").astype(float) if len(value) % 4 == 0 else None
    elif descriptor.type in (FieldDescriptor.TYPE_FLOAT, FieldDescriptor.TYPE_DOUBLE):
        found = np.atleast_1d(np.array(value, float))
    return found if found is not None and np.isfinite(found).all() else None


def _short(value: object) -> str:
    text = " ".join(str(value).split()) or "nothing"
    return text if len(text) <= 80 else text[:77] + "..."
