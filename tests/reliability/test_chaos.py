"""The rules of the chaos cases: each passes a run without fault, and notices the one that it is for."""

import json
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from lowfc.adapters.logs.sequence_gaps import Gaps
from lowfc.adapters.process.terminal import INTERRUPTED
from lowfc.contract.configuration import load
from lowfc.contract.envelope import sequence_of
from lowfc.contract.errors import ConfigurationError, LowfcError
from lowfc.contract.events import EVENTS, Level
from lowfc.contract.messages import COMMAND, EVENT, FRAME, MIRROR_STATE, STEP, TRUTH, Log, wire
from lowfc.programs.reliability.chaos.bench import PATIENCE_S, Ended, Left
from lowfc.programs.reliability.chaos.case import Case, lacking
from lowfc.programs.reliability.chaos.cases import CASES
from lowfc.programs.reliability.chaos.command import chaos, configured
from lowfc.programs.reliability.chaos.evidence import FORGED_S, Entry, Evidence
from lowfc.programs.reliability.chaos.frames import FIRST, STRUCK
from lowfc.programs.reliability.chaos.rules import FLOOR_NM, WITHIN, Finding, judge, recovered_s, restart_steps_nm
from sim_camera.faults import Kind

START_S = 1_800_000_000
SECOND_NS = 1_000_000_000
FRAMES = 1000
CASE = Case("nothing", "nothing", lambda bench: None)


def ns(index: int) -> int:
    return START_S * SECOND_NS + index * 4_000_000


def shape(index: int, height_nm: float = 0.0, start_s: int = START_S) -> Entry:
    surface = np.full((34, 34), height_nm, np.float32)
    command = wire.MirrorCommand(input_number=index, frame_sequence=sequence_of(START_S, index))
    return Entry(sequence_of(start_s, index), ns(index), command, surface)


def step(index: int, *reasons: int, used: bool = True, start_s: int = START_S) -> Entry:
    message = wire.ControlStep(
        input_number=index,
        frame_sequence=sequence_of(START_S, index),
        mode=wire.LOOP_MODE_CLOSED,
        reasons=reasons,
        error_nm=[1.0] * used,
    )
    return Entry(sequence_of(start_s, index), ns(index), message)


def truth(index: int, residual_nm: float) -> Entry:
    return Entry(sequence_of(START_S, index), ns(index), wire.Truth(residual_rms_nm=residual_nm))


def event(level: Level, text: str) -> Entry:
    return Entry(sequence_of(START_S, 1), ns(1), Log(name="controller", level=level, message=text))


def came(*lost: int) -> Gaps:
    found = Gaps(0)
    for number in range(FRAMES):
        if number not in lost:
            found.add(number)
    return found


@pytest.fixture
def evidence() -> Evidence:
    """Four seconds of a loop to which nothing happened."""
    found = Evidence(messages=5 * FRAMES, last_ns=[(ns(FRAMES), True)])
    found.entries[COMMAND] = [shape(index, index % 7) for index in range(FRAMES)]
    found.entries[MIRROR_STATE] = [shape(index, index % 7) for index in range(FRAMES)]
    found.entries[STEP] = [step(index) for index in range(FRAMES)]
    found.entries[TRUTH] = [truth(index, 2.0) for index in range(FRAMES)]
    found.came = {(0, key, START_S): came() for key in (FRAME.key, STEP.key)}
    return found


@pytest.fixture
def left(tmp_path: Path) -> Left:
    found = Left(tmp_path, load(None), marks={"quiet": ns(300), "end": ns(FRAMES)}, mode=wire.LOOP_MODE_CLOSED)
    found.ended = [Ended("camera", 0, 0.1, True), Ended("controller", 0, 0.1, True)]
    return found


def broken(case: Case, left: Left, evidence: Evidence) -> dict[str, str]:
    return {one.rule: one.found for one in judge(case, left, evidence) if not one.held}


def unflushed(evidence: Evidence, left: Left) -> None:
    left.killed_ns.append(ns(FRAMES))
    evidence.last_ns.append((ns(500), False))


def ended(name: str, *how: object) -> Callable[[Evidence, Left], None]:
    return lambda _, left: left.ended.append(Ended(name, *how))


