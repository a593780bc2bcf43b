"""The console with a running loop: the key of every button, the display, and a lost connection."""

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from textual.events import Key
from textual.geometry import Size
from textual.pilot import Pilot

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.files import calibration_file, law_file
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Answer
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.errors import BusError, ConfigurationError
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import EVENT, HEALTH, REQUEST, wire
from lowfc.control.laws.linear_law import integrator_block, law_from_blocks
from lowfc.programs.console import app as application
from lowfc.programs.console import feed, panels
from lowfc.programs.console.actions import ALL_ACTIONS
from lowfc.programs.console.app import Console
from lowfc.programs.console.feed import Reading
from lowfc.programs.console.gains import Gains
from lowfc.programs.console.history import History
from lowfc.programs.console.panels import _PIXELS, _mode, half_block_lines, reduced, sparkline
from lowfc.programs.console.phrases import phrased
from lowfc.programs.console.task import Task
from lowfc.programs.view import monitor
from lowfc.programs.view.verdicts.run_state import Liveness
from lowfc.programs.view.verdicts.tile import Level
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.console.live_run import CONFIG, RUN, LiveRun
from tests.support.loops import until
from tests.support.stage import Stage
from tests.support.toy import GRID, NOLL, calibration

LAW = law_from_blocks([integrator_block(0.2, 0.01, "pol", 1.0)] * 3, "pol", "leaky", NOLL, 1.0, 50.0)
TIMEOUT_S = 15.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveRun]:
    live_run = LiveRun(tmp_path_factory.mktemp("run"))
    yield live_run
    live_run.stop()


