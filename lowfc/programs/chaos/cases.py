"""The chaos cases: what befalls a running loop, what must come of it, and by which events it is named."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from lowfc.contract.configuration import Control
from lowfc.contract.messages import Role
from lowfc.programs.chaos import control as chaos_control
from lowfc.programs.chaos import disk as chaos_disk
from lowfc.programs.chaos import host as chaos_host
from lowfc.programs.chaos import junk as chaos_junk
from lowfc.programs.chaos import processes as chaos_processes
from lowfc.programs.chaos.bench import ChaosBench

FIRST = 600
"""Index of the first frame that a camera's fault befalls: the loop has settled and been quiet for a second."""
STRUCK = 250
"""Frames that it befalls: a second."""
LATEST = 50
"""Frames by which one may be late."""


class End(Enum):
    """What a case must come to."""

    RECOVERS = "the loop is closed, and the residual as before"
    SAFED = "latched, and the mirror flat"


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        name: on the command line.
        group: in the table.
        sentence: what befalls the loop.
        act: does it, once the loop is quiet.
        faults: kinds of frames' faults, of the camera from the start.
        config: keys that differ from a chaos run's own.
        expected: events that must be in the log, by how they begin.
        allowed: names of events of the level ERROR that may be there.
        end: what it must come to.
        bad: which frames, by their number, may not be used.
        statuses: exit statuses that a process may end with, beside 0.
        noisy: tracebacks of what could not be read are to be expected.
        lacks: why this host cannot do it; empty where it can.
    """

    name: str
    group: str
    sentence: str
    act: Callable[[ChaosBench], None]
    faults: str = ""
    config: Mapping[str, Any] = field(default_factory=dict)
    expected: tuple[str, ...] = ()
    allowed: tuple[str, ...] = ()
    end: End = End.RECOVERS
    bad: Callable[[int], bool] | None = None
    statuses: Mapping[str, frozenset[int]] = field(default_factory=dict)
    noisy: bool = False
    lacks: Callable[[], str] = chaos_host.nothing


def _through(bench: ChaosBench) -> None:
    """Wait until the camera's fault is over and the loop has settled."""
    last = FIRST + STRUCK + LATEST
    bench.wait(lambda: bench.newest_frame & 0xFFFFFFFF >= last, f"frame {last}")
    bench.settled()


_LOST = ("MESSAGES_LOST",)


def _frames(kind: str, sentence: str, reason: str, *, used: int = STRUCK, lost: bool = False) -> Case:
    """A fault of the frames, of which so many, the first ones, may be used."""
    return Case(
        f"frames-{kind}",
        "frames",
        sentence,
        _through,
        faults=kind,
        expected=(reason,) if reason else (),
        allowed=_LOST if lost else (),
        bad=(lambda number: FIRST + used <= number < FIRST + STRUCK) if used < STRUCK else None,
    )


FRAMES = (
    _frames("lost", "10 % of the frames are not sent", "FRAMES_MISSING", lost=True),
    _frames("duplicated", "each frame is sent twice", "FRAMES_REFUSED frames refused: REPEATED", lost=True),
    _frames(
        "reordered",
        "frames come in pairs, the second one first",
        "FRAMES_REFUSED frames refused: OUT_OF_ORDER",
        lost=True,
    ),
    _frames("late", "each frame comes 1 to 50 frames late", "FRAMES_REFUSED frames refused: OUT_OF_ORDER", lost=True),
    _frames("wrong-size", "frames of another size", "FRAMES_REFUSED frames refused: WRONG_SIZE", used=0),
    _frames("truncated", "messages cut off anywhere", "FRAMES_REFUSED frames refused: WRONG_SIZE", used=0),
    _frames("random", "random bytes", "FRAMES_REFUSED frames refused: WRONG_SIZE", used=0),
    _frames("old-sequence", "numbers of an hour ago", "FRAMES_REFUSED frames refused: OUT_OF_ORDER", used=0, lost=True),
    _frames("saturated", "all pixels at full well", "FRAMES_REFUSED frames refused: SATURATED", used=0),
    _frames("dark", "the star is lost, and found", "FRAMES_REFUSED frames refused: DARK", used=0),
    _frames("hot-pixels", "a tenth of the pixels at full well", "FRAMES_REFUSED frames refused: SATURATED", used=0),
    _frames("cosmic-rays", "a track of six pixels at full well in every fifth frame", ""),
    _frames(
        "stuck",
        "the same image again and again, as new frames",
        "FRAMES_REFUSED frames refused: STUCK",
        used=Control().most_alike,
    ),
)

_UNSEEN: dict[str, tuple[str, ...]] = {
    Role.CAMERA: ("CAMERA_RESTARTED",),
    Role.CONTROLLER: ("STARTED controller",),
    Role.MIRROR: ("STARTED mirror",),
    Role.RECORDER: (),
    Role.VIEWER: (),
}
_FROZEN: dict[str, tuple[str, ...]] = {
    Role.CAMERA: ("NO_FRAMES", "FRAMES_BACK"),
    Role.CONTROLLER: ("COMMAND_EXPIRED", "COMMAND_BACK"),
    Role.MIRROR: (),
    Role.RECORDER: (),
    Role.VIEWER: (),
}

