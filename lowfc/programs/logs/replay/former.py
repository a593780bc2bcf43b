"""Logs of other versions: the fields to compare, and the controller's rules that were changed on purpose since then."""

import contextlib
from collections.abc import Mapping
from typing import TypeVar

from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError, Message
from mcap.records import Schema

from lowfc.contract.messages import wire

M = TypeVar("M", bound=Message)

CAMERA_RULE = "the camera's settings are compared with the calibration's, instead of the bias with the dark frame"
CHANNEL_RULE = "only a channel that exists is removed"
CLOSE_RULE = "the loop is not closed while frames are refused, or on a camera that does not fit the calibration"
CLEAR_RULE = "clear forgets the newest frame sequence"
GAIN_RULE = "gain and leak of a mode are checked together, and only controlled modes have automatic gains"
LOAD_RULE = "loading a calibration adopts no shape in safe mode, and no shape of a running probe sequence"

_REQUEST_RULES = {
    **dict.fromkeys(("close", "step", "law"), CLOSE_RULE),
    **dict.fromkeys(("gain", "leak"), GAIN_RULE),
    "channel": CHANNEL_RULE,
    "clear": CLEAR_RULE,
    "load": LOAD_RULE,
}
# Not compared: the inputs that a request contains, and the wording of its reply, which may change.
_NOT_COMPARED = {"lowfc.v1.Request": ("reply", "law", "table", "columns", "actuators", "calibration", "play_id")}


def changed_rule(logged: Message | None) -> str:
    """The present rule for an input, if former versions had another one; otherwise empty."""
    if isinstance(logged, wire.Request) and logged.accepted:
        return _REQUEST_RULES.get(logged.name, "")
    if isinstance(logged, wire.ControlInput) and logged.HasField("camera"):
        return CAMERA_RULE
    return ""


class FormerVersion:
    """Fields of the messages of a former version, by number, as declared in its log."""

    def __init__(self, schemas: Mapping[int, Schema]) -> None:
        """Read the fields from the log's `schemas`, by number; the reader adds schemas while it reads the log."""
        self._schemas = schemas
        self._read: set[int] = set()
        self._fields: dict[str, set[int]] = {}

    def _declared_fields(self, name: str) -> set[int] | None:
        """Numbers of the fields of a message; None if the log does not declare it."""
        if name in self._fields:
            return self._fields[name]
        for number in self._schemas.keys() - self._read:
            self._read.add(number)
            with contextlib.suppress(DecodeError):
                for file in FileDescriptorSet.FromString(self._schemas[number].data).file:
                    for message in file.message_type:
                        self._declare(f"{file.package}.{message.name}", message)
        return self._fields.get(name)

    def _declare(self, name: str, message: DescriptorProto) -> None:
        self._fields[name] = {field.number for field in message.field}
        for nested in message.nested_type:
            self._declare(f"{name}.{nested.name}", nested)

    def compared(self, message: M) -> M:
        """A copy of a message with only the fields to compare."""
        copy = type(message)()
        copy.CopyFrom(message)
        self._prune(copy)
        return copy

    def _prune(self, message: Message) -> None:
        descriptor = message.DESCRIPTOR
        declared = self._declared_fields(descriptor.full_name)
        for field, value in message.ListFields():
            ignored = field.name in _NOT_COMPARED.get(descriptor.full_name, ())
            if ignored or (declared is not None and field.number not in declared):
                message.ClearField(field.name)
            elif field.message_type is not None:
                for nested in value if field.is_repeated else (value,):
                    self._prune(nested)
