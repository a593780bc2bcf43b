"""A night with the loop: every command and program of docs/howto/operating.md, run against real processes."""

import contextlib
import io
import itertools
import json
import os
import re
import shlex
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import Popen

import numpy as np
import pytest

from lowfc.adapters.files import calibration_file, law_file
from lowfc.client import Client, running
from lowfc.client.requests import DECLARED
from lowfc.contract.errors import CalibrationError, RequestRefusedError
from lowfc.contract.messages import COMMAND, EVENT, REQUEST, Log, wire
from lowfc.control.laws.linear_law import integrator_block, law_from_blocks
from lowfc.control.loop.requests import REQUESTS
from lowfc.control.loop.safety import Limits
from tests.support.loops import FIXED, children, interrupt, json_of, lowfc, payloads, refusal, started, until
from tests.support.safety_checks import violations

pytestmark = pytest.mark.exclusive

DOCUMENT = Path(__file__).parents[2] / "docs" / "howto" / "operating.md"
COMMANDS = re.findall(r"^    (lowfc ctl .*)$", DOCUMENT.read_text(), flags=re.MULTILINE)
PROGRAMS = re.findall(r"^```python\n(.*?)^```$", DOCUMENT.read_text(), flags=re.MULTILINE | re.DOTALL)


@dataclass
class Night:
    """A running loop, the outputs of commands and programs, and, after `end`, the loop's results and logs."""

    folder: Path
    process: "Popen[str]"
    name: str = ""
    outputs: dict[str, str] = field(default_factory=dict)
    results: dict[str, object] = field(default_factory=dict)
    logs: list[Path] = field(default_factory=list)

    def ctl(self, command: str) -> str:
        _, *arguments = [
            str(self.folder / part) if (self.folder / part).is_file() else part for part in shlex.split(command)
        ]
        done = lowfc(*arguments, "--run", self.name)
        assert done.exit_code == 0, (done.output, done.exception)
        self.outputs[command] = done.stdout
        return done.stdout

    def end(self) -> None:
        out, stderr = interrupt(self.process)
        assert self.process.returncode == 0, stderr
        self.results = json.loads(out)
        self.logs = [self.folder / name for name in self.results["logs"]]  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Night]:
    """Run all commands and programs once; the tests check their output and logs."""
    folder = tmp_path_factory.mktemp("night")
    before = set(running())
    (folder / "test.toml").write_text(FIXED)
    options = ("--config", "test.toml", "--rate", "100", "--json", "--disturbance", "bench", "--seed", "4")
    with started(folder, "sim-loop", *options) as process:
        night = Night(folder, process)
        until(lambda: "controller" in children(process.pid) and set(running()) - before)
        (night.name,) = set(running()) - before
        _prepare(night)
        for command in COMMANDS:
            night.ctl(command)
        for number, program in enumerate(PROGRAMS):
            night.outputs[f"program {number}"] = _run_program(night, program)
        _make_requests_beyond_the_document(night)
        night.end()
        yield night


def _prepare(night: Night) -> None:
    """Wait for frames, and write the files that the document's commands read."""
    with Client(night.name) as loop:
        until(lambda: loop.status().state.frames_used)  # type: ignore[union-attr]
        loop.steps(1, patience_s=20)
        until(lambda: loop.processes()["controller"].last_second.frames)
        calibration, status = loop.calibration(), loop.status().state
    calibration_file.save(calibration, night.folder / "calibration.fits")
    delay = status.settings.delay_frames
    blocks = [integrator_block(0.2, 0.001, "pol", delay)] * len(calibration.noll)
    law_file.save(law_from_blocks(blocks, "pol", "leaky", calibration.noll, delay, 100.0), night.folder / "law.fits")
    rows, columns = np.indices(calibration.grid)
    np.save(night.folder / "shape.npy", 3.0 * np.sin(rows / 3) * np.cos(columns / 4))


def _run_program(night: Night, program: str) -> str:
    """Run a program of the document in this process, for this run and with this Python's `lowfc`; return its output."""
    printed = io.StringIO()
    source = program.replace('"bench"', repr(night.name)).replace("Client()", f"Client({night.name!r})")
    source = source.replace('"lowfc", "config"', f"{sys.executable!r}, '-m', 'lowfc', 'config'")
    with contextlib.redirect_stdout(printed):
        exec(compile(source, DOCUMENT.name, "exec"), {"__name__": "example"})  # noqa: S102  # from our own document
    return printed.getvalue()


