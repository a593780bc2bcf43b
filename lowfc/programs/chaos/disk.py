"""Chaos cases: disks that are full, slow, or not to be written."""

import contextlib
import resource
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

from lowfc.contract.messages import Role
from lowfc.programs.chaos.bench import CaseFailedError, ChaosBench
from lowfc.programs.chaos.processes import CALM_S, STALL_S, Latencies

ROOM_BYTES = 3_000_000
"""What the log may still grow before its disk is full: about a second of the loop."""
SLOW_S = 3.0

# The recorder itself, with a file that takes its time, and says so as a slow one would.
_SLOW = """
import sys, time
from lowfc.adapters import log_writer
plain, writes = log_writer._File.write, [0]
seconds, after, times = float(sys.argv.pop(1)), int(sys.argv.pop(1)), int(sys.argv.pop(1))
def write(file, data):
    writes[0] += 1
    begun_ns = time.monotonic_ns()
    if after < writes[0] <= after + times:
        time.sleep(seconds)
    written = plain(file, data)
    file.longest_write_ns = max(file.longest_write_ns, time.monotonic_ns() - begun_ns)
    return written
log_writer._File.write = write
sys.argv[0] = "lowfc"
from lowfc.programs.cli import main
main()
"""


def full(bench: ChaosBench) -> None:
    """Let no file of the recorder grow any further: as a full disk, it refuses the next write."""
    process = bench.children[Role.RECORDER].process
    assert process is not None  # noqa: S101  # it was started
    size = max(path.stat().st_size for path in bench.folder.glob("*.part"))
    limit = size + ROOM_BYTES
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
    bench.wait(lambda: bool(bench.health[Role.RECORDER].recording.failure), "the recorder to say that it failed")
    bench.settled()


@contextlib.contextmanager
def _read_only(folder: Path) -> Iterator[None]:
    """A folder that cannot be written, by root neither."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "ro,size=1m", "tmpfs", folder], check=True)  # noqa: S603, S607  # ours
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=False)  # noqa: S603, S607  # ours
        folder.rmdir()


def read_only(bench: ChaosBench) -> None:
    """Stop the recorder; one whose folder is read-only says so and ends; the loop goes on, and a good one records."""
    locked = bench.folder / "locked"
    with _read_only(locked):
        _instead(bench, lambda words: [*words, "--folder", str(locked)])
        if bench.ends(Role.RECORDER) != 2:
            raise CaseFailedError("the recorder did not refuse a read-only folder")
        last_words = bench.children[Role.RECORDER].last_words()
        if "error:" not in last_words or "Traceback" in last_words:
            raise CaseFailedError(f"the recorder did not say what is wrong in one line: {last_words}")
    bench.restart(Role.RECORDER, lambda words: words[: words.index("--folder")])
    bench.wait(lambda: bench.heard(Role.RECORDER), "the recorder")
    bench.settled()


def slow(bench: ChaosBench) -> None:
    """Record on a disk that takes 3 s for each of two writes."""
    _on_slow_disk(bench, SLOW_S, 8, 2)
    bench.wait(lambda: bench.health[Role.RECORDER].recording.messages > 0, "a recording")
    bench.frames(1000)  # of which two writes take the most
    bench.settled()


def stalled(bench: ChaosBench) -> None:
    """Record on a disk that takes nothing for 10 s, and compare latencies."""
    latencies = Latencies(bench)
    latencies.take("before", CALM_S)
    _on_slow_disk(bench, STALL_S + 2, 12, 1)
    latencies.take("during", STALL_S)
    bench.wait(lambda: bench.health[Role.RECORDER].recording.messages > 1000, "the disk to go on")
    latencies.take("after", CALM_S)
    latencies.report()
    bench.settled()


def _on_slow_disk(bench: ChaosBench, seconds: float, after: int, times: int) -> None:
    def slowly(words: list[str]) -> list[str]:
        at = words.index("-m")
        return [*words[:at], "-c", _SLOW, str(seconds), str(after), str(times), *words[at + 2 :]]

    _instead(bench, slowly)
    bench.wait(lambda: bench.heard(Role.RECORDER), "the recorder")


def _instead(bench: ChaosBench, changed: Callable[[list[str]], list[str]]) -> None:
    """Stop the recorder, and start one with another command line."""
    child = bench.children[Role.RECORDER]
    assert child.process is not None  # noqa: S101  # it was started
    child.process.terminate()
    bench.ends(Role.RECORDER)
    bench.restart(Role.RECORDER, changed)
