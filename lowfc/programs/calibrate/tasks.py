"""What `lowfc calibrate` does: a running loop, files, a progress bar; each returns its figures and its text."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import TextColumn, TimeRemainingColumn

from lowfc.adapters import calibration_file, instrument
from lowfc.adapters.array_file import read_array
from lowfc.adapters.progress import Counted, counting_bar, spoken
from lowfc.adapters.terminal import configuration
from lowfc.adapters.whole_file import require_folder
from lowfc.client import Client, configuration_of
from lowfc.contract.calibration_codec import identified
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError, DataFileError
from lowfc.control.adapted import with_dark, with_reference
from lowfc.control.calibration import Calibration
from lowfc.control.dark_frames import Dark, dark_of, light_in
from lowfc.control.regularised import Reconstruction, advice, reconstruct
from lowfc.control.response_fit import normalised
from lowfc.control.wording import counted
from lowfc.programs.analytic import analytic
from lowfc.programs.calibrate.at import zero_point
from lowfc.programs.calibrate.finish import finished
from lowfc.programs.calibrate.partial import partial_of
from lowfc.programs.calibrate.pokes import Wanted
from lowfc.programs.calibrate.recording import watch
from lowfc.programs.calibrate.result import (
    comparison,
    comparison_text,
    figures,
    text_of,
)
from lowfc.programs.calibrate.run import Calibrator

Found = tuple[dict[str, Any], str]
MOST_LIGHT = 0.02
"""Part of the star's light that may be in dark frames."""


def poked(asked: Wanted, run: str | None, truncate: float, tikhonov: float, *, load: bool) -> Found:
    """Calibrate a running loop and write the file, once nothing else can go wrong.

    Raises:
        CalibrationError: pokes are not seen, frames are lost, or H is not above its noise.
        BusError: there is no such loop.
        DataFileError: a file cannot be written, or there is nothing to go on from.
    """
    require_folder(asked.out)
    console = Console(stderr=True)
    say = sayer(console)
    kept = partial_of(asked.out)
    with contextlib.ExitStack() as held:
        loop = held.enter_context(Client(run))
        computed = analytic(configuration_of(loop), console)
        progress = held.enter_context(shown_progress(console, say))
        lease = held.enter_context(loop.reserved(f"lowfc calibrate --method {asked.method}"))
        progress = lease.expecting(progress, configuration_of(loop).camera.rate_hz)
        calibrator = Calibrator(loop, asked, say, progress, computed)
        held.enter_context(_telling_what_is_kept(calibrator, kept, say))
        held.enter_context(calibrator.holding())
        done = finished(calibrator, asked, calibrator.run(), computed, None, truncate, tikhonov)
        if not done.faults:
            kept.unlink(missing_ok=True)
            if load:
                loop.load(done.calibration)
    return done.figures, done.text + ("\nit is not loaded" if load and done.faults else "")


@contextlib.contextmanager
def shown_progress(console: Console, say: Callable[[str], None]) -> Iterator[Counted]:
    """A bar on a terminal, else a line every 10 s."""
    if not console.is_terminal:
        yield spoken(say)
        return
    with counting_bar(console, TextColumn("{task.percentage:.0f} %"), TimeRemainingColumn()) as count:
        yield count


