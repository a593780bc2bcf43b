"""What camera and configuration must agree on, and the times that follow the frame rate."""

import pytest

from lowfc.adapters.files.factory import camera_state
from lowfc.contract.configuration import Camera, Configuration, Control
from lowfc.contract.messages import wire
from lowfc.programs.commissioning.checks import Status
from lowfc.programs.commissioning.conformance.settings import AGREEMENTS, agreement_checks


def changed(**fields: float) -> wire.CameraState:
    state = camera_state(Configuration(), (80, 80), 1)
    for name, value in fields.items():
        setattr(state, name, value)
    return state


def faults(config: Configuration, state: wire.CameraState) -> dict[str, Status]:
    checks = agreement_checks(config, state)
    return {check.name.split(" ")[0]: check.status for check in checks if check.status is not Status.OK}


@pytest.mark.parametrize("em_gain", [1.0, 300.0])
@pytest.mark.parametrize("bits", [12, 16])
def test_the_simulated_camera_agrees_with_its_configuration(em_gain: float, bits: int) -> None:
    config = Configuration(camera=Camera(em_gain=em_gain, bit_depth=bits, full_well_e=2_000.0))
    assert faults(config, camera_state(config, (80, 80), 1)) == {}


@pytest.mark.parametrize("one", AGREEMENTS, ids=lambda one: one.field)
def test_a_value_that_differs_is_found(one: object) -> None:
    field, needed = one.field, one.needed  # type: ignore[attr-defined]
    found = faults(Configuration(), changed(**{field: getattr(changed(), field) * 2}))
    assert found[field] is (Status.WRONG if needed else Status.WARNING)


def test_a_camera_of_100_hz_and_14_bits_on_the_default_configuration() -> None:
    state = changed(period_ns=10_000_000, exposure_ns=5_000_000, bit_depth=14, saturation_dn=16383)
    assert faults(Configuration(), state) == {
        "period_ns": Status.WRONG,
        "exposure_ns": Status.WARNING,
        "bit_depth": Status.WARNING,
        "saturation_dn": Status.WARNING,
    }


@pytest.mark.parametrize(
    ("rate_hz", "max_frame_age_ms", "frame_timeout_ms"),
    [(1000, 20, 50), (250, 20, 50), (100, 20, 50), (50, 40, 100), (5, 400, 1000)],
)
def test_the_times_follow_the_rate(rate_hz: float, max_frame_age_ms: float, frame_timeout_ms: float) -> None:
    config = Configuration(camera=Camera(rate_hz=rate_hz))
    assert (config.max_frame_age_ns, config.frame_timeout_ns) == (max_frame_age_ms * 1e6, frame_timeout_ms * 1e6)
    assert "control.frame_timeout_ms" not in faults(config, camera_state(config, (80, 80), 1))


def test_what_was_chosen_holds_and_is_checked() -> None:
    config = Configuration(camera=Camera(rate_hz=20.0), control=Control(max_frame_age_ms=7.0, frame_timeout_ms=50.0))
    assert (config.max_frame_age_ns, config.frame_timeout_ns) == (7_000_000, 50_000_000)
    assert faults(config, camera_state(config, (80, 80), 1)) == {"control.frame_timeout_ms": Status.WRONG}
