"""Automatic gains for stars of all magnitudes: effect of closing the loop, and comparison with the best fixed gains."""

from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from typing import Any

import numpy as np
from rich.progress import track
from threadpoolctl import threadpool_limits

from lowfc.adapters.files import factory
from lowfc.arrays import Array
from lowfc.contract.configuration import FIXED_GAINS, Configuration
from lowfc.contract.errors import CalibrationError
from tools.law_bench import Bench, calibrated, configured
from tools.modal_bench import ModalBench
from tools.shared import Results, formatted_table

PRESETS = ("bench", "thermal", "reaction-wheel", "quiet")
MAGNITUDES = tuple(range(-1, 9))
BRIGHT = (-1, 0, 2)
SEEDS = tuple(range(1, 9))
IMAGED = ("sam", "zwfs")
"""Sensors for which some stars are repeated with simulated images."""
MODAL = ("sam", "sam27d10_bal14", "clowfs", "zwfs", "bar")
IMAGED_MAGNITUDES = (2, 5, 8)
SHOWN = (-1, *IMAGED_MAGNITUDES)
TOLERATED = 0.01
"""Tolerated added contrast as a fraction of the dark zone's own, beyond three standard errors (none for `quiet`)."""
RATE_HZ, SECONDS = 250.0, 20.0
GAINS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.1)
_HALF_FRAMES = int(RATE_HZ * SECONDS / 2)
_AUTO = {"control.tilt_gain": "auto", "control.gain": "auto"}


def _configured(sensor: str, preset: str, magnitude: float, seed: int, gains: dict[str, Any]) -> Configuration:
    keys: dict[str, Any] = {"disturbance.preset": preset, "star.magnitude": magnitude, "camera.rate_hz": RATE_HZ}
    return configured(sensor, seed, **keys | gains | {"control.start_mode": "closed"})


@lru_cache(maxsize=64)
def _noise_nm2(sensor: str, magnitude: float) -> Array:
    """Covariance (modes, modes) of one frame's noise."""
    config = _configured(sensor, "bench", magnitude, 1, {})
    return factory.frame_noise_nm2(config, calibrated(config))


@lru_cache(maxsize=8)
def _contrast(sensor: str) -> tuple[Array, float]:
    """Quadratic form (modes, modes) of the added contrast, per nm^2, and the dark zone's own contrast."""
    contrast = factory.contrast_of(_configured(sensor, "bench", 0.0, 1, {}))
    return contrast.form, contrast.by_image(np.zeros(len(contrast.noll)))


@lru_cache(maxsize=64)
def _open_nm2(preset: str, seed: int) -> Array:
    """Mean squares (modes,) of the disturbance over the second half; independent of sensor and star."""
    config = _configured("sam", preset, 0.0, seed, FIXED_GAINS)
    bench = ModalBench(config, np.eye(len(config.noll)))
    bench.ask("open")
    return _residual_nm2(bench)


def _residual_nm2(bench: ModalBench) -> Array:
    bench.run(_HALF_FRAMES, record=False)
    bench.run(_HALF_FRAMES)
    return np.asarray(np.square(bench.residual_nm()).mean(axis=0))


def _closed_nm2(sensor: str, preset: str, magnitude: float, seed: int, gains: dict[str, Any]) -> Array:
    """Mean squares (modes,) of the closed loop's residual over the second half."""
    return _residual_nm2(ModalBench(_configured(sensor, preset, magnitude, seed, gains), _noise_nm2(sensor, magnitude)))


def modal_case(case: tuple[str, str, float]) -> Results:
    """Contrast added by closing the loop for a sensor, preset and star, simulated with `ModalBench`.

    Only the diagonal of the quadratic form counts. For bright stars it also compares the residual with that of the best
    fixed gains.
    """
    sensor, preset, magnitude = case
    try:
        _noise_nm2(sensor, magnitude)
    except CalibrationError as error:
        if "the star saturates" not in str(error):
            raise
        return {"sensor": sensor, "preset": preset, "magnitude": magnitude, "saturates": str(error)}
    residual_nm2 = np.array([_closed_nm2(*case, seed, _AUTO) for seed in SEEDS])
    disturbance_nm2 = np.array([_open_nm2(preset, seed) for seed in SEEDS])
    row = _row(case, residual_nm2, disturbance_nm2)
    if magnitude in BRIGHT and preset != "quiet":
        seeds = SEEDS[:2]
        fixed = np.array(
            [
                np.mean([_closed_nm2(*case, seed, dict.fromkeys(_AUTO, gain)) for seed in seeds], axis=0)
                for gain in GAINS
            ]
        )
        best = fixed[:, :2].sum(axis=1).min() + fixed[:, 2:].sum(axis=1).min()  # tip and tilt; other modes
        row["of_best"] = float(np.sqrt(residual_nm2[: len(seeds)].sum(axis=1).mean() / best))
    return row


