"""I0 and H computed at a wavefront that is not flat."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from rich.console import Console

from lowfc.adapters.files import factory
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import CalibrationError, ConfigurationError
from lowfc.control.calibration.calibration import Calibration
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.twin.twin import Evaluator, Twin, node_radii, reference, response
from lowfc.programs.commissioning.analytic import analytic
from lowfc.programs.commissioning.calibrate.tasks import zero_point
from tests.support.folded_loop import FoldedLoop

Array = npt.NDArray[np.float64]

BRIGHT = {"sensor.sam": "sam27d10_bal14", "star.magnitude": 0.0, "disturbance.preset": "quiet"}
THERE = "4=20,7=-20"
SILENT = Console(quiet=True)


@pytest.fixture(scope="module")
def config() -> Configuration:
    return load(None, BRIGHT)


@pytest.fixture(scope="module")
def optics(config: Configuration) -> Twin:
    return factory.twin(config, None, print)


@pytest.fixture(scope="module")
def there(config: Configuration) -> Calibration:
    return analytic(config, SILENT, zero_point(config, THERE).wavefront)


def seen(calibration: Calibration, optics: Twin, I0: Array, state_nm: Array, step_nm: float) -> Array:
    """(modes, modes): what R makes of a step of each mode about a state, by images with exp(i phi), over the step."""
    evaluator, modes = Evaluator(optics), zernikes(calibration.noll, *node_radii(optics))
    R = calibration.reconstructor.astype(np.float64)
    found = []
    for mode in modes:
        image = evaluator.image((state_nm + step_nm * mode).astype(np.float32)).reshape(-1).astype(np.float64)
        found.append(R @ (image / image.sum() - I0) / step_nm)
    return np.array(found).T


def test_steps_about_a_state_are_measured_where_those_about_a_flat_wavefront_are_not(
    config: Configuration, optics: Twin, there: Calibration
) -> None:
    state_nm = 20.0 * zernikes((4,), *node_radii(optics))[0] - 20.0 * zernikes((7,), *node_radii(optics))[0]
    flat = analytic(config, SILENT)
    I0 = there.reference.astype(np.float64)
    one = np.eye(len(flat.noll))
    for step_nm in (1.0, -1.0):
        assert np.abs(seen(there, optics, I0, state_nm, step_nm) - one).max() < 0.02
        assert np.abs(seen(flat, optics, I0, state_nm, step_nm) - one).max() > 0.05
    assert np.abs(there.actuators_to_modes @ there.modes_to_actuators - one).max() < 1e-4
    assert there.id != flat.id
    assert there.operator_hash == flat.operator_hash


def test_the_slopes_are_the_derivatives_of_the_image(optics: Twin) -> None:
    modes = zernikes((2, 4, 11), *node_radii(optics))
    state_nm = 15.0 * modes[1] - 10.0 * modes[2]
    H = response(optics, modes, state_nm)
    for k, mode in enumerate(modes):
        apart = (reference(optics, state_nm + 0.1 * mode) - reference(optics, state_nm - 0.1 * mode)).reshape(-1) / 0.2
        assert np.abs(H[:, k] - apart).max() < 1e-5 * np.abs(apart).max()
    flat = response(optics, modes)
    assert np.abs(response(optics, modes, 0 * state_nm) - flat).max() < 1e-12 * np.abs(flat).max()


def test_a_shape_of_the_mirror_is_the_wavefront_that_it_makes(
    config: Configuration, optics: Twin, there: Calibration, tmp_path: Path
) -> None:
    flat = analytic(config, SILENT)
    command_nm = np.zeros(len(flat.noll))
    command_nm[[flat.noll.index(4), flat.noll.index(7)]] = 20.0, -20.0
    np.save(tmp_path / "shape.npy", (flat.modes_to_actuators @ command_nm).reshape(flat.grid))
    shaped = analytic(config, SILENT, zero_point(config, str(tmp_path / "shape.npy")).wavefront)
    moved = there.reference - flat.reference
    assert np.linalg.norm(shaped.reference - there.reference) < 0.1 * np.linalg.norm(moved)
    changed = there.response - flat.response
    assert np.linalg.norm(shaped.response - there.response) < 0.1 * np.linalg.norm(changed)


def test_a_loop_on_it_goes_to_that_wavefront_and_holds_it() -> None:
    few = load(None, BRIGHT | {"sensor.modes": 6})
    world = load(None, BRIGHT | {"sensor.modes": 6, "disturbance.static_nm": {"4": 35.0, "6": 20.0}})
    made = analytic(few, SILENT, zero_point(few, "4=15,7=-10").wavefront)
    loop = FoldedLoop(few, made, world)
    loop.close_loop()
    loop.run(400)
    held = np.mean(loop.residual_nm[200:], axis=0)[:6]
    assert held == pytest.approx([0, 0, 15, 0, 0, -10], abs=0.02 * 20)


def test_what_is_no_wavefront_is_said(config: Configuration, tmp_path: Path) -> None:
    assert zero_point(config, " 4=15, 7 = -1e1").name == "4=15,7=-10"
    for text, why in {
        "4=": "as in 4=15,7=-10, or a file; got '4='",
        "4=15,": "or a file; got ''",
        "focus=15": "got 'focus=15'",
        "1=5": "not a Noll index of 2 or more",
        "4=1,4=2": "named once",
        "4=nan": "its amplitude in nm",
        str(tmp_path / "none.fits"): "--at: .*there is no such file",
    }.items():
        with pytest.raises(ConfigurationError, match=why):
            zero_point(config, text)
    np.save(tmp_path / "small.npy", np.zeros((5, 6)))
    with pytest.raises(ConfigurationError, match=r"--at = .*: 5 x 6 values, the mirror has 34 x 34 actuators"):
        zero_point(config, str(tmp_path / "small.npy"))
    sheared = load(None, BRIGHT | {"control.nuisance": ["shear"]})
    with pytest.raises(CalibrationError, match="known at a flat wavefront only"):
        analytic(sheared, SILENT, zero_point(config, THERE).wavefront)
