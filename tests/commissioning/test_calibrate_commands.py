"""`lowfc calibrate` on a loop in one process: files, results, errors, calibrations at wavefronts other than flat."""

import json
import re
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from astropy.io import fits
from rich.console import Console

from lowfc.adapters.files import calibration_file, factory
from lowfc.adapters.process.progress import counting_bar, progress_lines
from lowfc.arrays import single
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import CalibrationError, ConfigurationError, DataFileError, RequestRefusedError
from lowfc.contract.messages import wire
from lowfc.control.calibration.adapted import with_dark
from lowfc.control.calibration.alignment import Geometry, align, onto
from lowfc.control.calibration.calibration import Calibration, normalise_flux
from lowfc.control.calibration.response_fit import cross_talk
from lowfc.control.loop.camera import CameraSettings
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.twin.twin import node_radii, reference, response
from lowfc.programs.commissioning.analytic import analytic
from lowfc.programs.commissioning.calibrate import align as calibrate_align
from lowfc.programs.commissioning.calibrate import command, pokes, tasks
from lowfc.programs.commissioning.calibrate import result as calibrate_result
from lowfc.programs.commissioning.calibrate.align import on_sensor, oriented
from lowfc.programs.commissioning.calibrate.result import comparison
from lowfc.programs.commissioning.calibrate.run import Calibrator
from lowfc.programs.commissioning.calibrate.tasks import zero_point
from tests.support import toy
from tests.support.in_process_loop import BRIGHT, SMALL_MIRROR, InProcessLoop, calibration_of
from tests.support.loops import json_of, lowfc, refusal

CONFIG = BRIGHT | {"sensor.modes": 3}
STATIC = CONFIG | {"disturbance.static_nm": {"4": 6.0}}
RATE_HZ, DELAY_FRAMES = 250, 240
ZERO_POINT = "4=20,7=-20"
SILENT = Console(quiet=True)


@pytest.fixture(autouse=True)
def _few_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pokes, "DELAY_FRAMES", DELAY_FRAMES)


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> InProcessLoop:
    return connected(InProcessLoop(load(None, CONFIG), world=load(None, STATIC)), monkeypatch)


@pytest.fixture
def noiseless_loop(monkeypatch: pytest.MonkeyPatch) -> InProcessLoop:
    """Like `loop`, but without noise, so that shorter pokes suffice, and with a slew limit that shrinks pokes."""
    monkeypatch.setattr(pokes, "HOLD", 2)
    config = load(None, CONFIG | {"control.max_identical_frames": 0, "safety.slew_nm": 5.0})
    return connected(InProcessLoop(config, world=load(None, STATIC | {"camera.noise": False})), monkeypatch)


def connected(loop: InProcessLoop, monkeypatch: pytest.MonkeyPatch) -> InProcessLoop:
    """Let the commands connect to the loop; return the loop."""
    for module in (tasks, calibrate_align):
        monkeypatch.setattr(module, "Client", lambda run: loop)
    return loop


def compute(config: Configuration, out: str, *options: object) -> dict[str, Any]:
    """Result of `lowfc calibrate --method analytic` with a configuration."""
    Path("test.toml").write_text(config.to_toml())
    return json_of("calibrate", "--method", "analytic", "--config", "test.toml", "--out", out, *options)


def frames_to_go(stderr: str) -> float:
    """Frames to go, from the reported time in whole seconds."""
    line = next(line for line in stderr.splitlines() if "to go" in line)
    return float(line.partition("about ")[2].split()[0]) * RATE_HZ


