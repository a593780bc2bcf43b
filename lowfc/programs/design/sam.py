"""The search for a sparse aperture mask: chains on all cores or on a Dask cluster, resumable after interruption."""

import hashlib
import shlex
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import TimeElapsedColumn, TimeRemainingColumn
from threadpoolctl import threadpool_limits

from lowfc.adapters.files.drawing import figure_class
from lowfc.adapters.files.sensors import load_pupil
from lowfc.adapters.process.progress import counting_bar
from lowfc.contract.errors import ConfigurationError, LowfcError, raised_as
from lowfc.control.loop.wording import counted
from lowfc.design.goal import predictions
from lowfc.design.paper import TABLE4_MODES
from lowfc.design.sam_merit import FOCAL_MASKS, Hole, Optics, SamCandidate, build_optics, hole_fields
from lowfc.design.sam_search import Chain, advance, holes, start
from lowfc.optics.chain.sam import Layout
from lowfc.programs.design.options import command_line
from lowfc.programs.design.sam_executors import is_lost
from lowfc.programs.design.sam_files import FoundLayout, front, write_front, write_layouts, write_plot, write_state
from lowfc.programs.design.sam_request import Search

STATE_PERIOD_S = 10.0
"""Shortest time between two writes of the state file."""
_PUPIL_SAMPLES = 256
"""Samples across the pupil: one for each cell of the package's shaped pupil. Predictions differ from those with 512
samples by at most 4e-4 (relative), predictions of contrast by at most 2 %."""
_NOTHING = "no chain had finished its first steps: nothing was found, nothing is written"


def begin(search: Search) -> list[Chain]:
    """Start the chains of a new search at random layouts; ConfigurationError if the holes cannot be placed."""
    with raised_as(ConfigurationError, ValueError):
        return [start(search.bounds, search.seed, i, search.steps) for i in range(search.chains)]


