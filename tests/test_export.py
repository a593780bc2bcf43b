"""Exports, read back with other people's readers and compared with the log."""

import csv
import json
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import aotpy
import numpy as np
import numpy.typing as npt
import pytest
import toy
from aotpy.io.fits import AOTFITSErrorLevel
from astropy.io import fits
from astropy.table import Table
from rich.console import Console
from typer.testing import CliRunner

from lowfc.adapters.bus import Sample
from lowfc.adapters.history import History
from lowfc.adapters.history_reader import read_history
from lowfc.adapters.log_reader import LogReader
from lowfc.adapters.log_writer import Attachment, LogWriter
from lowfc.adapters.terminal import new_app
from lowfc.contract.calibration_codec import encode_calibration, identified
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import count_of, sequence_of
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    COMMAND,
    CONTROLLER_STATE,
    FRAME,
    MIRROR_STATE,
    STEP,
    TIMING,
    TRUTH,
    Message,
    Topic,
    image,
    timestamp,
    wire,
)
from lowfc.control.safety import Reason
from lowfc.programs.export.command import Format, export, export_log, render

STEPS, REFUSED, UNSENT, UNTRUE = 30, 4, 7, 9
START_S = 1_767_225_600
PERIOD_NS = 1_000_000
GOOD = np.arange(toy.SHAPE[0] * toy.SHAPE[1]) != 10
CALIBRATED = identified(replace(toy.calibration(), good=GOOD.astype(np.float32)))
MODES, ACTUATORS = len(toy.NOLL), toy.GRID[0] * toy.GRID[1]
QUIET = Console(quiet=True)


