"""What a camera says of itself, and whether its frames agree."""

from collections.abc import Iterator, Sequence
from math import isfinite
from typing import Protocol

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.contract.messages import CAMERA_STATE, from_timestamp, wire
from lowfc.programs.conformance.checks import Check, Heard, envelope_of, ok, warning, wrong

_FIELDS = tuple(field.name for field in wire.CameraState.DESCRIPTOR.fields if field.name != "timestamp")
_MOST_BITS = 16


class Seen(Protocol):
    """What of a frame the settings are held against."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ...

    @property
    def time_ns(self) -> int:
        """End of the exposure."""
        ...

    @property
    def highest(self) -> int | None:
        """Brightest pixel, DN."""
        ...


def settings_checks(
    states: Sequence[wire.CameraState | None], answers: Sequence[Heard], frames: Sequence[Seen], seconds: float
) -> Iterator[Check]:
    """Check the camera's settings: there, possible, unchanged, those of its frames, and told to who asks.

    Args:
        states: as they came; None for one that could not be read.
        answers: to who asks for the last one.
        frames: during the same time.
        seconds: how long that was.
    """
    expected = f"{CAMERA_STATE.key}: lowfc.v1.CameraState on change and twice a second"
    good = [state for state in states if state is not None]
    if len(good) < len(states):
        got = f"{len(states) - len(good)} of {len(states)} are no lowfc.v1.CameraState"
        yield wrong("settings", expected, got, "encode the message with its declaration")
    elif not good:
        advice = "publish it: calibration, noise and the guard against a changed camera go by it"
        yield wrong("settings", expected, f"none in {seconds:g} s", advice)
        return
    elif seconds >= 2 and not 1 < len(good) / seconds < 20:
        yield warning("settings", expected, f"{len(good) / seconds:.1f} a second", "publish them twice a second")
    else:
        yield ok("settings", expected, f"{len(good)} in {seconds:g} s")
    if good:
        yield _possible(good[-1])
        yield _unchanged(good)
        yield from _those_of_the_frames(good[-1], frames)
    yield _asked(answers)


def _possible(state: wire.CameraState) -> Check:
    """Values that a camera can have."""
    name, expected = "settings' values", "a timestamp; period, gain, saturation, rows, columns and bit depth above 0"
    values = {field: float(getattr(state, field)) for field in _FIELDS}
    impossible = [f"{field} {value:g}" for field, value in values.items() if not isfinite(value) or value < 0]
    needed = ("exposure_ns", "period_ns", "gain_e_per_dn", "saturation_dn", "rows", "columns", "bit_depth")
    impossible += [f"{field} 0" for field in needed if values[field] == 0]
    if not from_timestamp(state.timestamp):
        impossible.append("no timestamp")
    if state.bit_depth > _MOST_BITS:
        impossible.append(f"bit_depth {state.bit_depth}, and pixels of {_MOST_BITS} bits")
    elif state.bit_depth > 0 and state.saturation_dn > 2**state.bit_depth - 1:
        impossible.append(
            f"saturation_dn {state.saturation_dn:g} above {2**state.bit_depth - 1}, the converter's highest"
        )
    if 0 < state.saturation_dn <= state.bias_dn:
        impossible.append(f"bias_dn {state.bias_dn:g} not below saturation_dn {state.saturation_dn:g}")
    if impossible:
        return wrong(name, expected, ", ".join(impossible), "say what the camera is set to; units are in the names")
    if state.em_gain < 1:
        return warning(name, expected, f"em_gain {state.em_gain:g}", "1 is a detector without multiplication")
    if state.exposure_ns > state.period_ns:
        got = f"exposure {state.exposure_ns / 1e6:g} ms, period {state.period_ns / 1e6:g} ms"
        return warning(name, expected, got, "an exposure longer than the period sees two mirror shapes")
    got = f"exposure {state.exposure_ns / 1e6:g} of {state.period_ns / 1e6:g} ms, saturation {state.saturation_dn:g} DN"
    return ok(name, expected, got)


def _unchanged(states: Sequence[wire.CameraState]) -> Check:
    name, expected = "settings kept", "the same all the time: a change opens the loop"
    changed = [field for field in _FIELDS if len({str(getattr(state, field)) for state in states}) > 1]
    if changed:
        got = f"{', '.join(changed)} changed"
        return warning(name, expected, got, "was that wanted? Publish what is set, not what is measured")
    return ok(name, expected, f"{len(states)} alike")


def _those_of_the_frames(state: wire.CameraState, frames: Sequence[Seen]) -> Iterator[Check]:
    if not frames:
        return
    said, shapes = (state.rows, state.columns), sorted({frame.shape for frame in frames})
    got = f"{said[0]} x {said[1]}, frames {', '.join(f'{rows} x {columns}' for rows, columns in shapes)}"
    if shapes != [said]:
        advice = "exchange rows and columns" if shapes == [said[::-1]] else "say the size of the region that is sent"
        yield wrong("settings' size", "rows and columns of the frames", got, advice)
    else:
        yield ok("settings' size", "rows and columns of the frames", got)
    highest = max(frame.highest or 0 for frame in frames)
    top = min(state.saturation_dn, 2.0**state.bit_depth - 1)
    expected, got = "no pixel above saturation_dn and the converter", f"brightest {highest} DN, highest {top:g} DN"
    if highest > top > 0:
        advice = "raise saturation_dn to what pixels reach, or bit_depth; in DN, bias included"
        yield wrong("settings' range", expected, got, advice)
    else:
        yield ok("settings' range", expected, got)
    spans = np.diff([frame.time_ns for frame in frames])
    period_ns = float(np.median(spans)) if spans.size else 0.0
    if period_ns > 0 and state.period_ns:
        off = period_ns / state.period_ns - 1
        expected = "period_ns is what is between two frames' times"
        got = f"{period_ns / 1e6:.5g} ms, period_ns {state.period_ns / 1e6:.5g} ms"
        if abs(off) > 0.1:
            yield wrong("settings' period", expected, got, "say the real period: gains and spectra go by it")
        elif abs(off) > 0.01:
            yield warning("settings' period", expected, got, "say the real period: spectra go by it")
        else:
            yield ok("settings' period", expected, got)


def _asked(answers: Sequence[Heard]) -> Check:
    name, expected = "settings on request", f"the last one, with its envelope, to a zenoh query of {CAMERA_STATE.key}"
    advice = "declare a queryable on that key: who joins late asks, and a log begins with it"
    if not answers:
        return warning(name, expected, "no answer", advice)
    for answer in answers:
        if envelope_of(answer) is None:
            return wrong(name, expected, "an answer without an envelope", "attach the envelope of the message's put")
        try:
            wire.CameraState.FromString(answer.payload)
        except DecodeError:
            return wrong(name, expected, "an answer that is no lowfc.v1.CameraState", "answer with the last payload")
    return ok(name, expected, f"{len(answers)} answer")