@pytest.fixture(autouse=True)
def _no_wait_for_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Textual waits for an idle process after each key, up to 2 s; this process, with the loop in it, is never idle."""

    async def pause(*_: float) -> None:
        await asyncio.sleep(0)

    for module in ("app", "pilot"):
        monkeypatch.setattr(f"textual.{module}.wait_for_idle", pause)
    monkeypatch.setattr("textual.screen.UPDATE_PERIOD", 0.1)  # paint seldom: the tests read texts, not the picture
    monkeypatch.setattr("lowfc.programs.console.app.READ_PERIOD_S", 0.05)
    monkeypatch.setattr("lowfc.programs.console.feed.DISCONNECTED_S", 0.4)


class Screen:
    """A console without a terminal: its keys, mouse and texts; it runs only during `press`, `click` and `until`."""

    def __init__(self, app: Console, pilot: Pilot, runner: asyncio.Runner) -> None:
        self.app, self._pilot, self._runner = app, pilot, runner

    def text(self, name: str) -> str:
        return str(self.app.screen_stack[0].query_one(f"#{name}").render())

    def form_is_open(self) -> bool:
        """Whether there is a form, a question or the help."""
        return len(self.app.screen_stack) == 2

    def press(self, *keys: str) -> None:
        self._runner.run(self._pilot.press(*keys))

    def click(self, selector: str, offset: tuple[int, int] = (0, 0)) -> None:
        self._runner.run(self._pilot.click(selector, offset=offset))

    def until(self, condition: Callable[[], object]) -> None:
        for _ in range(round(TIMEOUT_S / 0.01)):
            if condition():
                return
            self._runner.run(self._pilot.pause(0.01))
        raise AssertionError(f"condition not met in {TIMEOUT_S:g} s; the console shows {self.text('answer')!r}")

    def fill(self, *values: str) -> None:
        self.until(lambda: self.form_is_open() and self.app.focused is not None)
        for field, value in zip(self.app.screen.query("Input"), values, strict=True):
            field.value = value
        self.press("enter")


@contextlib.contextmanager
def console(run: LiveRun) -> Iterator[Screen]:
    with asyncio.Runner() as runner, contextlib.closing(run.bus("operator")) as bus:
        app = Console(bus, RUN, run.clock)
        running = app.run_test(size=(100, 30))
        screen = Screen(app, runner.run(running.__aenter__()), runner)
        screen.until(lambda: screen.text("verdict") and "NOT CONNECTED" not in screen.text("verdict"))
        screen.until(lambda: "light" in screen.text("sparks"))
        yield screen
        runner.run(running.__aexit__(None, None, None))


@pytest.fixture
def screen(run: LiveRun) -> Iterator[Screen]:
    with console(run) as screen:
        yield screen


BUTTONS: dict[str, tuple[tuple[str, ...], dict[str, object]]] = {
    "open": ((), {"name": "open"}),
    "close": ((), {"name": "close"}),
    "pause": ((), {"name": "pause"}),
    "step": (("7",), {"name": "step", "values": [7.0]}),
    "gain": (("0.25", "2,3"), {"name": "gain", "modes": [2, 3], "values": [0.25]}),
    "leak": (("0.01", ""), {"name": "leak", "modes": []}),
    "limit": (("40", "4"), {"name": "limit", "modes": [4], "values": [40.0]}),
    "law": (("~/law.fits",), {"name": "law"}),
    "no law": ((), {"name": "law"}),
    "offset": (("5", "4"), {"name": "offset", "modes": [4], "values": [5.0]}),
    "channel": (("dark-hole", "~/shape.npy"), {"name": "channel", "text": "dark-hole"}),
    "reset": ((), {"name": "reset"}),
    "stop": ((), {"name": "stop"}),
    "load": (("~/calibration.fits",), {"name": "load"}),
    "note": (("seeing 0.8",), {"name": "note", "text": "seeing 0.8"}),
    "record": (("HD 209458", "Ann"), {"name": "note", "text": "target: HD 209458; observer: Ann"}),
    "end log": ((), {}),
    "safe": ((), {"name": "safe"}),
    "clear": ((), {"name": "clear"}),
}
"""Values typed for each button, and some fields of the request that the controller then publishes."""
ORDER = ("open", *(name for name in BUTTONS if name not in ("open", "close", "pause")), "close", "pause")
"""Buttons in an order in which the controller accepts every request."""
TASKS = {
    "dark": "calibrate dark --star-blocked --frames 400 --out",
    "reference": "calibrate reference --frames 1000 --out",
    "calibrate": "calibrate --method hadamard --snr 70 --out",
}


def test_the_key_of_every_button_sends_its_request(
    screen: Screen, run: LiveRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert {*BUTTONS, *TASKS} == set(ALL_ACTIONS)
    monkeypatch.setenv("HOME", str(tmp_path))
    np.save(tmp_path / "shape.npy", np.full(GRID, 3.0))
    law_file.save(LAW, tmp_path / "law.fits")
    calibration_file.save(with_identity(calibration()), tmp_path / "calibration.fits")
    for name in ORDER:
        typed, expected = BUTTONS[name]
        before = len(run.requests)
        screen.press(ALL_ACTIONS[name].key)
        if typed:
            screen.fill(*typed)
        elif ALL_ACTIONS[name].confirm:
            screen.until(screen.form_is_open)
            assert len(run.requests) == before, "no request before the question is answered"
            screen.press("enter")
        screen.until(
            lambda name=name: (
                screen.text("answer").startswith(f"{name}: ") and not screen.text("answer").endswith(": requested")
            )
        )
        if expected:
            request = run.requests[-1]
            assert request.accepted, request.reply
            assert {field: getattr(request, field) for field in expected} == expected
            assert request.requester.endswith(f"(process {os.getpid()})")
        assert not screen.form_is_open(), "a form closes when its request is accepted"
    laws = [request for request in run.requests if request.name == "law"]
    assert [law.HasField("law") for law in laws] == [True, False]
    assert run.recorder_requests == ["stop", "start", "stop"]
    screen.until(lambda: "pause (" in screen.text("log"))
    line = next(line for line in screen.text("log").splitlines() if "pause (" in line)
    assert f"(process {os.getpid()}))" in line
    assert "loop paused" in line
    screen.press("c")
    screen.until(lambda: "CLOSED" in screen.text("tiles"))


def test_a_refused_request_shows_its_reason_and_turns_its_button_red(screen: Screen, run: LiveRun) -> None:
    screen.press("g")
    screen.fill("much", "2")
    screen.until(lambda: "write numbers" in str(screen.app.screen.query_one("#refusal").render()))
    screen.fill("9", "2")
    screen.until(lambda: "becomes unstable" in str(screen.app.screen.query_one("#refusal").render()))
    assert not run.requests[-1].accepted
    assert "becomes unstable" in screen.text("answer")
    screen.press("escape")
    screen.until(lambda: not screen.form_is_open())
    button = screen.app.screen.query_one("#gain")
    assert button.has_class("refused")
    screen.press("g")
    screen.fill("0.1", "")
    screen.until(lambda: not button.has_class("refused"))


def test_a_form_stays_open_at_the_answer_to_an_earlier_request_of_its_button(
    screen: Screen, monkeypatch: pytest.MonkeyPatch
) -> None:
    answered = threading.Event()

    def slow(*_: object) -> Answer:
        answered.wait(TIMEOUT_S)
        return Answer(True, "noted", 0)

    monkeypatch.setitem(ALL_ACTIONS, "note", ALL_ACTIONS["note"]._replace(ask=slow))
    screen.press("n")
    screen.fill("the first")
    screen.press("escape")
    screen.until(lambda: not screen.form_is_open())
    screen.press("n")
    screen.until(screen.form_is_open)
    answered.set()
    screen.until(lambda: screen.text("answer") == "note: noted")
    assert screen.form_is_open()
    screen.fill("the second")
    screen.until(lambda: not screen.form_is_open())


def test_auto_is_accepted_for_gains_only(screen: Screen, run: LiveRun) -> None:
    before = len(run.requests)
    for key, values in (("l", ("auto", "")), ("t", ("auto",))):
        screen.press(key)
        screen.fill(*values)
        screen.until(lambda: "'auto': write numbers" in str(screen.app.screen.query_one("#refusal").render()))
        screen.press("escape")
        screen.until(lambda: not screen.form_is_open())
    assert len(run.requests) == before


def test_safe_is_requested_by_s_by_its_button_by_f12_in_a_form_and_by_s_in_the_help(
    screen: Screen, run: LiveRun
) -> None:
    for press in (lambda: screen.press("S"), lambda: screen.click("#safe"), lambda: screen.press("question_mark", "s")):
        before = len(run.requests)
        press()
        screen.until(lambda before=before: [request.name for request in run.requests[before:]] == ["safe"])
    screen.until(lambda: not screen.form_is_open())
    screen.press("n")
    screen.until(screen.form_is_open)
    before = len(run.requests)
    screen.press("s", "f12")
    screen.until(lambda: [request.name for request in run.requests[before:]] == ["safe"])
    screen.until(lambda: screen.app.screen.query_one("Input").value == "s")
    screen.press("escape", "k", "enter")
    screen.until(lambda: run.requests[-1].name == "clear" and not screen.form_is_open())
    screen.click("#close")
    screen.until(lambda: run.requests[-1].name == "close")


def test_a_gain_knob_scales_the_gains_of_all_modes_or_of_one_radial_order(screen: Screen, run: LiveRun) -> None:
    def gain() -> list[float]:
        return list(run.requests[-1].values) if run.requests and run.requests[-1].name == "gain" else []

    screen.press("g")
    screen.fill("0.5 0.5 0.05", "2-4")
    screen.until(lambda: gain() == pytest.approx([0.5, 0.5, 0.05]) and "0.05-0.5" in screen.text("gains"))
    screen.until(lambda: not screen.form_is_open())  # an open form takes the keys
    before = len(run.requests)
    screen.press(*["right"] * 4)
    screen.until(lambda: gain() == pytest.approx([0.7, 0.7, 0.07]))
    tip_gains = [request.values[0] for request in run.requests[before:]]
    assert tip_gains == sorted(tip_gains), "requested in the order of the keys"
    screen.until(lambda: "0.07-0.7" in screen.text("gains"))
    screen.press("down", "left")
    screen.until(lambda: gain() == pytest.approx([0.65, 0.65]))
    assert list(run.requests[-1].modes) == [2, 3]
    screen.press("down", "left")
    screen.until(lambda: gain() == pytest.approx([0.06]))
    screen.until(lambda: "0.06-0.65" in screen.text("gains"))
    screen.click("#gains", offset=(11 + 8, 0))  # the right end of the knob's bar
    screen.until(lambda: gain() == pytest.approx([1.5, 1.5, 0.1385]))
    screen.press("u")
    screen.until(lambda: any(request.text == "auto" and request.accepted for request in run.requests))
    screen.until(lambda: "auto" in screen.text("gains"))
    screen.press("g")  # automatic gains would send requests during the next tests
    screen.fill("0.5 0.5 0.05", "2-4")
    screen.until(lambda: "auto" not in screen.text("gains"))


def test_a_knob_is_chosen_and_shown_whatever_the_number_of_modes(monkeypatch: pytest.MonkeyPatch) -> None:
    turned: list[tuple[Sequence[int], Sequence[float]]] = []
    knobs = Gains(lambda modes, values: turned.append((modes, values)))

    def update(*noll: int, gain: float = 0.5, automatic: tuple[bool, ...] = ()) -> None:
        controller = wire.ControllerState(gain=[gain] * len(noll), automatic=automatic)
        snapshot = SimpleNamespace(controller=controller, noll=noll)
        knobs.update(SimpleNamespace(state=SimpleNamespace(snapshot=snapshot)))

    update(2, 3, 4, 5, 6, 7)
    knobs.choose(-1)
    update(2, 3)
    knobs.turn(1)
    knobs.automatic()
    assert [modes for modes, _ in turned] == [(2, 3), (2, 3)]
    knobs.discard_pending()
    update(2, 3, gain=1.8)
    knobs.turn(1)
    assert turned[-1][1] == [1.8, 1.8], "a gain beyond the bar, entered as a number, is not lowered"
    for gain, automatic in ((np.inf, ()), (np.nan, ()), (0.5, (True,))):  # another program's messages
        update(2, 3, gain=gain, automatic=automatic)
        assert [line.plain for line in knobs._lines] == ["gains are not known yet"]
    update(2, gain=-1e30)
    assert " ●━━━━━━━━ -1e+30" in knobs._lines[0].plain
    monkeypatch.setattr(Gains, "size", Size(60, 5))
    update(*range(2, 37))
    for _ in range(8):
        knobs.choose(1)
        assert any(line.plain.startswith("▸") for line in knobs._lines[:5]), "scrolled to the chosen knob"


def test_keys_typed_while_a_form_opens_are_entered_in_it(screen: Screen, run: LiveRun) -> None:
    before = len(run.requests)
    for key in ("n", "o", "s", "escape", "g", "0", ".", "2", "tab", "2", "tab", "shift+tab", "enter"):
        screen.app.post_message(Key(key, key if len(key) == 1 else None))
    screen.until(lambda: len(run.requests) > before)
    (gain,) = run.requests[before:]
    assert (gain.name, list(gain.values), list(gain.modes)) == ("gain", [pytest.approx(0.2)], [2])


def test_a_repeated_event_has_one_line_with_its_count() -> None:
    history = History()
    for number in range(40):
        name = "LIMIT_CLEARED" if number % 2 else "LIMIT_HIT"
        history.add(EVENTS[name].log("controller", number * 10**7, reason="SLEW"))
    history.add(wire.Request(name="open", accepted=True, reply="loop open"))
    lines = history.last(5).plain.splitlines()
    assert [line.split()[1:4] for line in lines[:2]] == [["20", "x", "controller:"]] * 2
    assert "open (" in lines[2]
    history.add(EVENTS["LIMIT_HIT"].log("controller", 60 * 10**9, reason="SLEW"))
    assert len(history.last(5).plain.splitlines()) == 4, "a repetition after 10 s has its own line"


def test_the_console_replaces_commands_by_keys_and_long_lists_by_ranges() -> None:
    assert phrased("`lowfc ctl clear` first, when it is safe") == "clear (key k) first, when it is safe"
    assert phrased("`lowfc ctl record start` goes on") == "record start (key r) goes on"
    assert phrased("`lowfc ctl gain 0 --modes 5,7` leaves") == "gain 0, modes 5,7 (key g) leaves"
    assert phrased("`lowfc ctl permit` and `lowfc tune`") == "`lowfc ctl permit` and `lowfc tune`"
    assert phrased("gain is now 0.5 0.5 0.05 0.01: below 2") == "gain is now 0.01 to 0.5 (4 modes): below 2"
    assert phrased("1.9 1.9 1.9 1.9 1.9") == "1.9 (5 modes)"
    assert panels.event_line(EVENTS["NOTE"].log("controller", 0, text="1 2 3 4")).plain.endswith("NOTE 1 2 3 4")


def test_tasks_are_commands_with_the_options_of_their_form(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    task = Mock(side_effect=lambda name, _: SimpleNamespace(status=0, status_line=f"{name}: done"))
    monkeypatch.setattr(application, "Task", task)
    for name, expected_command in TASKS.items():
        screen.press(ALL_ACTIONS[name].key)
        screen.until(screen.form_is_open)
        screen.press("enter")
        screen.until(lambda name=name: screen.text("answer") == f"{name}: done")
        command = " ".join(task.call_args.args[1])
        assert command.startswith(f"{expected_command} calibration-")
        assert command.endswith(f".fits --load --run {RUN}")


def test_a_task_expands_a_tilde_and_its_load_field_takes_yes_or_no() -> None:
    dark = ALL_ACTIONS["dark"]
    out = str(Path.home() / "dark.fits")
    assert dark.command({"frames": "9", "out": "~/dark.fits"}, RUN)[3:7] == ["--frames", "9", "--out", out]
    for answer, expected in (("y", ["--load"]), ("Yes", ["--load"]), ("n", []), ("NO", []), ("", [])):
        assert dark.command({"load": answer}, RUN) == [*dark.task, *expected, "--run", RUN]
    with pytest.raises(ConfigurationError, match="load must be yes or no, got 'yep': write yes, y, no or n"):
        dark.command({"load": "yep"}, RUN)


def test_a_task_runs_in_its_own_session_and_reports_its_end() -> None:
    for arguments, status, status_line in ((["--version"], 0, "t: done; 0."), (["no-such"], 2, "t failed: ")):
        task = Task("t", arguments)
        assert task.status_line.startswith("t: running for ")
        assert os.getsid(task._process.pid) == task._process.pid, "neither Ctrl-C nor a lost terminal reaches it"
        until(lambda task=task: task.status is not None)
        assert task.status == status
        assert task.status_line.startswith(status_line)
        task.output.unlink()
        assert task.status_line.startswith(status_line[:8]), "a cleaner of temporary files may remove the output"


def test_the_configuration_is_queried_until_it_is_known(run: LiveRun, monkeypatch: pytest.MonkeyPatch) -> None:
    ask = Mock(return_value=CONFIG, side_effect=BusError)
    monkeypatch.setattr(feed, "configuration_of", ask)
    monkeypatch.setattr(monitor, "_QUERY_AGAIN_NS", 100_000_000)
    console_feed = feed.Feed(run.bus("operator"), RUN, run.clock)
    until(
        lambda: len(console_feed.read().state.snapshot.health) == 3 and console_feed.read().state.snapshot.calibration
    )
    ask.side_effect = None
    until(lambda: console_feed.read() and console_feed._configured)
    assert not console_feed._complete(Mock(controller=None)), "a controller whose state is unknown is queried again"
    asked = ask.call_count
    console_feed._query()  # called again, as it is while there is no calibration
    until(lambda: not any(thread.name == "query" for thread in threading.enumerate()))
    assert ask.call_count == asked, "a known configuration is not requested again: each request is in the log"
    assert console_feed._config == CONFIG


def test_states_are_queried_when_a_process_appears_and_every_five_seconds_until_the_controller_has_sent_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(monitor.Monitor, "_query", query := Mock())
    hub, clock = MemoryHub(), HostClock()
    reader = monitor.Monitor(MemoryBus(hub, "operator", clock), clock)
    begin_ns = clock.now_ns()
    for seconds, new, queries in ((0, "recorder", 1), (9, "controller", 2), (13, "", 2), (15, "", 3)):
        if new:
            MemoryBus(hub, new, clock).publisher(HEALTH, new).put(wire.Health(process=new).SerializeToString())
        reader.snapshot(begin_ns + seconds * 10**9)
        assert query.call_count == queries, seconds


def test_a_request_is_in_the_log_of_every_console(run: LiveRun) -> None:
    with console(run) as first, console(run) as second:
        first.press("n")
        first.fill("from the first")
        for screen in (first, second):
            screen.until(lambda screen=screen: "note from the first (" in screen.text("log"))


def test_errors_ring_the_bell_until_it_is_muted(screen: Screen, run: LiveRun, monkeypatch: pytest.MonkeyPatch) -> None:
    bells: list[str] = []
    monkeypatch.setattr(screen.app, "bell", lambda: bells.append("bell"))
    events = run.bus("recorder").publisher(EVENT)

    def publish(name: str, **details: object) -> None:
        events.put(EVENTS[name].log("recorder", run.clock.now_ns(), **details).SerializeToString())
        screen.until(lambda: name in screen.text("log"))

    publish("DISK_SLOW", stall_s=2.0, waiting=3)
    assert bells == []
    publish("RECORDING_FAILED", why="no space")
    assert bells == ["bell"]
    screen.press("m")
    publish("MESSAGES_LOST", count=3, topic="lowfc/event")
    assert bells == ["bell"]


def test_a_disconnected_console_reports_it_and_hides_the_values(
    screen: Screen, run: LiveRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as disconnected:
        disconnected.setattr(run.hub, "lose", lambda role, key, envelope: role == "operator")
        screen.until(lambda: screen.text("verdict").startswith("NOT CONNECTED"))
        screen.until(lambda: not screen.app.screen.query_one("#tiles").visible)
        screen.until(lambda: not screen.app.screen.query_one("#gains").visible)
    screen.until(lambda: not screen.text("verdict").startswith("NOT CONNECTED"))
    # Nine rows after the new layout: seven tiles, CONTRAST and VIEW.
    screen.until(lambda: screen.app.screen.query_one("#tiles").size.height == 9)


def test_a_console_without_its_terminal_ends() -> None:
    gone, clock = threading.Event(), HostClock()
    app = Console(MemoryBus(MemoryHub(), "operator", clock), RUN, clock, terminal_gone=gone.is_set)

    async def scenario() -> None:
        async with app.run_test(size=(100, 30)) as pilot:
            await pilot.pause(2 * application.READ_PERIOD_S)
            assert app.is_running
            gone.set()
            await pilot.pause(3 * application.READ_PERIOD_S)
            assert app.return_code == 0

    asyncio.run(scenario())


def test_verdict_and_tiles_have_the_text_of_the_view() -> None:
    stage = Stage()
    stage.begin()
    stage.flux = 0.01
    verdict = stage.run(2.0)
    no_command = np.zeros(0, np.float32)
    reading = Reading(0.1, stage.watcher.state(), verdict, None, no_command, [], [], [])
    assert panels.verdict(reading, RUN) == (verdict.level, f"CHECK  {verdict.headline}")
    for line, tile in zip(panels.tiles(reading), verdict.tiles, strict=True):
        assert all(word in line.plain for word in (tile.title, tile.value, tile.detail))
    slow = reading._replace(state=replace(reading.state, rate_hz=0.4))
    assert panels.peers(slow, RUN).plain.endswith(" 0.4 Hz")
    silent = reading._replace(silent_s=3.0)
    assert panels.verdict(silent, RUN)[0] is Level.BAD
    ended = replace(silent.state, controller=silent.state.controller._replace(life=Liveness.STOPPED))
    assert panels.verdict(silent._replace(state=ended), RUN)[0] is Level.NEUTRAL


def test_pictures_and_sparklines_have_a_fixed_size() -> None:
    assert sparkline([1.0, float("nan"), 0.5, 0.0]) == "█ ▅▁"
    assert sparkline([]) == ""
    assert sparkline([1.0, float("inf")]) == "▁█"
    assert sparkline([-0.01, -0.02]) == "▁▁"  # negative flux, after subtraction of the dark
    for shape in ((6, 7), (34, 34), (1, 300)):
        small = reduced(np.full(shape, 4.0))
        assert small.shape == (_PIXELS, _PIXELS)
        assert np.allclose(small, 4.0)
    lines = half_block_lines(np.zeros((4, 3, 3), np.uint8))
    assert [line.plain for line in lines] == ["▀▀▀"] * 2
    for command_nm, limit_nm, bar in ((-5.0, 10.0, "  ██│    "), (np.nan, 10.0, "    │████"), (0.0, 0.0, "    │████")):
        assert _mode(2, command_nm, limit_nm, 12).plain == f"Z2  {bar}"


@pytest.mark.parametrize("count", range(1, 36))
def test_the_bars_and_limits_of_all_modes_fit_their_columns(count: int) -> None:
    snapshot = SimpleNamespace(controller=wire.ControllerState(limit_nm=[50.0] * count), noll=range(2, 2 + count))
    reading = SimpleNamespace(state=SimpleNamespace(snapshot=snapshot), command_nm=np.full(count, -50.0))
    lines = panels.modes(reading, application._LEFT)
    assert max(line.cell_len for line in lines) <= application._LEFT
    assert sum(line.plain.count("│") for line in lines) == count


def test_a_request_of_an_impossible_time_is_not_shown() -> None:
    request = wire.Request(name="note")
    request.timestamp.seconds = 10**12
    assert feed._request(Sample(REQUEST.key, request.SerializeToString(), 1, 1, 1)) is None
