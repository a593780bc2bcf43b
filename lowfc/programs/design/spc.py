"""The command `lowfc design spc`: progress, mask file and plot around `lowfc.design.shaped_pupil`."""

import atexit
import io
import json
import os
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict
from pathlib import Path
from threading import Thread
from typing import TypeVar

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits

from lowfc.adapters.files.drawing import figure_class, png
from lowfc.adapters.files.whole_file import require_folder, write_whole
from lowfc.adapters.process.terminal import INTERRUPTED
from lowfc.arrays import Array
from lowfc.contract.errors import ConfigurationError
from lowfc.control.loop.wording import counted
from lowfc.design.dark_zone import FINE_STEP, fine_grid
from lowfc.design.linear_program import NotSolvedError
from lowfc.design.shaped_pupil import (
    FOCAL_MASK_RADIUS,
    MIN_OPEN_AREA,
    Request,
    Round,
    exchange,
    in_shortest_type,
    nearest_feasible,
    properties,
    relative_field,
)
from lowfc.optics.chain.pupil import from_quarter
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.design.options import command_line

Value = TypeVar("Value")


class ShapedPupil(Result):
    """Properties of the designed mask.

    `below_optimum_at_limit_fraction`: the best mask with `limit` times the required contrast is more open by at most
    this fraction of the circle. The best mask with the required contrast may be more open still.
    """

    open_area_fraction: float = result_field("open area", "of the circle", ".2%")
    energy_fraction: float = result_field("throughput", "of the circle's light", ".2%")
    focal_mask_fraction: float = result_field("on the focal mask", "of the light passed", ".2%")
    focal_mask_radius_lambda_d: float = result_field("focal mask radius", "lambda/D", "g")
    max_contrast: float = result_field("largest contrast", form=".2e")
    mean_contrast: float = result_field("mean contrast", form=".2e")
    contrast_step_lambda_d: float = result_field("contrast step", "lambda/D", "g")
    grey_cells_fraction: float = result_field("grey cells", form=".2%")
    below_optimum_at_limit_fraction: float
    rounds: int = result_field("linear programs")
    points: int = result_field("points in the last program")
    file: str = result_field("written to")
    dtype: str = result_field("stored as")
    command: str = result_field("reproduced by")


def design_spc(request: Request, out: Path, plot: Path | None, console: Console) -> ShapedPupil:
    """Design a mask and write it; ConfigurationError if the request is infeasible, or the rounds do not suffice.

    Args:
        request: Requirements on the mask.
        out: npz file with `quarter`, which `load_pupil` reads, and `made_by`, the request as JSON.
        plot: Plot file (PNG), or None.
        console: Console for progress.
    """
    if plot is not None:
        figure_class()  # report a missing package before the work, not after
    if out.suffix != ".npz":
        raise ConfigurationError(f"--out must end in .npz, the only type read as a pupil file; got {out}")
    if not request.zone.is_sampled:
        raise ConfigurationError("the dark zone is too thin for a science image of two samples per lambda/D: widen it")
    require_folder(out, plot)
    with console.status("solving linear programs"):
        rounds = _interruptibly(lambda: _rounds(request, console))
    last = rounds[-1]
    if last.open_area < MIN_OPEN_AREA:
        with console.status("infeasible; looking for the nearest feasible request"):
            raise ConfigurationError(_infeasible(request, *_interruptibly(lambda: nearest_feasible(request))))
    if last.contrast > request.contrast:
        raise ConfigurationError(
            f"after {counted(last.number, 'linear program')} with {request.cells} cells the contrast is "
            f"{last.contrast:.2e}, not {request.contrast:g}: allow more --rounds, or a lower --limit than "
            f"{request.limit:g}"
        )
    quarter = in_shortest_type(last.quarter, request)
    made_by = np.array(json.dumps(asdict(request)))
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, quarter=quarter, made_by=made_by)
    write_whole(out, content.getvalue())
    mask_properties = properties(quarter.astype(np.float64), request)
    if plot is not None:
        write_whole(plot, _picture(quarter.astype(np.float64), request))
    return ShapedPupil(
        file=str(out),
        dtype=str(quarter.dtype),
        command=command_line("lowfc design spc", request),
        **asdict(mask_properties),
        focal_mask_radius_lambda_d=FOCAL_MASK_RADIUS,
        contrast_step_lambda_d=FINE_STEP,
        below_optimum_at_limit_fraction=last.bound - last.open_area,
        rounds=len(rounds),
        points=last.points,
    )


