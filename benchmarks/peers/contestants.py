"""Who takes part: each contestant's processes and what they are told."""

from dataclasses import dataclass, field
from typing import Any

PAIR = ("source", "controller")


@dataclass(frozen=True)
class Contestant:
    """One row of the table.

    Attributes:
        name: in the table.
        what: it is, in a sentence.
        module: whose roles its processes play.
        roles: in the order in which they start; the source's end is the end of a run.
        options: what its processes are told.
        package: that must be installed for it, and in which `python` it is looked for, beside what lowfc needs.
    """

    name: str
    what: str
    roles: tuple[str, ...]
    options: dict[str, Any] = field(default_factory=dict)
    module: str = "benchmarks.peers.pair"
    package: str = ""

    @property
    def pacer(self) -> str:
        """The role that waits for the start and ends by itself."""
        return "source" if "source" in self.roles else self.roles[0]


TIMER = "timer wake-up of this host"
BARE = "zenoh"

_WATCHED = (*PAIR, "onlooker")
_RINGS = "a ring in shared memory each way, the step in numpy, on a thread that waits for a"
_BESIDE = (
    "a prototype: frame and command go through rings to the other end of the loop, then through zenoh to everybody else"
)


def _plain(
    name: str, what: str, transport: str, *, step: str = "numpy", wake: str = "", roles: tuple[str, ...] = PAIR
) -> Contestant:
    return Contestant(name, what, roles, {"transport": transport, "step": step, "wake": wake})


def _pyrtcao(name: str, what: str, roles: tuple[str, ...], *, fused: bool) -> Contestant:
    return Contestant(name, what, roles, {"fused": fused}, "benchmarks.peers.pyrtcao_loop", "pyrtcao")


CONTESTANTS = (
    Contestant(
        TIMER,
        "no loop: how late a sleep until an absolute time ends on the controller's processor, in turn with the rest",
        ("timer",),
    ),
    _plain("shared memory, semaphore", f"{_RINGS} POSIX semaphore", "ring", wake="semaphore"),
    _plain("shared memory, pipe", f"{_RINGS} named pipe", "ring", wake="pipe"),
    _plain(
        BARE,
        "zenoh as it comes, in sessions set up as lowfc's, the step in numpy, in the subscriber's callback",
        "zenoh",
    ),
    _plain(
        "zenoh, onlooker",
        "the same, and a third process that subscribes to the frames, as a recorder does",
        "zenoh",
        roles=_WATCHED,
    ),
    _plain("shared memory beside zenoh, onlooker", _BESIDE, "both", wake="semaphore", roles=_WATCHED),
    _plain("zenoh, lowfc's step", "as zenoh, with lowfc's own decoding, advance and encoding", "zenoh", step="lowfc"),
    _plain(
        "shared memory beside zenoh, onlooker, lowfc's step",
        "the prototype with lowfc's own step",
        "both",
        step="lowfc",
        wake="semaphore",
        roles=_WATCHED,
    ),
    _plain(
        "lowfc's bus and step",
        "its bus, handover, step, rehearsal and real-time set-up, without what the controller publishes after a "
        "command",
        "lowfc",
        step="lowfc",
    ),
    _pyrtcao(
        "pyrtcao, fused",
        "WavefrontSensor, one component of one's own with all of the step compiled, and WavefrontCorrector, each a "
        "process; in the normal class it sets nice -20 where it may",
        ("mirror", "source", "controller"),
        fused=True,
    ),
    _pyrtcao(
        "pyrtcao, stock",
        "WavefrontSensor, a component that makes a signal of the pixels, Loop.standard_integrator, WavefrontCorrector, "
        "each a process; its command is modes, and the actuators are made after it",
        ("mirror", "source", "signal", "controller"),
        fused=False,
    ),
)
