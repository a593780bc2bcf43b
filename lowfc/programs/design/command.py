"""The commands `lowfc design ...`: arguments only; the work is elsewhere."""

import os
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal

import typer

from lowfc.adapters.process.terminal import INTERRUPTED, Json, new_app
from lowfc.contract.errors import ConfigurationError
from lowfc.design.goal import MERITS, WEIGHTED, Goal
from lowfc.design.shaped_pupil import Request
from lowfc.programs.cli.output import put
from lowfc.programs.design.options import flag, span, with_options_of
from lowfc.programs.design.sam_request import Search

Merit = Annotated[str, typer.Option(help=f"What to minimise: {', '.join(MERITS)}.")]
Estimator = Annotated[str, typer.Option(help="pinv, or weighted for the Cramer-Rao bound.")]
Modes = Annotated[int, typer.Option(help="Modes in Table 3 and the condition number: 14 or 20.")]
Weight = Annotated[float, typer.Option(help="Of Table 4 in paper and pareto, 0 to 1.")]
Keys = Annotated[Path | None, typer.Option(help="Configuration file. Default: the sensor's name.")]
Drawn = Annotated[Path | None, typer.Option(help="Draw the figures over the sizes (PNG).")]

design_app = new_app("Design masks and sensors.\n\nExample: lowfc design spc --help")


@design_app.command()
@with_options_of(Request)
def spc(
    request: Request,
    out: Annotated[Path, typer.Option(help="Mask file.")] = Path("spc.npz"),
    plot: Annotated[Path | None, typer.Option(help="Draw mask, image and contrast (PNG).")] = None,
    as_json: Json = False,
) -> None:
    """Design a shaped pupil: by linear programs, the most open mask with a dark zone beside the star.

    Example: lowfc design spc --outer 12 --cells 64 --out spc.npz
    """
    from rich.console import Console

    from lowfc.programs.cli import result
    from lowfc.programs.design.spc import design_spc

    result.put(design_spc(request, out, plot, Console(stderr=True)), as_json=as_json)


@design_app.command()
@with_options_of(Search)
def sam(
    search: Search,
    context: typer.Context,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes. Default: one for each core.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, to use its workers.")] = None,
    out: Annotated[Path | None, typer.Option(help="Layout file (.json). Default: the layout's name.")] = None,
    resume: Annotated[
        Path | None, typer.Option(help="State file of an interrupted search, which it goes on with.")
    ] = None,
    front: Annotated[Path | None, typer.Option(help="Write a table of every chain's best (CSV).")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw every chain's best (PNG).")] = None,
    as_json: Json = False,
) -> None:
    """Search for a sparse aperture mask: where its holes are, how large and how many. Ctrl-C keeps the best so far.

    Example: lowfc design sam --diameter 0.05:0.2 --holes 8:30 --chains 4 --out mask.json
    """
    from lowfc.programs.design.sam import begin, design_sam, render, resumed
    from lowfc.programs.design.sam_executors import open_executor
    from lowfc.programs.design.sam_files import check_files

    if resume is not None:
        names = [field.name for field in fields(Search)]
        given = [name for name in names if str(context.get_parameter_source(name)).endswith("COMMANDLINE")]
        if given:
            raise ConfigurationError(f"--resume goes on with the search of {resume}: leave out {flag(given[0])}")
        search, found = resumed(resume)
    else:
        found = begin(search)
    out = out if out is not None else Path(f"{search.name}.json")
    state = check_files(out, resume, front, plot)
    processes = min(jobs or len(os.sched_getaffinity(0)), search.chains)
    with open_executor(processes, scheduler) as executor:
        result = design_sam(search, found, out, state, executor, front, plot)
    put(result, render(result), as_json=as_json)
    if result["interrupted"]:
        raise typer.Exit(INTERRUPTED)


@design_app.command()
def zwfs(
    spot: Annotated[str, typer.Option(help="SMALLEST:LARGEST spot, lambda/D.")] = "0.5:3",
    merit: Merit = "contrast",
    estimator: Estimator = "weighted",
    modes: Modes = 14,
    weight: Weight = 0.5,
    out: Keys = None,
    plot: Drawn = None,
    as_json: Json = False,
) -> None:
    """Find the phase spot of a Zernike sensor.

    Example: lowfc design zwfs --merit contrast --out zwfs.toml
    """
    _sized("zwfs", "--spot", spot, {}, (merit, estimator, modes, weight), out, plot, as_json)


@design_app.command()
def clowfs(
    defocus: Annotated[str, typer.Option(help="SMALLEST:LARGEST defocus, mm.")] = "1.5:8",
    inner_radius: Annotated[float, typer.Option(help="Of the reflecting annulus, lambda/D.")] = 0.0,
    merit: Merit = "contrast",
    estimator: Estimator = "weighted",
    modes: Modes = 14,
    weight: Weight = 0.5,
    out: Keys = None,
    plot: Drawn = None,
    as_json: Json = False,
) -> None:
    """Find the defocus of a coronagraphic low-order sensor.

    Example: lowfc design clowfs --merit contrast --out clowfs.toml
    """
    others = {"inner_radius": inner_radius}
    _sized("clowfs", "--defocus", defocus, others, (merit, estimator, modes, weight), out, plot, as_json)


def _sized(
    kind: Literal["zwfs", "clowfs"],
    option: str,
    text: str,
    others: dict[str, float],
    wanted: tuple[str, str, int, float],
    out: Path | None,
    plot: Path | None,
    as_json: bool,
) -> None:
    from lowfc.programs.cli import result
    from lowfc.programs.design.full_light import Sizes, design

    merit, estimator, modes, weight = wanted
    try:
        goal = Goal(merit, estimator, modes, weight if merit in WEIGHTED else None)
        sizes = Sizes(kind, *span(option, text), others)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    result.put(design(sizes, goal, out or Path(f"{kind}.toml"), plot), as_json=as_json)
