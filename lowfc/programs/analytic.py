"""The analytic calibration of a configured instrument, with a progress bar where the optical model must be built."""

import contextlib
from collections.abc import Callable, Iterator

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn

from lowfc.adapters import instrument
from lowfc.adapters.progress import passing_bar
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration import Calibration


def analytic(config: Configuration, console: Console) -> Calibration:
    """I0, H and R from the paper's equations; the optical model goes into the cache, from where the camera takes it.

    Raises:
        CalibrationError: this sensor cannot tell the modes apart.
        DataFileError: a layout is missing or damaged.
    """

    def warn(text: str) -> None:
        console.print(f"warning: {text}", style="yellow", highlight=False, soft_wrap=True)

    with _progress("building the optical model", console) as advance:
        optics = instrument.twin(config, advance, warn)
    made = instrument.analytic_calibration(config, optics, instrument.mirror_on_twin(config, optics, lambda _: None))
    noise = instrument.frame_noise_nm(config, made)
    worst = int(np.argmax(noise))
    if noise[worst] > config.control.limit_nm:
        warn(
            f"Z{made.noll[worst]} is measured with {noise[worst]:.0f} nm rms of noise in each frame, more than the "
            f"{config.control.limit_nm:g} nm that its command is limited to: "
            "the star is too faint, or the mask cannot tell so many modes apart"
        )
    return made


@contextlib.contextmanager
def _progress(what: str, console: Console) -> Iterator[Callable[[int, int], None]]:
    """A progress bar that appears with the first step."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with passing_bar(console, *columns) as bar:
        tasks: list[TaskID] = []

        def advance(done: int, total: int) -> None:
            if not tasks:
                tasks.append(bar.add_task(what, total=total))
            bar.update(tasks[0], completed=done, total=total)

        yield advance
