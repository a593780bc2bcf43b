"""`lowfc --help`, the text and JSON of a typed result, and the lines of `lowfc runs`."""

import re
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import click
import pytest
import typer
from typer.testing import CliRunner

from lowfc.programs.cli.ctl import bench_value, ctl_app
from lowfc.programs.cli.main import COMMANDS, app
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.cli.runs import _lines


def test_every_command_is_listed_under_its_heading_with_its_complete_description() -> None:
    lines = CliRunner().invoke(app, ["--help"], terminal_width=80).stdout.splitlines()
    assert max(map(len, lines)) <= 80
    for heading, rows in COMMANDS.items():
        assert f"{heading}:" in lines
        for row in rows:
            assert any(line.split(maxsplit=1) == [row.name, row.description] for line in lines), row.name


def contexts(context: click.Context) -> Iterator[click.Context]:
    """The context of a command, and those of all commands below it."""
    yield context
    if hasattr(context.command, "list_commands"):
        for name in context.command.list_commands(context):
            command = context.command.get_command(context, name)
            yield from contexts(click.Context(command, parent=context, info_name=name))


def test_every_help_page_has_an_example_no_shortened_descriptions_and_no_colloquial_verbs() -> None:
    pages = []
    for context in contexts(click.Context(typer.main.get_command(app), info_name="lowfc")):
        page = context.command.get_help(context)
        pages.append(" ".join(page.split()))
        assert "Example: lowfc " in pages[-1]
        assert "..." not in page.partition("\nCommands:\n")[2]
    assert len(pages) > 70
    colloquial = r"\b(?:told|tells?|hears?|listen to|lies to|nobody can|last words)\b.*"
    assert re.findall(colloquial, "\n".join(pages)) == []


def test_the_command_line_imports_no_large_package_before_a_command_is_used() -> None:
    packages = "('numpy', 'zenoh', 'rich')"
    code = f"import sys, lowfc.programs.cli.main; print(*(name for name in {packages} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


def test_the_error_of_an_unknown_command_suggests_the_nearest() -> None:
    group = typer.main.get_command(app)
    with pytest.raises(Exception, match="Did you mean 'sim-loop'"), group.make_context("lowfc", ["sim-lop"]) as context:
        group.resolve_command(context, ["sim-lop"])


def test_the_error_of_a_wrong_argument_names_what_was_expected_and_found() -> None:
    for command_line, expected in (
        ("calibrate --method foo", "'--method': 'foo' is not one of 'analytic'"),
        ("sim-loop --rate fast", "'--rate': must be a valid number, got 'fast'\n"),
        ("sim-loop --duration 0", "'--duration': must be greater than or equal to 0.01, got '0'\n"),
        ("ctl dark --frames 3", "'--frames': must be greater than or equal to 16, got '3'\n"),
    ):
        assert expected in CliRunner().invoke(app, command_line.split()).output


def test_a_run_named_before_the_request_is_the_run_of_every_command_of_ctl() -> None:
    group: Any = typer.main.get_command(ctl_app)
    with group.make_context("ctl", ["--run", "other", "status"]) as context:
        context.invoke(group.callback, **context.params)
    _, *subcommands = contexts(context)
    runs = {subcommand.command_path: subcommand.lookup_default("run") for subcommand in subcommands}
    assert {"ctl bench", "ctl dark", "ctl safe", "ctl record stop"} <= runs.keys()
    assert [path for path, run in runs.items() if run != "other"] == []


class Mode(Result):
    noll: int = result_field("mode", form="Z{}")
    gain: float | None = result_field("gain", form=".2f")
    hidden: int = result_field(default=0)

    def remarks(self) -> list[str]:
        return ["low"] if self.gain is not None and self.gain < 1 else []


class LoopResult(Result):
    rate_hz: float = result_field("rate", "Hz", "g")
    good: bool = result_field("good")
    noll: list[int] = result_field("mode", form="Z{}", column=True)
    noise_nm: list[float] = result_field("noise", "nm", ".1f", column=True)
    modes: list[Mode] = result_field("modes")
    missing: float | None = result_field("missing", default=None)


@pytest.mark.parametrize(("argument", "value"), [("True", True), ("FALSE", False), ("2.5e1", 25.0), ("truer", "truer")])
def test_a_bench_value_on_the_command_line_is_a_boolean_a_number_or_a_text(argument: str, value: object) -> None:
    assert (type(bench_value(argument)), bench_value(argument)) == (type(value), value)


def test_text_and_json_of_a_result_have_the_same_fields() -> None:
    modes = [Mode(noll=2, gain=0.5), Mode(noll=11, gain=None)]
    result = LoopResult(rate_hz=250, good=True, noll=[2, 11], noise_nm=[1, 12.25], modes=modes)
    assert result.text().splitlines() == [
        "rate               250 Hz",
        "good               yes",
        "mode  noise, nm",
        "Z2          1.0",
        "Z11        12.2",
        "mode  gain",
        "Z2    0.50   low",
        "Z11      -",
    ]
    assert result.json_object() == {
        "rate_hz": 250,
        "good": True,
        "noll": [2, 11],
        "noise_nm": [1, 12.25],
        "modes": [{"noll": 2, "gain": 0.5}, {"noll": 11, "gain": None}],
    }


def test_a_process_that_does_not_answer_is_not_called_absent_from_its_run() -> None:
    processes = [{"process": name, "state": "starting", "pid": None} for name in ("controller", "recorder")]
    row = {"run": "bench", "mode": "starting", "holding": None, "rate_hz": None, "uptime_s": None}
    row |= {"processes": processes, "recording": "none", "log": None}
    assert _lines([row]) == [
        "bench  starting or not answering; controller, recorder; its recorder is starting or not answering"
    ]
    running = row | {"processes": processes[:1], "mode": "open", "rate_hz": 99.6, "uptime_s": 12.3}
    assert _lines([running]) == ["bench  open at 100 Hz, up 12 s; controller; not recording"]
