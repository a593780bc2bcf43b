"""A group of commands, listed by purpose and imported on use."""

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple

import typer
from typer.main import get_command

from lowfc.adapters.process.terminal import AppGroup, new_app


class Row(NamedTuple):
    """A command: name, target "module:attribute" below `lowfc.programs` (empty for a group), and description.

    Name and description fit in 80 columns. The attribute is a function or a typer application.
    """

    name: str
    target: str
    description: str


class Commands(Mapping[str, Any]):
    """Commands by name; each is imported when it is looked up."""

    def __init__(self, rows: Sequence[Row], group_commands: Sequence[Row]) -> None:
        """`rows` are the commands and groups; `group_commands`, named "GROUP COMMAND", are those of the groups."""
        self._rows, self._group_commands = {row.name: row for row in rows}, group_commands

    def __getitem__(self, name: str) -> Any:
        row = self._rows[name]
        if row.target:
            module, _, attribute = row.target.partition(":")
            command = getattr(import_module(f"lowfc.programs.{module}"), attribute)
        else:
            full_rows = [each for each in self._group_commands if each.name.startswith(f"{name} ")]
            commands = [each._replace(name=each.name.removeprefix(f"{name} ")) for each in full_rows]
            command = lazy_app(f"{row.description}\n\nExample: lowfc {full_rows[0].name}", {"Commands": commands})
            command.callback()(lambda: None)
        if not isinstance(command, typer.Typer):
            function, command = command, new_app("")
            command.command(name)(function)
        click_command = get_command(command)
        click_command.name = name
        return click_command

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


def lazy_app(help_text: str, panels: Mapping[str, Sequence[Row]], group_commands: Sequence[Row] = ()) -> typer.Typer:
    """A typer application; the caller adds its callback.

    Args:
        help_text: text at the head of `--help`.
        panels: commands by the heading under which `--help` lists them.
        group_commands: commands of the groups in `panels`, named "GROUP COMMAND".
    """
    rows = [row for panel in panels.values() for row in panel]
    width = max(len(row.name) for row in rows)

    class Group(AppGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            self.commands = Commands(rows, group_commands)  # type: ignore[assignment]  # read only

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            for heading, panel in panels.items():
                with formatter.section(heading):
                    formatter.write_dl([(f"{row.name:{width}}", row.description) for row in panel])

    app = new_app(help_text)
    app.info.cls = Group
    return app
