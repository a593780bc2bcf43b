"""The console's screen: state of the run, read five times a second, and buttons."""

import threading
from collections.abc import Callable, Sequence
from typing import ClassVar

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.color import Color
from textual.containers import Grid, Horizontal, Vertical
from textual.widgets import Button, Static

from lowfc.adapters.bus.bus import Bus
from lowfc.adapters.process.clock import Clock
from lowfc.client import Client
from lowfc.contract.errors import LowfcError
from lowfc.contract.events import Level as Severity
from lowfc.control.loop.wording import AUTO
from lowfc.programs.console import panels
from lowfc.programs.console.actions import ACTIONS, ALL_ACTIONS, SAFE, Action, Values
from lowfc.programs.console.feed import Feed, Reading
from lowfc.programs.console.form import Form, Help
from lowfc.programs.console.gains import Gains
from lowfc.programs.console.history import History
from lowfc.programs.console.keys import IMMEDIATE_KEY, OrderedKeys
from lowfc.programs.console.lines import Lines
from lowfc.programs.console.phrases import phrased
from lowfc.programs.console.task import Task
from lowfc.programs.view.verdicts.tile import FILL, INK, clock

READ_PERIOD_S = 0.2
"""Time between two readings."""
PICTURES_EVERY = 3
"""Number of readings from one drawing of the pictures to the next."""
RESTARTED = "restarted"
"""Result of the application if the run restarted and must be joined again."""
_LEFT = 62  # columns of the left half
_RESTART_CHECK_EVERY = 10  # number of readings from one check for a restart to the next


