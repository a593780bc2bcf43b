"""Checks of a camera's settings: present, valid, constant, consistent with its frames and configuration, queryable."""

from collections.abc import Iterator
from math import isfinite
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import CAMERA_STATE, from_timestamp, wire
from lowfc.control.loop.wording import counted
from lowfc.device import CameraSettings
from lowfc.programs.commissioning.checks import Check, Table, judged, ok, warning, wrong
from lowfc.programs.commissioning.conformance.camera import Camera

_FIELDS = tuple(field.name for field in wire.CameraState.DESCRIPTOR.fields if field.name != "timestamp")
_ABOVE_ZERO = ("exposure_ns", "period_ns", "gain_e_per_dn", "saturation_dn", "rows", "columns", "bit_depth")
_MAX_BITS = 16
_NS_PER_MS = 1e6

SETTINGS: Table[Camera] = Table()


@SETTINGS.check("settings", f"{CAMERA_STATE.key}: lowfc.v1.CameraState on change and twice a second")
def _settings(camera: Camera) -> Check:
    count, unreadable = len(camera.states), camera.states.count(None)
    if unreadable:
        got = f"{unreadable} of {count} are not a lowfc.v1.CameraState"
        return wrong(got, "encode the message as declared")
    if not count:
        advice = camera.driver_failure or "publish it: calibration, noise and the check for a changed camera use it"
        return wrong(f"none in {camera.seconds:g} s", advice)
    if camera.seconds >= 2 and not 1 < count / camera.seconds < 20:
        return warning(f"{count / camera.seconds:.1f} a second", "publish them twice a second")
    return ok(f"{count} in {camera.seconds:g} s")


@SETTINGS.check(
    "settings' values", "a timestamp; exposure, period, gain, saturation, rows, columns and bit depth above 0"
)
def _values(camera: Camera) -> Check | None:
    if (state := camera.settings) is None:
        return None
    values, highest = {field: float(getattr(state, field)) for field in _FIELDS}, _highest_dn(state)
    impossible = [f"{field} {value:g}" for field, value in values.items() if not isfinite(value) or value < 0]
    impossible += [f"{field} 0" for field in _ABOVE_ZERO if values[field] == 0]
    if not from_timestamp(state.timestamp):
        impossible.append("no timestamp")
    if state.bit_depth > _MAX_BITS:
        impossible.append(f"bit_depth {state.bit_depth}, but pixels have {_MAX_BITS} bits")
    elif 0 < highest < state.saturation_dn:
        impossible.append(f"saturation_dn {state.saturation_dn:g} above {highest:g}, the converter's largest value")
    if 0 < state.saturation_dn <= state.bias_dn:
        impossible.append(f"bias_dn {state.bias_dn:g} not below saturation_dn {state.saturation_dn:g}")
    if impossible:
        return wrong(", ".join(impossible), "publish the camera's settings, in the units of the field names")
    if state.em_gain < 1:
        return warning(f"em_gain {state.em_gain:g}", "use 1 for a detector without multiplication")
    exposure_ms, period_ms = state.exposure_ns / 1e6, state.period_ns / 1e6
    if exposure_ms > period_ms:
        got = f"exposure {exposure_ms:g} ms, period {period_ms:g} ms"
        return warning(got, "an exposure longer than the period sees two mirror shapes")
    return ok(f"exposure {exposure_ms:g} of {period_ms:g} ms, saturation {state.saturation_dn:g} DN")


def _highest_dn(state: wire.CameraState) -> float:
    """Largest value of the converter; a pixel has 16 bits, whatever the camera states."""
    return 2.0 ** min(state.bit_depth, _MAX_BITS) - 1


@SETTINGS.check("settings kept", "constant: a change of size, region, bias, saturation or gain opens the loop")
def _kept(camera: Camera) -> Check | None:
    states = [state for state in camera.states if state is not None]
    if not states:
        return None
    changed = [field for field in _FIELDS if len({str(getattr(state, field)) for state in states}) > 1]
    if changed:
        return warning(f"{', '.join(changed)} changed", "unless intended: publish the set values, not measured values")
    return ok(f"{len(states)} identical")


@SETTINGS.check("settings' size", "rows and columns of the frames")
def _size(camera: Camera) -> Check | None:
    if (state := camera.settings) is None or not camera.frames:
        return None
    size = (state.rows, state.columns)
    shapes = ", ".join(f"{rows} x {columns}" for rows, columns in camera.shapes)
    got = f"{size[0]} x {size[1]}, frames {shapes}"
    if camera.shapes == [size]:
        return ok(got)
    swapped = camera.shapes == [size[::-1]]
    advice = "exchange rows and columns" if swapped else "publish the size of the region of interest that is sent"
    return wrong(got, advice)


