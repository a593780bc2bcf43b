"""Flat map, active actuators, law and registration error: from the configuration to the mirror."""

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
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import LinearLaw, Signal, integrator_block, of_blocks
from lowfc.control.loop.advance import advance
from lowfc.control.loop.command_channels import ADOPTED, FLAT
from lowfc.control.loop.inputs import Frame, Load, MirrorShape, Request
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import State
from lowfc.programs.core.start_up import StartUp, check_files
from sim_camera.driver import scene
from tests.support.loops import run
from tools.law_bench import calibrated

GRID = (34, 34)
QUIET = {"disturbance.preset": "quiet", "star.magnitude": -2.0}


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(load(None, QUIET))


def wavy(height_nm: float = 30.0) -> Single:
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
    return of_blocks(blocks, signal, "leaky", config.noll, delay_frames, config.camera.rate_hz)


def complaint(overrides: dict[str, Any]) -> str:
    with pytest.raises(ConfigurationError) as caught:
        check_files(load(None, overrides))
    return str(caught.value)


@pytest.mark.parametrize("name", ["map.npy", "map.fits"])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int16, ">f4"])
def test_a_map_is_read_from_fits_and_from_numpy(tmp_path: Path, name: str, kind: npt.DTypeLike) -> None:
    shape = np.round(wavy()).astype(kind)
    found = read_shape(Path(saved(tmp_path, name, shape)))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, shape)