LATER = [truth(FRAMES - 1, 5 * (WITHIN * 2 + FLOOR_NM))] * 100
LINE = (0, STEP.key, START_S)
SPOILT: list[tuple[str, str, Callable[[Evidence, Left], object]]] = [
    ("limits", "stroke", lambda e, _: e.entries[COMMAND].append(shape(FRAMES, 701))),
    ("limits", "slew", lambda e, _: e.entries[COMMAND].append(shape(FRAMES, 110))),
    ("limits", "not finite", lambda e, _: e.entries[COMMAND].append(shape(FRAMES, np.nan))),
    ("limits", "mirror: slew", lambda e, _: e.entries[MIRROR_STATE].append(shape(FRAMES, 160))),
    ("limits", "restarted", lambda e, _: e.entries[COMMAND].append(shape(FRAMES, 120, START_S + 5))),
    ("limits", "0 states", lambda e, _: e.entries[MIRROR_STATE].clear()),
    (
        "bad frames",
        "500, which was refused",
        lambda e, _: e.entries[STEP].__setitem__(500, step(500, wire.REASON_DARK, used=False)),
    ),
    ("bad frames", "twice", lambda e, _: e.entries[STEP].insert(500, step(500))),
    ("recovery", "closed", lambda e, _: e.entries[TRUTH].extend(LATER)),
    ("recovery", "open", lambda _, left: setattr(left, "mode", wire.LOOP_MODE_OPEN)),
    ("recovery", "in vain", lambda _, left: left.notes.append("waited in vain")),
    ("events", "1 unexpected SAFED", lambda e, _: e.entries[EVENT].append(event(Level.ERROR, "SAFED why"))),
    ("account", f"2 of {STEP.key} missing, 0 counted", lambda e, _: e.came.__setitem__(LINE, came(7, 8))),
    ("account", f"5 of {STEP.key} missing", lambda e, _: e.sent.__setitem__(LINE, FRAMES + 5)),
    ("account", "damaged", lambda e, _: e.unreadable.append("damaged")),
    ("account", "no log", lambda e, _: setattr(e, "messages", 0)),
    ("account", "flushed", unflushed),
    ("account", "nothing is counted", lambda _, left: setattr(left, "failure", "disk")),
    ("processes", "did not end", ended("mirror-dm", -signal.SIGKILL, PATIENCE_S, True)),
    ("processes", "camera ended with 1, by itself", ended("camera", 1, 0.0, False)),
    ("processes", "by itself", ended("camera", 0, 0.0, False)),
    ("processes", "lives on", lambda _, left: left.alive.append("python (1, Z)")),
    ("processes", "traceback in one", lambda _, left: (left.folder / "one.stderr").write_text("Traceback (most")),
]


@pytest.mark.parametrize(("rule", "words", "spoil"), SPOILT)
def test_each_rule_notices_what_it_is_for(
    rule: str, words: str, spoil: Callable[[Evidence, Left], object], left: Left, evidence: Evidence
) -> None:
    assert broken(CASE, left, evidence) == {}
    assert len(judge(CASE, left, evidence)) == 6
    spoil(evidence, left)
    found = broken(CASE, left, evidence)
    assert set(found) == {rule}
    assert words in found[rule]


def test_what_is_counted_or_held_is_no_fault(left: Left, evidence: Evidence) -> None:
    evidence.came[0, STEP.key, START_S] = came(7, 8)
    evidence.lost = {STEP.key: 2}
    evidence.entries[COMMAND].append(shape(FRAMES + 1, 110))  # a lost command allows as many moves
    assert broken(CASE, left, evidence) == {}
    evidence.entries[STEP][500] = step(500, wire.REASON_DARK, used=False)
    for shapes in (evidence.entries[COMMAND], evidence.entries[MIRROR_STATE]):
        shapes[500] = shapes[500]._replace(actuators_nm=shapes[499].actuators_nm)

    def where(bad: Callable[[int], bool]) -> dict[str, str]:
        return broken(replace(CASE, bad=bad), left, evidence)

    assert where(lambda number: number == 500) == {}
    assert "bad frame 501 was used" in where(lambda number: number == 501)["bad frames"]
    assert "no bad frame came" in where(lambda number: False)["bad frames"]


def test_an_expected_event_must_be_there(left: Left, evidence: Evidence) -> None:
    case = replace(CASE, expected=("FRAMES_REFUSED frames refused: DARK",))
    assert "no event" in broken(case, left, evidence)["events"]
    evidence.entries[EVENT].append(event(Level.WARNING, "FRAMES_REFUSED frames refused: DARK"))
    assert broken(case, left, evidence) == {}


def test_safed_means_latched_and_flat(left: Left, evidence: Evidence) -> None:
    case = replace(CASE, safe=True)
    assert "closed" in broken(case, left, evidence)["recovery"]
    left.mode = wire.LOOP_MODE_SAFE
    assert "mirror at" in broken(case, left, evidence)["recovery"]
    evidence.entries[MIRROR_STATE].append(shape(FRAMES))
    assert broken(case, left, evidence) == {}


def test_the_step_at_a_restart_is_measured_from_where_the_mirror_was(evidence: Evidence) -> None:
    assert restart_steps_nm(evidence) == []
    evidence.entries[COMMAND].append(shape(FRAMES, 40, START_S + 5))
    at_nm = float(evidence.entries[MIRROR_STATE][-1].actuators_nm.max())
    assert restart_steps_nm(evidence) == pytest.approx([40 - at_nm])


