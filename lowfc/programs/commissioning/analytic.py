"""The analytic calibration of a configured instrument, with a progress bar where the optical model must be built."""

from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.progress import TimeElapsedColumn

from lowfc.adapters.files import factory
from lowfc.adapters.process.progress import counting_bar
from lowfc.arrays import Array
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.calibration import Calibration
from lowfc.optics.twin.twin import Twin
from lowfc.optics.twin.twin_mirror import TwinMirror

Wavefront = Callable[[Twin, TwinMirror], Array]
"""Wavefront, nm, at the used nodes of a twin, from the twin and the mirror on its nodes."""


def analytic(config: Configuration, console: Console, at: Wavefront | None = None) -> Calibration:
    """I0, H and R from the paper's equations; the optical model goes into the cache, from where the camera takes it.

    Args:
        config: The instrument's.
        console: For people: a progress bar, warnings.
        at: The wavefront that is the zero point; flat when None.
    """

    def warn(text: str) -> None:
        console.print(f"warning: {text}", style="yellow", highlight=False, soft_wrap=True)

    with counting_bar(console, TimeElapsedColumn()) as count:
        optics = factory.twin(config, lambda done, total: count("building the optical model", done, total), warn)
    on_nodes = factory.mirror_on_twin(config, optics, lambda _: None)
    made = factory.analytic_calibration(config, optics, on_nodes, None if at is None else at(optics, on_nodes))
    noise = factory.frame_noise_nm(config, made)
    worst = int(np.argmax(noise))
    if noise[worst] > config.control.limit_nm:
        warn(
            f"Z{made.noll[worst]} is measured with {noise[worst]:.0f} nm rms of noise in each frame, more than the "
            f"{config.control.limit_nm:g} nm that its command is limited to: "
            "the star is too faint, or the mask cannot tell so many modes apart"
        )
    return made
