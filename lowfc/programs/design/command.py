"""Arguments of the commands `lowfc design ...`; the other modules of this package do the work."""

import os
from dataclasses import fields
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.process.terminal import INTERRUPTED, Json, new_app, options_set
from lowfc.contract.errors import ConfigurationError
from lowfc.design.shaped_pupil import Request
from lowfc.programs.cli.output import print_result
from lowfc.programs.design.full_light_request import Defocus, Spot
from lowfc.programs.design.options import flag, with_options_of
from lowfc.programs.design.sam_request import Search

KeysFile = Annotated[Path, typer.Option(help="Configuration file to write, with the keys of [sensor].")]
Plot = Annotated[Path | None, typer.Option(help="Plot the figures of merit against size (PNG).")]

design_app = new_app("Design masks and sensors.\n\nExample: lowfc design spc --help")


@design_app.command()
@with_options_of(Request)
def spc(
    request: Request,
    out: Annotated[Path, typer.Option(help="Mask file.")] = Path("spc.npz"),
    plot: Annotated[Path | None, typer.Option(help="Plot mask, image and contrast (PNG).")] = None,
    as_json: Json = False,
) -> None:
    """Design a shaped pupil by linear programming: the most open mask with a dark zone near the star.

    Example: lowfc design spc --outer 12 --cells 64 --out spc.npz
    """
    from rich.console import Console

    from lowfc.programs.cli import result
    from lowfc.programs.design.spc import design_spc

    result.print_result(design_spc(request, out, plot, Console(stderr=True)), as_json=as_json)


@design_app.command()
@with_options_of(Search)
def sam(
    search: Search,
    context: typer.Context,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Number of processes, at most --chains. Default: one per core.")
    ] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, to use its workers.")] = None,
    out: Annotated[Path | None, typer.Option(help="Layout file (.json). Default: the layout's name.")] = None,
    resume: Annotated[Path | None, typer.Option(help="State file of an interrupted search to continue.")] = None,
    front: Annotated[Path | None, typer.Option(help="Write a table of each chain's best layout (CSV).")] = None,
    plot: Annotated[Path | None, typer.Option(help="Plot Tables 3 and 4 of each chain's best layout (PNG).")] = None,
    as_json: Json = False,
) -> None:
    """Search for a sparse aperture mask: position, size and number of holes. Ctrl-C writes the best layout found.

    Example: lowfc design sam --diameter 0.05:0.2 --holes 8:30 --chains 4 --out mask.json
    """
    from lowfc.programs.design.sam import begin, design_sam, pupil_digest, render
    from lowfc.programs.design.sam_executors import open_executor
    from lowfc.programs.design.sam_files import check_files, read_state

    if jobs is not None and scheduler is not None:
        raise ConfigurationError("--jobs and --scheduler exclude each other: use one")
    if resume is not None:
        search_options = {flag(field.name) for field in fields(Search)}
        for option in options_set(context):
            if option in search_options:
                raise ConfigurationError(f"--resume continues the search of {resume}: omit {option}")
        search, chains = read_state(resume, pupil_digest())
    else:
        chains = begin(search)
    out = out if out is not None else Path(f"{search.name}.json")
    state = check_files(out, resume, front, plot)
    processes = min(jobs or len(os.sched_getaffinity(0)), search.chains)
    with open_executor(processes, scheduler) as executor:
        result = design_sam(search, chains, out, state, executor, front, plot)
    print_result(result, render(result), as_json=as_json)
    if result["interrupted"]:
        raise typer.Exit(INTERRUPTED)


@design_app.command()
@with_options_of(Spot)
def zwfs(request: Spot, out: KeysFile = Path("zwfs.toml"), plot: Plot = None, as_json: Json = False) -> None:
    """Optimise the phase spot of a Zernike sensor.

    Example: lowfc design zwfs --merit contrast --out zwfs.toml
    """
    _optimise(request, out, plot, as_json=as_json)


@design_app.command()
@with_options_of(Defocus)
def clowfs(request: Defocus, out: KeysFile = Path("clowfs.toml"), plot: Plot = None, as_json: Json = False) -> None:
    """Optimise the defocus of a coronagraphic low-order sensor.

    Example: lowfc design clowfs --merit contrast --out clowfs.toml
    """
    _optimise(request, out, plot, as_json=as_json)


def _optimise(request: Spot | Defocus, out: Path, plot: Path | None, *, as_json: bool) -> None:
    from lowfc.programs.cli import result
    from lowfc.programs.design.full_light import design

    result.print_result(design(request.sizes, request.goal, out, plot), as_json=as_json)
