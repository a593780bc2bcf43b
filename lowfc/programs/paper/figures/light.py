"""Figures 2, 3, 4 and 10: light in the planes of the sensor, its focal-plane masks, and differences of images."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lowfc.arrays import Array
from lowfc.design.fisher import variance_e2
from lowfc.design.paper import STAR, TABLE4_EXPOSURE_S, TABLE4_READ_NOISE_E
from lowfc.design.trials import noisy_e
from lowfc.optics.chain.fourier import to_image, to_pupil
from lowfc.optics.chain.relay import ApertureMask, PupilImage
from lowfc.optics.chain.zernike import mode_name
from lowfc.optics.detector.photometry import electrons
from lowfc.programs.paper import plots
from lowfc.programs.paper.cases import Case, Context, Prepared, Row, assuming, prepared
from lowfc.programs.paper.tables.photometry import PAPER_PEAK, PAPER_SIGNAL, differential, tilt_signal
from lowfc.programs.paper.tables.pointing import PAPER_FOCAL_MASK, PAPER_PUPIL, PAPER_RELAY_MASK
from lowfc.programs.paper.tables.tables import PAPER_TABLE2

_TABLE_NOLLS = (4, 5, 6, 7, 8)
_PLOT_NOLLS = (4, 5, 7)
_VIEW, _VIEW_SAMPLES_PER = 10, 8  # half width of a picture, lambda/D; samples per lambda/D
_FAINTEST = {"focal": 1e-8, "relay": 1e-4, "sensor": 1e-5}  # least intensity shown, relative to the peak, by plane


@assuming(
    "Flat wavefront at the central wavelength. Our pupil and layout differ from the paper's, which are not published."
)
def fig2(context: Context) -> Iterator[Row]:
    """Fraction of the light that passes each plane, Fig. 2 and Sect. 3.3."""
    for name in context.names("sam"):
        sensor = prepared(name)
        budget, relay = sensor.budget, PAPER_RELAY_MASK if sensor.paper_name == "sam" else None
        yield Row(name, "shaped pupil / open circle", "", budget.pupil, PAPER_PUPIL)
        yield Row(name, "reflected by the focal-plane mask / light on it", "", budget.focal_mask, PAPER_FOCAL_MASK)
        yield Row(name, "sensor / reflected by the focal-plane mask", "", budget.sensor, relay)
        yield Row(name, "brightest pixel / light on the sensor", "", budget.peak, PAPER_PEAK.get(sensor.paper_name))


def plot_fig2(context: Context, path: Path) -> None:
    """Draw Fig. 2: intensities in the focal plane, after the aperture mask and on the sensor."""
    sensor = prepared(context.names("sam")[0])
    optics = sensor.optics
    pupil = optics.pupil.astype(np.complex128)
    sky = np.abs(to_image(pupil, 2 * _VIEW * _VIEW_SAMPLES_PER, _VIEW_SAMPLES_PER, 1.0)) ** 2
    panels: list[plots.Panel] = [
        plots.picture(sky / sky.max(), "focal plane", plots.SKY, _VIEW, (_FAINTEST["focal"], 1.0), "of peak", "log")
    ]
    if isinstance(optics.relay, ApertureMask):
        focal = to_image(pupil, len(optics.focal_mask), optics.samples_per, 1.0) * optics.focal_mask
        relay = np.abs(to_pupil(focal, len(pupil), optics.samples_per, 1.0)) ** 2
        transmitted = relay / relay.max() * optics.relay.transmission**2
        bounds = (_FAINTEST["relay"], 1.0)
        panels.append(plots.picture(transmitted, "after the aperture mask", plots.PUPIL, 0.5, bounds, "of peak", "log"))
    image, bounds = sensor.I0 / sensor.I0.max(), (_FAINTEST["sensor"], 1.0)
    panels.append(_on_sensor(sensor, image, "sensor, $I_0$", bounds, "of peak", "log"))
    plots.draw(path, panels, f"Fig. 2. {sensor.name}: flat wavefront at {optics.wavelength_nm:.0f} nm.")


@assuming(
    "The paper gives the reflected light for its own pupil and the disk only. "
    "The two wedges of the bowtie have an opening angle of 95 degrees."
)
def fig3(context: Context) -> Iterator[Row]:
    """Sizes and reflected light of the focal-plane masks, Fig. 3."""
    for name in context.names("sam", "bowtie"):
        sensor = prepared(name)
        mask, paper_name = np.abs(sensor.optics.focal_mask) ** 2, sensor.paper_name
        reflected = PAPER_FOCAL_MASK if paper_name == "sam" else None
        radius = len(mask) / (2.0 * sensor.optics.samples_per)
        yield Row(name, "outer radius", "lambda/D", radius, {"sam": 4.0, "bowtie": 10.0}.get(paper_name))
        yield Row(name, "reflecting area", "(lambda/D)^2", float(mask.sum()) / sensor.optics.samples_per**2)
        yield Row(name, "reflected / light on it", "", sensor.budget.focal_mask, reflected)


def plot_fig3(context: Context, path: Path) -> None:
    """Draw Fig. 3: the disk and the bowtie."""
    chosen = [prepared(name) for name in context.names("sam", "bowtie")]
    widest = max(len(sensor.optics.focal_mask) for sensor in chosen)
    panels: list[plots.Panel] = []
    for sensor in chosen:
        mask = np.abs(sensor.optics.focal_mask) ** 2
        padded = np.pad(mask, (widest - len(mask)) // 2)
        half_width = widest / (2.0 * sensor.optics.samples_per)
        panels.append(plots.picture(padded, sensor.name, plots.SKY, half_width, (0.0, 1.0), "reflectivity"))
    plots.draw(path, panels, "Fig. 3. Focal-plane masks: bright parts reflect to the sensor.")


@assuming(
    "lambda/30 rms, full optical chain, no noise; 'normalised to unity' is interpreted as divided by I0's brightest "
    "pixel. The layout differs from the paper's."
)
def fig4(context: Context) -> Iterator[Row]:
    """Largest change of the image by lambda/30, Fig. 4 and Table 2."""
    for name in context.names("sam"):
        sensor = prepared(name)
        for noll in _TABLE_NOLLS:
            yield Row(
                f"{name}, Z{noll} {mode_name(noll)}",
                "peak of abs(I - I0) / peak of I0",
                "",
                float(np.abs(differential(sensor, noll)).max()),
                PAPER_TABLE2[noll] if sensor.paper_name == "sam" else None,
            )


def plot_fig4(context: Context, path: Path) -> None:
    """Draw Fig. 4: differential images of focus, astigmatism and coma."""
    sensor = prepared(context.names("sam")[0])
    panels: list[plots.Panel] = []
    for noll in _PLOT_NOLLS:
        change = differential(sensor, noll)
        bound = float(np.abs(change).max())
        panels.append(
            _on_sensor(sensor, change, f"Z{noll}, {mode_name(noll)}", (-bound, bound), "$(I - I_0)$ / peak", "signed")
        )
    plots.draw(path, panels, rf"Fig. 4. {sensor.name}: differential images of $\lambda$/30 rms, without noise.")


def _tilted_e(sensor: Prepared, axis: int) -> tuple[Array, Array]:
    """Electrons (pixels,) of a flat wavefront in Table 4's exposure, and their change by 1 mas of tilt."""
    light_e = electrons(STAR, TABLE4_EXPOSURE_S)
    return light_e * sensor.band_I0, light_e * tilt_signal(sensor, axis)


