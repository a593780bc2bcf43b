"""Today's figures beside those of the last release, as ratios to the echo of their own run; and their storage.

    lowfc latency --json | python -m benchmarks.releases            # today against the last release
    lowfc latency --json | python -m benchmarks.releases --store    # and keep today's as this release's

A release is a file in benchmarks/history. Two runs differ by the host and by the hour; the echo of a run differs with
them, so that a ratio to it can be compared where microseconds cannot.
"""

import argparse
import json
import re
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import lowfc
from benchmarks.host import host
from lowfc.adapters.whole_file import write_whole

FOLDER = Path(__file__).parent / "history"
ECHO = "echo"
PLAIN = ("without", "lost", "missing", "skipped", "ratio")
"""In the paths of figures without a unit that are shown beside the ratios."""

_UNITS = ("_ns", "_us", "_ms", "_s")

Figures = dict[str, float]


class HistoryError(Exception):
    """Figures that cannot be read or stored."""


def flat(found: Any, name: str = "") -> Figures:
    """All numbers of a JSON object by their path, as in "latency_us.frame_to_command.p50"; lists are left out."""
    return dict(_numbers(found, name))


def entry(figures: Figures, release: str) -> dict[str, Any]:
    """What is stored of a release."""
    about = host()
    return {
        "release": release,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "host": f"{about['processors']} x {about['processor']}, Python {about['python']}",
        "kernel": about["kernel"],
        "figures": figures,
    }


def store(folder: Path, made: Mapping[str, Any]) -> Path:
    """Keep an entry as a release's.

    Raises:
        HistoryError: that release has one.
    """
    path = folder / f"{made['release']}.json"
    if path.exists():
        raise HistoryError(f"{path} is there already; remove it first, or give another --release")
    folder.mkdir(exist_ok=True)
    write_whole(path, (json.dumps(made, indent=1) + "\n").encode())
    return path


def last(folder: Path) -> dict[str, Any] | None:
    """The newest entry by its date, of one day the one stored last; None where there is none.

    Raises:
        HistoryError: a file of the history cannot be read.
    """
    entries = []
    for path in folder.glob("*.json"):
        try:
            found = json.loads(path.read_text())
            entries.append((found["date"], path.stat().st_mtime_ns, {**found, "figures": flat(found["figures"])}))
        except (OSError, ValueError, KeyError, TypeError) as fault:
            raise HistoryError(f"{path} should hold release, date and figures as JSON ({fault!r})") from fault
    return max(entries, key=lambda one: one[:2])[2] if entries else None


def ratios(figures: Figures, echo: str = ECHO) -> Figures:
    """Every time over the echo's of the same last name and unit: "latency_us.wakeup.p99" over "echo_us.p99".

    The echo is whatever has a part in its path that begins with `echo`; of several with one last name it is the first.
    """
    echoes: dict[tuple[str, str], float] = {}
    for path, value in figures.items():
        if _is_echo(path, echo) and _kind(path)[1] and value > 0:
            echoes.setdefault(_kind(path), value)
    return {
        path: value / echoes[_kind(path)]
        for path, value in figures.items()
        if not _is_echo(path, echo) and _kind(path) in echoes
    }


def compare(today: Mapping[str, Any], before: Mapping[str, Any] | None, echo: str = ECHO) -> list[dict[str, Any]]:
    """One line for each time that has a ratio to the echo, and for each figure of `PLAIN`.

    Returns:
        figure; today; to_echo; before_to_echo; change: to_echo over before_to_echo. None where there is none; those of
        `PLAIN` have before instead of ratios.
    """
    now = today["figures"]
    then: Figures = before["figures"] if before is not None else {}
    to_echo, before_to_echo = ratios(now, echo), ratios(then, echo)
    lines: list[dict[str, Any]] = []
    for path, value in now.items():
        if path in to_echo:
            old = before_to_echo.get(path)
            change = to_echo[path] / old if old else None
            lines.append(
                {"figure": path, "today": value, "to_echo": to_echo[path], "before_to_echo": old, "change": change}
            )
        elif any(part.startswith(word) or part.endswith(word) for part in re.split(r"[._]", path) for word in PLAIN):
            lines.append({"figure": path, "today": value, "before": then.get(path)})
    return lines


def render(today: Mapping[str, Any], before: Mapping[str, Any] | None, lines: list[dict[str, Any]]) -> str:
    """The comparison as a table."""
    name = f"{before['release']} of {before['date']}" if before is not None else "no release stored"
    width = max([len(line["figure"]) for line in lines] + [len("figure")])
    table = [f"{'figure':<{width}}  {'today':>10}  {'to the echo':>11}  {name:>24}  {'change':>7}"]
    for line in lines:
        if "to_echo" in line:
            cells = (_number(line["to_echo"]), _number(line["before_to_echo"]), _percent(line["change"]))
        else:
            cells = ("", _number(line["before"]), "")
        table.append(
            f"{line['figure']:<{width}}  {line['today']:>10.4g}  {cells[0]:>11}  {cells[1]:>24}  {cells[2]:>7}".rstrip()
        )
    table.append(f"today: {today['release']}, {today['host']}, Linux {today['kernel']}")
    if before is not None:
        table.append(f"before: {before['release']}, {before['host']}, Linux {before['kernel']}")
    if not any("to_echo" in line for line in lines):
        table.append("none of the figures has an echo to be set against")
    return "\n".join(table)


def main() -> int:
    """The command line; returns its exit status."""
    asked = _parser().parse_args()
    try:
        today = entry(_read(asked.figures), asked.release)
        before = last(asked.folder)
        lines = compare(today, before, asked.echo)
        sys.stdout.write((json.dumps(lines) if asked.json else render(today, before, lines)) + "\n")
        if asked.store:
            sys.stderr.write(f"stored: {store(asked.folder, today)}\n")
    except HistoryError as fault:
        sys.stderr.write(f"error: {fault}\n")
        return 2
    return 0


def _read(name: str) -> Figures:
    where = "standard input" if name == "-" else name
    try:
        found = json.loads(sys.stdin.read() if name == "-" else Path(name).read_text())
    except (OSError, ValueError) as fault:
        raise HistoryError(f"{where} should hold one JSON object of figures ({fault})") from fault
    figures = flat(found)
    if not figures:
        raise HistoryError(f"{where} holds no figures")
    return figures


def _numbers(found: Any, name: str) -> Iterator[tuple[str, float]]:
    match found:
        case bool():
            return
        case int() | float():
            yield name, found
        case dict():
            for key, value in found.items():
                yield from _numbers(value, f"{name}.{key}" if name else key)


def _is_echo(path: str, echo: str) -> bool:
    return any(part.startswith(echo) for part in path.split("."))


def _kind(path: str) -> tuple[str, str]:
    """The last name of a path, and the unit that one of its names ends in."""
    parts = path.split(".")
    units = [unit for part in parts for unit in _UNITS if part.endswith(unit)]
    return parts[-1], units[-1] if units else ""


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _percent(change: float | None) -> str:
    return "" if change is None else f"{100 * (change - 1):+.0f} %"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.releases", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("figures", nargs="?", default="-", help="a file of figures as JSON; default: standard input")
    parser.add_argument("--store", action="store_true", help="keep today's as this release's")
    parser.add_argument("--release", default=lowfc.__version__, help="whose they are (%(default)s)")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of the history (%(default)s)")
    parser.add_argument("--echo", default=ECHO, help="in a part of the path of the echo's figures (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print the comparison as JSON")
    return parser


if __name__ == "__main__":
    sys.exit(main())
