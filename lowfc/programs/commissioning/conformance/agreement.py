"""What a camera's settings and the configuration both say, and must say alike."""

from collections.abc import Iterator
from typing import NamedTuple

from lowfc.adapters.files.factory import camera_state
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import wire
from lowfc.programs.commissioning.checks import Check, ok, warning, wrong


class Agreement(NamedTuple):
    """One value that is in both.

    Attributes:
        field: of lowfc.v1.CameraState.
        key: of the configuration, from which the same field is made.
        apart: part of the configured value by which they may differ.
        needed: whether the loop is wrong where they differ; otherwise only what is computed is.
        use: what is computed from it.
    """

    field: str
    key: str
    apart: float
    needed: bool
    use: str


_WEIGHTS = "the weights of the pixels in R, the predicted noise"
_SATURATED = "where a computed calibration takes a pixel for saturated"
AGREEMENTS = (
    Agreement("period_ns", "camera.rate_hz", 0.01, True, "laws, margins, spectra, the duration of probe sequences"),
    Agreement("gain_e_per_dn", "camera.gain_e_per_dn", 0.02, True, _WEIGHTS),
    Agreement("em_gain", "camera.em_gain", 0.02, True, _WEIGHTS),
    Agreement("read_noise_e", "camera.read_noise_e", 0.2, True, _WEIGHTS),
    Agreement("exposure_ns", "camera.exposure_fraction", 0.05, False, "the light of a computed calibration"),
    Agreement("bit_depth", "camera.bit_depth", 0.0, False, _SATURATED),
    Agreement("saturation_dn", "camera.full_well_e", 0.01, False, _SATURATED),
)
PERIODS_OF_TIMEOUT = 1.5
"""Frame periods below which `control.frame_timeout_ms` takes every frame for a silence."""


def agreement_checks(config: Configuration, state: wire.CameraState) -> Iterator[Check]:
    """Compare a camera's settings with the configuration of its loop."""
    ours = camera_state(config, (state.rows, state.columns), 0)
    for one in AGREEMENTS:
        configured, found = float(getattr(ours, one.field)), float(getattr(state, one.field))
        if one.field == "em_gain":
            found = max(found, 1.0)  # 0 from a camera that has none
        check, expected = ok(f"{found:.6g}"), f"{configured:.6g}"
        if abs(found - configured) > one.apart * abs(configured):
            advice = f"set {one.key}, or the camera; it is used for: {one.use}"
            check, expected = (wrong if one.needed else warning)(check.got, advice), f"{expected}, as configured"
        yield check._replace(name=f"{one.field} and {one.key}", expected=expected)
    frame_timeout_ms, period_ms = config.frame_timeout_ns * 1e-6, state.period_ns * 1e-6
    check = ok(f"{frame_timeout_ms:g} ms, the period is {period_ms:g} ms")
    if frame_timeout_ms < PERIODS_OF_TIMEOUT * period_ms:
        check = wrong(check.got, "leave the key out: it then follows camera.rate_hz")
    yield check._replace(name="control.frame_timeout_ms", expected=f"at least {PERIODS_OF_TIMEOUT:g} frame periods")
