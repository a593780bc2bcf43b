"""The command `lowfc report`."""

import json
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lowfc.adapters.process.terminal import Logs
from lowfc.contract.errors import DataFileError
from lowfc.contract.printable import LINES, printable

if TYPE_CHECKING:
    from lowfc.adapters.logs.parts import Parts

_ENDINGS = (".html", ".htm")


def report(
    logs: Logs,
    out: Annotated[
        Path | None, typer.Option(help="The page (HTML). Default: next to the log, with its name.", show_default=False)
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the results as one JSON object; write the page only with --out.")
    ] = False,
) -> None:
    """Summarise a run from its log as a self-contained HTML page; --json prints the same results.

    Example: lowfc report last
    """
    from lowfc.adapters.logs.parts import named_logs

    named = named_logs(logs, out, as_json=as_json)
    if out is not None and out.suffix not in _ENDINGS:  # only HTML files are replaced without asking
        raise DataFileError(f"a report is an HTML page: use --out FILE.html, not {out}")
    for log in named:
        _report(log, out, as_json)


def _report(log: "Parts", out: Path | None, as_json: bool) -> None:
    from pydantic_core import to_jsonable_python
    from rich.console import Console
    from rich.progress import TimeElapsedColumn

    from lowfc.adapters.files.whole_file import require_folder, write_whole
    from lowfc.adapters.logs.parts import titled
    from lowfc.adapters.logs.writer import stem_of
    from lowfc.adapters.process.progress import counting_bar
    from lowfc.programs.logs.report.page import page, require_page
    from lowfc.programs.logs.report.results import report_of
    from lowfc.programs.logs.report.source import read_run

    target = out if out is not None or as_json else log[0].parent / f"{stem_of(log[0])}.html"
    require_folder(target)
    if target is not None:
        require_page()
    with counting_bar(Console(stderr=True), TimeElapsedColumn()) as count:
        run = read_run(log, partial(count, f"reading {titled(log)}"))
        run_report = report_of(run)
        if target is not None:
            html = page(run_report, lambda name: count(f"drawing {name}", 1, 1))
            write_whole(target, html.encode(), log[0])
    for remark in run.history.remarks:
        sys.stderr.write(f"warning: {remark}\n")
    if as_json:
        # A log may hold values that JSON cannot represent, such as NaN.
        sys.stdout.write(json.dumps(to_jsonable_python(run_report.results, inf_nan_mode="null")) + "\n")
    else:
        verdict = run_report.results["verdict"]
        because = f": {verdict['because']}" if verdict["because"] else ""
        sys.stdout.write(printable(f"{verdict['heading']}{because}\n{target}\n", keep=LINES))