def design_sam(
    search: Search,
    chains: list[Chain],
    out: Path,
    state: Path,
    executor: Executor,
    front_file: Path | None = None,
    plot_file: Path | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Search, write the best layout or the front, and return their predictions; Ctrl-C writes the best so far.

    The chains are advanced in place, and stored in the file `state` while the search runs. LowfcError if the workers
    were lost; KeyboardInterrupt if nothing was found before Ctrl-C.
    """
    console = Console(stderr=True) if console is None else console
    _one_thread()
    if plot_file is not None:
        figure_class()  # report a missing package before the work, not after
    digest = pupil_digest()
    write_state(state, search, digest, chains)  # fails here, before the work, if the folder cannot be written
    interrupted = False
    with counting_bar(console, TimeElapsedColumn(), TimeRemainingColumn()) as count:
        saved_s = time.monotonic()
        count(search.goal.merit, sum(chain.step for chain in chains), search.chains * search.steps)

        def on_block() -> None:
            nonlocal saved_s
            best, done = min(chain.best_merit for chain in chains), sum(chain.step for chain in chains)
            count(f"{search.goal.merit} {best:.4g}", done, search.chains * search.steps)
            if time.monotonic() - saved_s > STATE_PERIOD_S:
                write_state(state, search, digest, chains)
                saved_s = time.monotonic()

        try:
            run_chains(search, chains, executor, on_block)
        except KeyboardInterrupt:
            interrupted = True
            if _store_or_remove(state, search, digest, chains, out) == _NOTHING:
                console.print(_NOTHING, highlight=False)
                raise
        except Exception as error:
            advice = _store_or_remove(state, search, digest, chains, out)
            if is_lost(error):
                raise LowfcError(f"the workers were lost ({error!r}); {advice}") from error
            raise
    points = [found_layout(search, chain) for chain in chains if chain.step]
    best = front(points) if search.has_front else [min(points, key=lambda point: point.merit)]
    command = command_line("lowfc design sam", search)
    write_layouts(out, best, search, command)
    if front_file is not None:
        write_front(front_file, points)
    if plot_file is not None:
        write_plot(plot_file, points, search)
    if not interrupted:
        state.unlink(missing_ok=True)
    return {
        "command": command,
        "file": str(out),
        "merit": search.goal.merit,
        "seed": search.seed,
        "steps": sum(chain.step for chain in chains),
        "interrupted": interrupted,
        "resume": str(state) if interrupted else None,
        "merits": [chain.best_merit for chain in chains if chain.step],
        "layouts": [summary(point) for point in best],
    }


def _store_or_remove(state: Path, search: Search, digest: str, chains: list[Chain], out: Path) -> str:
    """Write the state if any chain has advanced, otherwise remove it; return what to do next."""
    if not any(chain.step for chain in chains):
        state.unlink(missing_ok=True)
        return _NOTHING
    write_state(state, search, digest, chains)
    return f"continue with --resume {state} --out {out}"


def run_chains(search: Search, chains: list[Chain], executor: Executor, on_block: Callable[[], None]) -> None:
    """Advance every chain to its end, in place, in blocks of steps; call `on_block` after each block."""
    running: dict[Future[Chain], int] = {}
    digest = pupil_digest()
    try:
        for i, chain in enumerate(chains):
            if chain.step < chain.steps:
                running[executor.submit(advance_block, search, chain, digest)] = i
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                i = running.pop(future)
                chains[i] = future.result()
                if chains[i].step < chains[i].steps:
                    running[executor.submit(advance_block, search, chains[i], digest)] = i
            on_block()
    finally:
        for future, i in running.items():
            if not future.cancel() and future.done() and future.exception() is None:
                chains[i] = future.result()


def advance_block(search: Search, chain: Chain, digest: str) -> Chain:
    """Advance a chain by one block of steps; called in a worker, possibly on another machine."""
    if digest != pupil_digest():
        raise ConfigurationError("a worker has another shaped pupil: install the same lowfc on all machines")
    _one_thread()
    return advance(_optics(search.focal_masks), search.goal_of(chain.index), search.bounds, chain)


def found_layout(search: Search, chain: Chain) -> FoundLayout:
    """The best layout of a chain, with its predictions."""
    best = holes(chain.best, search.bounds.symmetry)
    name = f"{search.name}_{chain.index}" if search.has_front else search.name
    goal = search.goal_of(chain.index)
    weight = "" if goal.weight is None else f" with weight {goal.weight:g}"
    masks = " and ".join(search.focal_masks)
    purpose = f"{_described(best)}: merit {goal.merit}{weight}, focal-plane mask {masks}"
    predicted = _predictions(search.focal_masks[0], best)
    return FoundLayout(
        Layout(name, purpose, best),
        chain.best_merit,
        predicted["table3_waves"][goal.estimator][str(goal.modes)],
        max(predicted["table4_mas"][goal.estimator][str(TABLE4_MODES)]),
        predicted["throughput"],
    )


def summary(point: FoundLayout) -> dict[str, Any]:
    """A layout and its predictions, for JSON."""
    return {
        "name": point.layout.name,
        "purpose": point.layout.purpose,
        "merit": point.merit,
        "holes": len(point.layout.holes),
        "focal_masks": {name: _predictions(name, point.layout.holes) for name in FOCAL_MASKS},
    }


def render(result: dict[str, Any]) -> str:
    """The result of `design_sam` as text."""
    lines = []
    for layout in result["layouts"]:
        lines.append(f"{layout['name']}: {layout['purpose']}, {result['merit']} {layout['merit']:.4g}")
        for name, predicted in layout["focal_masks"].items():
            condition = "  ".join(f"{value:.0f} ({modes} modes)" for modes, value in predicted["condition"].items())
            lines.append(f"  {name}: throughput {predicted['throughput']:.2%}, condition number {condition}")
            for estimator, row in predicted["table3_waves"].items():
                lines.append(f"    Table 3  {estimator:<9} n<=4 {row['14']:.2e}  n<=5 {row['20']:.2e} waves rms")
            for estimator, tilts in predicted["table4_mas"].items():
                fits = "  ".join(f"{modes} modes x {x:.3f} y {y:.3f}" for modes, (x, y) in tilts.items())
                lines.append(f"    Table 4  {estimator:<9} {fits} mas")
            lines.append(
                f"    weighted noise of 14 modes {predicted['noise_nm']:.3g} nm (monochromatic), which adds "
                f"{predicted['contrast_noise']:.2e} of contrast; {predicted['quantum_share']:.1%} of the quantum limit"
            )
    lines.append(
        "all values are predicted; 'bound' is the Cramer-Rao bound, which the weighted estimator attains in Table 4"
    )
    if not result["interrupted"]:
        lines.append(f"written to {result['file']}; reproduced on the same kind of processor by: {result['command']}")
    else:
        resume = shlex.join(["lowfc", "design", "sam", "--resume", result["resume"], "--out", result["file"]])
        lines.append(f"written to {result['file']} after {result['steps']} steps; continue with: {resume}")
    return "\n".join(lines)


@cache
def _one_thread() -> None:
    """Limit the linear algebra of this process to one thread for good, so that sums round the same in every run."""
    threadpool_limits(1)


@lru_cache(maxsize=1)
def pupil_digest() -> str:
    """Digest of the shaped pupil, on which every result depends."""
    return hashlib.sha256(load_pupil(_PUPIL_SAMPLES).tobytes()).hexdigest()


@lru_cache(maxsize=4)
def _optics(focal_masks: tuple[str, ...], band_modes: int = 2) -> Optics:
    return build_optics(load_pupil(_PUPIL_SAMPLES), focal_masks, band_modes)


@lru_cache(maxsize=64)
def _predictions(focal_mask: str, holes_: tuple[Hole, ...]) -> dict[str, Any]:
    optics = _optics((focal_mask,), band_modes=14)
    fields = np.asarray(np.sum([hole_fields(optics, hole) for hole in holes_], axis=0))
    return predictions(SamCandidate(optics, fields))


def _described(holes_: Sequence[Hole]) -> str:
    """Number of holes, and their diameters in per cent of the pupil's diameter."""
    low, high = min(hole[2] for hole in holes_), max(hole[2] for hole in holes_)
    size = f"{low:.1%}" if low == high else f"{low:.1%} to {high:.1%}"
    return f"{counted(len(holes_), 'hole')} of {size.replace('.0%', '%')}"
