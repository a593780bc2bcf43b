"""A whole loop without processes: what a run of it has recorded."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lowfc.contract.configuration import Configuration
from tools.law_bench import Bench, calibrated

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Fold:
    """Modes (frames, modes) and rms over the open pupil (frames,) of a run, nm of wavefront."""

    disturbance_nm: Array
    residual_nm: Array
    error_nm: Array
    pol_nm: Array
    command_nm: Array
    disturbance_rms_nm: Array
    residual_rms_nm: Array


def fold(config: Configuration, frames: int) -> Fold:
    """Run the loop of a configuration, of which every frame must be used."""
    bench = Bench(config, calibrated(config))
    bench.run(frames)
    assert not bench.refused

    def of_all(rows: list, name: str) -> Array:
        return np.array([getattr(row, name) for row in rows], dtype=np.float64)

    return Fold(
        **{name: of_all(bench.steps, name) for name in ("error_nm", "pol_nm", "command_nm")},
        **{
            name: of_all(bench.truths, name)
            for name in ("disturbance_nm", "residual_nm", "disturbance_rms_nm", "residual_rms_nm")
        },
    )
