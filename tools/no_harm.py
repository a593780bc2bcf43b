"""Automatic gains for stars of all magnitudes: effect of closing the loop, and comparison with the best fixed gains."""

from collections.abc import Sequence
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
from tools.shared import Results, columns

PRESETS = ("bench", "thermal", "reaction-wheel", "quiet")
MAGNITUDES = tuple(range(-1, 9))
BRIGHT = (-1, 0, 2)
SEEDS = tuple(range(1, 9))
IMAGED = ("sam", "zwfs")
"""Sensors for which some stars are repeated with simulated images."""
MODAL = ("sam", "sam27d10_bal14", "clowfs", "zwfs", "bar")
IMAGED_MAGNITUDES = (2, 5, 8)
OF_DARK_ZONE = 0.01
"""Tolerated added contrast as a fraction of the dark zone's own, in addition to three standard errors."""
RATE_HZ, SECONDS = 250.0, 20.0
GAINS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.1)
_HALF = int(RATE_HZ * SECONDS / 2)
_AUTO = {"control.tilt_gain": "auto", "control.gain": "auto"}


def _configured(sensor: str, preset: str, magnitude: float, seed: int, gains: dict[str, Any]) -> Configuration:
    keys: dict[str, Any] = {"disturbance.preset": preset, "star.magnitude": magnitude, "camera.rate_hz": RATE_HZ}
    return configured(sensor, seed, **keys | gains | {"control.start_mode": "closed"})


@lru_cache(maxsize=64)
def _noise(sensor: str, magnitude: float) -> Array:
    config = _configured(sensor, "bench", magnitude, 1, {})
    return factory.frame_noise_nm2(config, calibrated(config))


@lru_cache(maxsize=8)
def _contrast(sensor: str) -> tuple[Array, float]:
    """Quadratic form (modes, modes) of the added contrast, per nm^2, and the dark zone's own contrast."""
    made = factory.contrast_of(_configured(sensor, "bench", 0.0, 1, {}))
    return made.form, made.by_image(np.zeros(len(made.noll)))


@lru_cache(maxsize=64)
def _open_nm2(preset: str, seed: int) -> Array:
    """Mean squares (modes,) of the disturbance over the second half, for any sensor and star."""
    config = _configured("sam", preset, 0.0, seed, FIXED_GAINS)
    bench = ModalBench(config, np.eye(len(config.noll)))
    bench.ask("open")
    return _residual_nm2(bench)


def _residual_nm2(bench: ModalBench) -> Array:
    bench.run(_HALF, record=False)
    bench.run(_HALF)
    return np.asarray(np.square(bench.residual_nm()).mean(axis=0))


def _modal(sensor: str, preset: str, magnitude: float, seed: int, gains: dict[str, Any]) -> Array:
    """Mean squares (modes,) of the residual over the second half."""
    return _residual_nm2(ModalBench(_configured(sensor, preset, magnitude, seed, gains), _noise(sensor, magnitude)))


def of_modes(case: tuple[str, str, float]) -> Results:
    """Contrast, closed minus open, of one sensor, preset and star, by modes; for bright stars also fixed gains."""
    sensor, preset, magnitude = case
    form, own = _contrast(sensor)
    try:
        _noise(sensor, magnitude)
    except CalibrationError as saturated:
        return {"sensor": sensor, "preset": preset, "magnitude": magnitude, "saturates": str(saturated)}
    left = np.array([_modal(*case, seed, _AUTO) for seed in SEEDS])
    before = np.array([_open_nm2(preset, seed) for seed in SEEDS])
    found = _row(case, (left - before) @ np.diag(form), own, np.sqrt(before.sum(axis=1).mean()), left)
    if magnitude in BRIGHT and preset != "quiet":
        seeds = SEEDS[:2]
        fixed = np.array(
            [np.mean([_modal(*case, seed, dict.fromkeys(_AUTO, gain)) for seed in seeds], axis=0) for gain in GAINS]
        )
        tilt = fixed[:, :2].sum(axis=1).min()
        best = tilt + fixed[:, 2:].sum(axis=1).min()
        found["of_best"] = float(np.sqrt(left[: len(seeds)].sum(axis=1).mean() / best))
        found["of_best_tilt"] = float(np.sqrt(left[: len(seeds), :2].sum(axis=1).mean() / tilt))
    return found