def _rounds(request: Request, console: Console) -> list[Round]:
    """Solve the linear programs one after the other, and print each."""
    rounds: list[Round] = []
    for round_ in exchange(request):
        rounds.append(round_)
        console.print(
            f"{len(round_.quarter):>4} cells, program {round_.number:>2}: {round_.points:>5} points, open area "
            f"{round_.open_area:7.3%}, contrast {round_.contrast:.2e}",
            highlight=False,
        )
    return rounds


def _infeasible(request: Request, inner: float | None, contrast: float | None) -> str:
    """Message for an infeasible request, with the nearest feasible inner radius and contrast."""
    ways = []
    if inner is not None:
        ways.append(f"inner radius is {inner:g} (same contrast)")
    if contrast is not None:
        ways.append(f"contrast is {contrast:g} (same radius)")
    nearest = f"the nearest feasible {', or '.join(ways)}" if ways else "nothing near it is feasible"
    return (
        f"inner radius {request.inner:g} lambda/D at contrast {request.contrast:g} is infeasible (masks that meet both "
        f"are open over less than {MIN_OPEN_AREA:.0%} of the circle); {nearest}"
    )


def _interruptibly(work: Callable[[], Value]) -> Value:
    """Run `work` in a thread: in the main thread Ctrl-C would wait for the end of a linear program."""
    future: Future[Value] = Future()

    def run() -> None:
        try:
            with threadpool_limits(1):
                future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    Thread(target=run, daemon=True).start()
    try:
        return future.result()
    except KeyboardInterrupt:
        # Python's usual end would unwind the thread within the solver, which aborts the process.
        atexit.register(os._exit, INTERRUPTED)
        raise
    except NotSolvedError as error:
        raise ConfigurationError(str(error)) from error


def _picture(quarter: Array, request: Request) -> bytes:
    """Mask, image on a log scale with the dark zone outlined, and contrast against angle (PNG)."""
    drawing = figure_class()(figsize=(15, 4.6), layout="constrained")
    mask, image, curve = drawing.subplots(1, 3)
    mask.imshow(from_quarter(quarter, 2 * len(quarter)), cmap="gray", extent=(-0.5, 0.5, -0.5, 0.5))
    mask.set(title="shaped pupil", xlabel="x (D)", ylabel="y (D)")

    edge = min(request.outer + 4.0, float(request.cells))
    axis = np.arange(-edge, edge + FINE_STEP / 2, FINE_STEP)
    border = edge + FINE_STEP / 2  # outer rim of the outermost samples
    decades = np.log10(np.maximum(relative_field(quarter, axis) ** 2, 1e-30))
    floor = np.log10(request.contrast) - 2.0
    drawn_image = image.imshow(
        decades, vmin=floor, vmax=0.0, cmap="inferno", origin="lower", extent=(-border, border, -border, border)
    )
    angles = np.deg2rad(np.linspace(-request.half_angle_deg, request.half_angle_deg, 91))
    radii = np.concatenate([np.full(91, request.inner), np.full(91, request.outer), [request.inner]])
    outline = np.concatenate([angles, angles[::-1], angles[:1]])
    for side in (-1.0, 1.0):
        x, y = side * radii * np.cos(outline), radii * np.sin(outline)
        image.plot(x, y, "c-", linewidth=0.8)
        if request.symmetry == "octant":
            image.plot(y, x, "c-", linewidth=0.8)
    image.set(title="image, log10 of contrast", xlabel="x (lambda/D)", ylabel="y (lambda/D)")
    drawing.colorbar(drawn_image, ax=image)

    axis, zone = fine_grid(request.zone)
    contrast = relative_field(quarter, axis) ** 2
    ring = np.round(np.hypot(axis, axis[:, None])[zone] / 0.5).astype(int)
    values = contrast[zone]
    rings = np.unique(ring)
    for name, reduce in (("max", np.max), ("mean", np.mean)):
        curve.semilogy(0.5 * rings, [reduce(values[ring == k]) for k in rings], label=f"{name} in the dark zone")
    along_x = axis[axis <= request.outer]
    curve.semilogy(along_x, contrast[0, : along_x.size], color="0.6", linewidth=0.8, label="on the x axis")
    curve.axhline(request.contrast, color="k", linestyle=":", label="required")
    curve.set(title="contrast", xlabel="angle (lambda/D)", ylim=(10.0**floor, 1.0), xlim=(0.0, request.outer))
    curve.legend()
    return png(drawing)
