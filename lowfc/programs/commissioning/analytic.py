"""The analytic calibration of a configured instrument; the optical model is built with a progress bar, and cached."""

from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.progress import TimeElapsedColumn

from lowfc.adapters.files import factory
from lowfc.adapters.process.progress import counting_bar
from lowfc.arrays import Array
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.calibration import Calibration
from lowfc.optics.detector.detector import expose
from lowfc.optics.twin.twin import Twin
from lowfc.optics.twin.twin_mirror import TwinMirror

_FRAMES = 100  # number of simulated frames; their flux in DN is compared with that of the light on the detector

_MIN_REACH = 0.1
"""Smallest amplitude that the stroke must allow, relative to the modal limit, or to the stroke if that is smaller."""

WavefrontFunction = Callable[[Twin, TwinMirror], Array]
"""Computes the wavefront at the used nodes, nm, from a twin and the mirror on its nodes."""


def analytic(config: Configuration, console: Console, zero_point: WavefrontFunction | None = None) -> Calibration:
    """Compute I0, H and R, the paper's eqs. (6) to (12); raises the errors of `factory.analytic_calibration`.

    Args:
        config: Configuration of the instrument.
        console: Terminal for the progress bar and warnings.
        zero_point: Computes the wavefront of the zero point; flat if None.
    """

    def warn(text: str) -> None:
        console.print(f"warning: {text}", style="yellow", highlight=False, soft_wrap=True, markup=False)

    with counting_bar(console, TimeElapsedColumn()) as count:
        optics = factory.twin(config, lambda done, total: count("building the optical model", done, total), warn)
    on_nodes = factory.mirror_on_twin(config, optics, lambda _: None)
    calibration = factory.analytic_calibration(
        config, optics, on_nodes, None if zero_point is None else zero_point(optics, on_nodes)
    )
    noise_nm = factory.frame_noise_nm(config, calibration)
    limit_nm = factory.settings(config).integrator(calibration.noll).limit_nm
    worst = int(np.argmax(noise_nm - limit_nm))
    if noise_nm[worst] > limit_nm[worst]:
        warn(
            f"Z{calibration.noll[worst]}: noise is {noise_nm[worst]:.0f} nm rms per frame, more than its modal "
            f"limit of {limit_nm[worst]:g} nm: the star is too faint, or the mask cannot distinguish so many modes"
        )
    mirror, reach_nm = config.mirror, config.safety.stroke_nm / np.abs(calibration.modes_to_actuators).max(axis=0)
    fraction = reach_nm / np.minimum(limit_nm, config.safety.stroke_nm)
    worst = int(np.argmin(fraction))
    if fraction[worst] < _MIN_REACH:
        warn(
            f"{mirror.rows} x {mirror.columns} actuators at {mirror.pitches_per_pupil:g} pitches per "
            f"pupil make at most {reach_nm[worst]:.2g} nm rms of Z{calibration.noll[worst]} within safety.stroke_nm: "
            "check mirror.rows, mirror.columns and mirror.pitches_per_pupil, or use fewer modes"
        )
    detector, flux_dn = factory.detector(config), calibration.flux_dn
    light_e = calibration.reference * flux_dn * detector.gain_e_per_dn / detector.em_gain
    frames = expose(detector, np.tile(light_e, (_FRAMES, 1)), np.random.Generator(np.random.SFC64(1)))
    flux_ratios = (frames - calibration.dark).sum(axis=1) / flux_dn
    flux_ratio = float(flux_ratios.mean())
    if abs(flux_ratio - 1) > 0.1 + 3 * flux_ratios.std() / np.sqrt(_FRAMES):
        why = (
            "dark pixels are cut off at 0 DN: raise camera.bias_dn"
            if flux_ratio > 1
            else "faint pixels are rounded down to whole DN: camera.gain_e_per_dn is too large for the read noise"
        )
        warn(f"the frames' flux is {100 * flux_ratio:.0f} % of the light's, which distorts the modes: {why}")
    return calibration