def _make_requests_beyond_the_document(night: Night) -> None:
    """Make requests that the document has no command for: probe sequences, a lease, refusals, other options."""
    with Client(night.name) as loop:
        grid = loop.calibration().grid
        loop.open_loop()
        shapes = np.zeros((2, *grid))
        shapes[0, 10:20, 10:20], shapes[1, 5:9, 20:30] = 2.0, -3.0
        steps = loop.steps(60)
        first = loop.play(shapes, np.ones((20, 2))).frame_sequence
        night.outputs["played"] = json.dumps([len(list(steps)), steps.lost])
        until(lambda: not loop.status().state.HasField("play"))  # type: ignore[union-attr]
        loop.step(5)
        until(lambda: loop.status().reply == "open")
        loop.close_loop()
        assert loop.play_offset(np.ones((5000, 14))).frame_sequence > first
        loop.stop()
        for request, reason in (
            (lambda: loop.gain(9.0), "becomes unstable"),
            (lambda: loop.offset(np.nan), "finite"),
            (lambda: loop.channel("Dark Hole", np.zeros(grid)), "letter first"),
            (lambda: loop.load(loop.calibration()), "the loop is closed"),
            (lambda: loop.note(" "), "1 to"),
            (lambda: loop.ask("dance"), "unknown request 'dance'"),
            (lambda: loop.record(True), "already in progress"),
        ):
            with pytest.raises(RequestRefusedError, match=reason):
                request()
        with loop.reserved("a test", 30.0), Client(night.name) as other:
            with pytest.raises(RequestRefusedError, match=r"reserved for a test by .*, about \d+ s to go"):
                other.gain(0.1)
            night.outputs["while reserved"] = night.ctl("lowfc ctl status")
            loop.gain(0.05)
            loop.check_lease()
            other.open_loop()
            with pytest.raises(CalibrationError, match="operator asked to open"):
                loop.check_lease()
        loop.close_loop()
        loop.pause()
        night.outputs["while paused"] = night.ctl("lowfc ctl status --json")
        loop.close_loop()
        loop.record(False)
        night.outputs["while not recording"] = night.ctl("lowfc ctl status --json")
        loop.record(True)
        until(lambda: loop.processes()["controller"].mode == wire.LOOP_MODE_CLOSED)
        until(lambda: not loop.processes()["recorder"].recording.stopped)
    for name, arguments in (("short name", ("ctl", "note", "here", "--run", night.name[:-1])), ("hosts", ("hosts",))):
        night.outputs[name] = lowfc(*arguments).stdout

    def recorder_answered() -> bool:
        night.outputs["runs"] = lowfc("runs", "--json").stdout
        return '"recording": "none"' not in night.outputs["runs"]

    until(recorder_answered)  # `runs` does not wait for a late Health of the recorder
    for command in ("lowfc ctl status --json", "lowfc ctl note once --json", "lowfc ctl configuration --json"):
        night.ctl(command)
    night.outputs["refused"] = refusal("ctl", "gain", "-0.1", "--modes", "2", "--run", night.name)
    with Client(night.name) as loop:
        list(loop.steps(125))  # so that the last log holds the controller's state, which comes once a second


def test_every_request_is_made_by_a_command_of_the_document() -> None:
    names = {command.split()[2] for command in COMMANDS} - {"bench"}  # `bench` makes no request
    assert names == {request.example.split()[0] for request in DECLARED if request.example}


def test_the_commands_print_what_they_did(night: Night) -> None:
    outputs = night.outputs
    status_of_a_closed_loop = (
        r"closed · residual [\d.]+ nm rms, noise included( \(true [\d.]+ over 2 s\))? · light \d+ % · "
        r"\d+ frames? lost · recording "
    )
    assert re.match(status_of_a_closed_loop, outputs["lowfc ctl status"])
    assert "loop           closed" in outputs["lowfc ctl status"]
    assert 'preset = "bench"' in outputs["lowfc ctl configuration"]
    assert "loop closed for 50 frames, from frame" in outputs["lowfc ctl step 50"]
    assert "gain is now 0.4 0.4 0.05" in outputs["lowfc ctl gain 0.4 --modes 2,3"]
    assert outputs["lowfc ctl gain auto"].startswith("the gain of Z2"), "without --modes, all modes get a gain"
    assert "leak is now 0 0 0.001 0.001" in outputs["lowfc ctl leak 0.001 --modes 4-11"]
    assert "offset is now 0 0 5 0" in outputs["lowfc ctl offset 5 -3 --modes 4,11"]
    assert "channel dark-hole: 1.47 nm rms of surface" in outputs["lowfc ctl channel dark-hole shape.npy"]
    assert "mask-moving is true; no interlock is configured (run" in outputs["lowfc ctl bench mask-moving true"]
    assert "'leaky' takes over" in outputs["lowfc ctl law law.fits"]
    assert [re.split("[,;]", outputs[f"lowfc ctl {name}"])[0] for name in ("safe", "clear", "pause", "close")] == [
        "loop in safe mode",
        "loop open",
        "loop paused: the command is held until `lowfc ctl close`",
        "loop closed",
    ]
    assert all(f"run {night.name}" in outputs[command] for command in COMMANDS), "every answer names its run"
    status = json.loads(outputs["lowfc ctl status --json"])
    assert (status["mode"], status["law"]["name"], status["offset_rms_nm"]) == ("closed", "integrator", 0.0)
    assert (status["run"], status["paused"], status["recording"]) == (night.name, False, "recording")
    paused, not_recording = json.loads(outputs["while paused"]), json.loads(outputs["while not recording"])
    assert (paused["mode"], paused["paused"], not_recording["recording"]) == ("open", True, "stopped")
    (listed,) = json.loads(outputs["runs"])["runs"]
    expected = {"run": night.name, "mode": "closed", "holding": None, "recording": "recording"}
    assert {name: listed[name] for name in expected} == expected
    assert listed.keys() == {"run", "mode", "holding", "rate_hz", "uptime_s", "processes", "recording", "log"}
    names = ["camera", "controller", "mirror-dm", "recorder"]
    assert [process["process"] for process in listed["processes"]] == names
    assert all(name in outputs["hosts"] for name in names)
    assert outputs["hosts"].endswith("no clock is compared: the run has no router, or its router reports no clock\n")
    assert f"run {night.name}" in outputs["short name"]
    assert status["channels"] == []
    assert json.loads(outputs["lowfc ctl note once --json"])["reply"] == "noted"
    assert json.loads(outputs["lowfc ctl configuration --json"])["camera"]["rate_hz"] == 100.0
    assert outputs["refused"].startswith("gain refused: gain must be at least 0")


