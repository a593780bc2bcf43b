"""The commands `lowfc design ...`: arguments only; the work is elsewhere."""

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.terminal import INTERRUPTED, new_app
from lowfc.contract.errors import ConfigurationError

design_app = new_app("Design masks.\n\nExample: lowfc design spc --help")


@design_app.command()
def spc(
    inner: Annotated[float, typer.Option(help="Where the dark zone begins, in lambda/D.")] = 4.0,
    outer: Annotated[float, typer.Option(help="Where it ends, in lambda/D.")] = 20.0,
    half_angle: Annotated[
        float, typer.Option(help="Degrees from the x axis, on both sides, within which it lies; 90: all around.")
    ] = 42.5,
    contrast: Annotated[float, typer.Option(help="Largest intensity in it, over the star's; kept every 0.1.")] = 1e-9,
    limit: Annotated[float, typer.Option(help="Contrast in the linear programs, over the one promised.")] = 0.95,
    cells: Annotated[int, typer.Option(help="In half the diameter: 8, 16, 32, 64, 128 or 256.")] = 128,
    step: Annotated[float, typer.Option(help="Of the first grid of points, in lambda/D.")] = 0.5,
    symmetry: Annotated[
        str, typer.Option(help="quarter: about both axes; octant: about the diagonals too, four times as fast.")
    ] = "quarter",
    rounds: Annotated[int, typer.Option(help="Programs at most, with each number of cells on the way.")] = 20,
    out: Annotated[Path, typer.Option(help="Mask file.")] = Path("spc.npz"),
    plot: Annotated[Path | None, typer.Option(help="Draw mask, image and contrast (PNG).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Design a shaped pupil: by linear programs, the most open mask with a dark zone beside the star.

    Example: lowfc design spc --outer 12 --cells 64 --out spc.npz
    """
    from rich.console import Console

    from lowfc.programs.design.spc import design_spc, render, request

    wanted = request(
        inner=inner,
        outer=outer,
        half_angle_deg=half_angle,
        contrast=contrast,
        limit=limit,
        cells=cells,
        step=step,
        symmetry=symmetry,
        rounds=rounds,
    )
    result = design_spc(wanted, out, plot, Console(stderr=True))
    sys.stdout.write((json.dumps(result) if as_json else render(result)) + "\n")


@design_app.command()
def sam(
    context: typer.Context,
    merit: Annotated[
        str, typer.Option(help="What to minimise: paper, table3, table4, condition, throughput or pareto.")
    ] = "paper",
    estimator: Annotated[
        str | None,
        typer.Option(help="pinv, or weighted for the Cramer-Rao bound. Default: weighted; pinv for the merit paper."),
    ] = None,
    modes: Annotated[int, typer.Option(help="Modes in Table 3: 14 or 20.")] = 14,
    weight: Annotated[
        float | None, typer.Option(help="Of Table 4 in paper and pareto, 0 to 1. Default: 0.5; in pareto, a front.")
    ] = None,
    focal_mask: Annotated[
        str | None, typer.Option(help="disk, bowtie or both. Default: disk; both for the merit paper.")
    ] = None,
    holes: Annotated[str, typer.Option(help="Number of holes, or FEWEST:MOST.")] = "27",
    diameter: Annotated[str, typer.Option(help="Of the holes, or SMALLEST:LARGEST, in pupil diameters.")] = "0.07",
    gap: Annotated[float, typer.Option(help="Least distance between two holes' rims, in pupil diameters.")] = 0.01,
    edge: Annotated[float, typer.Option(help="Least distance from a hole to the pupil's edge.")] = 0.0,
    symmetry: Annotated[str, typer.Option(help="none, or the axis of a mirror symmetry: x or y.")] = "none",
    seed: Annotated[int, typer.Option(help="Of all random numbers.")] = 1,
    chains: Annotated[int, typer.Option(help="Independent searches; the best one counts.")] = 4,
    steps: Annotated[int, typer.Option(help="Of each chain.")] = 20_000,
    name: Annotated[str, typer.Option(help="Of the layout.")] = "sam",
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes. Default: one for each core.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, to use its workers.")] = None,
    out: Annotated[Path | None, typer.Option(help="Layout file (.json). Default: the layout's name.")] = None,
    resume: Annotated[
        Path | None, typer.Option(help="State file of an interrupted search, which it goes on with.")
    ] = None,
    front: Annotated[Path | None, typer.Option(help="Write a table of every chain's best (CSV).")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw every chain's best (PNG).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Search for a sparse aperture mask: where its holes are, how large and how many. Ctrl-C keeps the best so far.

    Example: lowfc design sam --diameter 0.05:0.2 --holes 8:30 --chains 4 --out mask.json
    """
    from lowfc.programs.design.sam import begin, design_sam, render, resumed
    from lowfc.programs.design.sam_executors import open_executor
    from lowfc.programs.design.sam_files import check_files
    from lowfc.programs.design.sam_request import SEARCH_OPTIONS, request

    values = context.params
    if resume is not None:
        given = [key for key in SEARCH_OPTIONS if str(context.get_parameter_source(key)).endswith("COMMANDLINE")]
        if given:
            option = given[0].replace("_", "-")
            raise ConfigurationError(f"--resume goes on with the search of {resume}: leave out --{option}")
        search, found = resumed(resume)
    else:
        search = request(**{key: values[key] for key in SEARCH_OPTIONS})
        found = begin(search)
    out = out if out is not None else Path(f"{search.name}.json")
    state = check_files(out, resume, front, plot)
    processes = min(jobs or len(os.sched_getaffinity(0)), search.chains)
    with open_executor(processes, scheduler) as executor:
        result = design_sam(search, found, out, state, executor, front, plot)
    sys.stdout.write((json.dumps(result) if as_json else render(result)) + "\n")
    if result["interrupted"]:
        raise typer.Exit(INTERRUPTED)