@SETTINGS.check("settings' range", "no pixel above saturation_dn or the converter's largest value")
def _range(camera: Camera) -> Check | None:
    if (state := camera.settings) is None or not camera.frames:
        return None
    top = min(state.saturation_dn, _highest_dn(state))
    got = f"brightest pixel {camera.brightest_dn} DN, largest possible {top:g} DN"
    if camera.brightest_dn > top > 0:
        return wrong(got, "raise saturation_dn (DN, bias included) to the largest pixel value, or bit_depth")
    return ok(got)


@SETTINGS.check("settings' period", "period_ns equals the difference of the frames' times")
def _period(camera: Camera) -> Check | None:
    spans = np.diff([frame.time_ns for frame in camera.frames])
    period_ns = float(np.median(spans)) if spans.size else 0.0
    if (state := camera.settings) is None or period_ns <= 0 or not state.period_ns:
        return None
    difference = abs(period_ns / state.period_ns - 1)
    got = f"{period_ns / 1e6:.5g} ms, period_ns {state.period_ns / 1e6:.5g} ms"
    if difference > 0.1:
        return wrong(got, "publish the real period: gains and spectra depend on it")
    return warning(got, "publish the real period: spectra depend on it") if difference > 0.01 else ok(got)


@SETTINGS.check(
    "settings on request", f"the last settings, with their envelope, in reply to a zenoh query of {CAMERA_STATE.key}"
)
def _on_request(camera: Camera) -> Check | None:
    if not camera.states:
        return None
    if not camera.answers:
        return warning("no answer", "declare a queryable on that key: recorder and processes that start later query it")
    for answer in camera.answers:
        if answer.envelope is None:
            return wrong("an answer without an envelope", "attach the envelope of the published message")
        try:
            wire.CameraState.FromString(answer.payload)
        except DecodeError:
            return wrong("an answer that is not a lowfc.v1.CameraState", "answer with the last payload")
    return ok(counted(len(camera.answers), "answer"))


class Agreement(NamedTuple):
    """One of the camera's settings that the configuration also determines.

    Attributes:
        field: field of lowfc.v1.CameraState.
        key: configuration key that determines the same value.
        unit: unit in which both values are printed.
        tolerance: largest difference, relative to the configured value.
        disturbs_loop: whether a difference disturbs the loop (status wrong) or only computed values (status warning).
        used_for: results that depend on this setting.
    """

    field: str
    key: str
    unit: str
    tolerance: float
    disturbs_loop: bool
    used_for: str


_WEIGHTS = "the weights of the pixels in R, the predicted noise"
_RATES = "control laws, margins, spectra, duration of probe sequences"
_SATURATED = "the saturation level of a computed calibration"
AGREEMENTS = (
    Agreement("period_ns", "camera.rate_hz", "ms", 0.01, True, _RATES),
    Agreement("gain_e_per_dn", "camera.gain_e_per_dn", "e-/DN", 0.02, True, _WEIGHTS),
    Agreement("em_gain", "camera.em_gain", "", 0.02, True, _WEIGHTS),
    Agreement("read_noise_e", "camera.read_noise_e", "e-", 0.2, True, _WEIGHTS),
    Agreement("exposure_ns", "camera.exposure_fraction", "ms", 0.05, False, "the flux of a computed calibration"),
    Agreement("bit_depth", "camera.bit_depth", "bits", 0.0, False, _SATURATED),
    Agreement("saturation_dn", "camera.full_well_e", "DN", 0.01, False, _SATURATED),
)
_MIN_TIMEOUT_PERIODS = 1.5
"""Smallest `control.frame_timeout_ms`, in frame periods; a shorter timeout may act although no frame is missing."""


def agreement_checks(config: Configuration, state: wire.CameraState) -> Iterator[Check]:
    """Compare a camera's settings with the configuration of its loop."""
    expected_settings = CameraSettings.configured(config, state.rows, state.columns)
    for agreement in AGREEMENTS:
        field, unit = agreement.field, agreement.unit
        configured, reported = float(getattr(expected_settings, field)), float(getattr(state, field))
        if field == "em_gain":
            reported = max(reported, 1.0)  # a camera without multiplication may report 0
        divisor = _NS_PER_MS if unit == "ms" else 1.0
        got, expected = (f"{value / divisor:.6g} {unit}".rstrip() for value in (reported, configured))
        agree = abs(reported - configured) <= agreement.tolerance * abs(configured)
        expected, severity = f"{expected}, as configured", wrong if agreement.disturbs_loop else warning
        advice = f"set {agreement.key}, or the camera; it is used for: {agreement.used_for}"
        yield judged(f"{field} and {agreement.key}", expected, agree, got, advice, severity=severity)
    frame_timeout_ms, period_ms = config.frame_timeout_ns * 1e-6, state.period_ns * 1e-6
    enough, got = frame_timeout_ms >= _MIN_TIMEOUT_PERIODS * period_ms, f"{frame_timeout_ms:g} ms"
    expected = f"at least {_MIN_TIMEOUT_PERIODS:g} frame periods of {period_ms:g} ms"
    advice = "omit the key: its default follows camera.rate_hz"
    yield judged("control.frame_timeout_ms", expected, enough, got, advice)
