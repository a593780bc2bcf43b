"""Exports, read back with independent readers and compared with the messages of the log."""

import csv
import json
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import aotpy
import numpy as np
import numpy.typing as npt
import pytest
from aotpy.io.fits import AOTFITSErrorLevel
from astropy.io import fits
from astropy.table import Table
from rich.console import Console

from lowfc.adapters.logs.history import History
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.recovery import damage_in_words
from lowfc.arrays import Array
from lowfc.contract.codecs.calibration_codec import wire_camera, with_identity
from lowfc.contract.codecs.codec import decode_frame
from lowfc.contract.codecs.state_codec import calibration_in_use
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import count_of
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    COMMAND,
    CONTROLLER_STATE,
    FRAME,
    MIRROR_STATE,
    STEP,
    TIMING,
    TRUTH,
    Message,
    Topic,
    from_timestamp,
    image,
)
from lowfc.programs.logs.export import files
from lowfc.programs.logs.export.command import Format, export_log, render
from lowfc.programs.logs.export.cubes import copy_frames_to_npy
from tests.support import toy
from tests.support.loops import json_of, lowfc, refusal
from tests.support.mutated_logs import flipped
from tests.support.report_log import METADATA, SyntheticLog

STEPS, REFUSED, WITHOUT_COMMAND, WITHOUT_TRUTH = 30, 4, 7, 9  # number of steps, and indices of three of them
MODES, ACTUATORS = len(toy.NOLL), toy.GRID[0] * toy.GRID[1]
QUIET = Console(quiet=True)
GOOD = np.arange(toy.SHAPE[0] * toy.SHAPE[1]) != 10  # one bad pixel
CALIBRATED = with_identity(replace(toy.calibration(), good=GOOD.astype(np.float32)))


