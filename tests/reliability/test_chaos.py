"""The rules of the chaos cases, each of which holds without a fault and detects its own; the command `lowfc chaos`."""

import random
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import runtime_base
from lowfc.adapters.logs.writer import LogWriter
from lowfc.adapters.process.terminal import INTERRUPTED
from lowfc.contract.configuration import load
from lowfc.contract.envelope import sequence_of
from lowfc.contract.errors import ConfigurationError, DataFileError, LowfcError
from lowfc.contract.events import EVENTS, Level
from lowfc.contract.messages import COMMAND, EVENT, FRAME, MIRROR_STATE, STEP, TRUTH, Log, Topic, wire
from lowfc.contract.sequence_gaps import Gaps
from lowfc.programs.reliability.chaos.bench import PATIENCE_S, Outcome, ProcessEnd
from lowfc.programs.reliability.chaos.case import Case, unmet
from lowfc.programs.reliability.chaos.cases import CASES
from lowfc.programs.reliability.chaos.command import _run, configured
from lowfc.programs.reliability.chaos.evidence import FORGED_S, Entry, Evidence, read
from lowfc.programs.reliability.chaos.frames import FAULTY_FRAMES, FIRST
from lowfc.programs.reliability.chaos.rules import FLOOR_NM, MAX_RATIO, Finding, judge, recovered_s, restart_steps_nm
from sim_camera.faults import Kind
from tests.support.loops import json_of, lowfc, refusal

START_S = 1_800_000_000
SECOND_NS = 1_000_000_000
FRAMES = 1000
CASE = Case("nothing", "nothing", lambda bench: None)
CONFIG = load(None, {"mirror.rows": 12, "mirror.columns": 12})
GRID = CONFIG.mirror.rows, CONFIG.mirror.columns


def frame_ns(index: int) -> int:
    """Time of a frame, at 250 Hz."""
    return START_S * SECOND_NS + index * 4_000_000


def shape(index: int, height_nm: float = 0.0, start_s: int = START_S) -> Entry:
    surface = np.full(GRID, height_nm, np.float32)
    command = wire.MirrorCommand(input_number=index, frame_sequence=sequence_of(START_S, index))
    return Entry(sequence_of(start_s, index), frame_ns(index), command, surface)


def step(index: int, *reasons: int, used: bool = True, start_s: int = START_S) -> Entry:
    message = wire.ControlStep(
        input_number=index,
        frame_sequence=sequence_of(START_S, index),
        mode=wire.LOOP_MODE_CLOSED,
        reasons=reasons,
        error_nm=[1.0] if used else [],
    )
    return Entry(sequence_of(start_s, index), frame_ns(index), message)


def truth(index: int, residual_nm: float) -> Entry:
    return Entry(sequence_of(START_S, index), frame_ns(index), wire.Truth(residual_rms_nm=residual_nm))


def event(level: Level, text: str) -> Entry:
    return Entry(sequence_of(START_S, 1), frame_ns(1), Log(name="controller", level=level, message=text))


def received(*lost: int) -> Gaps:
    """Gaps of a topic of `FRAMES` messages; all were received except those with the numbers in `lost`."""
    gaps = Gaps(0)
    for number in range(FRAMES):
        if number not in lost:
            gaps.add(number)
    return gaps


@pytest.fixture(scope="module")
def good_entries() -> dict[Topic, tuple[Entry, ...]]:
    shapes = tuple(shape(index, index % 7) for index in range(FRAMES))
    steps, truths = zip(*((step(index), truth(index, 2.0)) for index in range(FRAMES)), strict=True)
    return {COMMAND: shapes, MIRROR_STATE: shapes, STEP: steps, TRUTH: truths}


@pytest.fixture
def evidence(good_entries: dict[Topic, tuple[Entry, ...]]) -> Evidence:
    """Evidence from the logs of a loop without a fault, four seconds long."""
    evidence = Evidence(messages=5 * FRAMES, log_ends=[(frame_ns(FRAMES), True)])
    for topic, entries in good_entries.items():
        evidence.entries[topic] = list(entries)
    evidence.received = {(0, key, START_S): received() for key in (FRAME.key, STEP.key)}
    return evidence


