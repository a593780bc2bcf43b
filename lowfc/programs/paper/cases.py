"""Cases (tables and figures), the settings with which they are computed, and the prepared sensors."""

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import isfinite
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lowfc.adapters.files.layouts import layout_names
from lowfc.adapters.files.sensors import coronagraph_from, sensor_from
from lowfc.adapters.files.twin_cache import load_or_build
from lowfc.arrays import Array, Mask
from lowfc.contract.errors import ConfigurationError, raised_as
from lowfc.contract.sections import SENSORS, SensorSection, sensor_keys
from lowfc.control.calibration.calibration import normalise_flux, reconstructor
from lowfc.design.estimators import Fit, fit
from lowfc.design.trials import gram
from lowfc.optics.chain.band import Band, uniform
from lowfc.optics.chain.coronagraph import SAMPLES_PER, Coronagraph, contrast
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.sensor import LightBudget, Sensor, image, light_budget, reference, response, shear_response
from lowfc.optics.chain.zernike import NOLLS_20, zernikes
from lowfc.optics.twin.twin import ACCURATE, Evaluator, Twin, node_radii

DEFAULT_SAM = SensorSection().sam
Item = TypeVar("Item")
Result = TypeVar("Result")


class Prepared:
    """A sensor at the paper's sampling, with the quantities that the tables use, computed on first use."""

    def __init__(self, name: str, section: SensorSection, optics: Sensor | None = None) -> None:
        """Build the optics of a section's sensor, or use `optics` behind the section's coronagraph."""
        self.name, self.section = name, section
        self.optics = sensor_from(section) if optics is None else optics

    @property
    def paper_name(self) -> str:
        """Key of the paper's values: "sam" for any layout, "bowtie" also for bowtie:LAYOUT, else the sensor's name."""
        kind = self.name.partition(":")[0]
        if kind not in SENSORS:
            return "sam"
        return kind if kind == "bowtie" else self.name  # the paper has no values for clowfs:MM

    @cached_property
    def modes(self) -> Array:
        """The 20 modes (20, n, n) at the pupil's samples."""
        return modes_at(len(self.optics.pupil))

    @cached_property
    def open(self) -> Mask:
        """The open part (n, n) of the pupil, where wavefronts are compared."""
        return np.asarray(self.optics.pupil > 0.5)

    @cached_property
    def open_modes(self) -> Array:
        """The 20 modes (20, samples) in the open part of the pupil."""
        return self.modes[:, self.open]

    @cached_property
    def gram(self) -> Array:
        """Covariance (20, 20) of the modes over the open part."""
        return gram(self.open_modes)

    @cached_property
    def I0(self) -> Array:
        """Image (pixels,) of a flat wavefront at the central wavelength, fractions of the open circle's light."""
        return reference(self.optics).ravel()

    @cached_property
    def H(self) -> Array:
        """Derivative (pixels, 20) of the image per nm of each mode."""
        return response(self.optics, self.modes)

    @cached_property
    def band(self) -> Band:
        """The band of Sect. 3.3: 20 % in five wavelengths, both ends included."""
        return uniform(self.optics.wavelength_nm)

    @cached_property
    def band_I0(self) -> Array:
        """`I0` averaged over the band."""
        return reference(self.optics, self.band).ravel()

    @cached_property
    def band_H(self) -> Array:
        """`H` averaged over the band."""
        return np.hstack([self.band_tilt_H, response(self.optics, self.modes[2:], self.band)])

    @cached_property
    def band_tilt_H(self) -> Array:
        """The columns (pixels, 2) of `band_H` for tip and tilt, computed in a tenth of the time."""
        return response(self.optics, self.modes[:2], self.band)

    @cached_property
    def nuisance(self) -> Array:
        """Changes of the image (pixels, 3) by nuisance parameters: flux (relative), pupil shear x and y (diameters)."""
        return np.column_stack([self.I0, shear_response(self.optics)])

    @cached_property
    def budget(self) -> LightBudget:
        """Throughput of each element."""
        return light_budget(self.optics)

    @cached_property
    def coronagraph(self) -> Coronagraph:
        """Optics of the science image."""
        return coronagraph_from(self.section)

    @cached_property
    def twin(self) -> Twin:
        """The twin used by the iterations with the full model, accurate to about 1e-5 of the image."""
        return load_or_build(self.optics, ACCURATE)

    def opd_nm(self, modes_nm: Array) -> Array:
        """Wavefront (n, n) of the first modes (up to 20,) in nm."""
        return np.asarray(np.tensordot(modes_nm, self.modes[: len(modes_nm)], 1))

    def image(self, modes_nm: Array, band: Band | None = None) -> Array:
        """Image (pixels,) of the first modes (up to 20,) in nm by the full optical chain, the truth of the trials."""
        return image(self.optics, self.opd_nm(modes_nm), band).ravel()

    def star_image(self, modes_nm: Array, columns: int, samples_per: int = SAMPLES_PER) -> Array:
        """Contrast (columns, columns) around the star with a wavefront of the first modes (up to 20,) in nm."""
        opd_nm, wavelength_nm = self.opd_nm(modes_nm), self.optics.wavelength_nm
        return contrast(self.coronagraph, opd_nm, wavelength_nm, columns, samples_per=samples_per)

    def fit(
        self,
        modes: int,
        scale_e: float,
        read_noise_e: float,
        kind: str,
        in_band: bool = False,
        nuisance: Array | None = None,
    ) -> Fit:
        """A linear estimator of the first modes, at the central wavelength or over the band.

        `scale_e` is the open circle's light in electrons, `kind` is one of `KINDS`.
        """
        if in_band:
            I0, H = self.band_I0, self.band_tilt_H if modes <= 2 else self.band_H
        else:
            I0, H = self.I0, self.H
        with self._fitting(modes):
            return fit(I0, H[:, :modes], scale_e, read_noise_e, kind, nuisance)

    def loop_fit(self, I0: Array, H: Array, scale_e: float, read_noise_e: float) -> tuple[Array, Array]:
        """Normalised I0 (pixels,) and weighted R (modes, pixels) of a loop; `scale_e` as in `fit`, in electrons."""
        good = np.ones(I0.size)
        I0_normalised, H_normalised = normalise_flux(I0, H, good)
        flux_e = scale_e * float(I0.sum())
        with self._fitting(H.shape[1]):
            return I0_normalised, reconstructor(I0_normalised, H_normalised, good, flux_e, read_noise_e)

    def _fitting(self, modes: int) -> AbstractContextManager[None]:
        """Convert ValueError, raised by a fit if the sensor cannot distinguish the modes, to ConfigurationError."""
        return raised_as(ConfigurationError, ValueError, f"sensor {self.name}, {modes} modes")

    @cached_property
    def _evaluator(self) -> Evaluator:
        return Evaluator(self.twin)

    @cached_property
    def _node_modes(self) -> Array:
        return zernikes(NOLLS_20, *node_radii(self.twin))

    def model(self, modes_nm: Array) -> Array:
        """The same as `image` at the central wavelength, computed by the twin."""
        opd_nm = modes_nm @ self._node_modes[: len(modes_nm)]
        return np.asarray(self._evaluator.image(opd_nm.astype(np.float32)), np.float64).ravel()


