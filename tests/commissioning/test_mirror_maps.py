"""Effect of the configured flat map, active actuators, control law and registration error on the mirror."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from astropy.io import fits

from lowfc.adapters.files import factory, law_file
from lowfc.adapters.files.mirror_maps import active_actuators, flat_nm, read_shape
from lowfc.arrays import Single
from lowfc.contract.configuration import FIXED_GAINS, Configuration, load
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import LinearLaw, Signal, integrator_block, law_from_blocks
from lowfc.control.loop.advance import advance
from lowfc.control.loop.command_channels import ADOPTED, FLAT
from lowfc.control.loop.inputs import Frame, Load, MirrorShape, Request
from lowfc.control.loop.safety import LoopMode, Rejection
from lowfc.control.loop.state import State
from lowfc.programs.core.start_up import StartUp, check_files
from sim_camera.driver import scene
from tests.support.loops import run
from tests.support.toy import feed
from tools.law_bench import calibrated

GRID = (34, 34)
QUIET = {"disturbance.preset": "quiet", "star.magnitude": -2.0}
PERMIT = Request(0, "permit", values=(5.0,), text="moving the mask", lease_id=7)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(load(None, QUIET))


def wavy(height_nm: float = 30.0) -> Single:
    """A shape of the mirror (rows, columns) with waves, nm of surface."""
    rows, columns = np.indices(GRID)
    return (height_nm * np.sin(rows / 2) * np.cos(columns / 3)).astype(np.float32)


def saved(folder: Path, name: str, array: npt.ArrayLike) -> str:
    path = folder / name
    if path.suffix == ".npy":
        np.save(path, np.asarray(array))
    else:
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.asarray(array))]).writeto(path)
    return str(path)


def law_of(config: Configuration, gain: float = 0.2, signal: Signal = "pol") -> LinearLaw:
    delay_frames = factory.settings(config).delay_frames
    blocks = [integrator_block(gain, 0.001, signal, delay_frames)] * len(config.noll)
    return law_from_blocks(blocks, signal, "leaky", config.noll, delay_frames, config.camera.rate_hz)


def file_error(overrides: dict[str, Any]) -> str:
    """The error of the check of a configuration's files and gains."""
    with pytest.raises(ConfigurationError) as caught:
        check_files(load(None, overrides))
    return str(caught.value)


@pytest.mark.parametrize("key", ["control.tilt_gain", "control.gain"])
def test_gains_with_which_the_loop_is_unstable_are_refused(key: str) -> None:
    assert file_error({key: 1.0, "control.delay_frames": 2.0}).startswith(f"{key}: gain must be at least 0 and below 1")
    with pytest.raises(ConfigurationError, match="got 3"):
        StartUp(load(None, {key: 3.0}))


@pytest.mark.parametrize("name", ["map.npy", "map.fits"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16, ">f4"])
def test_a_map_is_read_from_fits_and_numpy_files(tmp_path: Path, name: str, dtype: npt.DTypeLike) -> None:
    shape = np.round(wavy()).astype(dtype)
    read = read_shape(Path(saved(tmp_path, name, shape)))
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, shape)