def test_what_is_no_map_is_named_in_one_line(tmp_path: Path) -> None:
    whole = Path(saved(tmp_path, "whole.fits", wavy())).read_bytes()
    (tmp_path / "short.fits").write_bytes(whole[: len(whole) // 2])
    np.savez(tmp_path / "many.npz", wavy())
    (tmp_path / "many.npz").rename(tmp_path / "archive.npy")
    fits.HDUList([fits.PrimaryHDU()]).writeto(tmp_path / "empty.fits")
    saved(tmp_path, "line.npy", np.zeros(9))
    saved(tmp_path, "cube.npy", np.zeros((2, 3, 4)))
    saved(tmp_path, "words.npy", np.array([["flat"]]))
    saved(tmp_path, "nothing.npy", np.zeros((0, 34)))
    np.save(tmp_path / "pickle.npy", np.array([[{}]], dtype=object))
    for file, why in {
        **dict.fromkeys(("short.fits", "archive.npy", "pickle.npy"), "neither"),
        **dict.fromkeys(("line.npy", "words.npy", "nothing.npy"), ""),
        "cube.npy": r"\(2, 3, 4\) of float64",
        "none.fits": "there is no such file",
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


def test_every_file_that_cannot_be_used_is_a_line(tmp_path: Path) -> None:
    config = load(None)
    small, tall = saved(tmp_path, "small.npy", np.ones((5, 6))), saved(tmp_path, "tall.npy", wavy(900.0))
    assert complaint({"mirror.flat": small}).endswith("5 x 6 values, the mirror has 34 x 34 actuators")
    assert "there is no such file" in complaint({"mirror.active": str(tmp_path / "none.fits")})
    assert "0 or 1" in complaint({"mirror.active": tall})
    assert "no actuator is active" in complaint({"mirror.active": saved(tmp_path, "none.npy", np.zeros(GRID))})
    assert "finite" in complaint({"mirror.flat": saved(tmp_path, "nan.npy", np.full(GRID, np.nan))})
    assert "beyond the limits of [safety]: stroke, neighbour" in complaint({"mirror.flat": tall})
    law = tmp_path / "law.fits"
    law_file.save(law_of(config), law)
    check_files(load(None, {"control.law": str(law)}))
    assert "Z2 to Z15" in complaint({"control.law": str(law), "sensor.modes": 9})
    assert "made for 250 Hz, the frames come at 500 Hz" in complaint({"control.law": str(law), "camera.rate_hz": 500})
    assert "is made for a delay of 1 frames, the loop has 3" in complaint(
        {"control.law": str(law), "control.delay_frames": 3}
    )
    law_file.save(law_of(config, gain=0.95, signal="error"), law)
    check_files(load(None, {"control.law": str(law)}))
    assert "unstable with a delay of 3" in complaint({"control.law": str(law), "control.delay_frames": 3})
    several = complaint({"mirror.flat": small, "control.law": small, "sensor.sam": "none.json"}).splitlines()
    assert len(several) == 3
    assert all(words in line for words, line in zip(("none.json", "mirror.flat", "control.law"), several, strict=True))


def test_inactive_actuators_are_not_commanded_and_the_modes_are_measured_as_they_are(
    tmp_path: Path, calibration: Calibration
) -> None:
    """With five actuators of the pupil out of use, a mode is what the sensor measures of it all the same."""
    dead = [34 * row + column for row, column in ((10, 12), (16, 17), (17, 17), (22, 9), (25, 24))]
    active = np.ones(GRID)
    active.flat[dead] = 0
    config = load(None, QUIET | {"mirror.active": saved(tmp_path, "a.fits", active), "mirror.dead": dead})
    made = calibrated(config)
    assert not made.modes_to_actuators[dead].any()
    assert not made.actuators_to_modes[:, dead].any()
    assert np.abs(calibration.modes_to_actuators[dead]).max() > 0.01
    seen = made.actuators_to_modes @ made.modes_to_actuators
    assert np.abs(seen - np.eye(14)).max() < 1e-4
    ignorant = calibration.modes_to_actuators.copy()
    ignorant[dead] = 0
    wrong = np.abs(made.actuators_to_modes @ ignorant - np.eye(14)).max()
    assert wrong > 0.01, "the map makes a difference"


def test_a_registration_error_is_the_mirrors_and_not_the_calibrations(calibration: Calibration) -> None:
    wrong = {"mirror.magnification": 1.01, "mirror.shift_pitches": 0.31}
    config = load(None, QUIET | wrong)
    believed = calibrated(config)
    np.testing.assert_array_equal(believed.modes_to_actuators, calibration.modes_to_actuators)
    poked = (20.0 * calibration.modes_to_actuators[:, 2]).reshape(GRID)  # defocus
    straight = scene(load(None, QUIET)).truth(0, poked).sampled.residual_nm
    moved = scene(config).truth(0, poked).sampled.residual_nm
    assert straight[2] == pytest.approx(20, rel=0.01)
    assert abs(straight[0]) < 0.1
    assert 19 < moved[2] < 19.9, "a larger mirror has a gentler defocus"
    # dZ4/dx = 2 sqrt(3) Z2 over the circle, and the shift is 2 x 0.31 / 31 radii.
    assert moved[0] == pytest.approx(-20 * 2 * np.sqrt(3) * 2 * 0.31 / 31, rel=0.1)
    assert moved[1] == pytest.approx(moved[0], rel=0.05)


def begun(config: Configuration, calibration: Calibration, shape: MirrorShape | None) -> tuple[State, list[Request]]:
    """The controller's start: calibration, mirror, and what the configuration asks; all granted."""
    settings = factory.settings(config)
    state, _ = advance(settings, State(), Load(0, calibration, "test"))
    if shape is not None:
        state, _ = advance(settings, state, shape)
    requests = StartUp(config).requests(state, 0)
    for request in requests:
        assert request.requester == "the configuration"
        state, outputs = advance(settings, state, request)
        assert outputs.reply.accepted, outputs.reply.text
    return state, requests


def commands(config: Configuration, state: State, frames: int) -> tuple[list[Single], list[str]]:
    """What is commanded over some frames of any light, for which the loop is open, and the channels at their end."""
    settings, shape = (
        replace(factory.settings(config), min_flux_fraction=0.0, max_identical_frames=0),
        state.drive.calibration.shape,
    )
    dark = np.rint(state.drive.calibration.dark + 100).reshape(shape).astype(np.uint16)
    sent = []
    for index in range(frames):
        state, outputs = advance(settings, state, Frame(1 + index, index, 0, dark))
        sent.append(outputs.command.actuators_nm)
    return sent, [one.name for one in state.drive.added().channels]


def test_the_flat_map_is_put_on_the_mirror_at_the_start(tmp_path: Path, calibration: Calibration) -> None:
    config = load(None, {"mirror.flat": saved(tmp_path, "flat.fits", wavy(120.0))})
    state, requests = begun(config, calibration, None)
    assert [(one.name, one.text) for one in requests] == [("channel", FLAT)]
    sent, names = commands(config, state, 10)
    assert names == [FLAT]
    np.testing.assert_allclose(sent[-1], wavy(120.0), atol=1e-3)
    steps = np.abs(np.diff([np.zeros(GRID), *sent], axis=0)).max(axis=(1, 2))
    assert 40 < steps.max() <= config.safety.slew_nm / 2
    assert not StartUp(load(None)).requests(state, 0)


@pytest.mark.parametrize("told", [True, False])
def test_a_restarted_controller_does_not_put_the_flat_map_on_twice(
    tmp_path: Path, calibration: Calibration, told: bool
) -> None:
    """Whether or not the mirror says which modal command it has, it does not move."""
    config = load(None, {"mirror.flat": saved(tmp_path, "flat.npy", wavy(120.0))})
    modal_nm = np.linspace(-10, 10, 14, dtype=np.float32)
    there = wavy(120.0) + (calibration.modes_to_actuators @ modal_nm).reshape(GRID)
    state, requests = begun(config, calibration, MirrorShape(0, there, modal_nm if told else np.zeros(0, np.float32)))
    assert [one.text for one in requests] == [ADOPTED, FLAT]
    sent, names = commands(config, state, 10)
    for shape in sent:
        np.testing.assert_allclose(shape, there, atol=2e-3)
    # Where the mirror does not say, its modal command has the flat map's modes too, and a channel takes them out again.
    assert names == ([FLAT] if told else [ADOPTED, FLAT])


def test_the_configured_law_takes_over(tmp_path: Path, calibration: Calibration) -> None:
    path = tmp_path / "law.fits"
    config = load(None, {"control.law": str(path)})
    law_file.save(law_of(config), path)
    state, requests = begun(config, calibration, None)
    assert [one.name for one in requests] == ["law"]
    assert state.mode is LoopMode.OPEN
    assert state.drive.following.law.name == "leaky"
    with pytest.raises(ConfigurationError, match="the law is of the modes"):
        StartUp(config).refused(requests[0], "the law is of the modes 2 to 15, the loop of 2 to 9")


def test_a_controller_does_not_start_without_what_it_is_configured_with(tmp_path: Path) -> None:
    """One line, and the process ends."""
    done = run(tmp_path, "controller", "--run", "lawless", config='[control]\nlaw = "none.fits"\n', timeout_s=30)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("error: control.law: none.fits: there is no such law file")
    assert "Traceback" not in done.stderr
