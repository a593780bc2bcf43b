"""Overlays of the screen: the form of a button, and the help."""

import re
from collections.abc import Callable
from typing import ClassVar

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.binding import BindingType
from textual.containers import Horizontal, Vertical
from textual.screen import ModalScreen
from textual.widgets import Button, Input, Label, Static

from lowfc.programs.console.actions import ACTIONS, SAFE, Action, Values

HELP = (
    "Top line: verdict, with the reason below it. Bars: command of each mode, nm, between its limits. Press a key or "
    "click a button. In a form: Tab next line, Enter send, Escape cancel. The answer is above the buttons; red: "
    "refused. When the console ends, the loop and commands started here go on."
)
_ROWS = (
    ("s F12", "SAFE", f"At once (with a form open, only F12): {SAFE.description}"),
    *((action.key, action.name, action.description) for action in ACTIONS),
    ("↑↓ ←→", "knobs", "Choose a gain knob and turn it (the gains of its modes keep their ratios)"),
    ("u", "auto", "Set the gains of the chosen knob to automatic"),
    ("m", "mute", "Switch the terminal's bell for errors on or off"),
    ("? q", "help, quit", "This help, or leave the console (the loop goes on)"),
)
"""Keys, names and descriptions of the help."""
_CLAUSE_END = re.compile(r"\. |; |, (?:and|whatever)|: it ")
"""Where the help cuts off a description."""


class Form(ModalScreen[None]):
    """The fields of an action, or its question. It stays open until the request is accepted, and shows refusals."""

    AUTO_FOCUS = "Input, #ok"
    BINDINGS: ClassVar[list[BindingType]] = [("escape", "dismiss", "leave")]

    def __init__(self, action: Action, send: "Callable[[Action, Values, Form], None]") -> None:
        """Make the form of an action; `send` is called with its values when the operator presses OK or Enter."""
        super().__init__()
        self._action, self._send = action, send

    def compose(self) -> ComposeResult:
        """Lay out the form."""
        with Vertical():
            yield Static(self._action.confirm or f"{self._action.name}: {self._action.description}", markup=False)
            for field in self._action.fields:
                yield Label(field.label, markup=False)
                yield Input(field.default(), name=field.name, compact=True)
            yield Static("", id="refusal", markup=False)
            with Horizontal():
                yield Button("OK", id="ok", compact=True, variant="primary")
                yield Button("leave", id="leave", compact=True)

    def show_answer(self, text: str) -> None:
        """Show the reason of a refusal, or that the answer is awaited."""
        self.query_one("#refusal", Static).update(text)

    @on(Input.Submitted)
    @on(Button.Pressed, "#ok")
    def _filled(self) -> None:
        self.show_answer("requested, waiting for the answer")
        self._send(self._action, {field.name or "": field.value.strip() for field in self.query(Input)}, self)

    @on(Button.Pressed, "#leave")
    def _leave(self) -> None:
        self.dismiss()


class Help(ModalScreen[None]):
    """The keys and buttons."""

    BINDINGS: ClassVar[list[BindingType]] = [
        *((key, "dismiss", "leave") for key in ("escape", "question_mark", "q", "enter")),
        *((key, "safe", "safe") for key in ("s", "S")),
    ]

    async def action_safe(self) -> None:
        """Leave the help, and do what the button SAFE does."""
        self.dismiss()
        await self.app.run_action(f"press({SAFE.name!r})")

    def compose(self) -> ComposeResult:
        """Lay out the help."""
        lines = [
            Text.assemble((f"{key:6}", "bold"), f"{name:11}", _CLAUSE_END.split(description, maxsplit=1)[0].rstrip("."))
            for key, name, description in _ROWS
        ]
        with Vertical():
            yield Static(HELP, markup=False)
            yield Static(Text("\n").join(lines), id="table")