@pytest.fixture
def outcome(tmp_path: Path) -> Outcome:
    outcome = Outcome(tmp_path, CONFIG, settled_ns=frame_ns(300), end_ns=frame_ns(FRAMES), mode=wire.LOOP_MODE_CLOSED)
    outcome.ended = [ProcessEnd("camera", 0, 0.1, True), ProcessEnd("controller", 0, 0.1, True)]
    return outcome


def broken_rules(case: Case, outcome: Outcome, evidence: Evidence) -> dict[str, str]:
    return {one.rule: one.found for one in judge(case, outcome, evidence) if not one.held}


def kill_with_unflushed_log(evidence: Evidence, outcome: Outcome) -> None:
    outcome.killed_ns.append(frame_ns(FRAMES))
    evidence.log_ends.append((frame_ns(500), False))


def ended(name: str, *details: object) -> Callable[[Evidence, Outcome], None]:
    return lambda _, outcome: outcome.ended.append(ProcessEnd(name, *details))


def refused(reason: int) -> Callable[[Evidence, Outcome], None]:
    return lambda evidence, _: evidence.entries[STEP].__setitem__(500, step(500, reason, used=False))


LARGE_RESIDUALS = [truth(FRAMES - 1, 5 * (MAX_RATIO * 2 + FLOOR_NM))] * 100
STEPS = (0, STEP.key, START_S)
FAULTS: list[tuple[str, str, Callable[[Evidence, Outcome], object]]] = [
    ("limits", "stroke", lambda e, _: e.entries[COMMAND].append(shape(FRAMES, 701))),
    ("limits", "slew", lambda e, _: e.entries[COMMAND].append(shape(FRAMES, 110))),
    ("limits", "not finite", lambda e, _: e.entries[COMMAND].append(shape(FRAMES, np.nan))),
    ("limits", "mirror: slew", lambda e, _: e.entries[MIRROR_STATE].append(shape(FRAMES, 160))),
    ("limits", "restarted", lambda e, _: e.entries[COMMAND].append(shape(FRAMES, 120, START_S + 5))),
    ("limits", "0 states", lambda e, _: e.entries[MIRROR_STATE].clear()),
    ("bad frames", "500, which was refused", refused(wire.REASON_DARK)),
    ("bad frames", "500, which was refused", refused(wire.REASON_AHEAD)),
    ("bad frames", "twice", lambda e, _: e.entries[STEP].insert(500, step(500))),
    ("recovery", "closed", lambda e, _: e.entries[TRUTH].extend(LARGE_RESIDUALS)),
    ("recovery", "open", lambda _, outcome: setattr(outcome, "mode", wire.LOOP_MODE_OPEN)),
    ("recovery", "in vain", lambda _, outcome: outcome.notes.append("waited in vain")),
    ("events", "1 unexpected SAFED", lambda e, _: e.entries[EVENT].append(event(Level.ERROR, "SAFED why"))),
    ("account", f"{STEP.key}: 2 missing, 0 counted", lambda e, _: e.received.__setitem__(STEPS, received(7, 8))),
    ("account", f"{STEP.key}: 5 missing", lambda e, _: e.sent.__setitem__(STEPS, FRAMES + 5)),
    ("account", "damaged", lambda e, _: e.unreadable.append("damaged")),
    ("account", "no log", lambda e, _: setattr(e, "messages", 0)),
    ("account", "flushed", kill_with_unflushed_log),
    ("account", "no message is counted", lambda _, outcome: setattr(outcome, "failure", "disk")),
    ("processes", "did not end", ended("mirror-dm", -signal.SIGKILL, PATIENCE_S, True)),
    ("processes", "camera ended with status 1, by itself", ended("camera", 1, 0.0, False)),
    ("processes", "by itself", ended("camera", 0, 0.0, False)),
    ("processes", "is still running", lambda _, outcome: outcome.alive.append("python (1, Z)")),
    ("processes", "traceback in one", lambda _, outcome: (outcome.folder / "one.stderr").write_text("Traceback (most")),
]


