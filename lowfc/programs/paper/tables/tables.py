"""Tables 1 and 2, and the tables of `lowfc validate` by name."""

from collections.abc import Iterator

import numpy as np

from lowfc.adapters.files.layouts import load_layout
from lowfc.contract.sections import SensorSection
from lowfc.optics.chain.zernike import NOLLS_14, mode_name
from lowfc.programs.paper.cases import Case, Context, Row, prepared
from lowfc.programs.paper.tables import anchors, tolerance
from lowfc.programs.paper.tables.conditioning import conditioning
from lowfc.programs.paper.tables.photometry import defocus_waves, differential, photometry
from lowfc.programs.paper.tables.pointing import table4
from lowfc.programs.paper.tables.reconstruction import table3

PAPER_TABLE2 = dict(
    zip(
        NOLLS_14,
        (
            *(5.42e-2, 5.34e-2, 7.58e-3, 8.37e-3, 7.31e-3, 1.03e-1, 1.02e-1),
            *(4.74e-3, 3.96e-3, 1.92e-2, 1.88e-2, 2.57e-2, 1.72e-3, 1.78e-3),
        ),
        strict=True,
    )
)
"""The paper's peak differential intensity for lambda/30 rms of a mode, by its Noll index."""
TABLE2_SENSORS = ("sam", "sam27d07_bal14", "sam27d10_bal14", "bowtie", "clowfs", "zwfs")


def table1(context: Context) -> list[Row]:
    """Rows of Table 1, and of parameters in the text of Sects. 2 and 3."""
    sensor, section, clowfs = prepared("sam").optics, SensorSection(), SensorSection(kind="clowfs")
    layout = load_layout(section.sam)
    diameters = sorted({hole[2] for hole in layout.holes})
    scaled = "The model uses focal lengths and diameters only by their ratio."
    ripple = "The paper's ripple pupil is not published: ours is made by linear programming for the same mask."
    waves = defocus_waves(clowfs, sensor.wavelength_nm)
    return [
        Row("pupil", "focal ratio, 200 mm over 10 mm", "", clowfs.focal_ratio, 20.0, assumption=scaled),
        Row("pupil", "samples across the diameter", "", len(sensor.pupil), 512),
        Row("pupil", "kind", "", section.pupil, "ripple shaped pupil", assumption=ripple),
        Row("light", "central wavelength", "nm", sensor.wavelength_nm, 550.0),
        Row("focal-plane mask", "radius", "lambda/D", section.focal_radius, 4.0),
        Row("focal planes", "samples per lambda/D", "", sensor.samples_per, 8),
        Row("sparse aperture mask", "holes", "", len(layout.holes), 27, assumption=f"Layout {layout.name}."),
        Row("sparse aperture mask", "smallest hole", "pupil diameters", diameters[0], 0.07),
        Row("sparse aperture mask", "largest hole", "pupil diameters", diameters[-1], 0.07),
        Row("sensor image", "pixels per lambda/D", "", sensor.samples_per / sensor.binning, 4.0),
        Row("sensor image", "pixels across", "", sensor.pixels, 80),
        Row("sensor image", "width", "lambda/D", sensor.pixels * sensor.binning / sensor.samples_per, 20.0),
        Row("clowfs", "defocus", "mm", clowfs.defocus_mm, 6.0),
        Row("clowfs", "defocus, peak to valley", "waves", waves, 3.4),
        Row("clowfs", "inner radius of the reflecting disk", "lambda/D", clowfs.inner_radius, 0.0),
    ]


def table2(context: Context) -> list[Row]:
    """Rows of Table 2: change of the image by lambda/30 of each mode."""
    names = context.names(*TABLE2_SENSORS)
    return [row for name in names for row in _peaks(context, name)]


def _peaks(context: Context, name: str) -> Iterator[Row]:
    sensor = prepared(name)
    peaks = context.map(f"table2 {name}", lambda noll: float(np.abs(differential(sensor, noll)).max()), NOLLS_14)
    assumption = (
        "lambda/30 rms with the full exp(i phi). (I - I0) / I0 is taken as the peak of |I - I0| over the peak of I0, "
        "because I0 has dark pixels, where the ratio of single pixels has no bound."
    )
    for noll, value in zip(NOLLS_14, peaks, strict=True):
        quantity, paper = f"peak differential intensity of Z{noll}, {mode_name(noll)}", PAPER_TABLE2[noll]
        yield Row(name, quantity, "", value, paper if sensor.paper_name == "sam" else None, assumption=assumption)


TABLES: dict[str, Case] = {
    "table1": Case("Table 1: parameters of the model", table1),
    "table2": Case("Table 2: peak differential intensity", table2),
    "table3": Case("Table 3: residuals of random wavefronts", table3),
    "table4": Case("Table 4: scatter of tilt estimates", table4),
    "conditioning": Case("Sect. 4: condition numbers", conditioning),
    "photometry": Case("Sect. 3.3: photometry, and the paper's inconsistencies", photometry),
}

ADDITIONAL: dict[str, Case] = {
    "anchors": Case("Anchors: published values and lowfc's", anchors.anchors, anchors.plot, None, anchors.ABOUT),
    "tolerance": Case(
        "Tolerated drift and vibration lines",
        tolerance.tolerance,
        tolerance.plot,
        tolerance.is_printed,
        tolerance.ABOUT,
    ),
}