@assuming(
    f"1 mas, {TABLE4_EXPOSURE_S} s, V = {STAR.magnitude}, 20 % band in five wavelengths including both ends, "
    "1 e- read noise, our own photometry and masks, full optical chain. "
    "The image's signal-to-noise ratio is that of the matched filter."
)
def fig10(context: Context) -> Iterator[Row]:
    """Signal of 1 mas of tilt in a short exposure, Fig. 10 and Sect. 3.3."""
    for name in context.names("sam", "clowfs"):
        sensor = prepared(name)
        for axis in (0, 1):
            row_name, (flat_e, change_e) = f"{name}, tilt {'xy'[axis]}", _tilted_e(sensor, axis)
            signal_e, paper = float(np.ptp(change_e)), PAPER_SIGNAL.get(sensor.paper_name)
            ratio = np.abs(change_e) / np.sqrt(variance_e2(flat_e + change_e, TABLE4_READ_NOISE_E))
            yield Row(row_name, "P-V change of the image / its peak", "", signal_e / float(flat_e.max()), paper)
            yield Row(row_name, "P-V change of the image", "e-", signal_e)
            yield Row(row_name, "largest signal-to-noise ratio of a pixel", "", float(ratio.max()))
            yield Row(row_name, "signal-to-noise ratio of the image", "", float(np.sqrt(np.sum(ratio**2))))


def plot_fig10(context: Context, path: Path) -> None:
    """Draw Fig. 10: noisy differential images of 1 mas."""
    panels: list[plots.Panel] = []
    for name in context.names("sam", "clowfs"):
        sensor = prepared(name)
        flat_e, change_e = _tilted_e(sensor, 0)
        image_e = noisy_e(context.rng("fig10", name), flat_e + change_e, TABLE4_READ_NOISE_E)
        for values, title in ((image_e - flat_e, name), (change_e, f"{name}, without noise")):
            bound = float(np.percentile(np.abs(values), 99.8))
            panels.append(_on_sensor(sensor, values, title, (-bound, bound), "e-", "signed"))
    plots.draw(
        path,
        panels,
        f"Fig. 10. One exposure minus the noiseless image of a flat wavefront: 1 mas in x, {TABLE4_EXPOSURE_S} s, "
        f"V = {STAR.magnitude}, 20 % band, 1 e- read noise, our own photometry.",
        columns=2,
    )


def _on_sensor(
    sensor: Prepared, image: Array, title: str, bounds: tuple[float, float], unit: str, scale: plots.Scale
) -> plots.Panel:
    optics = sensor.optics
    axes = plots.PUPIL if isinstance(optics.relay, PupilImage) else plots.SKY
    half_width = optics.samples * optics.pitch / 2.0
    shape = (optics.pixels, optics.pixels)
    return plots.picture(image.reshape(shape), title, axes, half_width, bounds, unit, scale)


CASES = {
    "fig2": Case("Fig. 2: intensity in the planes of the sensor", fig2, plot_fig2),
    "fig3": Case("Fig. 3: focal-plane masks", fig3, plot_fig3),
    "fig4": Case("Fig. 4: differential images of focus, astigmatism and coma", fig4, plot_fig4),
    "fig10": Case("Fig. 10: differential images of 1 mas of tilt in a short exposure", fig10, plot_fig10),
}