@pytest.mark.parametrize(("rule", "text", "inject"), FAULTS)
def test_a_fault_breaks_its_rule_and_no_other(
    rule: str, text: str, inject: Callable[[Evidence, Outcome], object], outcome: Outcome, evidence: Evidence
) -> None:
    assert [one.held for one in judge(CASE, outcome, evidence)] == [True] * 6
    inject(evidence, outcome)
    broken = broken_rules(CASE, outcome, evidence)
    assert set(broken) == {rule}
    assert text in broken[rule]


def test_counted_losses_and_a_held_command_at_refused_frames_break_no_rule(
    outcome: Outcome, evidence: Evidence
) -> None:
    evidence.received[STEPS] = received(7, 8)
    evidence.lost = {STEP.key: 2}
    evidence.entries[COMMAND].append(shape(FRAMES + 1, 110))  # after a missing command, twice the slew limit is allowed
    assert broken_rules(CASE, outcome, evidence) == {}
    evidence.entries[STEP][500] = step(500, wire.REASON_DARK, used=False)
    for shapes in (evidence.entries[COMMAND], evidence.entries[MIRROR_STATE]):
        shapes[500] = shapes[500]._replace(actuators_nm=shapes[499].actuators_nm)

    def broken_with(bad: Callable[[int], bool]) -> dict[str, str]:
        return broken_rules(replace(CASE, is_bad=bad), outcome, evidence)

    assert broken_with(lambda number: number == 500) == {}
    assert "bad frame 501 was used" in broken_with(lambda number: number == 501)["bad frames"]
    assert "no bad frame was received" in broken_with(lambda number: False)["bad frames"]


def test_a_missing_expected_event_breaks_the_rule_of_events(outcome: Outcome, evidence: Evidence) -> None:
    case = replace(CASE, expected=("FRAMES_REFUSED frames refused: DARK",))
    assert "no event" in broken_rules(case, outcome, evidence)["events"]
    evidence.entries[EVENT].append(event(Level.WARNING, "FRAMES_REFUSED frames refused: DARK"))
    assert broken_rules(case, outcome, evidence) == {}


def test_a_case_of_safe_mode_requires_this_mode_and_a_flat_mirror(outcome: Outcome, evidence: Evidence) -> None:
    case = replace(CASE, ends_safe=True)
    assert "closed" in broken_rules(case, outcome, evidence)["recovery"]
    outcome.mode = wire.LOOP_MODE_SAFE
    assert "nm of flat" in broken_rules(case, outcome, evidence)["recovery"]
    evidence.entries[MIRROR_STATE].append(shape(FRAMES))
    assert broken_rules(case, outcome, evidence) == {}


def test_the_step_at_a_restart_is_the_largest_move_from_the_last_mirror_state(evidence: Evidence) -> None:
    assert restart_steps_nm(evidence) == []
    evidence.entries[COMMAND].append(shape(FRAMES, 40, START_S + 5))
    last_nm = float(evidence.entries[MIRROR_STATE][-1].actuators_nm.max())
    assert restart_steps_nm(evidence) == pytest.approx([40 - last_nm])


def test_the_time_to_recover_starts_with_the_first_frame_of_the_new_controller(
    outcome: Outcome, evidence: Evidence
) -> None:
    assert recovered_s(outcome, evidence) is None
    evidence.entries[STEP][600:] = [step(index, start_s=START_S + 5) for index in range(600, FRAMES)]
    evidence.entries[TRUTH][550:650] = [truth(index, 40.0) for index in range(550, 650)]
    assert recovered_s(outcome, evidence) == pytest.approx(50 * 0.004, abs=0.01)
    evidence.entries[TRUTH][600:] = [truth(index, 40.0) for index in range(600, FRAMES)]
    assert recovered_s(outcome, evidence) is None


