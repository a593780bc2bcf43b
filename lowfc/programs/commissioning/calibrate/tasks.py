"""The tasks of `lowfc calibrate`, on a running loop or on files; each returns a result."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from lowfc.adapters.files import calibration_file, factory
from lowfc.adapters.files.array_file import read_array
from lowfc.adapters.files.mirror_maps import shape_of
from lowfc.adapters.files.whole_file import require_folder
from lowfc.adapters.process.progress import percentage_bar
from lowfc.adapters.process.terminal import configuration
from lowfc.arrays import Array, single
from lowfc.client import Client, configuration_of
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError, ConfigurationError, DataFileError, raised_as
from lowfc.control.calibration.adapted import with_dark, with_reference
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.dark_frames import check_dark, measure_dark
from lowfc.control.calibration.response_fit import normalised
from lowfc.control.loop.estimator import saturated_pixels
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.twin.twin import Twin, node_radii
from lowfc.optics.twin.twin_mirror import TwinMirror, wavefront_nm
from lowfc.programs.cli.modes import HIGHEST
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.commissioning.analytic import WavefrontFunction, analytic
from lowfc.programs.commissioning.calibrate.pokes import CalibrationRequest
from lowfc.programs.commissioning.calibrate.recording import Report, check_size, next_frames, warn_of_added_shapes
from lowfc.programs.commissioning.calibrate.result import (
    CalibrationResult,
    compute_reconstructor,
    finish_calibration,
    result_of,
)
from lowfc.programs.commissioning.calibrate.run import Calibrator, partial_path

_LARGEST_NM = 1e5  # largest amplitude of a mode in --at


class DarkResult(Result):
    """A measured dark, and the number of bad pixels by kind."""

    frames: int = result_field("frames")
    dark_dn: float = result_field("dark, median", "DN", ".4g")
    noise_dn: float = result_field("noise, median", "DN", ".3g")
    hot: int = result_field("hot pixels")
    noisy: int = result_field("noisy pixels")
    dead: int = result_field("dead pixels")
    file: str = result_field("written")


class ReferenceResult(Result):
    """Shift of the zero point."""

    frames: int = result_field("frames")
    noll: list[int] = result_field("mode", form="Z{}", column=True)
    reference_shift_nm: list[float] = result_field("zero point moved by", "nm", "+.2f", column=True)
    flux_dn: float = result_field("light", "DN", ".4g")
    file: str = result_field("written")


def calibrate_with_pokes(request: CalibrationRequest, run: str | None, *, load: bool) -> CalibrationResult:
    """Calibrate a running loop with pokes and write the file; with `load`, load a recommended calibration."""
    require_folder(request.out, partial_path(request.out))
    console = Console(stderr=True)
    report = reporter(console)
    with contextlib.ExitStack() as stack:
        loop = stack.enter_context(Client(run))
        config = configuration_of(loop)
        computed = analytic(config, console)
        progress = stack.enter_context(percentage_bar(console))
        lease = stack.enter_context(loop.reserved(f"lowfc calibrate --method {request.method}"))
        progress = lease.expecting(progress, config.camera.rate_hz)
        calibrator = Calibrator(loop, request, report, progress, computed)
        try:
            with calibrator.required_mode():
                calibration, result = finish_calibration(calibrator, calibrator.run())
                if result.recommended:
                    if load:
                        with calibrator.opened("to load the calibration"):
                            loop.load(calibration)
                    partial_path(request.out).unlink(missing_ok=True)
        except BaseException:
            if calibrator.completed and partial_path(request.out).is_file():
                cycles = counted(calibrator.completed, "cycle")
                report(f"kept in {partial_path(request.out)}: {cycles}; the same command with --resume continues")
            raise
    result.not_loaded = load and not result.recommended
    return result


def compute_calibration(
    file: Path | None, request: CalibrationRequest, at: str | None, run: str | None, *, load: bool
) -> CalibrationResult:
    """Compute a calibration from a configuration, at a flat or the given wavefront; write it, and load it if `load`."""
    require_folder(request.out)
    config = configuration(file)
    name, wavefront = ("", None) if at is None else zero_point(config, at)
    calibration = analytic(config, Console(stderr=True), wavefront)
    # with fitted nuisance parameters, R does not follow from I0 and H
    initial = calibration.reconstructor.astype(np.float64) if config.control.nuisance else None
    options = {"truncate": request.truncate, "tikhonov": request.tikhonov}
    reconstruction = compute_reconstructor(config, calibration, initial, estimator=config.control.estimator, **options)
    if name:
        calibration = replace(calibration, estimator=f"{calibration.estimator}+at {name}")
    if request.truncate or request.tikhonov:
        R = reconstruction.matrix
        actuators = single(R @ calibration.response @ calibration.actuators_to_modes)  # R H: what R measures of a mode
        estimator = f"{calibration.estimator}+regularised"
        calibration = replace(calibration, reconstructor=single(R), actuators_to_modes=actuators, estimator=estimator)
    with Client(run) if load else contextlib.nullcontext() as loop:
        calibration = write(calibration, request.out, loop)
    return result_of(config, calibration, reconstruction, "analytic", request.out)


def zero_point(config: Configuration, text: str) -> tuple[str, WavefrontFunction]:
    """The wavefront of --at: modes as in 4=15,7=-10 (Noll index = nm rms), or a file as for `lowfc ctl channel`.

    Returns:
        The wavefront's name in a calibration, and the function that computes the wavefront.
    """
    if "=" not in text and Path(text).suffix:
        shape = shape_of(config, "--at", text)
        return ("a shape", lambda _, mirror: wavefront_nm(mirror, shape).astype(np.float64))
    modes_nm = _modes(text)

    def of_modes(optics: Twin, _: TwinMirror) -> Array:
        return np.array(list(modes_nm.values())) @ zernikes(list(modes_nm), *node_radii(optics))

    return ",".join(f"{mode}={amplitude_nm:g}" for mode, amplitude_nm in modes_nm.items()), of_modes


def _modes(text: str) -> dict[int, float]:
    modes_nm: dict[int, float] = {}
    for part in text.split(","):
        index, _, value = part.partition("=")
        try:
            mode, amplitude_nm = int(index), float(value)
        except ValueError:
            raise ConfigurationError(f"--at must be modes in nm, as in 4=15,7=-10, or a file; got {part!r}") from None
        if not 2 <= mode <= HIGHEST or mode in modes_nm or not abs(amplitude_nm) <= _LARGEST_NM:
            raise ConfigurationError(
                f"--at: {part!r} is not a Noll index of 2 or more (at most {HIGHEST}), named once, and its amplitude "
                f"in nm (at most {_LARGEST_NM:g})"
            )
        modes_nm[mode] = amplitude_nm
    return modes_nm


def take_dark(out: Path, run: str | None, frames: int, file: Path | None, *, load: bool) -> DarkResult:
    """Write the calibration in use with a new dark and bad pixels, from the loop's frames or a file's."""
    require_folder(out)
    with Client(run) as loop, _in_use(loop) as (in_use, noise_and_gain):
        cube = next_frames(loop, frames) if file is None else images(file)
        if file is None:
            check_size(cube.shape[1:], in_use)
        elif cube.shape[1:] != in_use.shape:
            raise DataFileError(f"{file}: its frames have {cube.shape[1:]} pixels, the calibration {in_use.shape}")
        measured = measure_dark(cube.reshape(len(cube), -1))
        check_dark(measured.dark_dn, in_use.reference.astype(np.float64), in_use.flux_dn)
        calibration = with_dark(in_use, measured.dark_dn, measured.good, *noise_and_gain)
        write(calibration, out, loop if load else None)
    counts = {name: int(np.count_nonzero(getattr(measured, name))) for name in ("hot", "noisy", "dead")}
    level, noise_dn = float(np.median(measured.dark_dn)), float(np.median(measured.noise_dn))
    return DarkResult(frames=len(cube), dark_dn=level, noise_dn=noise_dn, **counts, file=str(out))


def take_reference(out: Path, run: str | None, frames: int, *, load: bool) -> ReferenceResult:
    """Write the calibration in use with the present image as the reference image."""
    require_folder(out)
    with Client(run) as loop, loop.reserved("lowfc calibrate reference"), _in_use(loop) as (in_use, noise_and_gain):
        warn_of_added_shapes(loop, reporter(Console(stderr=True)))
        cube = next_frames(loop, frames)
        loop.check_lease()  # without the lease another client may have changed the mirror's shape and the zero point
        check_size(cube.shape[1:], in_use)
        pixels, allowed = cube.reshape(frames, -1), configuration_of(loop).control.max_saturated_pixels
        if (saturated := max(saturated_pixels(in_use, frame) for frame in pixels)) > allowed:
            raise CalibrationError(
                f"a frame has {counted(saturated, 'good pixel')} at full well, {in_use.saturation_dn:g} DN; the loop "
                f"uses frames with at most {allowed}: shorten the exposure, or dim the star"
            )
        light, flux = normalised(pixels, in_use.dark.astype(np.float64), in_use.good.astype(np.float64))
        image = light.mean(axis=0)
        calibration = with_reference(in_use, image, float(flux.mean()), *noise_and_gain)
        calibration = write(calibration, out, loop if load else None)
    shift = in_use.reconstructor.astype(np.float64) @ (image - in_use.reference)
    shift_nm, noll = shift.tolist(), list(calibration.noll)
    return ReferenceResult(
        frames=frames, noll=noll, reference_shift_nm=shift_nm, flux_dn=calibration.flux_dn, file=str(out)
    )


@contextlib.contextmanager
def _in_use(loop: Client) -> Iterator[tuple[Calibration, tuple[float, float]]]:
    """Context with the calibration in use, and the camera's read noise per pixel, e-, and gain, e-/DN."""
    camera = factory.detector(configuration_of(loop))
    noise_and_gain = factory.equivalent_read_noise_e(camera), camera.gain_e_per_dn / camera.em_gain
    in_use = replace(loop.calibration(), camera=loop.camera())
    if in_use.camera is not None:  # also with frames from a file: the calibration is written with this camera
        check_size(in_use.camera.shape, in_use)
    with raised_as(CalibrationError, ValueError):
        yield in_use, noise_and_gain


def write(calibration: Calibration, out: Path, loop: Client | None) -> Calibration:
    """Write a calibration with its identity, and load it unless `loop` is None; return it with the identity."""
    calibration = with_identity(calibration)
    calibration_file.save(calibration, out)
    if loop is not None:
        loop.load(calibration)
    return calibration


def images(file: Path) -> Array:
    """Frames (frames, rows, columns) of a file's image or cube."""
    data = read_array(file, "frames are an array (rows, columns) or (frames, rows, columns)", (2, 3))
    return np.asarray(data, dtype=np.float64).reshape(-1, *data.shape[-2:])


def reporter(console: Console) -> Report:
    """Make a function that prints a line; warnings are yellow."""

    def report(text: str) -> None:
        style = "yellow" if text.startswith("warning") else None
        console.print(text, style=style, highlight=False, soft_wrap=True, markup=False)

    return report