@lru_cache(maxsize=1)
def modes_at(samples: int) -> Array:
    """The 20 modes (20, samples, samples) of a pupil."""
    u = 2.0 * pupil_axis(samples)
    return zernikes(NOLLS_20, u, u[:, None])


def sparse_apertures() -> tuple[str, ...]:
    """Names of the default sensor, and of a sensor with each of the other packaged layouts."""
    return "sam", *(name for name in layout_names() if name != DEFAULT_SAM)


@lru_cache(maxsize=64)
def prepared(name: str) -> Prepared:
    """The sensor of a name as in `section_of`, cached in the process."""
    return Prepared(name, section_of(name))


def section_of(name: str) -> SensorSection:
    """Section [sensor] for one of `SENSORS`, for a layout, for clowfs:MM with its defocus, or for bowtie:LAYOUT."""
    kind, _, detail = name.partition(":")
    if kind == "clowfs" and detail:
        try:
            return SensorSection(kind="clowfs", defocus_mm=float(detail))
        except ValueError:
            raise ConfigurationError(f"{name}: after the colon comes the defocus in mm, 1 to 50") from None
    return SensorSection.model_validate(
        {"focal_mask": "bowtie", "sam": detail} if kind == "bowtie" and detail else sensor_keys(name)
    )


@dataclass(frozen=True)
class Row:
    """One value of a table.

    Attributes:
        name: Object of the measurement: a sensor, a mode, an element.
        quantity: Measured quantity.
        unit: Unit of all numbers; "" if they have none.
        measured: Our value; None if it cannot be computed.
        paper: The paper's value; None if it has none.
        error: Standard error of `measured` if it is a mean or scatter over trials; None if it is deterministic.
        predicted: Theoretical prediction of `measured`; None if not computed.
        limit: The Cramer-Rao bound, or another limit described in the assumption; None if there is none.
        modes: Number of fitted modes; None if nothing is fitted.
        estimator: Name of the estimator; None if nothing is estimated.
        assumption: Assumptions where the paper is silent or contradicts itself, one per line.
    """

    name: str
    quantity: str
    unit: str
    measured: float | str | None
    paper: float | str | None = None
    error: float | None = None
    predicted: float | None = None
    limit: float | None = None
    modes: int | None = None
    estimator: str | None = None
    assumption: str | None = None