def test_reading_the_logs_counts_losses_and_lists_what_cannot_be_read(tmp_path: Path) -> None:
    def log(name: str, finished: bool, *samples: tuple[Topic, bytes]) -> None:
        writer = LogWriter(tmp_path / name, 0, {})
        for number, (topic, payload) in enumerate(samples):
            writer.write(
                Sample(topic.at("dm"), payload, sequence_of(START_S, number), frame_ns(number), frame_ns(number))
            )
        if finished:
            writer.finish({"recording": {f"lost {STEP.key}": "3", "messages": "2"}})
        else:
            writer.flush()
            writer.abandon()

    log(
        "1.mcap",
        True,
        (COMMAND, shape(1, 5.0).message.SerializeToString()),
        (STEP, step(1).message.SerializeToString()),
    )
    log("2.mcap", True, (TRUTH, b"\xff"))
    log("3.mcap", False, (TRUTH, truth(1, 2.0).message.SerializeToString()))
    (tmp_path / "4.mcap").write_bytes(b"damaged")
    found = read(tmp_path)
    assert [len(found.entries[topic]) for topic in (COMMAND, STEP, TRUTH)] == [0, 1, 1]  # the command has no actuators
    assert found.lost == {STEP.key: 6}
    assert [finished for _, finished in found.log_ends] == [True, True, False, False]
    assert found.messages == 4
    shapeless, undecodable, damaged = found.unreadable
    assert shapeless == f"a message on {COMMAND.at('dm')} has 0 bytes of actuators"
    assert TRUTH.key in undecodable
    assert "4.mcap" in damaged


def test_every_case_has_a_valid_configuration_and_known_events(tmp_path: Path) -> None:
    for name, case in CASES.items():
        assert case.name == name
        assert {text.partition(" ")[0] for text in (*case.expected, *case.allowed)} <= EVENTS.keys()
    for case in {str(case.config): case for case in CASES.values()}.values():  # each configuration once
        assert configured(case, tmp_path).control.start_mode == "closed"
    assert {case.fault for case in CASES.values() if case.fault} == set(Kind)
    bad = next(case for case in CASES.values() if case.is_bad is not None).is_bad
    edges = (FIRST - 1, FIRST, FIRST + FAULTY_FRAMES - 1, FIRST + FAULTY_FRAMES)
    assert [bad(number) for number in edges] == [False, True, True, False]
    assert FORGED_S < START_S
    bad = CASES["frames-stuck"].is_bad  # of the identical frames, the first max_identical_frames may be used
    edges = (FIRST, FIRST + 2, FIRST + 3, FIRST + FAULTY_FRAMES)
    assert [bad(number) for number in edges] == [False, False, True, False]


def run(*arguments: str, status: int = 0) -> str:
    done = lowfc("chaos", *arguments)
    assert done.exit_code == status, done.exception
    return done.stdout