def of_images(case: tuple[str, str, float]) -> Results:
    """As `of_modes`, with every image simulated."""
    sensor, preset, magnitude = case
    form, own = _contrast(sensor)
    calibration = calibrated(_configured(sensor, preset, magnitude, 1, _AUTO))
    changes, left, before = [], [], []
    for seed in SEEDS:
        bench = Bench(_configured(sensor, preset, magnitude, seed, _AUTO), calibration)
        bench.run(2 * _HALF)
        truths = [truth.continuous for truth in bench.truths[-_HALF:]]
        residual, disturbance = (
            np.array([getattr(truth, name) for truth in truths], float) for name in ("residual_nm", "disturbance_nm")
        )
        left.append(np.square(residual).mean(axis=0))
        before.append(np.square(disturbance).mean(axis=0))
        changes.append((left[-1] - before[-1]) @ np.diag(form))
    open_nm = np.sqrt(np.sum(before, axis=1).mean())
    return _row(case, np.array(changes), own, open_nm, np.array(left)) | {"images": True}


def _row(case: tuple[str, str, float], change: Array, own: float, open_nm: float, residual_nm2: Array) -> Results:
    sensor, preset, magnitude = case
    error = float(change.std(ddof=1) / np.sqrt(len(change)))
    return {
        "sensor": sensor,
        "preset": preset,
        "magnitude": magnitude,
        "change": float(change.mean()),
        "error": error,
        "own": own,
        "open_nm": float(open_nm),
        "closed_nm": float(np.sqrt(residual_nm2.sum(axis=1).mean())),
    }


def harms(row: Results) -> bool:
    """Whether closing the loop adds more contrast than tolerated."""
    errors = 0 if row["preset"] == "quiet" else 3
    return bool(row["change"] > errors * row["error"] + OF_DARK_ZONE * row["own"])


def measure(
    sensors: Sequence[str] = MODAL, magnitudes: Sequence[float] = MAGNITUDES, imaged: Sequence[str] = IMAGED
) -> Results:
    """All cases."""
    modes = [(one, preset, star) for one in sensors for preset in PRESETS for star in magnitudes]
    images = [(one, preset, star) for one in imaged for preset in PRESETS for star in IMAGED_MAGNITUDES]
    with threadpool_limits(1), ProcessPoolExecutor(initializer=threadpool_limits, initargs=(1,)) as pool:
        rows = list(track(pool.map(of_modes, modes), "modes", total=len(modes)))
        rows += list(track(pool.map(of_images, images), "images", total=len(images)))
    return {"rows": rows, "seeds": len(SEEDS), "rate_hz": RATE_HZ, "seconds": SECONDS}


def render(results: Results) -> str:
    """A row for each sensor and star: wavefront open and closed by preset, and cases in which closing harms."""
    rows = [row for row in results["rows"] if "saturates" not in row]
    modal = [row for row in rows if "images" not in row]
    table = []
    for sensor, magnitude in dict.fromkeys((row["sensor"], row["magnitude"]) for row in modal):
        mine = {row["preset"]: row for row in modal if (row["sensor"], row["magnitude"]) == (sensor, magnitude)}
        if magnitude in (-1, 2, 5, 8):
            table.append(
                {"sensor": sensor, "magnitude": magnitude}
                | {preset: "{open_nm:.2f} to {closed_nm:.2f}".format(**row) for preset, row in mine.items()}
            )
    harmful = [row for row in rows if harms(row)]
    stars = _listed(modal)
    bright = [row for row in rows if "of_best" in row]
    compared = [row["of_best"] for row in bright]
    names = "; ".join(
        "{sensor}, {preset}, V = {magnitude}: {added:.2g}".format(**row, added=row["change"] / row["own"])
        for row in harmful
    )
    heads = {"sensor": "`{sensor}`", "V": "{magnitude}"} | {
        f"`{name}`": f"{{{name}}}" for name in PRESETS if name != "quiet"
    }
    return (
        f"{columns(heads, table)}\nTrue wavefront, open to closed with automatic gains, nm rms over the second half "
        f"of {results['seconds']:g} s at {results['rate_hz']:g} Hz, mean of {results['seeds']} seeds. "
        f"Number of cases: {len(rows)} (V = {stars}; these presets and `quiet`; {len(rows) - len(modal)} of them "
        "with every image simulated). A case counts as harmful if closing adds more contrast than "
        f"{100 * OF_DARK_ZONE:g} % of the dark zone's own plus three standard errors (`quiet`: "
        f"{100 * OF_DARK_ZONE:g} % alone). Harmful cases, with the ratio of added contrast to the dark zone's own: "
        f"{names or 'none'}. On bright stars "
        f"(V = {_listed(bright)}) the residual with automatic gains is {min(compared):.2f} to {max(compared):.2f} "
        "times that of the best fixed gains, chosen afterwards."
    )


def _listed(rows: list[Results]) -> str:
    """The magnitudes of rows."""
    return ", ".join(f"{one:g}" for one in sorted({row["magnitude"] for row in rows}))
