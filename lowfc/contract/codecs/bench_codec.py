"""Encode and decode bench values and interlocks."""

from math import isfinite

from google.protobuf.message import DecodeError

from lowfc.contract.errors import BadMessageError, raised_as
from lowfc.contract.messages import checked_time_ns, from_timestamp, timestamp, wire
from lowfc.control.loop.interlocks import MAX_TEXT_LENGTH, Action, BenchReport, Interlock, Value

MAX_BYTES = 4 * MAX_TEXT_LENGTH + 200
"""Largest size of a bench value: a text of up to four bytes per character, and the other fields."""


def encode_bench_value(value: Value, time_ns: int) -> bytes:
    """BenchValue of a value measured at this time; BadMessageError if the value is invalid."""
    message = wire_value(value)
    _checked(message)
    message.timestamp.CopyFrom(timestamp(time_ns))
    return message.SerializeToString()


def decode_bench_value(payload: bytes) -> Value:
    """Value of a received BenchValue; BadMessageError if it cannot be read or is invalid."""
    if len(payload) > MAX_BYTES:
        raise BadMessageError(f"a bench value has at most {MAX_BYTES} bytes, got {len(payload)}")
    with raised_as(BadMessageError, DecodeError):
        message = wire.BenchValue.FromString(payload)
    checked_time_ns(message.timestamp)
    return _checked(message)


def wire_value(value: Value) -> wire.BenchValue:
    """Message of a value, without a time."""
    if isinstance(value, bool):
        return wire.BenchValue(truth=value)
    return wire.BenchValue(text=value) if isinstance(value, str) else wire.BenchValue(number=value)


def value_of(message: wire.BenchValue) -> Value:
    """Value of a message; ValueError if it has none, a number that is not finite, or too long a text."""
    match message.WhichOneof("value"):
        case "number" if isfinite(message.number):
            return message.number
        case "truth":
            return message.truth
        case "text" if len(message.text) <= MAX_TEXT_LENGTH:
            return message.text
    raise ValueError(
        f"a bench value is a finite number, true or false, or a text of at most {MAX_TEXT_LENGTH} characters"
    )


def _checked(message: wire.BenchValue) -> Value:
    with raised_as(BadMessageError, ValueError):
        return value_of(message)


def wire_report(report: BenchReport) -> wire.BenchReport:
    """Message of a report on a bench value."""
    value = None if report.value is None else wire_value(report.value)
    return wire.BenchReport(timestamp=timestamp(report.time_ns), name=report.name, value=value, age_ns=report.age_ns)


def report_of(message: wire.BenchReport) -> BenchReport:
    """Report of a message; ValueError if its value is invalid."""
    value = value_of(message.value) if message.HasField("value") else None
    return BenchReport(from_timestamp(message.timestamp), message.name, value, message.age_ns)


def wire_interlock(interlock: Interlock) -> wire.Interlock:
    """Message of an interlock."""
    return wire.Interlock(**interlock._asdict() | {"value": wire_value(interlock.value)})


def interlock_of(message: wire.Interlock) -> Interlock:
    """Interlock of a message; ValueError if it has no valid value or its action is unknown."""
    value, action = value_of(message.value), Action(message.action)
    return Interlock(message.name, message.test, value, action, message.max_age_ns, message.acts_when_old)