def sequence(number: int) -> int:
    """The camera was restarted half way."""
    return sequence_of(START_S + number // (STEPS // 2), number % (STEPS // 2))


def time_ns(number: int) -> int:
    return START_S * 10**9 + number * PERIOD_NS + 123


def pixels(number: int, shape: tuple[int, int] = toy.SHAPE) -> npt.NDArray[np.uint16]:
    return np.random.default_rng(number).integers(0, 65536, shape, dtype=np.uint16)


def modes(kind: int, number: int) -> list[float]:
    return np.random.default_rng([kind, number]).normal(0, 10, MODES).astype(np.float32).tolist()


def surface_nm(number: int) -> npt.NDArray[np.float32]:
    return np.random.default_rng([5, number]).normal(0, 100, ACTUATORS).astype(np.float32)


def messages(number: int, shape: tuple[int, int]) -> list[tuple[Topic, Message]]:
    """What is said of one frame."""
    about = {"timestamp": timestamp(time_ns(number)), "frame_sequence": sequence(number)}
    on_mirror = {"rows": toy.GRID[0], "columns": toy.GRID[1], "actuators": surface_nm(number).tobytes()}
    good = number != REFUSED
    step = wire.ControlStep(
        **about,
        mode=wire.LOOP_MODE_CLOSED if number else wire.LOOP_MODE_OPEN,
        error_nm=modes(1, number) if good else [],
        pol_nm=modes(2, number) if good else [],
        command_nm=modes(3, number),
        reasons=[wire.REASON_STROKE, wire.REASON_SLEW] if good else [wire.REASON_SATURATED],
        flux_dn=1000.25 + number,
        saturated_pixels=number,
    )
    found: list[tuple[Topic, Message]] = [
        (FRAME, image(pixels(number, shape), time_ns(number), "sensor")),
        (STEP, step),
        (MIRROR_STATE, wire.MirrorState(**about, **on_mirror)),
        (TIMING, wire.ControlTiming(frame_sequence=[sequence(number)], **_stages(number))),
    ]
    if number != UNSENT:
        found.append((COMMAND, wire.MirrorCommand(**about, **on_mirror)))
        held = on_mirror | {"actuators": bytes(4 * ACTUATORS)}
        found.append((COMMAND, wire.MirrorCommand(**about, **held)))  # repeated while no frame came
    if number != UNTRUE:
        truth = wire.Truth(
            **about,
            disturbance_nm=modes(6, number),
            residual_nm=modes(7, number),
            disturbance_rms_nm=number,
            residual_rms_nm=number / 3,
        )
        found.append((TRUTH, truth))
    return found


def _stages(number: int) -> dict[str, Any]:
    names = ("transport", "wakeup", "compute", "publish", "frame_to_command")
    return {f"{name}_ns": [1000 * place + number] for place, name in enumerate(names)}


def write(
    path: Path,
    *,
    steps: int = STEPS,
    shape: tuple[int, int] = toy.SHAPE,
    odd_frame: int | None = None,
    without: tuple[Topic, ...] = (),
    finished: bool = True,
) -> Path:
    """A log of a small loop."""
    configuration = Attachment("config.toml", "application/toml", Configuration().to_toml().encode())
    log = LogWriter(path, time_ns(0), {"lowfc": {"lowfc": "1.2.3", "run": "night"}}, [configuration])
    state = wire.ControllerState(gain=[0.5, 0.4, 0.3], leak=[0.0, 0.125, 0.25], delay_frames=1.0)
    camera = wire.CameraState(exposure_ns=PERIOD_NS // 2, period_ns=PERIOD_NS, gain_e_per_dn=2.0)
    bodies = [
        (CALIBRATION, encode_calibration(CALIBRATED, time_ns(0))),
        (CAMERA_STATE, camera.SerializeToString()),
        (CONTROLLER_STATE, state.SerializeToString()),
    ]
    for number in range(steps):
        size = (3, 3) if number == odd_frame else shape
        bodies += [(topic, message.SerializeToString()) for topic, message in messages(number, size)]
        if number == STEPS // 2:
            bodies.append((FRAME, b""))  # marks where a flush is due
    frames = 0
    for topic, body in bodies:
        if not body:
            log.flush()
        elif topic not in without:
            own = sequence(frames) if topic is FRAME else sequence_of(START_S, frames)
            frames += topic is FRAME
            now_ns = time_ns(frames)
            log.write(Sample(topic.at("dm"), body, own, now_ns, now_ns))
    if finished:
        return log.finish({})
    log.abandon()
    return log.part


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("night") / "night.mcap")


@pytest.fixture(scope="module")
def history(log: Path) -> History:
    found = read_history(LogReader(log))
    assert len(found.steps.sequence) == len(found.frame_sequence) == STEPS
    assert np.isnan(found.steps.error_nm[REFUSED]).all()
    return found


def stack(kind: int, missing: int | None = None) -> npt.NDArray[np.float32]:
    nothing = [np.nan] * MODES
    return np.array([nothing if number == missing else modes(kind, number) for number in range(STEPS)], np.float32)


def test_csv(log: Path, history: History, tmp_path: Path) -> None:
    figures = export_log(log, Format.CSV, tmp_path / "out.csv", console=QUIET)
    assert figures["files"] == [str(tmp_path / "out.csv")]
    assert (figures["steps"], figures["modes"], figures["finished"]) == (STEPS, MODES, True)
    with (tmp_path / "out.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["sequence"]) for row in rows] == history.steps.sequence.tolist() == [*map(sequence, range(STEPS))]
    assert [int(row["count"]) for row in rows] == [count_of(sequence(number)) for number in range(STEPS)]
    assert [int(row["time_ns"]) for row in rows] == [time_ns(number) for number in range(STEPS)]
    assert rows[1]["time_utc"] == "2026-01-01T00:00:00.001000123"
    assert [row["mode"] for row in rows[:2]] == ["open", "closed"]
    assert rows[0]["reasons"] == "stroke slew"
    assert rows[REFUSED]["reasons"] == "saturated"
    assert rows[REFUSED]["error_z2_nm"] == rows[UNTRUE]["true_residual_rms_nm"] == ""
    assert float(rows[3]["frame_to_command_us"]) == 4.003
    for place, noll in enumerate(toy.NOLL):
        for stem, values in (("error", history.steps.error_nm), ("true_disturbance", stack(6, UNTRUE))):
            read = np.array([float(row[f"{stem}_z{noll}_nm"] or "nan") for row in rows], np.float32)
            np.testing.assert_array_equal(read, values[:, place])
    table = Table.read(tmp_path / "out.csv")
    np.testing.assert_array_equal(np.array(table["command_z4_nm"], np.float32), stack(3)[:, 2])


def test_npz(log: Path, history: History, tmp_path: Path) -> None:
    figures = export_log(log, Format.NPZ, tmp_path / "out.npz", frames=True, console=QUIET)
    assert figures["files"] == [str(tmp_path / "out.npz"), str(tmp_path / "out.frames.npy")]
    assert figures["frames"] == STEPS
    with np.load(tmp_path / "out.npz", allow_pickle=False) as found:
        np.testing.assert_array_equal(found["sequence"], history.steps.sequence)
        np.testing.assert_array_equal(found["pol_nm"], stack(2, REFUSED))
        np.testing.assert_array_equal(found["true_residual_nm"], stack(7, UNTRUE))
        np.testing.assert_array_equal(found["mirror_stroke_nm"], [abs(surface_nm(one)).max() for one in range(STEPS)])
        assert found["time_utc"][2] == np.datetime64(time_ns(2), "ns")
        reference = CALIBRATED
        np.testing.assert_array_equal(found["calibration_reference"].ravel(), reference.reference)
        np.testing.assert_array_equal(found["calibration_response_per_nm"][1].ravel(), reference.response[:, 1])
        assert found["calibration_id"] == reference.id
        assert json.loads(str(found["metadata_json"]))["lowfc"]["run"] == "night"
        np.testing.assert_array_equal(found["frame_sequence"], history.frame_sequence)
    frames = np.load(tmp_path / "out.frames.npy", mmap_mode="r")
    np.testing.assert_array_equal(frames, [pixels(number) for number in range(STEPS)])


def test_fits(log: Path, history: History, tmp_path: Path) -> None:
    export_log(log, Format.FITS, tmp_path / "out.fits", frames=True, console=QUIET)
    with fits.open(tmp_path / "out.fits", checksum=True) as units:
        units.verify("exception")
        assert units[0].header["RATE"] == 1000
        assert "lowfc: run = night" in list(units[0].header["COMMENT"])
        np.testing.assert_array_equal(units["FRAMES"].data, [pixels(number) for number in range(STEPS)])
        np.testing.assert_array_equal(units["FRAME_TIMES"].data["sequence"], history.frame_sequence.astype(np.int64))
        np.testing.assert_array_equal(units["FRAME_TIMES"].data["time_ns"], [time_ns(one) for one in range(STEPS)])
        assert units["RECONSTRUCTOR_NM"].header["BUNIT"] == "nm"
        np.testing.assert_array_equal(units["RECONSTRUCTOR_NM"].data[2].ravel(), CALIBRATED.reconstructor[2])
    table = Table.read(tmp_path / "out.fits", hdu="STEPS", mask_invalid=False)
    units_of = {name: str(table[name].unit or "") for name in table.colnames}
    assert units_of["error_nm"] == "nm"
    assert units_of["time_ns"] == "ns"
    assert units_of["compute_us"] == "us"
    assert units_of["flux_dn"] == "adu"
    np.testing.assert_array_equal(table["sequence"], history.steps.sequence.astype(np.int64))
    np.testing.assert_array_equal(table["error_nm"], stack(1, REFUSED))
    np.testing.assert_array_equal(table["flux_dn"], history.steps.flux_dn)
    assert table["reasons"][REFUSED].strip() == Reason.SATURATED.name.lower()
    assert table["time_utc"][1] == "2026-01-01T00:00:00.001000123"


def test_aot(log: Path, history: History, tmp_path: Path) -> None:
    path = tmp_path / "out.aot.fits"
    export_log(log, Format.AOT, path, frames=True, console=QUIET)
    system = aotpy.AOSystem.read_from_file(path, exception_level=AOTFITSErrorLevel.WARNING)
    (loop,) = system.loops
    sensor, mirror = loop.input_sensor, loop.commanded_corrector
    calibration, good = CALIBRATED, GOOD

    def check(found: aotpy.Image, unit: str | None, expected: npt.ArrayLike) -> None:
        assert found.unit == unit
        assert found.data.shape == np.shape(expected)
        np.testing.assert_array_equal(found.data, expected)

    check(loop.modal_coefficients, "nm", stack(1, REFUSED))
    sent_m = np.array([surface_nm(number) * np.float32(1e-9) for number in range(STEPS)])
    sent_m[UNSENT] = np.nan
    check(loop.commands, "m", sent_m)
    check(loop.measurements_to_modes, "nm", calibration.reconstructor[:, None, good])
    check(loop.modes_to_measurements, "nm-1", calibration.response[good][:, None])
    check(loop.modes_to_commands, "m nm-1", calibration.modes_to_actuators * np.float32(1e-9))
    check(loop.time_filter_num, None, np.array([[0.5], [0.4], [0.3]], np.float32))
    check(loop.time_filter_den, None, [[-1, 1], [-0.875, 1], [-0.75, 1]])
    assert loop.modes.data.shape == (MODES, 64, 64)
    inside = np.abs(loop.modes.data).sum(axis=0) > 0
    products = np.einsum("iyx,jyx->ij", loop.modes.data, loop.modes.data) / inside.sum()
    np.testing.assert_allclose(products, np.eye(MODES), atol=0.02)
    np.testing.assert_allclose(loop.time.timestamps, history.steps.time_ns / 1e9, rtol=0, atol=1e-6)
    assert list(loop.time.frame_numbers) == [count_of(sequence(number)) for number in range(STEPS)]
    assert loop.modal_coefficients.time is loop.commands.time is loop.time
    assert (loop.closed, loop.framerate, loop.delay) == (True, 1000, 1.25)

    check(sensor.detector.pixel_intensities, "adu", [pixels(number) for number in range(STEPS)])
    check(sensor.detector.dark, "adu", calibration.dark.reshape(toy.SHAPE))
    check(sensor.ref_measurements, None, calibration.reference[None, good])
    assert sensor.n_valid_subapertures == good.sum() == (sensor.subaperture_mask.data >= 0).sum()
    assert sensor.wavelength == pytest.approx(calibration.wavelength_nm * 1e-9)
    assert mirror.uid == "dm"
    assert mirror.n_valid_actuators == len(mirror.actuator_coordinates) == ACTUATORS
    across = [coordinate.x for coordinate in mirror.actuator_coordinates[: toy.GRID[1]]]
    np.testing.assert_allclose(np.diff(across), 2.0 / 31.0)
    assert system.main_telescope.enclosing_diameter == 2.0
    told = {one.key: one.value for one in system.metadata}
    assert (told["CALID"], told["RUN"], told["EPERADU"]) == (calibration.id, "night", 2.0)
    assert json.loads(system.config) == Configuration().model_dump()


@pytest.mark.parametrize("to", list(Format))
def test_a_truncated_log_without_truth(tmp_path: Path, to: Format) -> None:
    part = write(tmp_path / "cut.mcap", without=(TRUTH,), finished=False)
    figures = export_log(part, to, console=QUIET)
    assert figures["files"] == [str(tmp_path / f"cut.{'aot.fits' if to is Format.AOT else to}")]
    assert 0 < figures["steps"] < STEPS
    assert not figures["finished"]
    assert "truncated" in render(figures)
    if to is Format.CSV:
        heading = (tmp_path / "cut.csv").read_text().splitlines()[0]
        assert "error_z2_nm" in heading
        assert "true" not in heading


@pytest.mark.parametrize("to", list(Format))
def test_no_steps(tmp_path: Path, to: Format) -> None:
    empty = write(tmp_path / "empty.mcap", without=(STEP,))
    with pytest.raises(DataFileError, match="no steps"):
        export_log(empty, to, console=QUIET)
    assert list(tmp_path.iterdir()) == [empty]


@pytest.mark.parametrize("to", [Format.NPZ, Format.FITS, Format.AOT])
def test_half_a_file_is_never_left(tmp_path: Path, to: Format) -> None:
    odd = write(tmp_path / "odd.mcap", odd_frame=STEPS - 1)
    with pytest.raises(DataFileError, match="export without --frames"):
        export_log(odd, to, frames=True, console=QUIET)
    assert list(tmp_path.iterdir()) == [odd]


def test_mistakes(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigurationError, match="no place for frames"):
        export_log(log, Format.CSV, frames=True, console=QUIET)
    with pytest.raises(DataFileError, match="cannot be written"):
        export_log(log, Format.CSV, tmp_path / "nowhere" / "out.csv", console=QUIET)
    monkeypatch.setitem(sys.modules, "aotpy", None)
    monkeypatch.delitem(sys.modules, "lowfc.programs.export.aot", raising=False)
    with pytest.raises(ConfigurationError, match=r"pip install .*\[aot\]'"):
        export_log(log, Format.AOT, console=QUIET)


def test_nothing_is_replaced_unless_forced(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    out.write_text("mine")
    with pytest.raises(DataFileError, match="--force"):
        export_log(log, Format.CSV, out, console=QUIET)
    assert out.read_text() == "mine"
    app = new_app("Test.")
    app.command()(export)
    done = CliRunner().invoke(app, [str(log), "--to", "csv", "--out", str(out), "--force", "--json"])
    assert done.exit_code == 0
    assert json.loads(done.stdout)["steps"] == STEPS
    assert out.read_text().startswith("sequence,")


@pytest.mark.parametrize("name", ["night.mcap", "other.mcap", "torn.mcap", "linked.csv"])
def test_a_log_is_not_replaced_even_if_forced(tmp_path: Path, name: str) -> None:
    source = write(tmp_path / "night.mcap")
    (tmp_path / "other.mcap").write_bytes(source.read_bytes())
    (tmp_path / "linked.csv").symlink_to(source)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(b"?" + source.read_bytes()[1:])
    before = (tmp_path / name).read_bytes()
    with pytest.raises(DataFileError, match="never overwritten"):
        export_log(torn if name == torn.name else source, Format.CSV, tmp_path / name, force=True, console=QUIET)
    assert (tmp_path / name).read_bytes() == before


def test_frames_do_not_replace_a_log(log: Path, tmp_path: Path) -> None:
    frames = tmp_path / "out.frames.npy"
    frames.write_bytes(log.read_bytes())
    with pytest.raises(DataFileError, match="never overwritten"):
        export_log(log, Format.NPZ, tmp_path / "out.npz", frames=True, force=True, console=QUIET)
    assert frames.read_bytes() == log.read_bytes()


def test_several_logs_are_exported_in_turn(tmp_path: Path) -> None:
    logs = [str(write(tmp_path / f"{name}.mcap")) for name in "ab"]
    app = new_app("Test.")
    app.command()(export)
    for words in (["--json"], ["--out", str(tmp_path / "c.csv")]):
        assert isinstance(CliRunner().invoke(app, [*logs, "--to", "csv", *words]).exception, ConfigurationError)
    assert CliRunner().invoke(app, [*logs, "--to", "csv"]).exit_code == 0
    assert {path.name for path in tmp_path.glob("*.csv")} == {"a.csv", "b.csv"}


@pytest.mark.parametrize("to", [Format.NPZ, Format.FITS])  # with aot they are copied as with fits
def test_frames_are_not_held_in_memory(tmp_path: Path, to: Format) -> None:
    frames, shape = 90, (200, 200)
    big = write(tmp_path / "big.mcap", steps=frames, shape=shape)
    size = frames * shape[0] * shape[1] * 2
    export_log(big, to, tmp_path / "warm.out", console=QUIET)  # imports
    tracemalloc.start()
    try:
        figures = export_log(big, to, tmp_path / "out.out", frames=True, console=QUIET)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert figures["frames"] == frames
    assert sum(Path(file).stat().st_size for file in figures["files"]) > size
    assert peak < size / 2