def test_the_time_to_recover_begins_with_the_new_controllers_first_frame(left: Left, evidence: Evidence) -> None:
    assert recovered_s(left, evidence) is None
    evidence.entries[STEP][600:] = [step(index, start_s=START_S + 5) for index in range(600, FRAMES)]
    evidence.entries[TRUTH][550:650] = [truth(index, 40.0) for index in range(550, 650)]
    assert recovered_s(left, evidence) == pytest.approx(50 * 0.004, abs=0.01)
    evidence.entries[TRUTH][600:] = [truth(index, 40.0) for index in range(600, FRAMES)]
    assert recovered_s(left, evidence) is None


def test_every_case_can_be_run(tmp_path: Path) -> None:
    names = {event.name for event in EVENTS.values()}
    for name, case in CASES.items():
        assert case.name == name
        assert {text.partition(" ")[0] for text in (*case.expected, *case.allowed)} <= names
    for case in {str(case.config): case for case in CASES.values()}.values():  # most have the usual one
        assert configured(case, tmp_path).control.start_mode == "closed"
    assert {case.fault for case in CASES.values() if case.fault} == set(Kind)
    first = next(case for case in CASES.values() if case.bad is not None).bad
    edges = (FIRST - 1, FIRST, FIRST + STRUCK - 1, FIRST + STRUCK)
    assert [first(number) for number in edges] == [False, True, True, False]
    assert FORGED_S < START_S
    bad = CASES["frames-stuck"].bad  # may be used as long as the loop lets it
    assert [bad(number) for number in (FIRST, FIRST + 2, FIRST + 3, FIRST + STRUCK)] == [False, False, True, False]


def run(*words: str, status: int = 0) -> str:
    app = typer.Typer()
    app.command("chaos")(chaos)
    app.command("other")(lambda: None)
    done = CliRunner().invoke(app, ["chaos", *words], catch_exceptions=False)
    assert done.exit_code == status
    return done.stdout


@pytest.fixture
def acted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cases that act without a loop."""

    def held(case: Case, left: Left, evidence: Evidence) -> list[Finding]:
        return [Finding("notes", not left.notes, "; ".join(left.notes))]

    def acting(case: Case, folder: Path, rng: object) -> Left:
        found = Left(folder, load(None))
        try:
            case.act(None)  # type: ignore[arg-type]  # they need none
        except LowfcError as error:
            found.notes.append(str(error))
        return found

    def wrong(bench: object) -> None:
        raise KeyError("odd")

    def stopped(bench: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lowfc.programs.reliability.chaos.command._run", acting)
    monkeypatch.setattr("lowfc.programs.reliability.chaos.rules.judge", held)
    acts = {"good": lambda bench: None, "odd": wrong, "stopped": stopped, "last": lambda bench: None}
    cases = {name: replace(CASE, name=name, act=act) for name, act in acts.items()}
    cases["lacking"] = replace(CASE, name="lacking", act=wrong, lacks=lambda: "takes a mount of its own (not here)")
    monkeypatch.setattr("lowfc.programs.reliability.chaos.cases.CASES", cases)


@pytest.mark.usefixtures("acted")
def test_what_a_host_cannot_do_is_skipped_and_not_passed() -> None:
    words = ("--case", "lacking", "--case", "good")
    table = run(*words)
    assert table.splitlines()[0].startswith("lacking  skipped: takes a mount of its own (not here) ")
    assert table.endswith("1 passed, 0 failed, 1 skipped, seed 1\n")
    figures = json.loads(run(*words, "--json"))
    assert (figures["passed"], figures["failed"], figures["skipped"]) == (1, 0, 1)
    assert [(row["passed"], row["skipped"]) for row in figures["cases"]] == [
        (False, "takes a mount of its own (not here)"),
        (True, None),
    ]


@pytest.mark.usefixtures("acted")
def test_an_odd_error_fails_its_case_alone_and_leaves_its_traceback() -> None:
    table = run("--case", "good", "--case", "odd", "--case", "last", status=1)
    assert "    error: KeyError: 'odd'\n" in table
    assert table.endswith("2 passed, 1 failed, seed 1\n")
    assert 'raise KeyError("odd")' in Path("chaos-logs/odd-1/error.txt").read_text()


@pytest.mark.usefixtures("acted")
def test_interrupted_it_prints_what_it_has() -> None:
    table = run("--case", "good", "--case", "stopped", "--case", "last", status=INTERRUPTED)
    assert table.splitlines()[0].split()[:2] == ["good", "passed"]
    assert table.endswith("1 passed, 0 failed, 2 not run, seed 1\n")
    assert not Path("chaos-logs").exists()


def test_what_cannot_be_tried_is_a_reason() -> None:
    assert lacking("takes it", "true") == ""
    assert lacking("takes it", "ls", "/not/there").startswith("takes it (ls: ")
    assert lacking("takes it", "false") == "takes it (false ended with 1)"
    assert lacking("takes it", "/not/there") == "takes it (/not/there: No such file or directory)"


def test_without_a_case_they_are_listed_and_one_that_is_not_there_is_named() -> None:
    assert all(name in run() for name in CASES)
    with pytest.raises(ConfigurationError, match="frames-dark"):
        run("--case", "frame-dark")