PROCESSES = (
    *(
        Case(
            f"kill-{role}",
            "processes",
            f"kill -9 of the {role}, started anew up to 1 s later",
            chaos_processes.killed(role),
            expected=_UNSEEN[role],
            allowed=_LOST,
        )
        for role in _UNSEEN
    ),
    *(
        Case(
            f"freeze-{role}",
            "processes",
            f"SIGSTOP of the {role}, SIGCONT 0.5 to 2 s later",
            chaos_processes.frozen(role),
            expected=_FROZEN[role],
            allowed=_LOST,
        )
        for role in _FROZEN
    ),
    Case(
        "silent-camera",
        "processes",
        "kill -9 of the camera, with the mirror to be relaxed meanwhile; started anew after a second",
        chaos_processes.silenced,
        config={"control.silence": "flat", "disturbance.static_nm": {"4": 40.0}},
        expected=("NO_FRAMES", "CAMERA_RESTARTED"),
        allowed=_LOST,
    ),
    Case(
        "random",
        "processes",
        "six kills or stops of any of them, at random times",
        chaos_processes.at_random,
        allowed=_LOST,
    ),
    Case(
        "stall-recorder",
        "processes",
        "the recorder stands still for 10 s",
        chaos_processes.stalled(Role.RECORDER),
        allowed=_LOST,
    ),
    Case(
        "stall-viewer",
        "processes",
        "the viewer stands still for 10 s",
        chaos_processes.stalled(Role.VIEWER),
        allowed=_LOST,
    ),
)

BUS = (
    Case("junk", "bus", "random bytes on every topic, 2,000 a second", chaos_junk.flood, allowed=_LOST, noisy=True),
    Case(
        "forged-commands",
        "bus",
        "commands of anything at all by who has the run's secret",
        chaos_junk.forged_commands,
        expected=("COMMAND_REFUSED command refused: NOT_FINITE", "LIMIT_HIT"),
        allowed=_LOST,
    ),
    Case(
        "forged-frames",
        "bus",
        "frames with numbers of the past, and with none",
        chaos_junk.forged_frames,
        allowed=_LOST,
        noisy=True,
    ),
)

MIRROR = (
    Case(
        "stuck-actuators",
        "mirror",
        "dead and stuck actuators",
        _through,
        config={"mirror.dead": [500, 501], "mirror.stuck_nm": {"600": 80.0}},
    ),
    Case(
        "saturating",
        "mirror",
        "a disturbance beyond what the modes may do",
        _through,
        config={"disturbance.preset": "step", "disturbance.scale": 6.0, "control.tilt_limit_nm": 20.0},
        expected=("LIMIT_HIT",),
    ),
)

CONTROL = (
    Case("gain", "control", "the highest gain that is granted, then one above, refused", chaos_control.highest_gain),
    Case(
        "reversed-calibration",
        "control",
        "a calibration of the right shape that drives the loop away; safed by the operator",
        chaos_control.reversed_calibration,
        expected=("SAFED",),
        allowed=("SAFED",),
    ),
    Case(
        "foreign-calibration",
        "control",
        "a calibration for frames of another size",
        chaos_control.foreign_calibration,
        expected=("FRAMES_REFUSED frames refused: WRONG_SIZE",),
    ),
    Case(
        "damaged-calibration",
        "control",
        "the controller is started with NaN in its file, which it refuses, then with a good one",
        chaos_control.damaged_calibration,
        expected=("STARTED controller",),
        statuses={Role.CONTROLLER: frozenset({2})},
    ),
    Case(
        "safed-restart",
        "control",
        "safed, then the controller is killed and started anew",
        chaos_control.safed_restart,
        expected=("SAFED",),
        allowed=("SAFED",),
        end=End.SAFED,
    ),
    Case(
        "safe-without-directory",
        "control",
        "safe while the run's directory is gone; then the controller is killed and started anew",
        chaos_control.safe_without_directory,
        expected=("SAFED", "LATCH_FAILED"),
        allowed=("SAFED", "LATCH_FAILED"),
        end=End.SAFED,
    ),
    Case(
        "safe-read-only",
        "control",
        "safe while the run's directory cannot be written; then the controller is killed and started anew",
        chaos_control.safe_in_read_only_directory,
        expected=("SAFED", "LATCH_FAILED"),
        allowed=("SAFED", "LATCH_FAILED"),
        end=End.SAFED,
        lacks=chaos_host.no_mounts,
    ),
    Case(
        "clock-ahead",
        "control",
        "a camera whose clock is an hour ahead takes the place of the camera",
        chaos_control.other_clock(3600),
        expected=("CAMERA_RESTARTED",),
        allowed=_LOST,
        lacks=chaos_host.no_other_clock,
    ),
    Case(
        "clock-behind",
        "control",
        "a camera whose clock is an hour behind, until the camera is back",
        chaos_control.other_clock(-3600),
        allowed=_LOST,
        lacks=chaos_host.no_other_clock,
    ),
)

DISK = (
    Case(
        "disk-full",
        "disk",
        "the disk fills up",
        chaos_disk.full,
        expected=(),
        allowed=("RECORDING_FAILED", "MESSAGES_LOST"),
        statuses={Role.RECORDER: frozenset({1})},
    ),
    Case(
        "disk-read-only",
        "disk",
        "a recorder on a read-only disk refuses, another one records",
        chaos_disk.read_only,
        statuses={Role.RECORDER: frozenset({2})},
        lacks=chaos_host.no_mounts,
    ),
    Case(
        "disk-slow",
        "disk",
        "the disk takes 3 s for each write",
        chaos_disk.slow,
        expected=("DISK_SLOW",),
        allowed=_LOST,
    ),
    Case("stall-disk", "disk", "the disk takes nothing for 10 s", chaos_disk.stalled, allowed=_LOST),
)

OPERATOR = (
    Case("malformed-requests", "operator", "requests of random bytes", chaos_junk.malformed_requests),
    Case("huge-requests", "operator", "requests of up to 64 MB", chaos_junk.huge_requests, allowed=_LOST),
    Case("concurrent-requests", "operator", "eight operators at once", chaos_junk.concurrent_requests),
)

CASES = {case.name: case for case in (*FRAMES, *PROCESSES, *BUS, *MIRROR, *CONTROL, *DISK, *OPERATOR)}