class Console(OrderedKeys):
    """One run on one screen."""

    CSS = f"""
    Screen {{ layout: vertical; }}
    #top {{ height: 2; }}
    #verdict {{ width: 1fr; height: 2; padding: 0 1; text-style: bold; }}
    #clock {{ width: 11; height: 2; padding: 0 1; text-style: bold; }}
    #readings {{ height: 18; }}
    #left {{ width: 1fr; min-width: {_LEFT}; }}
    #right {{ width: 1fr; padding: 0 0 0 1; }}
    #tiles {{ height: 9; }}
    #modes, #pictures {{ height: 7; }}
    #log, #table {{ text-wrap: nowrap; text-overflow: ellipsis; }}
    #sparks {{ height: 2; }}
    #gains {{ height: 5; }}
    #facts {{ height: 6; }}
    .disconnected {{ visibility: hidden; }}
    #log {{ height: 1fr; }}
    #answer {{ height: 2; padding: 0 1; }}
    #tasks {{ height: auto; padding: 0 1; display: none; }}
    #keys {{ height: 3; }}
    #buttons {{ width: 1fr; grid-size: 7 3; }}
    #buttons Button {{ width: 100%; min-width: 6; padding: 0; text-align: left;
                       content-align: left middle; text-wrap: nowrap; }}
    Button.refused, #answer.refused, #refusal {{ color: $error; text-style: bold; }}
    #safe {{ width: 15; height: 3; min-width: 10; background: #b00020; color: white; text-style: bold; border: none;
             content-align: center middle; }}
    #peers {{ height: 1; }}
    Form, Help {{ align: center middle; }}
    Form > Vertical {{ width: 80; height: auto; padding: 1 2; background: $surface; border: round $primary; }}
    Form Input {{ margin: 0 0 1 0; background: $panel; }}
    Form Horizontal, #refusal {{ height: auto; }}
    Help > Vertical {{ width: 100%; height: 100%; background: $surface; padding: 0 1; overflow-y: auto; }}
    Help Static {{ height: auto; }}
    """
    ENABLE_COMMAND_PALETTE = False
    AUTO_FOCUS = None
    BINDINGS: ClassVar[list[BindingType]] = [
        *(Binding(f"{one.key},{one.key.upper()}", f"press({name!r})") for name, one in ALL_ACTIONS.items()),
        Binding(IMMEDIATE_KEY, f"press({SAFE.name!r})", priority=True),
        *(Binding(key, f"choose({by})") for key, by in (("up", -1), ("down", 1))),
        *(Binding(key, f"turn({by})") for key, by in (("left", -1), ("right", 1), ("minus", -1), ("plus", 1))),
        Binding("u,U", "automatic"),
        Binding("m", "mute"),
        Binding("question_mark", "help"),
        Binding("q", "quit"),
    ]

    def __init__(
        self,
        bus: Bus,
        run_id: str,
        clock: Clock,
        restarted: Callable[[], bool] = lambda: False,
        terminal_gone: Callable[[], bool] = lambda: False,
    ) -> None:
        """Console of a run.

        Args:
            bus: bus of the run, joined as a monitor.
            run_id: name of the run.
            clock: clock of the run.
            restarted: returns whether the run restarted, so that the links have changed.
            terminal_gone: returns whether the terminal was closed.
        """
        super().__init__()
        self._bus, self._run_id, self._restarted = bus, run_id, restarted
        self._terminal_gone = terminal_gone
        self._feed = Feed(bus, run_id, clock)
        self._history = History()
        self._shown: dict[str, Text] = {}
        self._tasks: list[Task] = []
        self._requesting: dict[str, threading.Thread] = {}
        self._mute = False
        self._readings = 0

    def compose(self) -> ComposeResult:
        """Lay out the screen."""
        with Horizontal(id="top"):
            yield Static(id="verdict", markup=False)
            yield Static(id="clock", markup=False)
        with Horizontal(id="readings"):
            with Vertical(id="left"):
                for name in ("tiles", "sparks", "modes"):
                    yield Lines(name)
            with Vertical(id="right"):
                yield Lines("pictures")
                yield Gains(self._set_gains)
                yield Static(id="facts")
        yield Static(id="log")
        yield Static("? shows the keys", id="answer", markup=False)
        yield Static(id="tasks", markup=False)
        with Horizontal(id="keys"):
            with Grid(id="buttons"):
                for action in ACTIONS:
                    yield Button(Text(f"{action.key} {action.name}"), id=_id(action), name=action.name, compact=True)
            yield Button("SAFE\nkey s or F12", id=_id(SAFE), name=SAFE.name)
        yield Lines("peers")

    def on_mount(self) -> None:
        """Start the readings."""
        self.set_interval(READ_PERIOD_S, self._read)

    def action_press(self, name: str) -> None:
        """Carry out the action of a button: at once, or after its form."""
        action = ALL_ACTIONS[name]
        if action.fields or action.confirm:
            self.push_screen(Form(action, self._do))
        else:
            self._do(action, {})

    def action_choose(self, lines: int) -> None:
        """Choose the next (1) or the previous (-1) knob."""
        self.query_one(Gains).choose(lines)

    def action_turn(self, steps: int) -> None:
        """Turn the chosen knob by a number of steps."""
        self.query_one(Gains).turn(steps)

    def action_automatic(self) -> None:
        """Make the gains of the chosen knob automatic."""
        self.query_one(Gains).automatic()

    def action_mute(self) -> None:
        """Switch the bell off or on."""
        self._mute = not self._mute
        self._show_answer(f"the bell is {'off' if self._mute else 'on'}", ok=True)

    def action_help(self) -> None:
        """Show the keys."""
        self.push_screen(Help())

    @on(Button.Pressed)
    def _pressed(self, event: Button.Pressed) -> None:
        if event.button.name is not None:  # a form's buttons have no name
            self.set_focus(None)
            self.action_press(event.button.name)

    def _set_gains(self, modes: Sequence[int], gains: Sequence[float]) -> None:
        values = {"modes": ",".join(map(str, modes)), "values": " ".join(map(str, gains)) or AUTO}
        self._do(ALL_ACTIONS["gain"], values)

    def _do(self, action: Action, values: Values, form: Form | None = None) -> None:
        """Start a task, or send a request, in a new thread.

        It waits until the previous thread of the same button has ended; SAFE does not wait.
        """
        self._show_answer(f"{action.name}: requested", ok=True)
        previous = self._requesting.get(action.name) if action is not SAFE else None

        def ask() -> None:
            if previous is not None:
                previous.join()  # two turns of a knob are requested in their order
            tasks: list[Task] = []
            try:
                if action.ask is None:
                    tasks.append(Task(action.name, action.command(values, self._run_id)))
                    text = f"{action.name}: started"
                else:
                    answer = action.ask(Client(self._run_id, bus=self._bus), values)
                    since = f", from frame {answer.frame} on" if answer.frame else ""
                    text = f"{action.name}: {answer.reply}{since}"
            except (LowfcError, OSError, ValueError) as fault:
                self.call_later(self._answered, action, form, phrased(str(fault)), ok=False)
            else:
                self.call_later(self._answered, action, form, phrased(text), ok=True)
                self.call_later(self._tasks.extend, tasks)  # "started" is shown before "done"

        self._requesting[action.name] = threading.Thread(target=ask, name=action.name, daemon=True)
        self._requesting[action.name].start()

    def _answered(self, action: Action, form: Form | None, text: str, *, ok: bool) -> None:
        """Show the answer to an action, or why it failed. An open form shows a failure, and closes after success."""
        if self._torn_down:
            return
        self._show_answer(text, ok=ok)
        self.query_one(f"#{_id(action)}").set_class(not ok, "refused")
        if action.name == "gain" and not ok:
            self.query_one(Gains).discard_pending()
        if form is self.screen:  # otherwise the operator left it
            if ok:
                form.dismiss()
            else:
                form.show_answer(text)

    def _show_answer(self, text: str, *, ok: bool) -> None:
        answer = self._static("answer")
        answer.set_class(not ok, "refused")
        answer.update(text, layout=False)

    @property
    def _torn_down(self) -> bool:
        """Whether the screen is being removed, so that late answers and readings are dropped."""
        return not (self.screen_stack and any(one.id == "peers" for one in self.screen_stack[0].children))

    def _read(self) -> None:
        if self._terminal_gone():  # without a terminal, the thread that reads the keys would spin
            self.exit()
            return
        if self._torn_down:
            return
        reading = self._feed.read()
        self._readings += 1
        self._show(reading)
        self._watch_tasks()
        if not reading.connected and self._readings % _RESTART_CHECK_EVERY == 0 and self._restarted():
            self.exit(RESTARTED)

    def _show(self, reading: Reading) -> None:
        level, headline = panels.verdict(reading, self._run_id)
        for name in ("verdict", "clock"):
            styles = self._static(name).styles
            styles.background, styles.color = Color(*FILL[level]), Color(*INK[level])
        self._show_text("verdict", Text(headline))
        self._show_text("clock", Text(f"{clock(reading.state.snapshot.host_ns)}\nUTC"))
        self.screen_stack[0].query_one("#readings").set_class(not reading.connected, "disconnected")
        if reading.connected:
            self._lines("tiles").show(panels.tiles(reading))
            self._lines("sparks").show(panels.sparks(reading))
            self._lines("modes").show(panels.modes(reading, _LEFT))
            self._show_text("facts", panels.facts(reading))
            if self._readings % PICTURES_EVERY == 0:
                self._lines("pictures").show(panels.pictures(reading))
            self.screen_stack[0].query_one(Gains).update(reading)
        self._lines("peers").show([panels.peers(reading, self._run_id)])
        for request in reading.requests:
            self._history.add(request)
        events = reading.state.snapshot.events
        for event in events:
            self._history.add(event)
        self._show_text("log", self._history.last(self._static("log").size.height))
        if not self._mute and any(event.level >= Severity.ERROR for event in events):
            self.bell()

    def _watch_tasks(self) -> None:
        for task in [task for task in self._tasks if task.status is not None]:
            self._tasks.remove(task)
            self._show_answer(task.status_line, ok=not task.status)
        self._static("tasks").display = bool(self._tasks)
        self._show_text("tasks", Text("\n".join(task.status_line for task in self._tasks)))

    def _show_text(self, name: str, text: Text) -> None:
        if self._shown.get(name) != text:
            self._shown[name] = text
            self._static(name).update(text, layout=False)

    def _lines(self, name: str) -> Lines:
        return self.screen_stack[0].query_one(f"#{name}", Lines)

    def _static(self, name: str) -> Static:
        return self.screen_stack[0].query_one(f"#{name}", Static)


def _id(action: Action) -> str:
    return action.name.replace(" ", "-")