def a_night() -> SyntheticLog:
    """30 steps, the first in open loop, one of a dark frame; a command and a truth are missing; the camera restarts."""
    night = SyntheticLog(calibration=CALIBRATED).request("open").frames(1).request("close")
    night.frames(STEPS // 2 - 1, dark={REFUSED - 1})
    night.start_camera()
    night.request("gain", (9.0,))  # refused
    night.request("leak", (0.0,))
    night.frames(STEPS // 2)
    for topic, number in ((COMMAND, WITHOUT_COMMAND), (TRUTH, WITHOUT_TRUTH)):
        del night.samples[night.indices(topic)[number]]
    second_command = night.messages(COMMAND)[0]
    second_command.actuators = bytes(4 * ACTUATORS)
    night.put(COMMAND, second_command)  # a later command of the first frame
    return night


NIGHT = a_night()
STEPS_SENT = NIGHT.messages(STEP)
SEQUENCES = [step.frame_sequence for step in STEPS_SENT]
TIMES_NS = [from_timestamp(step.timestamp) for step in STEPS_SENT]
FRAMES = np.array([decode_frame(NIGHT.samples[index].payload, 0, 0).pixels for index in NIGHT.indices(FRAME)])


def sent(topic: Topic, name: str, width: int = MODES) -> Array:
    """Quantity `name` of the message of each step (steps, width), in its own unit; NaN if it was not sent."""
    rows = np.full((STEPS, width), np.nan, np.float32)
    for body in reversed(NIGHT.messages(topic)):
        value = getattr(body, name)
        if len(value):
            rows[SEQUENCES.index(body.frame_sequence)] = np.frombuffer(value, "<f4") if name == "actuators" else value
    return rows


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return NIGHT.write(tmp_path_factory.mktemp("night") / "night.mcap")


def test_a_csv_row_has_the_values_of_its_step(log: Path, tmp_path: Path) -> None:
    results = export_log(log, Format.CSV, tmp_path / "out.csv", console=QUIET)
    assert results["files"] == [str(tmp_path / "out.csv")]
    assert (results["steps"], results["modes"], results["finished"]) == (STEPS, MODES, True)
    with (tmp_path / "out.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["sequence"]) for row in rows] == SEQUENCES
    assert [int(row["count"]) for row in rows] == [count_of(one) for one in SEQUENCES]
    assert [int(row["time_ns"]) for row in rows] == TIMES_NS
    assert rows[1]["time_utc"] == f"{np.datetime64(TIMES_NS[1], 'ns')}"
    assert [row["mode"] for row in rows[:2]] == ["open", "closed"]
    assert (rows[0]["reasons"], rows[REFUSED]["reasons"]) == ("", "dark")
    assert rows[REFUSED]["error_z2_nm"] == rows[WITHOUT_TRUTH]["true_residual_rms_nm"] == ""
    assert float(rows[3]["transport_us"]) == 90
    for index, noll in enumerate(toy.NOLL):
        for stem, topic, name in (("error", STEP, "error_nm"), ("true_disturbance", TRUTH, "disturbance_nm")):
            read = np.array([float(row[f"{stem}_z{noll}_nm"] or "nan") for row in rows], np.float32)
            np.testing.assert_array_equal(read, sent(topic, name)[:, index])
    table = Table.read(tmp_path / "out.csv")
    np.testing.assert_array_equal(np.array(table["command_z4_nm"], np.float32), sent(STEP, "command_nm")[:, 2])


def test_npz_arrays_have_the_values_of_the_messages(log: Path, tmp_path: Path) -> None:
    results = export_log(log, Format.NPZ, tmp_path / "out.npz", frames=True, console=QUIET)
    assert results["files"] == [str(tmp_path / "out.npz"), str(tmp_path / "out.frames.npy")]
    assert results["frames"] == STEPS
    with np.load(tmp_path / "out.npz", allow_pickle=False) as found:
        for name in ("sequence", "frame_sequence"):
            np.testing.assert_array_equal(found[name], SEQUENCES)
        np.testing.assert_array_equal(found["pol_nm"], sent(STEP, "pol_nm"))
        np.testing.assert_array_equal(found["true_residual_nm"], sent(TRUTH, "residual_nm"))
        stroke_nm = np.abs(sent(MIRROR_STATE, "actuators", ACTUATORS)).max(axis=1)
        np.testing.assert_array_equal(found["mirror_stroke_nm"], stroke_nm)
        assert found["time_utc"][2] == np.datetime64(TIMES_NS[2], "ns")
        np.testing.assert_array_equal(found["calibration_reference"].ravel(), CALIBRATED.reference)
        np.testing.assert_array_equal(found["calibration_response_per_nm"][1].ravel(), CALIBRATED.response[:, 1])
        assert found["calibration_id"] == CALIBRATED.id
        assert json.loads(str(found["metadata_json"]))["lowfc"] == METADATA["lowfc"]
    np.testing.assert_array_equal(np.load(tmp_path / "out.frames.npy", mmap_mode="r"), FRAMES)


def test_fits_tables_and_images_have_the_values_of_the_messages(log: Path, tmp_path: Path) -> None:
    export_log(log, Format.FITS, tmp_path / "out.fits", frames=True, console=QUIET)
    with fits.open(tmp_path / "out.fits", checksum=True) as hdus:
        hdus.verify("exception")
        assert hdus[0].header["RATE"] == 1000
        assert "lowfc: run = night" in list(hdus[0].header["COMMENT"])
        np.testing.assert_array_equal(hdus["FRAMES"].data, FRAMES)
        np.testing.assert_array_equal(hdus["FRAME_TIMES"].data["sequence"], SEQUENCES)
        np.testing.assert_array_equal(hdus["FRAME_TIMES"].data["time_ns"], TIMES_NS)
        assert hdus["RECONSTRUCTOR_NM"].header["BUNIT"] == "nm"
        np.testing.assert_array_equal(hdus["RECONSTRUCTOR_NM"].data[2].ravel(), CALIBRATED.reconstructor[2])
    table = Table.read(tmp_path / "out.fits", hdu="STEPS", mask_invalid=False)
    units_of = {name: str(table[name].unit or "") for name in ("error_nm", "time_ns", "compute_us", "flux_dn")}
    assert units_of == {"error_nm": "nm", "time_ns": "ns", "compute_us": "us", "flux_dn": "adu"}
    np.testing.assert_array_equal(table["sequence"], SEQUENCES)
    np.testing.assert_array_equal(table["error_nm"], sent(STEP, "error_nm"))
    flux_dn = np.float32([one.flux_dn for one in STEPS_SENT])
    flux_dn[REFUSED] = np.nan  # the log has 0, because the flux is unknown
    np.testing.assert_array_equal(table["flux_dn"], flux_dn)
    assert table["reasons"][REFUSED].strip() == "dark"
    assert table["time_utc"][1] == f"{np.datetime64(TIMES_NS[1], 'ns')}"


def test_an_aot_file_describes_the_system_to_aotpy(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "out.aot.fits"
    export_log(log, Format.AOT, path, frames=True, console=QUIET)
    system = aotpy.AOSystem.read_from_file(path, exception_level=AOTFITSErrorLevel.WARNING)
    (loop,) = system.loops
    sensor, mirror = loop.input_sensor, loop.commanded_corrector

    def check(image: aotpy.Image, unit: str | None, expected: npt.ArrayLike) -> None:
        assert image.unit == unit
        assert image.data.shape == np.shape(expected)
        np.testing.assert_array_equal(image.data, expected)

    commands_nm = sent(COMMAND, "actuators", ACTUATORS)
    assert np.flatnonzero(np.isnan(commands_nm[:, 0])).tolist() == [WITHOUT_COMMAND]
    check(loop.modal_coefficients, "nm", sent(STEP, "error_nm"))
    check(loop.commands, "m", commands_nm * np.float32(1e-9))
    check(loop.measurements_to_modes, "nm", CALIBRATED.reconstructor[:, None, GOOD])
    check(loop.modes_to_measurements, "nm-1", CALIBRATED.response[GOOD][:, None])
    check(loop.modes_to_commands, "m nm-1", CALIBRATED.modes_to_actuators * np.float32(1e-9))
    check(loop.time_filter_num, None, np.array([[0.4], [0.4], [0.2]], np.float32))
    check(loop.time_filter_den, None, [[-1, 1]] * 3)
    assert loop.modes.data.shape == (MODES, 64, 64)
    inside = np.abs(loop.modes.data).sum(axis=0) > 0
    products = np.einsum("iyx,jyx->ij", loop.modes.data, loop.modes.data) / inside.sum()
    np.testing.assert_allclose(products, np.eye(MODES), atol=0.02)
    np.testing.assert_allclose(loop.time.timestamps, np.array(TIMES_NS) / 1e9, rtol=0, atol=1e-6)
    assert list(loop.time.frame_numbers) == [count_of(one) for one in SEQUENCES]
    assert loop.modal_coefficients.time is loop.commands.time is loop.time
    assert (loop.closed, loop.framerate, loop.delay) == (True, 1000, 1.25)

    check(sensor.detector.pixel_intensities, "adu", FRAMES)
    check(sensor.detector.dark, "adu", CALIBRATED.dark.reshape(toy.SHAPE))
    check(sensor.ref_measurements, None, CALIBRATED.reference[None, GOOD])
    assert sensor.n_valid_subapertures == GOOD.sum() == (sensor.subaperture_mask.data >= 0).sum()
    assert sensor.wavelength == pytest.approx(CALIBRATED.wavelength_nm * 1e-9)
    assert mirror.uid == "dm"
    assert mirror.n_valid_actuators == len(mirror.actuator_coordinates) == ACTUATORS
    across = [coordinate.x for coordinate in mirror.actuator_coordinates[: toy.GRID[1]]]
    np.testing.assert_allclose(np.diff(across), 2.0 / 31.0)  # diameter, m, over pitches per pupil
    assert system.main_telescope.enclosing_diameter == 2.0
    metadata = {one.key: one.value for one in system.metadata}
    assert (metadata["CALID"], metadata["RUN"], metadata["EPERADU"]) == (CALIBRATED.id, "night", 1.0)
    assert metadata["GAINSETS"] == 1
    assert json.loads(system.config) == Configuration().model_dump()


def test_aot_has_the_weighted_reconstructor_and_under_a_linear_law_no_integrator(tmp_path: Path) -> None:
    night = a_night()
    night.law(0.1)
    state = night.messages(CONTROLLER_STATE)[-1]
    state.prior_nm2[:], state.weighting_flux_dn = [0, 0, 16], toy.FLUX_DN
    state.camera_expected.CopyFrom(wire_camera(toy.CAMERA))
    night.put(CONTROLLER_STATE, state)
    path = tmp_path / "x.fits"
    export_log(night.write(tmp_path / "x.mcap"), Format.AOT, path, console=QUIET)
    (loop,) = aotpy.AOSystem.read_from_file(path).loops
    assert (loop.delay, loop.time_filter_num, loop.time_filter_den) == (1.25, None, None)
    weighted = calibration_in_use(state, CALIBRATED).reconstructor[:, None, GOOD]
    np.testing.assert_array_equal(loop.measurements_to_modes.data, weighted)
    assert np.abs(weighted[:2, 0] - CALIBRATED.reconstructor[:2, GOOD]).max() > 0.1


@pytest.mark.parametrize("to", list(Format))
def test_a_truncated_log_without_truth_and_with_an_accent_in_its_name_is_exported(tmp_path: Path, to: Format) -> None:
    part = a_night().without(TRUTH).write(tmp_path / "coupé.mcap", finish=False)
    part.write_bytes(part.read_bytes()[:-2000])
    results = export_log(part, to, console=QUIET)
    assert results["files"] == [str(tmp_path / f"coupé.{'aot.fits' if to is Format.AOT else to}")]
    assert 0 < results["steps"] < STEPS
    assert not results["finished"]
    assert "truncated" in render(results)
    if to is Format.CSV:
        heading = (tmp_path / "coupé.csv").read_text().splitlines()[0]
        assert "error_z2_nm" in heading
        assert "true" not in heading


def test_damage_is_reported_with_its_position_and_reason(tmp_path: Path) -> None:
    log = SyntheticLog().frames(800).write(tmp_path / "night.mcap")
    flipped(log, log.stat().st_size // 3)
    results = export_log(log, Format.NPZ, tmp_path / "out.npz", console=QUIET)
    reader = LogReader(log, skip_damaged=True)
    assert sum(1 for _ in reader)
    assert results["damaged"] == [damage_in_words(reader.damage[0])]
    assert f"left out: at byte {reader.damage[0].position}, " in render(results)


@pytest.mark.parametrize(
    ("topic", "reason"),
    [(STEP, "has no steps: there is nothing"), (CALIBRATION, f"has no calibration.* its {STEPS} steps")],
)
def test_a_log_without_steps_or_calibration_is_refused(tmp_path: Path, topic: Topic, reason: str) -> None:
    log = a_night().without(topic).write(tmp_path / "night.mcap")
    for to in Format:
        with pytest.raises(DataFileError, match=reason):
            export_log(log, to, console=QUIET)
    assert list(tmp_path.iterdir()) == [log]


@pytest.mark.parametrize("to", [Format.NPZ, Format.FITS, Format.AOT])
@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (image(np.zeros((3, 3), np.uint16), 0, "sensor"), r"has shape \(3, 3\), but earlier frames have"),
        (image(np.zeros((3, 3), np.float32), 0, "sensor"), "is not a complete image of 16-bit pixels"),
        (image(np.zeros((3, 3), np.uint16), 1 << 63, "sensor"), "cannot be read: its time is"),
        (None, "has no frames"),
    ],
)
def test_a_failed_export_leaves_no_file(tmp_path: Path, to: Format, frame: Message | None, reason: str) -> None:
    """Frames of several sizes, an image of another kind, an impossible time, or no frames at all."""
    night = a_night()
    if frame is None:
        night.without(FRAME)
    else:
        night.put(FRAME, frame)
    path = night.write(tmp_path / "night.mcap")
    with pytest.raises(DataFileError, match=f"{reason}.*; export without --frames"):
        export_log(path, to, frames=True, console=QUIET)
    assert list(tmp_path.iterdir()) == [path]


def test_a_log_replaced_during_its_export_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = NIGHT.write(tmp_path / "night.mcap")
    shorter = a_night()
    del shorter.samples[shorter.indices(FRAME)[-1]]
    replacement = shorter.write(tmp_path / "shorter.mcap")

    def copy_after_change(cube: Path, history: History) -> None:
        replacement.rename(path)
        copy_frames_to_npy(cube, history)

    monkeypatch.setattr(files, "copy_frames_to_npy", copy_after_change)
    with pytest.raises(DataFileError, match="changed while it was read: it has 29 frames now, and had 30"):
        export_log(path, Format.NPZ, frames=True, console=QUIET)
    assert list(tmp_path.iterdir()) == [path]


def test_invalid_exports_are_refused(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigurationError, match="cannot hold frames"):
        export_log(log, Format.CSV, frames=True, console=QUIET)
    with pytest.raises(DataFileError, match="cannot be written"):
        export_log(log, Format.CSV, tmp_path / "nowhere" / "out.csv", console=QUIET)
    monkeypatch.setitem(sys.modules, "aotpy", None)
    monkeypatch.delitem(sys.modules, "lowfc.programs.logs.export.aot", raising=False)
    with pytest.raises(ConfigurationError, match=r"pip install .*'aotpy"):
        export_log(log, Format.AOT, console=QUIET)


def test_an_export_is_next_to_the_log_with_its_permissions_and_replaced_only_by_force(tmp_path: Path) -> None:
    log = NIGHT.write(tmp_path / "night.mcap")
    log.chmod(0o600)
    done = lowfc("export", log)
    assert done.exit_code == 0, done.output
    out = tmp_path / "night.fits"
    assert done.output.startswith(f"{out}: {STEPS} steps")
    assert out.stat().st_mode & 0o777 == 0o600
    out.write_text("mine")
    assert "--force" in refusal("export", log)
    assert out.read_text() == "mine"
    assert json_of("export", log, "--force")["steps"] == STEPS
    assert fits.getheader(out)["LOG"] == "night.mcap"


@pytest.mark.parametrize("name", ["night.mcap", "other.mcap", "linked.csv", "out.frames.npy"])
def test_a_log_is_not_replaced_even_if_forced(log: Path, tmp_path: Path, name: str) -> None:
    source = tmp_path / "night.mcap"
    for path in (source, tmp_path / "other.mcap", tmp_path / "out.frames.npy"):
        path.write_bytes(log.read_bytes())
    (tmp_path / "linked.csv").symlink_to(source)
    frames = name.endswith(".npy")
    to, out = (Format.NPZ, "out.npz") if frames else (Format.CSV, name)
    with pytest.raises(DataFileError, match="never overwritten"):
        export_log(source, to, tmp_path / out, frames=frames, force=True, console=QUIET)
    assert (tmp_path / name).read_bytes() == log.read_bytes()


@pytest.mark.parametrize("to", [Format.NPZ, Format.FITS])  # AOT copies frames as FITS does
def test_frames_are_not_held_in_memory(tmp_path: Path, to: Format) -> None:
    frames, shape = 90, (200, 200)
    night = a_night().without(FRAME, TIMING)
    for number in range(frames):
        noise = np.random.default_rng(number).integers(0, 65536, shape, dtype=np.uint16)
        night.put(FRAME, image(noise, number, "sensor"))
    big = night.write(tmp_path / "big.mcap")
    export_log(big, to, tmp_path / "warm.out", console=QUIET)  # warm up the imports
    tracemalloc.start()
    results = export_log(big, to, tmp_path / "out.out", frames=True, console=QUIET)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert results["frames"] == frames
    size = frames * shape[0] * shape[1] * 2
    assert sum(Path(file).stat().st_size for file in results["files"]) > size > 2 * peak


def test_a_loop_mode_of_a_newer_version_is_exported_by_its_number(tmp_path: Path) -> None:
    night = a_night()
    night.change(STEP, -1, lambda step: setattr(step, "mode", 9))
    export_log(night.write(tmp_path / "night.mcap"), Format.CSV, tmp_path / "out.csv", console=QUIET)
    assert "mode 9" in (tmp_path / "out.csv").read_text().splitlines()[-1]
