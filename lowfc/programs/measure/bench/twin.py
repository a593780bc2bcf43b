"""Speed and accuracy of the real-time twin against the full optical chain, both on one thread."""

import platform
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from lowfc.adapters.files.sensors import sensor_named
from lowfc.adapters.files.twin_cache import load_or_build
from lowfc.adapters.process.terminal import Json
from lowfc.design.trials import PAPER_BOUNDS_WAVES, bounds_waves
from lowfc.optics.chain.band import gauss_legendre, monochromatic
from lowfc.optics.chain.sensor import image, pupil_radii
from lowfc.optics.chain.zernike import NOLLS_20, zernikes
from lowfc.optics.twin.twin import ACCURATE, FAST, Evaluator, node_radii
from lowfc.programs.cli.output import print_result

SENSOR, WAVEFRONTS = "sam", 20


def twin(as_json: Json = False) -> None:
    """Time the real-time twin against the full optical chain, both on one thread, in the same run.

    Example: lowfc bench twin --json
    """
    results = bench_twin()
    print_result(results, render(results), as_json=as_json)


def bench_twin(seconds: float = 1.0) -> dict[str, Any]:
    """Measure three twins; the results of the first, the default of the live loop, are also at the top level.

    Each time is the median for one frame, from the wavefront to the binned image; each model is timed for `seconds`.
    `relative_l2` is the largest relative error of the image over 20 random wavefronts of radial degrees 1 to 5, within
    the bounds of Subedi et al. 2015, Sect. 3.1.
    """
    optics = sensor_named(SENSOR)
    wavelength_nm = optics.wavelength_nm
    cases = (
        ("monochromatic, rank 60", FAST, monochromatic(wavelength_nm)),
        ("monochromatic, rank 80", ACCURATE, monochromatic(wavelength_nm)),
        ("20 % band in 3 wavelengths, rank 60", FAST, gauss_legendre(wavelength_nm)),
    )
    uniform = np.random.default_rng(1).uniform(-1.0, 1.0, (WAVEFRONTS, len(NOLLS_20)))
    coefficients_nm = wavelength_nm * uniform * bounds_waves(NOLLS_20, *PAPER_BOUNDS_WAVES)
    opds_nm = np.tensordot(coefficients_nm, zernikes(NOLLS_20, *pupil_radii(optics)), 1)
    results = []
    with threadpool_limits(1):
        truths = {band: [image(optics, opd_nm, band) for opd_nm in opds_nm] for band in {case[2] for case in cases}}
        for name, spec, band in cases:
            begin = time.perf_counter()
            twin = load_or_build(optics, spec, band)
            load_s = time.perf_counter() - begin
            evaluator = Evaluator(twin)
            node_opds_nm = (coefficients_nm @ zernikes(NOLLS_20, *node_radii(twin))).astype(np.float32)
            errors = []
            for truth, nodes_nm in zip(truths[band], node_opds_nm, strict=True):
                errors.append(float(np.linalg.norm(evaluator.image(nodes_nm) - truth) / np.linalg.norm(truth)))
            full_us = _median_us(partial(image, optics, band=band), opds_nm, seconds)
            twin_us = _median_us(evaluator.image, node_opds_nm, seconds)
            results.append(
                {
                    "name": name,
                    "wavelengths": len(band.wavelengths_nm),
                    "rank": len(twin.operators[0].to_modes),
                    "nodes": int(twin.used.size),
                    "twin_us": twin_us,
                    "full_us": full_us,
                    "ratio": full_us / twin_us,
                    "relative_l2": max(errors),
                    "load_s": load_s,
                }
            )
    top = {key: results[0][key] for key in ("twin_us", "full_us", "ratio", "relative_l2", "rank")}
    host = {"machine": platform.machine(), "python": platform.python_version(), "numpy": np.__version__}
    return {**top, "sensor": SENSOR, "wavefronts": WAVEFRONTS, "cases": results, "host": host}


def render(result: dict[str, Any]) -> str:
    """The result of `bench_twin` as a table."""
    lines = [f"{'case':<36} {'twin':>9} {'full chain':>12} {'ratio':>7} {'relative L2':>12}"]
    lines += [
        f"{case['name']:<36} {case['twin_us']:>6.0f} us {case['full_us']:>9.0f} us {case['ratio']:>6.0f}x "
        f"{case['relative_l2']:>12.1e}"
        for case in result["cases"]
    ]
    lines.append(
        f"one thread, median times; sensor {result['sensor']}; relative L2: largest relative error of the image over "
        f"{result['wavefronts']} random wavefronts"
    )
    return "\n".join(lines)


def _median_us(compute: Callable[[Any], object], wavefronts: NDArray[Any], seconds: float) -> float:
    """Median time to compute a frame, us, after a warm-up of three frames."""
    for wavefront in wavefronts[:3]:
        compute(wavefront)
    times: list[int] = []
    end = time.perf_counter() + seconds
    while not times or time.perf_counter() < end:
        wavefront = wavefronts[len(times) % len(wavefronts)]
        begin = time.perf_counter_ns()
        compute(wavefront)
        times.append(time.perf_counter_ns() - begin)
    return statistics.median(times) / 1000.0
