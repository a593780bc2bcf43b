"""The recorder as a process: killed at any moment, told to stop in any way, refused where there is no room."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.bus.run import new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.writer import UNFINISHED
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.provenance import provenance
from lowfc.adapters.process.service import Service
from lowfc.contract.envelope import count_of
from lowfc.contract.messages import FRAME, STEP, Topic
from lowfc.programs.launch.watch import topic_count
from tests.support.loops import lowfc, start, until
from tests.support.recording import PATIENCE_S, bodies_of

SAFE_NS = 600_000_000
"""What a kill may cost: the messages published in this time before it."""

# One process imports everything, and a copy of it becomes the recorder of each run.
RECORDERS = """
import os, signal, sys
from pathlib import Path
from lowfc.adapters.bus.run import open_run
from lowfc.programs.core.recording.process import record
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # tests under nohup would leave it ignored
folder, *runs = sys.argv[1:]
for run in runs:
    pid = os.fork()
    if not pid:
        done = record(open_run(run), Path(folder) / run, configuration=Path(folder) / "lowfc.toml")
        os._exit(1 if done.failure else 0)
    print(pid, flush=True)
for _ in runs:
    print(*os.waitpid(-1, 0), flush=True)
"""


class Bench:
    """A run with a camera in this process and a recorder in another."""

    def __init__(self, folder: Path) -> None:
        self.run = open_run(new_run_id())
        self.folder = folder / self.run.run_id
        self.clock = HostClock()
        self.bus = ZenohBus(self.run.links, "camera", self.clock)
        self.service = Service("camera", self.run.run_id, self.clock, self.bus)
        self.frames, self.steps = self.service.publisher(FRAME), self.service.publisher(STEP)
        self.pid = 0
        self.parent: subprocess.Popen[str] | None = None
        self.killed_ns = 0
        self.service.state = "ready"

    def put(self) -> None:
        number = self.frames.published
        self.frames.put(number.to_bytes(8) * 1600)
        self.steps.put(number.to_bytes(8) * 30)
        self.service.beat()

    def put_many(self, count: int) -> None:
        """Put so many frames and steps, at a pace that a loaded host keeps, until the recorder has counted them."""
        for _ in range(count):
            self.put()
            time.sleep(0.002)
        until(lambda: self.recorder_is("ready") and self.recorded(FRAME) == self.recorded(STEP) == count)

    def recorded(self, topic: Topic) -> int:
        return topic_count(self.service.last_health["recorder"], topic.key).received

    def recorder_is(self, state: str) -> bool:
        self.service.beat()
        return "recorder" in self.service.last_health and self.service.last_health["recorder"].state == state

    def read(self) -> LogReader:
        (path,) = self.folder.iterdir()
        return LogReader(path)

    def close(self) -> None:
        self.bus.close()
        self.run.remove()


def started(benches: Sequence[Bench], folder: Path) -> "subprocess.Popen[str]":
    """Start the recorders of all runs; return their parent, which says how each ended."""
    (folder / "lowfc.toml").write_text("[camera]\n")
    parent = subprocess.Popen(
        [sys.executable, "-c", RECORDERS, folder, *(bench.run.run_id for bench in benches)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        start_new_session=True,
    )
    for bench in benches:
        bench.parent = parent
        bench.pid = int(parent.stdout.readline())
    until(lambda: sum(bench.recorder_is("ready") for bench in benches) == len(benches))  # all of them beat
    return parent


@pytest.fixture
def benches(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[list[Bench]]:
    found = [Bench(tmp_path) for _ in range(request.param)]
    yield found
    for bench in found:
        bench.close()
    for parent in {bench.parent for bench in found if bench.parent is not None}:
        with parent, contextlib.suppress(ProcessLookupError):  # where all went well, none of them is left
            os.killpg(parent.pid, signal.SIGKILL)


@pytest.mark.exclusive
@pytest.mark.parametrize("benches", [10], indirect=True)
def test_a_recorder_killed_at_any_moment_leaves_all_but_the_last_moment(benches: list[Bench], tmp_path: Path) -> None:
    """Ten recorders, each killed at a random moment of its own, while 200 frames a second go on."""
    parent = started(benches, tmp_path)
    moments_s = np.random.default_rng(1).uniform(0.3, 1.5, len(benches)) + time.monotonic()
    due_s = time.monotonic()
    while not all(bench.killed_ns for bench in benches):
        for bench, moment_s in zip(benches, moments_s, strict=True):
            bench.put()
            if not bench.killed_ns and time.monotonic() >= moment_s:
                bench.killed_ns = bench.clock.host_ns()
                os.kill(bench.pid, signal.SIGKILL)
        due_s += 0.005
        time.sleep(max(0.0, due_s - time.monotonic()))
    assert [int(line.split()[1]) for line in parent.communicate(timeout=PATIENCE_S)[0].splitlines()] == [9] * 10
    for bench in benches:
        reader = bench.read()
        messages = list(reader)
        assert reader.path.suffix == UNFINISHED
        assert (reader.complete, list(reader.attachments)) == (False, ["lowfc.toml"])
        assert reader.metadata["lowfc"]["run"] == bench.run.run_id
        for topic in (FRAME, STEP):
            found = [message for message in messages if message.key == topic.key]
            counts = [count_of(message.sequence) for message in found]
            assert counts == list(range(counts[0], counts[0] + len(counts)))
            assert [int.from_bytes(message.payload[:8]) for message in found] == counts
            assert found[-1].publish_time_ns >= bench.killed_ns - SAFE_NS
        bench.put()  # the loop goes on


SIGNALS = (
    (signal.SIGTERM, signal.SIGTERM),
    (signal.SIGINT, signal.SIGINT),
    (signal.SIGHUP,),
    (signal.SIGINT, signal.SIGTERM),
)


@pytest.mark.exclusive
@pytest.mark.parametrize("benches", [len(SIGNALS)], indirect=True)
def test_however_it_is_told_to_stop_the_log_is_finished(benches: list[Bench], tmp_path: Path) -> None:
    parent = started(benches, tmp_path)
    for bench, signals in zip(benches, SIGNALS, strict=True):
        bench.put_many(50)
        for number in signals:
            os.kill(bench.pid, number)
            time.sleep(0.05)  # it waits for the camera's last words by now
    ends = [int(line.split()[1]) for line in parent.communicate(timeout=PATIENCE_S)[0].splitlines()]
    assert ends == [0] * len(SIGNALS)
    for bench in benches:
        reader = bench.read()
        messages = list(reader)
        assert reader.complete
        assert len(bodies_of(messages, FRAME)) == len(bodies_of(messages, STEP)) == 50
        assert reader.metadata["recording"]["messages_lost"] == "0"
        assert abs(float(reader.metadata["lowfc"]["clock_ahead_ms"])) < 1000


@pytest.mark.exclusive
def test_the_command_rotates_and_says_what_it_did(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    process = start(
        tmp_path, "record", "--run", bench.run.run_id, "--folder", tmp_path / "logs", "--longest-s", 1, "--json"
    )
    until(lambda: bench.recorder_is("ready"))

    def put_until_rotated() -> bool:
        bench.put()
        return len(list((tmp_path / "logs").iterdir())) > 1

    until(put_until_rotated)
    bench.frames.published += 3  # of these nobody hears
    bench.put()
    process.send_signal(signal.SIGTERM)
    until(lambda: bench.recorder_is("stopping"))
    bench.service.finish()
    out, wrong = process.communicate(timeout=PATIENCE_S)
    published = bench.frames.published - 3
    bench.close()
    done = json.loads(out)
    logs = [Path(log) for log in done["logs"]]
    assert (process.returncode, done["failure"]) == (0, None)
    assert sorted((tmp_path / "logs").iterdir()) == sorted(logs)
    assert len(logs) > 1
    assert (done["messages_lost"], done["lost"]) == (3, {FRAME.key: 3})
    assert f"MESSAGES_LOST 3 messages lost on {FRAME.key}" in wrong
    readers = [LogReader(log) for log in logs]
    messages = [message for reader in readers for message in reader]
    assert all(reader.complete for reader in readers)
    assert (len(messages), len(bodies_of(messages, FRAME))) == (done["messages_recorded"], published)
    assert readers[-1].metadata["recording"][f"lost {FRAME.key}"] == "3"
    assert done["longest_unflushed_ms"] >= done["longest_wait_ms"] > 0


@pytest.mark.exclusive
def test_a_recording_is_ended_where_the_controller_has_died(tmp_path: Path, own_runtime: Path) -> None:
    bench = Bench(tmp_path)
    process = start(tmp_path, "record", "--run", bench.run.run_id, "--folder", tmp_path / "logs")
    until(lambda: bench.recorder_is("ready"))
    bench.put_many(20)
    stopped = lowfc("ctl", "record", "stop", "--json")
    reader = LogReader(Path(json.loads(stopped.stdout)["log"]))
    assert len(bodies_of(list(reader), FRAME)) == 20
    assert reader.complete
    refused = lowfc("ctl", "status", "--run", bench.run.run_id)
    assert f"no controller is there in run '{bench.run.run_id}'" in str(refused.exception)
    process.send_signal(signal.SIGTERM)
    until(lambda: bench.recorder_is("stopping"))
    bench.service.finish()
    _, wrong = process.communicate(timeout=PATIENCE_S)
    bench.close()
    assert process.returncode == 0, wrong


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--folder", "{}/logs", "--min-free-mb", 1e9), "MB free, and recorder.min_free_mb is 1000000000"),
        (("--folder", "/proc/logs", "--min-free-mb", 0), "/proc/logs"),
        (("--longest-s", 0.5), "recorder.longest_s = 0.5"),
    ],
)
def test_what_cannot_be_recorded_is_refused_before_anything_is_made(
    options: tuple[object, ...], complaint: str, tmp_path: Path
) -> None:
    said = (str(option).format(tmp_path) for option in options)
    process = start(tmp_path, "record", "--run", new_run_id(), *said)
    out, wrong = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out) == (2, "")
    *_, line = wrong.strip().splitlines()
    assert line.startswith("error: ")
    assert complaint in line
    assert list(tmp_path.iterdir()) == []


def test_the_provenance_tells_processors_and_linear_algebra_apart() -> None:
    found = provenance("night", seed=3)
    assert (found["run"], found["seed"], found["processors"]) == ("night", "3", str(os.cpu_count()))
    flags = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith(("flags", "Feat")))
    features = found["cpu_features"].split()
    assert features == sorted(set(features))
    assert set(features) <= set(flags.partition(":")[2].split())
    assert {"sse2", "asimd"} & set(features)
    assert all(found[key] for key in ("host", "kernel", "processor", "python", "numpy", "eclipse-zenoh"))
    assert any(digit.isdigit() for digit in found["blas"])
    import scipy.linalg  # noqa: F401  # brings its own BLAS along, which the loop does not use

    assert provenance() == {key: value for key, value in found.items() if key not in ("run", "seed")}