def test_the_programs_of_the_document_run(night: Night) -> None:
    assert "frames lost on their way: 0" in night.outputs["program 0"]
    assert "mean image (" in night.outputs["program 0"]
    assert night.outputs["program 1"].startswith("True gain is now 0.3 0.3")
    assert json.loads(night.outputs["played"]) == [60, 0]
    assert "reserved       for a test by " in night.outputs["while reserved"]


def test_the_log_has_every_request_and_nothing_was_lost(night: Night) -> None:
    assert night.results["messages_lost"] == 0
    assert night.results["recording_failure"] is None
    assert len(night.logs) == 3, "the recording was stopped and started twice"
    messages = [payloads(log) for log in night.logs]
    requests = [wire.Request.FromString(body) for log in messages for body in log.get(f"/{REQUEST.key}", [])]
    counts = Counter((request.name, request.accepted) for request in requests)
    assert {name for name, accepted in counts if accepted} == set(REQUESTS)
    refused = {name for name, accepted in counts if not accepted}
    assert refused == {"gain", "offset", "channel", "load", "note", "renew", "dance"}
    commanded = Counter(command.split()[2] for command in COMMANDS)
    for name, count in commanded.items():
        assert name in ("record", "bench") or sum(counts[name, accepted] for accepted in (True, False)) >= count
    input_numbers = [request.input_number for request in requests if request.input_number]
    assert input_numbers == sorted(input_numbers)
    events = [Log.FromString(body).message for log in messages for body in log[f"/{EVENT.key}"]]
    for expected in (
        "RECORDING_STOPPED recording stopped: operator asked",
        "NOTE HD 209458, seeing 0.8 arcsec",
        "LOOP_STEPPED the loop opened after its last step",
    ):
        assert expected in events


def test_every_command_keeps_the_actuator_limits(night: Night) -> None:
    limits = Limits(700.0, 100.0, 400.0)
    shapes = []
    for messages in map(payloads, night.logs):
        commands = [wire.MirrorCommand.FromString(body) for body in messages[f"/{COMMAND.at('dm')}"]]
        shapes.append([np.frombuffer(one.actuators, "<f4").reshape(one.rows, one.columns) for one in commands])
    assert sum(map(len, shapes)) > 500
    for log in shapes:
        for before, now in itertools.pairwise(log):
            assert violations(limits, before, now) == []


def test_the_night_is_replayed_bit_for_bit(night: Night) -> None:
    commands = 0
    for log in night.logs:
        results = json_of("replay", log)
        assert results["identical"]
        assert results["largest_difference_nm"] == 0
        commands += results["commands"]
    frames = night.results["frames_processed"]
    assert isinstance(frames, int)
    assert commands > 0.6 * frames, (
        "only the commands before the first controller state of a later log are not replayed"
    )


@pytest.mark.slow
def test_requests_are_answered_while_a_process_is_suspended_beyond_the_timeout_of_its_links(tmp_path: Path) -> None:
    """A link that has timed out is closed without blocking the controller's receiving thread (formerly for 10 s)."""
    with started(tmp_path, "sim-loop", "--run", "suspended", "--rate", "50", "--no-record") as process:
        until(lambda: "sim_dm" in children(process.pid) and "suspended" in running())
        with Client("suspended") as loop:
            until(lambda: loop.status().state.frames_used)  # type: ignore[union-attr]
            mirror = children(process.pid)["sim_dm"]
            os.kill(mirror, signal.SIGSTOP)
            try:
                for _ in range(120):
                    assert loop.status().accepted
                    time.sleep(0.2)
            finally:
                os.kill(mirror, signal.SIGCONT)