@pytest.fixture
def without_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace all cases by ones that run without a loop."""

    def judge_notes(case: Case, outcome: Outcome, evidence: Evidence) -> list[Finding]:
        return [Finding("notes", not outcome.notes, "; ".join(outcome.notes))]

    def act_only(case: Case, folder: Path, rng: object) -> Outcome:
        outcome = Outcome(folder, load(None))
        try:
            case.act(None)  # type: ignore[arg-type]  # these acts need no bench
        except LowfcError as error:
            outcome.notes.append(str(error))
        return outcome

    def faulty(bench: object) -> None:
        raise KeyError("odd")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lowfc.programs.reliability.chaos.command._run", act_only)
    monkeypatch.setattr("lowfc.programs.reliability.chaos.rules.judge", judge_notes)
    acts = {"good": Mock(), "odd": faulty, "stopped": Mock(side_effect=KeyboardInterrupt), "last": Mock()}
    cases = {name: replace(CASE, name=name, act=act) for name, act in acts.items()}
    cases["lacking"] = replace(CASE, name="lacking", act=faulty, why_skipped=lambda: "requires a mount (not here)")
    monkeypatch.setattr("lowfc.programs.reliability.chaos.cases.CASES", cases)


@pytest.mark.usefixtures("without_loop")
def test_a_case_that_the_host_cannot_run_is_skipped_and_not_passed() -> None:
    arguments = ("--case", "lacking", "--case", "good")
    table = run(*arguments)
    assert table.splitlines()[0].startswith("lacking  skipped: requires a mount (not here) ")
    assert table.endswith("1 passed, 0 failed, 1 skipped, seed 1\n")
    results = json_of("chaos", *arguments)
    assert (results["passed"], results["failed"], results["skipped"]) == (1, 0, 1)
    assert [(row["passed"], row["skipped"]) for row in results["cases"]] == [
        (False, "requires a mount (not here)"),
        (True, None),
    ]


@pytest.mark.usefixtures("without_loop")
def test_an_unexpected_error_fails_only_its_case_and_its_traceback_is_kept() -> None:
    table = run("--case", "good", "--case", "odd", "--case", "last", status=1)
    assert "    error: KeyError: 'odd'\n" in table
    assert table.endswith("2 passed, 1 failed, seed 1\n")
    assert 'raise KeyError("odd")' in Path("chaos-logs/odd-1/error.txt").read_text()
    assert "    logs: chaos-logs/odd-1\n" in table
    rows = json_of("chaos", "--case", "good", "--case", "odd", "--case", "lacking", status=1)["cases"]
    assert [(row["detail"], row["log"]) for row in rows] == [
        ("", None),
        ("error: KeyError: 'odd'", "chaos-logs/odd-1"),
        ("requires a mount (not here)", None),
    ]


@pytest.mark.usefixtures("without_loop")
def test_a_log_that_cannot_be_moved_stays_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.move", Mock(side_effect=OSError("no space left")))
    good, odd = json_of("chaos", "--case", "good", "--case", "odd", status=1)["cases"]
    assert (good["passed"], good["log"], odd["passed"]) == (True, None, False)
    assert 'raise KeyError("odd")' in Path(odd["log"], "error.txt").read_text()
    shutil.rmtree(odd["log"])


@pytest.mark.usefixtures("without_loop")
def test_an_interrupted_command_prints_the_results_so_far() -> None:
    table = run("--case", "good", "--case", "stopped", "--case", "last", status=INTERRUPTED)
    assert table.splitlines()[0].split()[:2] == ["good", "passed"]
    assert table.endswith("1 passed, 0 failed, 2 not run, seed 1\n")
    assert not Path("chaos-logs").exists()


def test_an_unmet_requirement_has_the_reason_why_its_command_failed() -> None:
    assert unmet("requires it", "true") == ""
    assert unmet("requires it", "ls", "/not/there").startswith("requires it (ls: ")
    assert unmet("requires it", "false") == "requires it (false ended with 1)"
    assert unmet("requires it", "/not/there") == "requires it (/not/there: No such file or directory)"


def test_a_shifted_clock_is_tried_with_the_shift_of_the_case(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel refuses a monotonic clock below zero: a clock an hour behind needs a host that has run for an hour."""
    monkeypatch.setattr("lowfc.programs.reliability.chaos.case.unmet", lambda *arguments: " ".join(arguments[-2:]))
    assert [CASES[f"clock-{kind}"].why_skipped() for kind in ("ahead", "behind")] == ["3600 true", "-3600 true"]


@pytest.mark.usefixtures("without_loop")
def test_a_folder_that_cannot_hold_logs_is_refused_before_the_first_case(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in ("file", "file/logs"):
        error = refusal("chaos", "--case", "stopped", "--keep", folder, kind=DataFileError)
        assert "no logs can be kept in file" in error
    Path("chaos-logs").touch()
    assert "name another with --keep" in refusal("chaos", "--case", "stopped", kind=DataFileError)


@pytest.mark.usefixtures("own_runtime")
def test_an_interrupt_while_a_case_is_prepared_leaves_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lowfc.programs.reliability.chaos.bench.prepare", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        _run(CASE, tmp_path, random.Random(1))  # noqa: S311  # nothing secret
    assert [path for path in runtime_base().iterdir() if path.is_dir()] == []


def test_without_a_case_all_cases_are_listed_and_an_unknown_case_gets_a_suggestion() -> None:
    table = run()
    assert all(name in table for name in CASES)
    assert [one["name"] for one in json_of("chaos")["cases"]] == list(CASES)
    assert "frames-dark" in refusal("chaos", "--case", "frame-dark", kind=ConfigurationError)
