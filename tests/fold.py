"""A whole loop without processes: the live loop's own functions, one after the other."""

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from lowfc.adapters import instrument
from lowfc.contract.configuration import Configuration
from lowfc.control.inputs import Frame, Load
from lowfc.control.loop import advance
from lowfc.control.stability import delay_weights
from lowfc.control.state import State
from sim_camera.process import bench
from sim_dm.device import Told, initial, obey
from sim_dm.process import device

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
    """Expose, advance, obey, with the configured delay, `frames` times."""
    optics = instrument.twin(config, None, print)
    settings = instrument.settings(config)
    on_nodes = instrument.mirror_on_twin(config, optics, print)
    calibration = instrument.analytic_calibration(config, optics, on_nodes)
    state, _ = advance(settings, State(), Load(0, calibration, "test"))
    assert state.drive is not None
    scene, mirror = bench(config), device(config)
    status = initial(mirror)
    weights = delay_weights(settings.delay_frames).astype(np.float32)
    shapes = [status.surface_nm] * len(weights)
    rows: list[list[npt.ArrayLike]] = [[] for _ in fields(Fold)]
    for index in range(frames):
        shapes = [status.surface_nm, *shapes[:-1]]
        seen = np.sum([weight * shape for weight, shape in zip(weights, shapes, strict=True)], axis=0, dtype=np.float32)
        pixels, truth = scene.expose(index, seen)
        time_ns = 10**18 + index * config.period_ns
        state, outputs = advance(settings, state, Frame((1 << 32) + index, time_ns, 0, pixels))
        step, command = outputs.step, outputs.command
        assert step is not None
        assert command is not None
        assert step.error_nm is not None, step.reasons
        assert step.pol_nm is not None
        told = Told("lowfc", step.frame_sequence, time_ns, 10**9, command.actuators_nm, command.command_nm)
        status, refused = obey(mirror, status, told, time_ns)
        assert refused is None
        values = (
            truth.disturbance_nm,
            truth.residual_nm,
            step.error_nm,
            step.pol_nm,
            step.command_nm,
            truth.disturbance_rms_nm,
            truth.residual_rms_nm,
        )
        for row, value in zip(rows, values, strict=True):
            row.append(value)
    return Fold(*(np.array(row, dtype=np.float64) for row in rows))
