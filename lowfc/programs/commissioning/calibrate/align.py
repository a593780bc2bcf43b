"""`lowfc calibrate align`: resample the computed calibration to the pixels of a real sensor."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from lowfc.adapters.files import factory
from lowfc.adapters.files.whole_file import require_folder
from lowfc.arrays import Array, single
from lowfc.client import Client, configuration_of
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError, raised_as
from lowfc.control.calibration.alignment import Alignment, Geometry, align, onto
from lowfc.control.calibration.calibration import Calibration, normalise_flux
from lowfc.control.calibration.response_fit import correlation
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.commissioning.analytic import analytic
from lowfc.programs.commissioning.calibrate.pokes import AMPLITUDE_NM, first_poke_plan, largest_amplitude_nm
from lowfc.programs.commissioning.calibrate.recording import Player, check_size, next_frames
from lowfc.programs.commissioning.calibrate.result import compute_reconstructor
from lowfc.programs.commissioning.calibrate.tasks import reporter, write

MIN_CORRELATION = 0.5
"""Smallest mean correlation of pokes' images with the computed ones; below it the sensor is not the configured one."""


class AlignResult(Result):
    """Placement of the sensor's image relative to the computed one, and how well the images agree."""

    pixels_per_lambda_d: float = result_field("scale", "pixels per lambda/D", ".4f")
    scale: float = result_field()
    row: float = result_field("centre, row", form=".2f")
    column: float = result_field("centre, column", form=".2f")
    rotation_deg: float = result_field("rotation", "degrees", ".2f")
    parity: int = result_field("parity, -1 if reflected")
    flux_dn: float = result_field("light", "DN", ".4g")
    background_dn: float = result_field("background", "DN", ".3g")
    residual: float = result_field("residual of the image", form=".1%")
    other_parity_residual: float = result_field("residual, other parity", form=".1%")
    file: str = result_field("written")

    def remarks(self) -> Sequence[str]:
        """Confirmation that a poke determined the sign."""
        return ["the pokes have the right sign"]


def align_sensor(out: Path, run: str | None, frames: int, *, load: bool) -> AlignResult:
    """Fit the sensor's geometry, and write the computed calibration for its pixels; CalibrationError without a fit."""
    require_folder(out)
    console = Console(stderr=True)
    with Client(run) as loop, loop.reserved("lowfc calibrate align"):
        config, in_use = configuration_of(loop), replace(loop.calibration(), camera=loop.camera())
        pixels = next_frames(loop, frames)
        check_size(pixels.shape[1:], in_use)
        light_dn = pixels.mean(axis=0) - in_use.dark.reshape(in_use.shape).astype(np.float64)
        computed = analytic(config, console)
        with raised_as(CalibrationError, ValueError):
            model = computed.reference.astype(np.float64).reshape(computed.shape)
            alignment = align(light_dn, model, in_use.good.reshape(in_use.shape) > 0)
            in_use = replace(in_use, flux_dn=float(light_dn.reshape(-1) @ in_use.good))
        player = Player(loop, on_sensor(config, computed, alignment.geometry, in_use), reporter(console))

        def poke(mode: int) -> Array:
            amplitude_nm = min(AMPLITUDE_NM["poke"], float(largest_amplitude_nm(config, player.in_use)[mode]))
            return player.first_poke(mode, first_poke_plan(amplitude_nm)).response

        alignment, calibration, mean_correlation = oriented(config, computed, alignment, in_use, poke)
        if mean_correlation < MIN_CORRELATION:
            raise CalibrationError(
                f"the images of pokes do not resemble the computed ones: the correlation is {mean_correlation:.2f}, "
                f"expected {MIN_CORRELATION:g} or more; is the mirror turned or reflected relative to the pupil? "
                "Correct that in its driver, or measure the response with `lowfc commission`"
            )
        write(calibration, out, loop if load else None)
    return AlignResult(
        **asdict(alignment.geometry),
        pixels_per_lambda_d=alignment.geometry.scale * computed_scale(config),
        flux_dn=in_use.flux_dn,
        background_dn=alignment.background,
        residual=alignment.residual,
        other_parity_residual=alignment.other_parity,
        file=str(out),
    )