def test_an_invalid_map_gives_an_error_of_one_line(tmp_path: Path) -> None:
    intact = Path(saved(tmp_path, "intact.fits", wavy())).read_bytes()
    (tmp_path / "short.fits").write_bytes(intact[: len(intact) // 2])
    np.savez(tmp_path / "many.npz", wavy())
    (tmp_path / "many.npz").rename(tmp_path / "archive.npy")
    fits.HDUList([fits.PrimaryHDU()]).writeto(tmp_path / "empty.fits")
    saved(tmp_path, "line.npy", np.zeros(9))
    saved(tmp_path, "cube.npy", np.zeros((2, 3, 4)))
    saved(tmp_path, "text.npy", np.array([["flat"]]))
    saved(tmp_path, "nothing.npy", np.zeros((0, 34)))
    np.save(tmp_path / "pickle.npy", np.array([[{}]], dtype=object))
    for file, why in {
        **dict.fromkeys(("short.fits", "archive.npy", "pickle.npy"), "neither"),
        **dict.fromkeys(("line.npy", "text.npy", "nothing.npy"), "is an array"),
        "cube.npy": r"\(2, 3, 4\) of float64",
        **dict.fromkeys(("none.fits", "none.npy"), "there is no such file"),
        "empty.fits": "there is no image",
    }.items():
        with pytest.raises(DataFileError, match=f"{file}.*{why}") as caught:
            read_shape(tmp_path / file)
        assert "\n" not in str(caught.value)


def test_the_flat_map_is_zero_where_no_actuator_is_active(tmp_path: Path) -> None:
    active = np.ones(GRID, np.uint8)
    active[3, 4] = active[20, 21] = 0
    files = {"mirror.active": saved(tmp_path, "active.fits", active), "mirror.flat": saved(tmp_path, "f.npy", wavy())}
    config = load(None, files)
    np.testing.assert_array_equal(active_actuators(config), active == 1)
    np.testing.assert_array_equal(flat_nm(config), wavy() * active)
    assert flat_nm(load(None)) is None
    assert active_actuators(load(None)) is None


def test_the_error_has_one_line_for_each_unusable_file(tmp_path: Path) -> None:
    config = load(None)
    small, tall = saved(tmp_path, "small.npy", np.ones((5, 6))), saved(tmp_path, "tall.npy", wavy(900.0))
    assert file_error({"mirror.flat": small}).endswith("5 x 6 values, the mirror has 34 x 34 actuators")
    assert "there is no such file" in file_error({"mirror.active": str(tmp_path / "none.fits")})
    assert "0 or 1" in file_error({"mirror.active": tall})
    assert "no actuator is active" in file_error({"mirror.active": saved(tmp_path, "none.npy", np.zeros(GRID))})
    assert "finite" in file_error({"mirror.flat": saved(tmp_path, "nan.npy", np.full(GRID, np.nan))})
    assert "beyond the limits of [safety]: stroke, neighbour" in file_error({"mirror.flat": tall})
    law = tmp_path / "law.fits"
    law_file.save(law_of(config), law)
    check_files(load(None, {"control.law": str(law)}))
    assert "Z2 to Z15" in file_error({"control.law": str(law), "sensor.modes": 9})
    assert "made for 250 Hz, the frames come at 500 Hz" in file_error({"control.law": str(law), "camera.rate_hz": 500})
    assert "was made for a delay of 1 frame, the loop has 3" in file_error(
        {"control.law": str(law), "control.delay_frames": 3}
    )
    law_file.save(law_of(config, gain=0.95, signal="error"), law)
    check_files(load(None, {"control.law": str(law)}))
    assert "unstable with a delay of 3" in file_error({"control.law": str(law), "control.delay_frames": 3})
    lines = file_error({"mirror.flat": small, "control.law": small, "sensor.sam": "none.json"}).splitlines()
    assert len(lines) == 3
    assert all(text in line for text, line in zip(("none.json", "mirror.flat", "control.law"), lines, strict=True))


def test_inactive_actuators_get_no_command_and_each_mode_is_still_recovered_exactly(
    tmp_path: Path, calibration: Calibration
) -> None:
    """Five inactive actuators in the pupil: the product ACT2MODES MODES2ACT remains the identity."""
    dead = [34 * row + column for row, column in ((10, 12), (16, 17), (17, 17), (22, 9), (25, 24))]
    active = np.ones(GRID)
    active.flat[dead] = 0
    config = load(None, QUIET | {"mirror.active": saved(tmp_path, "a.fits", active), "mirror.dead": dead})
    computed = calibrated(config)
    assert not computed.modes_to_actuators[dead].any()
    assert not computed.actuators_to_modes[:, dead].any()
    assert np.abs(calibration.modes_to_actuators[dead]).max() > 0.01
    assert np.abs(computed.actuators_to_modes @ computed.modes_to_actuators - np.eye(14)).max() < 1e-4
    without_map = calibration.modes_to_actuators.copy()
    without_map[dead] = 0
    error = np.abs(computed.actuators_to_modes @ without_map - np.eye(14)).max()
    assert error > 0.01, "without the map of active actuators the modes are wrong"


def test_a_registration_error_affects_the_mirror_but_not_the_computed_calibration(calibration: Calibration) -> None:
    misregistered = {"mirror.magnification": 1.01, "mirror.shift_pitches": 0.31}
    config = load(None, QUIET | misregistered)
    computed = calibrated(config)
    np.testing.assert_array_equal(computed.modes_to_actuators, calibration.modes_to_actuators)
    poked = (20.0 * calibration.modes_to_actuators[:, 2]).reshape(GRID)  # defocus
    aligned = scene(load(None, QUIET)).truth(0, poked).sampled.residual_nm
    shifted = scene(config).truth(0, poked).sampled.residual_nm
    assert aligned[2] == pytest.approx(20, rel=0.01)
    assert abs(aligned[0]) < 0.1
    assert 19 < shifted[2] < 19.9, "magnification reduces the defocus in the pupil"
    # dZ4/dx = 2 sqrt(3) Z2 on the unit circle, and the shift is 2 x 0.31 / 31 radii of the pupil.
    assert shifted[0] == pytest.approx(-20 * 2 * np.sqrt(3) * 2 * 0.31 / 31, rel=0.1)
    assert shifted[1] == pytest.approx(shifted[0], rel=0.05)


def started(config: Configuration, calibration: Calibration, shape: MirrorShape | None) -> tuple[State, list[Request]]:
    """Start a controller: load the calibration, report the mirror, apply the configured requests (all accepted)."""
    settings = factory.settings(config)
    reported = () if shape is None else (shape,)
    state, _ = feed(settings, State(), Load(0, calibration, "test"), *reported)
    requests = StartUp(config).requests(state, 0)
    for request in requests:
        assert request.requester == "the configuration"
        state, outputs = advance(settings, state, request)
        assert outputs.reply.accepted, outputs.reply.text
    return state, requests


def commands(config: Configuration, state: State, frames: int = 10) -> tuple[list[Single], list[str]]:
    """Commands of an open loop for frames of uniform light, and names of the channels after the last frame."""
    settings = replace(factory.settings(config), min_flux_fraction=0.0, max_identical_frames=0)
    calibration, sent = state.loop.calibration, []
    pixels = np.rint(calibration.dark + 100).reshape(calibration.shape).astype(np.uint16)
    for index in range(frames):
        state, outputs = advance(settings, state, Frame(1 + index, index, 0, pixels))
        sent.append(outputs.command.actuators_nm)
    return sent, [channel.name for channel in state.loop.channels_or_empty().channels]


def test_the_flat_map_is_applied_at_the_start(tmp_path: Path, calibration: Calibration) -> None:
    config = load(None, {"mirror.flat": saved(tmp_path, "flat.fits", wavy(120.0))})
    state, requests = started(config, calibration, None)
    assert [(request.name, request.text) for request in requests] == [("channel", FLAT)]
    sent, names = commands(config, state)
    assert names == [FLAT]
    np.testing.assert_allclose(sent[-1], wavy(120.0), atol=1e-3)
    steps = np.abs(np.diff([np.zeros(GRID), *sent], axis=0)).max(axis=(1, 2))
    assert 40 < steps.max() <= config.safety.slew_nm / 2
    assert not StartUp(load(None)).requests(state, 0)


@pytest.mark.parametrize("permit_age_s", [1, 6])  # the permit lasts 5 s
def test_the_flat_map_is_applied_during_and_after_a_permit_that_began_before_the_mirror_reported(
    tmp_path: Path, calibration: Calibration, permit_age_s: int
) -> None:
    """If the request were refused, the controller would end, as it does not run without its configured flat map."""
    config = load(None, {"mirror.flat": saved(tmp_path, "flat.npy", wavy(120.0))})
    settings = factory.settings(config)
    state, _ = feed(settings, State(), Load(0, calibration, "test"), PERMIT)
    (request,) = StartUp(config).requests(state, permit_age_s * 10**9)
    assert advance(settings, state, request)[1].reply.accepted


def test_a_permit_delays_the_flat_map_of_a_closed_loop_whose_mirror_reports_late(
    tmp_path: Path, calibration: Calibration
) -> None:
    keys = FIXED_GAINS | {"mirror.flat": saved(tmp_path, "flat.npy", wavy(120.0)), "control.start_mode": "closed"}
    config, flat = load(None, keys), np.zeros(GRID, np.float32)
    settings = factory.settings(config)
    shape = MirrorShape(1, flat, np.zeros(0, np.float32))
    state, _ = feed(settings, State(), Load(0, calibration, "test"), PERMIT, shape)
    requests = StartUp(config).requests(state, 2)
    state, (*_, outputs) = feed(settings, state, *requests, Frame(1, 3, 0, None), Frame(2, 4, 0, None))
    assert (state.mode, outputs.step.reasons) == (LoopMode.CLOSED, (Rejection.HELD,))
    np.testing.assert_array_equal(outputs.command.actuators_nm, flat)
    state, _ = advance(settings, state, Request(5, "release", lease_id=7))
    sent, names = commands(config, state._replace(frame_sequence=0), 2)
    assert (names, np.abs(sent[-1]).max() > 40) == ([FLAT], True)


@pytest.mark.parametrize("command_reported", [True, False])
def test_a_restarted_controller_does_not_apply_the_flat_map_twice(
    tmp_path: Path, calibration: Calibration, command_reported: bool
) -> None:
    """The mirror does not move, whether or not it reports its modal command."""
    config = load(None, {"mirror.flat": saved(tmp_path, "flat.npy", wavy(120.0))})
    modal_nm = np.linspace(-10, 10, 14, dtype=np.float32)
    mirror_nm = wavy(120.0) + (calibration.modes_to_actuators @ modal_nm).reshape(GRID)
    reported_nm = modal_nm if command_reported else np.zeros(0, np.float32)
    state, requests = started(config, calibration, MirrorShape(0, mirror_nm, reported_nm))
    assert [request.text for request in requests] == [ADOPTED, FLAT]
    sent, names = commands(config, state)
    for shape in sent:
        np.testing.assert_allclose(shape, mirror_nm, atol=2e-3)
    # If no modal command is reported, the adopted one has the flat map's modes, and the channel ADOPTED cancels them.
    assert names == ([FLAT] if command_reported else [ADOPTED, FLAT])


def test_the_configured_law_is_requested_at_the_start(tmp_path: Path, calibration: Calibration) -> None:
    path = tmp_path / "law.fits"
    config = load(None, {"control.law": str(path)})
    law_file.save(law_of(config), path)
    state, requests = started(config, calibration, None)
    assert [request.name for request in requests] == ["law"]
    assert state.mode is LoopMode.OPEN
    assert state.loop.law_runner.law.name == "leaky"
    with pytest.raises(ConfigurationError, match="the law is of the modes"):
        StartUp(config).handle_refusal(requests[0], "the law is of the modes 2 to 15, the loop of 2 to 9")


def test_a_controller_does_not_start_without_a_configured_file(tmp_path: Path) -> None:
    """The process ends with an error of one line."""
    done = run(tmp_path, "controller", "--run", "lawless", config='[control]\nlaw = "none.fits"\n', timeout_s=30)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("error: control.law: none.fits: there is no such law file")
    assert "Traceback" not in done.stderr