def test_a_resumed_calibration_is_written_loaded_and_reported_when_complete(
    noiseless_loop: InProcessLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = noiseless_loop
    check = Calibrator.check
    # The delay is measured before the time to go is reported; its sequence has 16 more frames at its ends.
    delay_measurement_frames = DELAY_FRAMES + 16
    monkeypatch.setattr(Calibrator, "check", Mock(side_effect=KeyboardInterrupt))
    before = loop.calibration()
    arguments = ["--method", "hadamard", "--cycles", "4", "--out", "night.fits", "--load"]
    done = lowfc("calibrate", *arguments)
    assert done.exit_code == 130
    assert done.stderr.splitlines()[-1].startswith("kept in night.fits.part.npz: 4 cycles; the same command")
    assert "4 cycles of 146 frames and 3 check cycles; about" in done.stderr
    assert not Path("night.fits").exists()
    assert loop.calibration().id == before.id
    monkeypatch.setattr(Calibrator, "check", check)
    cycle_frames = len(loop.surfaces_nm) - delay_measurement_frames
    resumed = lowfc("calibrate", *arguments, "--resume", "--json")
    check_frames = len(loop.surfaces_nm) - cycle_frames - 2 * delay_measurement_frames
    assert frames_to_go(resumed.stderr) == pytest.approx(check_frames, abs=0.6 * RATE_HZ)
    assert frames_to_go(done.stderr) == pytest.approx(cycle_frames + check_frames, abs=0.6 * RATE_HZ)
    result = json.loads(resumed.stdout)
    calibration = calibration_file.load(Path("night.fits"))
    assert (result["method"], result["cycles"]) == ("hadamard", 4)
    assert result["modes"] == 3
    assert result["file"] == "night.fits"
    assert result["condition_number"] > 1
    assert abs(result["delay_frames"] - 1) < 0.05
    assert result["frame_to_effect_ms"] == pytest.approx(4.0, rel=0.05)
    assert len(result["noise_gain_nm"]) == len(result["singular_values"]) == 3
    # H was measured at 6 nm of Z4, where it differs a little from the computed H, which is for flat.
    assert result["cross_talk"] < 0.1 + 4 * result["cross_talk_error"]
    assert (result["recommended"], result["snr"]) == (True, 20)
    assert loop.calibration().id == calibration.id != before.id
    assert list(Path().glob("*.part.npz")) == []
    same = json_of("calibrate", "--compare", "night.fits", "night.fits")
    assert same["cross_talk"] < 1e-4
    assert same["same_commands"]
    assert same["reference_shift_nm"] == [0.0] * 3
    done = lowfc("calibrate", "--compare", "night.fits", "night.fits")
    assert "largest cross-talk" in done.stdout


def test_a_calibration_in_closed_loop_is_loaded_and_the_loop_closed_again(
    noiseless_loop: InProcessLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, before = noiseless_loop, noiseless_loop.calibration()
    new_calibration = with_identity(replace(before, reference=before.reference * np.float32(1.001)))
    part = Path("night.fits.part.npz")
    refuse = False

    def run(self: Calibrator) -> None:
        part.touch()
        self.completed = 4

    def load_calibration(calibration: Calibration) -> Any:
        if refuse:
            raise RequestRefusedError("load refused: a test")
        return InProcessLoop.load(loop, calibration)

    result = SimpleNamespace(recommended=True, not_loaded=False)
    monkeypatch.setattr(Calibrator, "run", run)
    monkeypatch.setattr(tasks, "finish_calibration", lambda *_: (new_calibration, result))
    monkeypatch.setattr(loop, "load", load_calibration)
    monkeypatch.setattr(command, "print_result", lambda *_, **__: None)
    loop.close_loop()
    arguments = ["--method", "in-loop", "--out", "night.fits", "--load"]
    done = lowfc("calibrate", *arguments)
    assert "the loop is opened to load the calibration and closed again afterwards" in done.stderr
    assert (loop.calibration().id, loop.status().state.mode) == (new_calibration.id, wire.LOOP_MODE_CLOSED)
    assert not part.exists()
    refuse = True
    done = lowfc("calibrate", *arguments)
    assert "load refused" in str(done.exception)
    assert "kept in night.fits.part.npz: 4 cycles" in done.stderr
    assert part.exists()
    assert loop.status().state.mode == wire.LOOP_MODE_CLOSED


def test_cycles_that_are_not_kept_are_not_reported(
    noiseless_loop: InProcessLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(self: Calibrator) -> None:
        self.completed = 4
        raise KeyboardInterrupt

    monkeypatch.setattr(Calibrator, "run", run)
    done = lowfc("calibrate", "--out", "night.fits")
    assert done.exit_code == 130
    assert "kept in" not in done.stderr


def test_a_calibration_that_is_not_recommended_is_written_but_not_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    """First the star is faint; then its image also moves before R is checked, and R is noisier than accepted."""
    loop = connected(InProcessLoop(load(None, CONFIG | {"star.magnitude": 3.0})), monkeypatch)
    before = loop.calibration()
    arguments = ["--cycles", "4", "--snr", "200", "--out", "night.fits", "--load"]
    done = lowfc("calibrate", *arguments, "--json")
    assert done.exit_code == 1
    result = json.loads(done.stdout)
    assert not result["recommended"]
    assert result["snr_reached"] < 200
    assert "200 required: find what disturbs this mode, or measure about" in result["faults"][0]
    assert "--resume --snr 200 --cycles " in result["faults"][0]  # --cycles alone would require an SNR of 20
    assert result["file"] == "night.rejected.fits"
    assert calibration_file.load(Path("night.rejected.fits")).id != before.id
    assert not Path("night.fits").exists(), "a rejected calibration would replace an earlier one in this file"
    assert loop.calibration().id == before.id
    check, expose = Calibrator.check, loop.scene.expose

    def shifted(index: int, surface_nm: np.ndarray) -> Any:
        return np.roll(expose(index, surface_nm), 2, axis=1)

    def check_shifted(self: Calibrator, *arguments: Any) -> Any:
        monkeypatch.setattr(loop.scene, "expose", shifted)
        return check(self, *arguments)

    assert "cross-talk on separate frames" not in str(result["faults"])
    monkeypatch.setattr(Calibrator, "check", check_shifted)
    monkeypatch.setattr(calibrate_result, "MAX_NOISE_RATIO", 0.5)
    done = lowfc("calibrate", *arguments, "--resume")
    assert done.exit_code == 1
    assert "verdict: NOT RECOMMENDED" in done.stdout
    assert "cross-talk on separate frames" in done.stdout
    assert "times the noise of the computed reconstructor, expected at most 0.5" in done.stdout
    assert done.stdout.endswith("not loaded\n")


def test_work_before_the_first_cycle_does_not_affect_the_time_to_go() -> None:
    lines, times = list[str](), iter([0.0, 7.0, 10.0, 13.0])
    count = progress_lines(lines.append, lambda: next(times))
    count("detecting pokes", 400, 1000)
    for done in (400, 500, 600):
        count("hadamard cycle", done, 1000)
    assert lines == ["hadamard cycle: 50%, about 15 s to go"]


def test_a_progress_bar_shows_brackets_in_a_file_name() -> None:
    with counting_bar(Console(file=(shown := StringIO()), force_terminal=True, width=80)) as count:
        count("reading [/b].mcap", 1, 2)
    assert "reading [/b].mcap" in shown.getvalue()


def test_progress_without_a_terminal_is_a_line_every_10_s_with_the_time_to_go_of_each_task() -> None:
    lines, times = list[str](), iter(np.arange(0.0, 100.0, 5.0))
    count = progress_lines(lines.append, lambda: float(next(times)))
    for task, begin in (("first", 0), ("second", 0), ("third", 1)):
        for done in range(begin, 4):
            count(task, done, 4)
    assert lines == [
        *("first: 50%, about 10 s to go", "second: 25%, about 15 s to go", "second: 75%, about 5 s to go"),
        "third: 50%, about 10 s to go",
    ]


def test_the_reference_is_the_present_image(loop: InProcessLoop) -> None:
    result = json_of("calibrate", "reference", "--frames", "200", "--out", "present.fits")
    shift = dict(zip(result["noll"], result["reference_shift_nm"], strict=True))
    assert shift[4] == pytest.approx(6.0, abs=0.6)
    calibration = calibration_file.load(Path("present.fits"))
    assert np.abs(cross_talk(calibration.reconstructor, calibration.response)).max() < 1e-3
    assert np.array_equal(calibration.response, loop.calibration().response)
    loop.offset(5.0, [4])  # a new reference would contain this offset, so that it would act twice
    done = lowfc("calibrate", "reference", "--frames", "16")
    assert "the new reference image contains the offset" in " ".join(done.stderr.split())
    loop.ask("lease", values=60.0, text="somebody", lease_id=2)
    arguments = ("calibrate", "reference", "--frames", "200", "--out", "present.fits")
    assert "reserved for somebody" in refusal(*arguments, kind=RequestRefusedError)


def test_a_saturated_image_is_no_reference(loop: InProcessLoop) -> None:
    loop.load(with_identity(replace(loop.calibration(), saturation_dn=float(loop.calibration().dark.max() + 10))))
    assert "good pixels at full well" in refusal("calibrate", "reference", "--frames", "16", kind=CalibrationError)


def test_a_dark_reveals_bad_pixels_and_is_refused_if_it_contains_light(
    loop: InProcessLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = refusal("calibrate", "dark", "--star-blocked", "--frames", "50", kind=CalibrationError)
    assert re.search(r"not dark: .*; block the star", error)
    rng = np.random.default_rng(5)
    cube = np.rint(100 + 1.5 * rng.standard_normal((64, 80, 80)))
    cube[:, 40, 41] += 500
    fits.PrimaryHDU(cube.astype(np.int16)).writeto("dark.fits")
    result = json_of("calibrate", "dark", "--file", "dark.fits", "--out", "masked.fits")
    assert (result["hot"], result["noisy"], result["dead"]) == (1, 0, 0)
    calibration = calibration_file.load(Path("masked.fits"))
    assert calibration.good.reshape(80, 80)[40, 41] == 0
    assert not calibration.reconstructor[:, 40 * 80 + 41].any()
    fits.PrimaryHDU(cube[:, :20].astype(np.int16)).writeto("small.fits")
    error = refusal("calibrate", "dark", "--file", "small.fits", kind=DataFileError)
    assert "frames have (20, 80) pixels, the calibration (80, 80)" in error
    np.save("cube.npy", cube)
    assert json_of("calibrate", "dark", "--file", "cube.npy")["frames"] == 64
    np.save("cube.npy", cube + 0.03 * loop.calibration().flux_dn * loop.calibration().reference.reshape(80, 80))
    error = refusal("calibrate", "dark", "--file", "cube.npy", kind=CalibrationError)
    assert re.search(r"3\.\d% of the star's light is in them", error)
    connected(InProcessLoop(load(None, CONFIG), world=load(None, CONFIG | {"star.magnitude": 20.0})), monkeypatch)
    result = json_of("calibrate", "dark", "--star-blocked", "--frames", "50", "--out", "night.fits")
    assert result["dark_dn"] == pytest.approx(100, abs=0.5)
    assert result["hot"] < 5


@pytest.mark.parametrize("arguments", ["", "reference", "align", "dark --star-blocked", "dark --file cube.npy"])
def test_frames_of_another_size_than_the_calibration_are_refused(
    loop: InProcessLoop, monkeypatch: pytest.MonkeyPatch, arguments: str
) -> None:
    other = replace(loop.calibration(), shape=(64, 100))
    monkeypatch.setattr(loop, "calibration", lambda: other)
    monkeypatch.setattr(loop, "camera", lambda: CameraSettings(0, (80, 80), 100.0, 40100.0))
    np.save("cube.npy", np.full((16, 64, 100), 100))
    frames = ["--frames", "16"] if arguments and "--file" not in arguments else []
    error = refusal("calibrate", *arguments.split(), *frames, kind=CalibrationError)
    assert re.search(r"80 x 80 pixels and are refused as WRONG_SIZE: .* is for 64 x 100: load", error)


def test_the_computed_calibration_is_resampled_to_a_scaled_and_rotated_sensor(loop: InProcessLoop) -> None:
    before, shape = loop.calibration(), (90, 96)
    geometry = Geometry(1.08, 44.0, 47.5, 12.0, -1)
    model = before.reference.astype(float).reshape(80, 80)
    light = np.random.default_rng(2).poisson(np.maximum(3e5 * onto(model, geometry, shape) + 3, 0))
    bad = np.arange(light.size).reshape(shape) % 997 == 0
    aligned = align(light + 3e4 * bad, model, ~bad)
    zeros = np.zeros((90 * 96, len(before.noll)), np.float32)
    blank = {"dark": zeros[:, 0], "reference": zeros[:, 0], "response": zeros, "reconstructor": zeros.T}
    real = replace(before, shape=shape, good=zeros[:, 0] + 1, flux_dn=float(light.sum()), **blank)
    calibration = on_sensor(loop.config, before, aligned.geometry, real)
    H = onto(before.response.astype(float).reshape(80, 80, -1), geometry, shape).reshape(90 * 96, -1)
    assert np.abs(cross_talk(calibration.reconstructor, H)).max() < 0.03


def test_a_poke_resolves_the_rotation_by_180_degrees(noiseless_loop: InProcessLoop) -> None:
    result = json_of("calibrate", "align", "--out", "aligned.fits", "--frames", "16")
    assert (result["pixels_per_lambda_d"], result["parity"]) == (pytest.approx(4, rel=0.003), 1)
    calibration = calibration_file.load(Path("aligned.fits"))
    assert np.abs(cross_talk(calibration.reconstructor, noiseless_loop.calibration().response)).max() < 0.05


def test_the_alignment_with_a_mirror_turned_by_90_degrees_is_refused(
    loop: InProcessLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A poke of Z2 makes Z3, so its image does not correlate with the computed one and cannot show the sign."""
    play = loop.play

    def play_turned(basis_nm: Any, table: Any) -> Any:
        return play(np.rot90(basis_nm.reshape(-1, 12, 12), axes=(1, 2)).reshape(basis_nm.shape), table)

    monkeypatch.setattr(loop, "play", play_turned)
    error = refusal("calibrate", "align", "--out", "aligned.fits", "--frames", "16", kind=CalibrationError)
    assert "the correlation is 0.0" in error
    assert not Path("aligned.fits").exists()


@pytest.mark.parametrize("pupil", [{}, {"sensor.pupil": "prolate", "sensor.focal_radius": 2.5}])
@pytest.mark.parametrize("geometry", [Geometry(1.0, 40.2, 39.5, -168.0, parity) for parity in (1, -1)])
def test_pokes_resolve_a_reflection_or_rotation_that_does_not_change_the_image(
    geometry: Geometry, pupil: dict[str, Any]
) -> None:
    """Without a mask, the image of a circular pupil is circular. That of the prolate pupil has two symmetry axes."""
    config = load(None, SMALL_MIRROR | {"sensor.kind": "clowfs", "sensor.modes": 3} | pupil)
    first = calibration_of(config.to_toml())
    image = first.reference.astype(float).reshape(80, 80)
    alignment = align(onto(image, geometry, (80, 80)), image)
    H = onto(first.response.astype(float).reshape(80, 80, 3), geometry, (80, 80)).reshape(-1, 3)
    alignment = replace(alignment, residual=0.1, other_parity=0.2)  # the wrong parity may fit better
    found, calibration, correlation = oriented(config, first, alignment, first, lambda mode: H[:, mode])
    assert (found.geometry.rotation_deg, found.geometry.parity) == (pytest.approx(-168, abs=0.1), geometry.parity)
    assert found.residual == (0.1 if alignment.geometry.parity == geometry.parity else 0.2)
    assert correlation > 0.99
    assert np.abs(cross_talk(calibration.reconstructor, H)).max() < 0.01


def test_an_aligned_calibration_expects_the_light_of_the_good_pixels_only(
    noiseless_loop: InProcessLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, before = noiseless_loop, noiseless_loop.calibration()
    good = before.good.reshape(80, 80).copy()
    good[:36] = 0
    monkeypatch.setattr(loop, "calibration", lambda: replace(before, good=good.reshape(-1)))
    result = json_of("calibrate", "align", "--out", "aligned.fits", "--frames", "16")
    light_dn = (next(loop.frames(1)).pixels.reshape(-1) - before.dark) @ good.reshape(-1)
    assert light_dn < 0.9 * before.flux_dn
    assert calibration_file.load(Path("aligned.fits")).flux_dn == pytest.approx(light_dn, rel=0.01)
    assert result["flux_dn"] == pytest.approx(light_dn, rel=0.01)


def test_a_computed_calibration_may_truncate_singular_values(loop: InProcessLoop) -> None:
    result = compute(loop.config, "all.fits")
    assert result["kept"] == [1.0] * 3
    assert (result["cycles"], result["delay_error_frames"]) == (None, None)  # nothing was measured
    smallest = result["singular_values"][-1] / result["singular_values"][0]
    assert np.count_nonzero(compute(loop.config, "few.fits", "--truncate", 1.01 * smallest)["kept"]) == 2
    whole, truncated = (calibration_file.load(Path(name)) for name in ("all.fits", "few.fits"))
    assert np.linalg.matrix_rank(whole.reconstructor) == 3
    assert np.linalg.matrix_rank(truncated.reconstructor) == 2
    assert np.allclose(
        truncated.actuators_to_modes @ whole.modes_to_actuators, truncated.reconstructor @ whole.response, atol=1e-4
    )
    done = lowfc("calibrate", "--method", "analytic", "--config", "test.toml", "--out", "all.fits")
    assert "no regularisation needed" in done.stdout


def test_a_truncation_keeps_the_fit_of_a_background() -> None:
    fitted = load(None, {"sensor.kind": "zwfs", "control.nuisance": ["background"]} | SMALL_MIRROR)
    compute(fitted, "few.fits", "--truncate", 0.3)
    calibration = calibration_file.load(Path("few.fits"))
    assert calibration.estimator == "weighted+background+regularised"
    assert np.linalg.matrix_rank(calibration.reconstructor) < len(calibration.noll)
    I0, good = calibration.reference.astype(float), calibration.good.astype(float)
    background = normalise_flux(I0, np.full((I0.size, 1), 1 / I0.size), good)[1]
    assert np.abs(calibration.reconstructor @ background).max() < 1e-3


def test_a_calibration_can_be_computed_at_another_wavefront(loop: InProcessLoop) -> None:
    compute(loop.config, "flat.fits")
    compute(loop.config, "aberrated.fits", "--at", "3=-10,4=15")
    result = json_of("calibrate", "--compare", "flat.fits", "aberrated.fits")
    assert result["estimators"] == ["weighted", "weighted+at 3=-10,4=15"]
    assert result["cross_talk"] > 0.02
    shift = dict(zip(result["noll"], result["reference_shift_nm"], strict=True))
    assert (shift[4], shift[3]) == pytest.approx((15, -10), abs=1.5)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ("--out night.fits dark --star-blocked", "--out is before `dark`: .* after it"),
        ("--json reference", "--json is before `reference`"),
        ("--method poke --config test.toml", "--config requires --method analytic"),
        ("--at 4=15", "--at requires --method analytic"),
        ("--compare one.fits other.fits --load", "--load has no effect with --compare"),
        ("--method analytic --resume --snr 50", "--snr is for pokes, but --method analytic computes H: omit it"),
        ("--method analytic --run bench", "--run has no effect with --method analytic unless --load"),
        ("dark --file cube.fits --frames 50", "--frames has no effect with --file"),
    ],
)
def test_an_option_without_effect_is_refused(arguments: str, why: str) -> None:
    before = {path.name for path in Path().iterdir()}
    assert re.search(why, refusal("calibrate", *arguments.split(), kind=ConfigurationError))
    assert {path.name for path in Path().iterdir()} == before


def test_too_few_cycles_to_measure_their_scatter_are_refused() -> None:
    assert "--cycles" in lowfc("calibrate", "--cycles", "3").stderr


def test_a_comparison_of_different_sensors_and_a_missing_directory_are_refused(loop: InProcessLoop) -> None:
    calibration_file.save(loop.calibration(), Path("one.fits"))
    calibration_file.save(with_identity(replace(loop.calibration(), noll=(2, 3, 5))), Path("other.fits"))
    error = refusal("calibrate", "--compare", "one.fits", "other.fits", kind=CalibrationError)
    assert re.search("cannot be compared: .* modes Z2 to Z4, the second .* modes Z2 to Z5", error)
    error = refusal("calibrate", "--method", "hadamard", "--out", "nowhere/night.fits", kind=DataFileError)
    assert "there is no directory" in error


def test_two_calibrations_are_compared_on_the_pixels_that_are_good_in_both() -> None:
    """Both calibrations are for the same star and sensor; in one of them five pixels are bad."""
    first = toy.calibration()
    good = np.ones(first.good.size)
    good[np.argsort(-first.reference)[[2, 7, 11, 20, 33]]] = 0
    second = with_dark(first, first.dark, good, 1.0, 1.0)
    for found in (comparison(first, second), comparison(second, first)):
        assert found.cross_talk < 1e-4
        assert found.reference_shift_nm == pytest.approx([0] * 3, abs=1e-3)
        assert found.flux_ratio == pytest.approx(1)
        assert sorted(found.bad_pixels) == [0, 5]
    with pytest.raises(CalibrationError, match="good in both: the reference image has no light"):
        comparison(second, replace(first, good=single(1 - good)))


@pytest.fixture(scope="module")
def config() -> Configuration:
    return load(None, BRIGHT)


def test_the_response_is_the_derivative_of_the_image(config: Configuration) -> None:
    optics = factory.twin(config, None, print)
    modes = zernikes((2, 4, 11), *node_radii(optics))
    state_nm = 15.0 * modes[1] - 10.0 * modes[2]
    H = response(optics, modes, state_nm)
    for k, mode in enumerate(modes):
        slope = (reference(optics, state_nm + 0.1 * mode) - reference(optics, state_nm - 0.1 * mode)).reshape(-1) / 0.2
        assert np.abs(H[:, k] - slope).max() < 1e-5 * np.abs(slope).max()
    flat = response(optics, modes)
    assert np.abs(response(optics, modes, 0 * state_nm) - flat).max() < 1e-12 * np.abs(flat).max()


def test_the_option_at_accepts_a_mirror_shape_in_place_of_a_wavefront(config: Configuration) -> None:
    flat, at_zero_point = analytic(config, SILENT), analytic(config, SILENT, zero_point(config, ZERO_POINT)[1])
    command_nm = np.zeros(len(flat.noll))
    command_nm[[flat.noll.index(4), flat.noll.index(7)]] = 20.0, -20.0
    np.save("shape.npy", (flat.modes_to_actuators @ command_nm).reshape(flat.grid))
    at_shape = analytic(config, SILENT, zero_point(config, "shape.npy")[1])
    change = at_zero_point.reference - flat.reference
    assert np.linalg.norm(at_shape.reference - at_zero_point.reference) < 0.1 * np.linalg.norm(change)
    assert at_zero_point.id != flat.id
    assert at_zero_point.operator_hash == flat.operator_hash
    identity = np.eye(len(flat.noll))
    assert np.abs(at_zero_point.actuators_to_modes @ at_zero_point.modes_to_actuators - identity).max() < 1e-4
    change = at_zero_point.response - flat.response
    assert np.linalg.norm(at_shape.response - at_zero_point.response) < 0.1 * np.linalg.norm(change)


@pytest.mark.parametrize(
    ("keys", "warned"),
    [
        (BRIGHT | {"control.tilt_limit_nm": 1e-3, "control.limit_nm": 1e3}, "more than its modal limit of 0.001 nm"),
        ({"mirror.rows": 8, "mirror.columns": 8, "sensor.modes": 6}, "8 x 8 actuators at 31 pitches per pupil make at"),
        (SMALL_MIRROR, ""),
        (SMALL_MIRROR | {"control.limit_nm": 1e5, "control.tilt_limit_nm": 1e5}, ""),  # limits that never act
        ({"star.magnitude": 6.0, "camera.bias_dn": 0.0}, "which distorts the modes: dark pixels are cut off at 0 DN"),
        ({"star.magnitude": 6.0, "camera.gain_e_per_dn": 10.0}, "distorts the modes: faint pixels are rounded down"),
        ({"star.magnitude": 6.0, "control.limit_nm": 1e5}, ""),  # the default limit would give a warning of noise
    ],
)
def test_the_computation_of_a_calibration_warns_of_an_unsuitable_configuration(
    keys: dict[str, Any], warned: str
) -> None:
    """Warnings: noise above a modal limit, a mirror smaller than the pupil, flux changed by rounding or clipping."""
    analytic(load(None, keys), Console(file=(printed := StringIO())))
    assert warned in printed.getvalue()
    assert ("warning" in printed.getvalue()) is bool(warned)


def test_a_loop_with_a_calibration_at_a_wavefront_converges_to_it() -> None:
    config = load(None, BRIGHT | {"sensor.modes": 6})
    world = load(None, BRIGHT | {"sensor.modes": 6, "disturbance.static_nm": {"4": 35.0, "6": 20.0}})
    calibration = analytic(config, SILENT, zero_point(config, "4=15,7=-10")[1])
    loop = InProcessLoop(config, calibration, world)
    loop.close_loop()
    loop.run(200)
    held_nm = np.mean(loop.residual_nm(100), axis=0)[:6]
    assert held_nm == pytest.approx([0, 0, 15, 0, 0, -10], abs=0.02 * 20)


def test_an_invalid_wavefront_for_the_option_at_is_an_error(config: Configuration, tmp_path: Path) -> None:
    assert zero_point(config, " 4=15, 7 = -1e1")[0] == "4=15,7=-10"
    for text, why in {
        "4:15": "as in 4=15,7=-10, or a file; got '4:15'",
        "4=": "as in 4=15,7=-10, or a file; got '4='",
        "4=15,": "or a file; got ''",
        "focus=15": "got 'focus=15'",
        "1=5": "not a Noll index of 2 or more",
        "4=1,4=2": "named once",
        "4=nan": "its amplitude in nm",
        "4=-1e300": r"at most 100000\)",
        "999999999=5": r"\(at most 1000\)",
        str(tmp_path / "none.fits"): "--at: .*there is no such file",
    }.items():
        with pytest.raises(ConfigurationError, match=why):
            zero_point(config, text)
    np.save(tmp_path / "small.npy", np.zeros((5, 6)))
    with pytest.raises(ConfigurationError, match=r"--at = .*: 5 x 6 values, the mirror has 12 x 12 actuators"):
        zero_point(config, str(tmp_path / "small.npy"))
    sheared = load(None, BRIGHT | {"control.nuisance": ["shear"]})
    with pytest.raises(CalibrationError, match="known at a flat wavefront only"):
        analytic(sheared, SILENT, zero_point(config, ZERO_POINT)[1])