def on_sensor(config: Configuration, computed: Calibration, geometry: Geometry, in_use: Calibration) -> Calibration:
    """The computed calibration on the pixels of a real sensor, with flux, dark and good pixels of `in_use`.

    CalibrationError if too little of the image falls on the good pixels.
    """
    shape, pixels = (*computed.shape, -1), in_use.good.size  # shape: rows, columns, modes
    I0 = onto(computed.reference.astype(np.float64).reshape(computed.shape), geometry, in_use.shape).reshape(-1)
    H = onto(computed.response.astype(np.float64).reshape(shape), geometry, in_use.shape).reshape(pixels, -1)
    good = in_use.good.astype(np.float64)
    with raised_as(CalibrationError, (ValueError, CalibrationError), "too little of the image falls on the sensor"):
        I0, H = normalise_flux(np.maximum(I0, 0), H, good)
        calibration = replace(
            computed,
            reference=single(I0),
            response=single(H),
            reconstructor=np.zeros(H.T.shape, np.float32),
            good=in_use.good,
            dark=in_use.dark,
            shape=in_use.shape,
            flux_dn=in_use.flux_dn,
            saturation_dn=in_use.saturation_dn,
            estimator=f"{config.control.estimator}+aligned",
            operator_hash="",
            camera=in_use.camera,
        )
        R = compute_reconstructor(config, calibration, None, estimator=config.control.estimator).matrix
    return with_identity(replace(calibration, reconstructor=single(R)))


def oriented(
    config: Configuration,
    computed: Calibration,
    alignment: Alignment,
    in_use: Calibration,
    poke: Callable[[int], Array],
) -> tuple[Alignment, Calibration, float]:
    """Choose the orientation that fits pokes of tip, and of tilt if needed, among those that the image allows.

    `poke(k)` measures the response (pixels,) to mode k; `alignment` is the fit of the image. Other arguments as for
    `on_sensor`.

    Returns:
        The alignment, its calibration, and the mean correlation of measured with computed responses.
    """
    orientations = alignment.orientations
    modes = range(min(len(orientations) // 2, len(computed.noll)))
    responses = [poke(mode) for mode in modes]

    def scored(geometry: Geometry) -> tuple[float, Calibration]:
        calibration = on_sensor(config, computed, geometry, in_use)
        return float(np.mean([correlation(responses[k], calibration.response[:, k]) for k in modes])), calibration

    if alignment.circular:  # the responses' correlation is a cosine of the rotation: two values give its maximum
        orientations = [
            each.rotated(float(np.degrees(np.arctan2(scored(each.rotated(90))[0], scored(each)[0]))))
            for each in orientations[::2]
        ]
    scores, candidates = zip(*map(scored, orientations), strict=True)
    best = int(np.argmax(scores))
    geometry, residuals = orientations[best], (alignment.residual, alignment.other_parity)
    residual, other = residuals if geometry.parity == alignment.geometry.parity else residuals[::-1]
    found = replace(alignment, geometry=geometry, residual=residual, other_parity=other)
    return found, candidates[best], scores[best]


def computed_scale(config: Configuration) -> float:
    """Pixels of the computed image per lambda/D; for a pupil-plane sensor, per pupil diameter."""
    optics = factory.sensor(config, lambda _: None)
    return 1 / (optics.pitch * optics.binning)


def geometry_in_words(alignment: Alignment, scale: float) -> str:
    """Text of the image's geometry and of the fit's residual; `scale` in pixels per lambda/D."""
    geometry = alignment.geometry
    return (
        f"{scale:.4f} pixels per lambda/D, centre at row {geometry.row:.2f}, column "
        f"{geometry.column:.2f}, rotation {geometry.rotation_deg:.2f} degrees, "
        f"{'reflected' if geometry.parity < 0 else 'not reflected'}; the image differs from the computed one by "
        f"{alignment.residual:.1%} rms ({alignment.other_parity:.1%} with the other parity)"
    )