ORDER = (
    *("name", "modes", "estimator", "quantity", "unit"),
    *("paper", "measured", "error", "predicted", "limit", "assumption"),
)


def plain(row: Row) -> dict[str, Any]:
    """The row as a JSON object; numbers have six digits."""
    return {key: _plain(getattr(row, key)) for key in ORDER}


def _plain(value: float | str | None) -> float | str | None:
    """A value for JSON: floats rounded to six digits."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if isfinite(value) else str(value)  # JSON has no infinity


@dataclass(frozen=True)
class Context:
    """Settings with which a table is computed.

    Attributes:
        trials: Number of wavefronts and noise realisations.
        seed: Seed of all random numbers.
        jobs: Number of threads; the results do not depend on it.
        sensors: Sensors that replace the table's own, unless those are fixed; None for the table's own.
        progress: Called with a description, the number of steps done, and the total.
    """

    trials: int = 100
    seed: int = 1
    jobs: int = 1
    sensors: tuple[str, ...] | None = None
    progress: Callable[[str, int, int], object] = lambda *_: None

    def names(self, *own: str) -> tuple[str, ...]:
        """The requested sensors, or a table's own."""
        return self.sensors or own

    def rng(self, *key: str | int) -> np.random.Generator:
        """A random generator that depends only on the seed and the key, so that trials are independent."""
        numbers = [part if isinstance(part, int) else zlib.crc32(part.encode()) for part in key]
        return np.random.default_rng([self.seed, *numbers])

    def map(self, description: str, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Apply the function to all items on `jobs` threads, with progress; results in the order of the items."""
        todo: Sequence[Item] = list(items)
        results: list[Result] = []
        with ThreadPool(self.jobs) as pool:  # its threads are daemons: Ctrl-C does not wait for them
            for result in pool.imap(function, todo):
                results.append(result)
                self.progress(description, len(results), len(todo))
        return results


def assuming(assumption: str) -> Callable[[Callable[[Context], Iterable[Row]]], Callable[[Context], list[Row]]]:
    """Decorator of a function that yields the rows of a figure: all of them get this assumption."""

    def decorated(rows_of: Callable[[Context], Iterable[Row]]) -> Callable[[Context], list[Row]]:
        return lambda context: [replace(row, assumption=assumption) for row in rows_of(context)]

    return decorated


@dataclass(frozen=True)
class Case:
    """A table or figure: title, function that computes its rows, and function that plots it if there is a plot.

    `is_printed` tells whether text and page show a row of `plain`, if there are too many rows to show all. `about` is
    the introduction of the page of an additional table.
    """

    title: str
    run: Callable[[Context], list[Row]]
    plot: Callable[[Context, Path], None] | None = None
    is_printed: Callable[[Mapping[str, Any]], bool] | None = None
    about: str = ""