def imaged_case(case: tuple[str, str, float]) -> Results:
    """As `modal_case` without fixed gains, with every image simulated."""
    sensor, preset, magnitude = case
    calibration = calibrated(_configured(sensor, preset, magnitude, 1, _AUTO))
    residual_nm2, disturbance_nm2 = list[Array](), list[Array]()
    for seed in SEEDS:
        bench = Bench(_configured(sensor, preset, magnitude, seed, _AUTO), calibration)
        bench.run(2 * _HALF_FRAMES)
        truths = [truth.continuous for truth in bench.truths[-_HALF_FRAMES:]]
        for name, means in (("residual_nm", residual_nm2), ("disturbance_nm", disturbance_nm2)):
            modes_nm = np.array([getattr(truth, name) for truth in truths], float)
            means.append(np.square(modes_nm).mean(axis=0))
    return _row(case, np.array(residual_nm2), np.array(disturbance_nm2)) | {"images": True}


def _row(case: tuple[str, str, float], residual_nm2: Array, disturbance_nm2: Array) -> Results:
    """Results of a case from mean squares (seeds, modes)."""
    sensor, preset, magnitude = case
    form, dark_zone_contrast = _contrast(sensor)
    change = (residual_nm2 - disturbance_nm2) @ np.diag(form)
    error = float(change.std(ddof=1) / np.sqrt(len(change)))
    return {
        "sensor": sensor,
        "preset": preset,
        "magnitude": magnitude,
        "change": float(change.mean()),
        "error": error,
        "own": dark_zone_contrast,
        "open_nm": float(np.sqrt(disturbance_nm2.sum(axis=1).mean())),
        "closed_nm": float(np.sqrt(residual_nm2.sum(axis=1).mean())),
    }


def harms(row: Results) -> bool:
    """Whether closing the loop adds more contrast than tolerated."""
    allowed_sigmas = 0 if row["preset"] == "quiet" else 3
    return bool(row["change"] > allowed_sigmas * row["error"] + TOLERATED * row["own"])


def measure() -> Results:
    """All cases."""
    modal_cases = [(one, preset, star) for one in MODAL for preset in PRESETS for star in MAGNITUDES]
    imaged_cases = [(one, preset, star) for one in IMAGED for preset in PRESETS for star in IMAGED_MAGNITUDES]
    with threadpool_limits(1), ProcessPoolExecutor(initializer=threadpool_limits, initargs=(1,)) as pool:
        rows = list(track(pool.map(modal_case, modal_cases), "modes", total=len(modal_cases)))
        rows += list(track(pool.map(imaged_case, imaged_cases), "images", total=len(imaged_cases)))
    return {"rows": rows, "seeds": len(SEEDS), "rate_hz": RATE_HZ, "seconds": SECONDS}


def render(results: Results) -> str:
    """Wavefront in open and closed loop by sensor, preset and star (V in `SHOWN`), and the harmful cases."""
    rows = [row for row in results["rows"] if "saturates" not in row]
    modal = [row for row in rows if "images" not in row]
    table = []
    for sensor, magnitude in dict.fromkeys((row["sensor"], row["magnitude"]) for row in modal):
        by_preset = {row["preset"]: row for row in modal if (row["sensor"], row["magnitude"]) == (sensor, magnitude)}
        if magnitude in SHOWN:
            table.append(
                {"sensor": sensor, "magnitude": magnitude}
                | {preset: "{open_nm:.2f} -> {closed_nm:.2f}".format(**row) for preset, row in by_preset.items()}
            )
    harmful, saturated = [row for row in rows if harms(row)], len(results["rows"]) - len(rows)
    stars = _magnitudes(modal)
    bright = [row for row in rows if "of_best" in row]
    ratios = [row["of_best"] for row in bright]
    names = "; ".join(
        "{sensor}, {preset}, V = {magnitude}: {added:.2g}".format(**row, added=row["change"] / row["own"])
        for row in harmful
    )
    heads = {"sensor": "`{sensor}`", "V": "{magnitude}"} | {
        f"`{name}`, nm rms": f"{{{name}}}" for name in PRESETS if name != "quiet"
    }
    return (
        f"{formatted_table(heads, table)}\n"
        f"True wavefront, open loop -> closed loop with automatic gains, over the second half of "
        f"{results['seconds']:g} s at {results['rate_hz']:g} Hz, mean of {results['seeds']} seeds. "
        f"{len(rows)} cases (V = {stars}; these presets and `quiet`; {len(rows) - len(modal)} of them with every image "
        f"simulated); {saturated} more were excluded because the star saturates the detector. Added contrast excludes "
        "the cross terms between modes. A case counts as harmful if closing adds more contrast than "
        f"{100 * TOLERATED:g} % of the dark zone's own plus three standard errors (`quiet`: {100 * TOLERATED:g} % "
        f"alone). Harmful cases, with the ratio of added contrast to the dark zone's own: {names or 'none'}. On bright "
        f"stars (V = {_magnitudes(bright)}; without `quiet`; two seeds) the residual with automatic gains is "
        f"{min(ratios):.2f} to {max(ratios):.2f} times the residual with the best fixed gains, chosen afterwards."
    )


def _magnitudes(rows: list[Results]) -> str:
    return ", ".join(f"{magnitude:g}" for magnitude in sorted({row["magnitude"] for row in rows}))