@contextlib.contextmanager
def _telling_what_is_kept(calibrator: Calibrator, kept: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Where a calibration does not come to its end: which cycles it can go on with."""
    try:
        yield
    except BaseException:
        if calibrator.kept:
            kept_cycles = counted(calibrator.kept, "cycle")
            say(f"kept in {kept}: {kept_cycles}, with which the same command with --resume goes on")
        raise


def computed(
    file: Path | None, out: Path, truncate: float, tikhonov: float, at: str | None, run: str | None, *, load: bool
) -> Found:
    """Compute a calibration from a configuration, flat or at a wavefront, and write the file.

    Raises:
        CalibrationError: this sensor cannot tell the modes apart.
        ConfigurationError: there is no such wavefront.
        DataFileError: the file cannot be written.
    """
    require_folder(out)
    config = configuration(file)
    there = None if at is None else zero_point(config, at)
    made = analytic(config, Console(stderr=True), None if there is None else there.wavefront)
    quality = quality_of(config, made, truncate, tikhonov)
    if there is not None:
        made = replace(made, estimator=f"{made.estimator}+at {there.name}")
    if truncate or tikhonov:
        made = _with_matrix(made, quality)
    made = identified(made)
    calibration_file.save(made, out)
    if load:
        with Client(run) as loop:
            loop.load(made)
    found = figures(config, made, quality, "analytic", None, None, None, None, None, out)
    return found, f"{text_of(found)}\n{advice(quality, made.noll, config.control.limit_nm)}"


def compared(one: Path, other: Path) -> Found:
    """How two calibration files differ."""
    found = comparison(calibration_file.load(one), calibration_file.load(other))
    return found, comparison_text(found, (one.name, other.name))


def darkened(out: Path, run: str | None, frames: int, file: Path | None, *, load: bool) -> Found:
    """The calibration in use with a dark and a mask, from the loop's frames or a cube of them.

    Raises:
        CalibrationError: the frames are not dark.
        DataFileError: the cube cannot be read, or the file not be written.
    """
    require_folder(out)
    with Client(run) as loop:
        before, config = replace(loop.calibration(), camera=loop.camera()), configuration_of(loop)
        found, count = _dark_frames(loop, before, frames) if file is None else _dark_file(file, before)
        camera = instrument.detector(config)
        try:
            made = with_dark(
                before,
                found.dark_dn,
                found.good,
                instrument.equivalent_read_noise_e(camera),
                camera.gain_e_per_dn / camera.em_gain,
            )
        except ValueError as error:
            raise CalibrationError(str(error)) from None
        made = identified(made)
        calibration_file.save(made, out)
        if load:
            loop.load(made)
    counts = {name: int(np.count_nonzero(getattr(found, name))) for name in ("hot", "noisy", "dead")}
    level, noise = float(np.median(found.dark_dn)), float(np.median(found.noise_dn))
    sentence = (
        f"dark {level:.2f} DN, noise {noise:.2f} DN; bad pixels: {counts['hot']} hot, {counts['noisy']} noisy, "
        f"{counts['dead']} dead\nwritten: {out}"
    )
    return {"frames": count, "dark_dn": level, "noise_dn": noise, **counts, "file": str(out)}, sentence


def referenced(out: Path, run: str | None, frames: int, *, load: bool) -> Found:
    """The calibration in use with the present image as its reference.

    Raises:
        CalibrationError: there is no light.
        DataFileError: the file cannot be written.
    """
    require_folder(out)
    with Client(run) as loop:
        before, config = replace(loop.calibration(), camera=loop.camera()), configuration_of(loop)
        pixels = watch(loop, frames).reshape(frames, -1)
        camera = instrument.detector(config)
        try:
            light, flux = normalised(pixels, before.dark.astype(np.float64), before.good.astype(np.float64))
            image = light.mean(axis=0)
            made = with_reference(
                before,
                image,
                float(flux.mean()),
                instrument.equivalent_read_noise_e(camera),
                camera.gain_e_per_dn / camera.em_gain,
            )
        except ValueError as error:
            raise CalibrationError(str(error)) from None
        made = identified(made)
        calibration_file.save(made, out)
        if load:
            loop.load(made)
    moved = before.reconstructor.astype(np.float64) @ (image - before.reference)
    text = ", ".join(f"Z{index} {shift:+.2f}" for index, shift in zip(made.noll, moved, strict=True))
    found = {
        "frames": frames,
        "noll": list(made.noll),
        "reference_shift_nm": moved.tolist(),
        "flux_dn": made.flux_dn,
        "file": str(out),
    }
    return found, f"the zero point moved by (nm): {text}\nwritten: {out}"


def _dark_frames(loop: Client, before: Calibration, frames: int) -> tuple[Dark, int]:
    """The dark of the loop's next frames; the star must not be in them."""
    found = _dark(watch(loop, frames), before, "the camera")
    light = light_in(found.dark_dn, before.reference.astype(np.float64))
    if light > MOST_LIGHT * before.flux_dn:
        raise CalibrationError(
            f"the frames are not dark: {light / before.flux_dn:.1%} of the star's light is in them; block the star"
        )
    return found, frames


def _dark_file(file: Path, before: Calibration) -> tuple[Dark, int]:
    """The dark of a cube of frames."""
    cube = images(file)
    return _dark(cube, before, str(file)), len(cube)


def _dark(cube: npt.NDArray[np.number], before: Calibration, whose: str) -> Dark:
    if cube.shape[1:] != before.shape:
        raise DataFileError(f"{whose}: frames of {cube.shape[1:]}, the calibration has {before.shape}")
    try:
        return dark_of(cube.reshape(len(cube), -1))
    except ValueError as error:
        raise CalibrationError(f"{whose}: {error}") from None


def quality_of(config: Configuration, calibration: Calibration, truncate: float, tikhonov: float) -> Reconstruction:
    """Singular values of a computed calibration, and R with some of them suppressed."""
    camera = instrument.detector(config)
    try:
        return reconstruct(
            calibration.reference.astype(np.float64),
            calibration.response.astype(np.float64),
            None,
            calibration.good.astype(np.float64),
            calibration.flux_dn * camera.gain_e_per_dn / camera.em_gain,
            instrument.equivalent_read_noise_e(camera),
            config.control.estimator,
            truncate,
            tikhonov,
        )
    except ValueError as error:
        raise CalibrationError(str(error)) from None


def _with_matrix(calibration: Calibration, quality: Reconstruction) -> Calibration:
    matrix = np.ascontiguousarray(quality.matrix, dtype=np.float32)
    return replace(calibration, reconstructor=matrix, estimator=f"{calibration.estimator}+regularised")


def images(file: Path) -> npt.NDArray[np.float64]:
    """Frames (frames, rows, columns) of a file's image or cube.

    Raises:
        DataFileError: there are none, or the file is damaged.
    """
    data = read_array(file, "frames are an array (rows, columns) or (frames, rows, columns)", (2, 3))
    return np.asarray(data, dtype=np.float64).reshape(-1, *data.shape[-2:])


def sayer(console: Console) -> Callable[[str], None]:
    """A line for people, warnings in yellow."""

    def say(text: str) -> None:
        style = "yellow" if text.startswith("warning") else None
        console.print(text, style=style, highlight=False, soft_wrap=True, markup=False)

    return say
