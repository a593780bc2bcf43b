"""`lowfc calibrate align`: the computed calibration on the pixels of a real sensor."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from lowfc.adapters.files import factory
from lowfc.adapters.files.whole_file import require_folder
from lowfc.adapters.process.terminal import configuration
from lowfc.arrays import Array, single
from lowfc.client import Client, configuration_of
from lowfc.contract.codecs.calibration_codec import identified
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError, ConfigurationError
from lowfc.control.calibration.alignment import Alignment, Geometry, align, onto
from lowfc.control.calibration.calibration import Calibration, normalise_flux
from lowfc.programs.cli.result import Result, figure
from lowfc.programs.commissioning.analytic import analytic
from lowfc.programs.commissioning.calibrate.pokes import AMPLITUDE_NM, sequence
from lowfc.programs.commissioning.calibrate.recording import Player, watch
from lowfc.programs.commissioning.calibrate.result import reconstructed
from lowfc.programs.commissioning.calibrate.tasks import images, reporter, written


class AlignResult(Result):
    """How the sensor is placed relative to the computed image."""

    pixels_per_lambda_d: float = figure("scale", "pixels per lambda/D", ".4f")
    scale: float = figure()
    row: float = figure("centre, row", form=".2f")
    column: float = figure("centre, column", form=".2f")
    rotation_deg: float = figure("rotation", "degrees", ".2f")
    parity: int = figure("parity, -1 where it is reflected")
    flux_dn: float = figure("light", "DN", ".4g")
    background_dn: float = figure("background", "DN", ".3g")
    residual: float = figure("part of the image that is left", form=".1%")
    other_parity_residual: float = figure("left with the other parity", form=".1%")
    half_turn_known: bool = figure()
    file: str = figure("written")

    def remarks(self) -> Sequence[str]:
        """Whether the sign is known."""
        if self.half_turn_known:
            return ["pokes are seen with the right sign"]
        return ["only a poke shows whether it is half a turn more: --half-turn is the other one"]


def aligned(
    file: Path | None,
    out: Path,
    run: str | None,
    frames: int,
    image: Path | None,
    *,
    half_turn: bool,
    load: bool,
) -> AlignResult:
    """Fit the geometry, resample the computed calibration, write it.

    Raises:
        CalibrationError: the image is not like the computed one, or pokes are not seen.
        ConfigurationError: an option is of no meaning with the others.
        DataFileError: a file cannot be read or written.
    """
    if image is None and file is not None:
        raise ConfigurationError("--config goes with --file: a running loop is aligned by its own configuration")
    if image is not None and load:
        raise ConfigurationError(
            "--load goes with the frames of a running loop: after --file, load what it wrote with `lowfc ctl load`"
        )
    require_folder(out)
    if image is not None:
        config = configuration(file)
        picture, sign_known = images(image).mean(axis=0), False
        computed = analytic(config, Console(stderr=True))
        found = _fit(computed, picture, half_turn)
        made = on_sensor(config, computed, found.geometry, found.flux, picture.shape, None)
        written(made, out, None)
    else:
        with Client(run) as loop, loop.reserved("lowfc calibrate align"):
            config, before = configuration_of(loop), replace(loop.calibration(), camera=loop.camera())
            pixels = watch(loop, frames)
            if pixels.shape[1:] != before.shape:
                raise CalibrationError(
                    f"the frames have {pixels.shape[1]} x {pixels.shape[2]} pixels, the calibration in use is for "
                    f"{before.shape[0]} x {before.shape[1]}, and so are its dark and bad pixels: `lowfc commission` "
                    "measures one for these frames"
                )
            dark = before.dark.reshape(before.shape).astype(np.float64)
            computed = analytic(config, Console(stderr=True))
            found = _fit(computed, pixels.mean(axis=0) - dark, half_turn)
            made = on_sensor(config, computed, found.geometry, found.flux, before.shape, before)
            sign_known = True
            mode = int(np.argmax(np.linalg.norm(made.response, axis=0)))
            seen = Player(loop, made, reporter(Console(stderr=True))).first_poke(mode, sequence(AMPLITUDE_NM["poke"]))
            if seen.picture @ made.response[:, mode] < 0:
                found = replace(found, geometry=found.geometry.turned())
                made = on_sensor(config, computed, found.geometry, found.flux, before.shape, before)
            written(made, out, loop if load else None)
    return AlignResult(
        **asdict(found.geometry),
        pixels_per_lambda_d=found.geometry.scale * computed_scale(config),
        flux_dn=found.flux,
        background_dn=found.background,
        residual=found.residual,
        other_parity_residual=found.other_parity,
        half_turn_known=sign_known,
        file=str(out),
    )


def on_sensor(
    config: Configuration,
    computed: Calibration,
    geometry: Geometry,
    flux: float,
    shape: tuple[int, ...],
    before: Calibration | None,
) -> Calibration:
    """A computed calibration on real pixels (rows, columns); dark and mask are those of `before`.

    Raises:
        CalibrationError: too little of the image falls on the sensor.
    """
    rows, columns = shape
    own = (*computed.shape, -1)
    I0 = onto(computed.reference.astype(np.float64).reshape(computed.shape), geometry, (rows, columns)).reshape(-1)
    H = onto(computed.response.astype(np.float64).reshape(own), geometry, (rows, columns)).reshape(rows * columns, -1)
    good = np.ones(I0.size) if before is None else before.good.astype(np.float64)
    dark = np.zeros(I0.size, np.float32) if before is None else before.dark
    try:
        I0, H = normalise_flux(np.maximum(I0, 0), H, good)
        made = reconstructed(config, I0, H, None, good, flux, estimator=config.control.estimator)
    except (ValueError, CalibrationError) as error:
        raise CalibrationError(f"too little of the image falls on the sensor: {error}") from None
    return identified(
        replace(
            computed,
            reference=single(I0),
            response=single(H),
            reconstructor=single(made.matrix),
            good=single(good),
            dark=dark,
            shape=(rows, columns),
            flux_dn=flux,
            saturation_dn=computed.saturation_dn if before is None else before.saturation_dn,
            estimator=f"{config.control.estimator}+aligned",
            operator_hash="",
            camera=None if before is None else before.camera,
        )
    )


def computed_scale(config: Configuration) -> float:
    """Pixels per lambda/D of the computed image; per pupil diameter where the sensor sees the pupil."""
    optics = factory.sensor(config, lambda _: None)
    return 1 / (optics.pitch * optics.binning)


def _fit(computed: Calibration, image: Array, half_turn: bool) -> Alignment:
    try:
        found = align(image, computed.reference.astype(np.float64).reshape(computed.shape))
    except ValueError as error:
        raise CalibrationError(str(error)) from None
    return replace(found, geometry=found.geometry.turned()) if half_turn else found


def in_words(found: Alignment, scale: float) -> str:
    """Where the image is, and what is left of it; `scale` in pixels per lambda/D."""
    geometry = found.geometry
    return (
        f"{scale:.4f} pixels per lambda/D, centre at row {geometry.row:.2f}, column "
        f"{geometry.column:.2f}, rotation {geometry.rotation_deg:.2f} degrees, "
        f"{'reflected' if geometry.parity < 0 else 'not reflected'}; {found.residual:.1%} of the image is left "
        f"({found.other_parity:.1%} with the other parity)"
    )
