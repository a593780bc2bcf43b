"""Arguments of the command `lowfc validate`; the other modules of this package do the work."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.process.terminal import Json
from lowfc.contract.errors import ConfigurationError, nearest

TABLES = (
    *("table1", "table2", "table3", "table4"),
    *("fig1", "fig2", "fig3", "fig4", "fig5", "fig6", "fig7", "fig8", "fig9", "fig10"),
    *("conditioning", "photometry"),
)

ADDITIONAL = ("anchors", "tolerance")
"""Tables that are not in the paper, and that `all` does not include."""
WITH_FIXED_SENSORS = ("table1", "photometry")
"""Tables whose sensors do not depend on `--sensor`: the paper's sensors, in photometry the Zernike sensor too."""


def validate(
    tables: Annotated[
        list[str],
        typer.Argument(
            help=f"Any of {', '.join(TABLES)}; all: all of these; or {', '.join(ADDITIONAL)}.",
            metavar="TABLE",
            show_default=False,
        ),
    ],
    trials: Annotated[
        int, typer.Option(min=2, max=1_000_000, help="Number of wavefronts and noise realisations.")
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 1,
    jobs: Annotated[int | None, typer.Option(min=1, help="Threads. Default: one for each core.")] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            help=f"Only this sensor, in all tables and figures but {' and '.join(WITH_FIXED_SENSORS)} (the table "
            "conditioning keeps its open relay pupil, bars and holes): sam, bowtie, bowtie:LAYOUT, clowfs, "
            "clowfs:MM (defocus in mm), clowfs_tuned, zwfs, zwfs_tuned, bar, open, lyot, aplc; or a layout, FILE.json "
            "or FILE.json:NAME. May be repeated.",
            show_default=False,
        ),
    ] = None,
    plots: Annotated[
        Path | None, typer.Option(help="Folder for plots of the figures (PNG).", show_default=False)
    ] = None,
    docs: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the pages, their JSON and plots; only with all, or with anchors or tolerance.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Reproduce the paper's tables and figures: the paper's values, ours, theoretical limits and the assumptions.

    Example: lowfc validate table3 table4 --trials 20
    """
    names = (*TABLES, *ADDITIONAL, "all")
    for name in tables:
        if name not in names:
            raise ConfigurationError(f"there is no table {name!r}{nearest(name, names)}; there are {', '.join(names)}")
    chosen = [name for name in TABLES if name in tables or "all" in tables]
    chosen += [name for name in ADDITIONAL if name in tables]
    only_additional = all(name in ADDITIONAL for name in chosen)
    if docs is not None and (not (only_additional or tuple(chosen) == TABLES) or sensor or plots is not None):
        raise ConfigurationError(
            f"--docs writes complete pages: use it with all, or with {' or '.join(ADDITIONAL)}, without --sensor "
            "and --plots"
        )

    from lowfc.programs.paper.cases import Context
    from lowfc.programs.paper.report import PICTURES, run, to_json, to_text, write_document, write_page

    context = Context(trials, seed, jobs or len(os.sched_getaffinity(0)), tuple(dict.fromkeys(sensor or ())) or None)
    fixed = [name for name in chosen if name in WITH_FIXED_SENSORS]
    if sensor and fixed:
        typer.echo(f"{', '.join(fixed)}: the sensors are fixed, --sensor has no effect there", err=True)
    results = run(chosen, context, plots if docs is None else docs / PICTURES)
    sys.stdout.write((to_json(results) if as_json else "\n\n".join(map(to_text, results))) + "\n")
    if docs is not None and only_additional:
        for table in results:
            write_page(docs, table)
    elif docs is not None:
        write_document(docs, results)
