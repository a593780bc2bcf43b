"""Chaos cases: disks that are full, slow or read-only."""

import contextlib
import resource
import signal
from collections.abc import Iterator

from lowfc.contract.messages import Role
from lowfc.programs.reliability.chaos.bench import CaseFailedError, ChaosBench
from lowfc.programs.reliability.chaos.case import LOST, case, no_mounts, read_only
from lowfc.programs.reliability.chaos.processes import STALL_S, compare

ROOM_BYTES = 3_000_000
"""Growth of the log until the disk is full: about a second of the loop."""
SLOW_S = 3.0
"""Duration of a slow write."""


# Program of a recorder on a slow disk: some writes to its file sleep, and all writes are timed.
_SLOW = """
import sys, time
from lowfc.adapters.logs import writer
plain, writes = writer._File.write, [0]
seconds, after, times = float(sys.argv.pop(1)), int(sys.argv.pop(1)), int(sys.argv.pop(1))
def write(file, data):
    writes[0] += 1
    begun_ns = time.monotonic_ns()
    if after < writes[0] <= after + times:
        time.sleep(seconds)
    written = plain(file, data)
    file.longest_write_ns = max(file.longest_write_ns, time.monotonic_ns() - begun_ns)
    return written
writer._File.write = write
sys.argv[0] = "lowfc"
from lowfc.programs.cli.main import main
main()
"""


@case("disk-full", "the disk fills up", allowed=("RECORDING_FAILED", "MESSAGES_LOST"), statuses={Role.RECORDER: 1})
def _full(bench: ChaosBench) -> None:
    """Limit the size of the recorder's files: writes beyond it fail as on a full disk."""
    process = bench.children[Role.RECORDER].process
    assert process is not None  # noqa: S101  # it was started
    limit = max(path.stat().st_size for path in bench.folder.glob("*.part")) + ROOM_BYTES
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
    bench.wait(lambda: bool(bench.health[Role.RECORDER].recording.failure), "the recorder to report that it failed")


@case(
    "disk-read-only",
    "a recorder on a read-only disk refuses to start, another one records",
    statuses={Role.RECORDER: 2},
    why_skipped=no_mounts,
)
def _read_only(bench: ChaosBench) -> None:
    locked = bench.folder / "locked"
    locked.mkdir()
    with read_only(locked):
        normal = bench.children[Role.RECORDER].command
        _replace_recorder(bench, [*normal, "--folder", str(locked)], ready=False)
        stderr_tail = bench.await_end(Role.RECORDER, 2)
        if "error:" not in stderr_tail or "Traceback" in stderr_tail:
            raise CaseFailedError(f"the recorder should have named what is wrong in one line, got: {stderr_tail}")
    bench.restart(Role.RECORDER, normal)


@case("disk-slow", "two writes take 3 s each", expected=("DISK_SLOW",), allowed=LOST)
def _slow(bench: ChaosBench) -> None:
    _on_slow_disk(bench, SLOW_S, 8, 2)
    bench.wait(lambda: bench.health[Role.RECORDER].recording.messages > 0, "a recording")
    bench.await_steps(2000)  # longer than the two slow writes


@case("stall-disk", "a write blocks for 12 s", allowed=LOST)
def _stalled(bench: ChaosBench) -> None:
    @contextlib.contextmanager
    def stall() -> Iterator[None]:
        _on_slow_disk(bench, STALL_S + 2, 12, 1)
        yield
        bench.wait(lambda: bench.health[Role.RECORDER].recording.messages > 1000, "the disk to continue")

    compare(bench, stall)


def _on_slow_disk(bench: ChaosBench, seconds: float, after: int, times: int) -> None:
    """Replace the recorder by one whose writes number `after` + 1 to `after` + `times` take `seconds` each."""
    command = bench.children[Role.RECORDER].command
    at = command.index("-m")
    _replace_recorder(bench, [*command[:at], "-c", _SLOW, str(seconds), str(after), str(times), *command[at + 2 :]])


def _replace_recorder(bench: ChaosBench, command: list[str], *, ready: bool = True) -> None:
    """Stop the recorder, and start one with another command line."""
    bench.signal(Role.RECORDER, signal.SIGTERM)
    bench.await_end(Role.RECORDER, 0)
    bench.restart(Role.RECORDER, command, ready=ready)
