"""Every change that was tried on the way down: what it is, whether it was kept and why not, and how it is switched."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from benchmarks.road.patches import PATCHES
from lowfc.adapters.realtime import spread


class Loop(StrEnum):
    """The loops to which changes are made."""

    AS_IT_IS = "as it is"
    BY_BUS = "by the bus alone"
    """Without the short way: frames and commands go through zenoh."""
    RECORDING = "recording"

    @property
    def patches(self) -> str:
        """What makes it of the loop as it is."""
        return "shortcut" if self is Loop.BY_BUS else ""

    @property
    def variables(self) -> dict[str, str]:
        """Environment of its processes."""
        return _switch(self.patches)


@dataclass(frozen=True)
class Change:
    """One change. What is switched undoes one that was kept, and does one that was not.

    Attributes:
        name: for --only; a patch of that name, if there is one, is applied in every process.
        what: was changed.
        kept: whether the loop has it.
        why: not, where speed alone would not tell.
        keys: of the configuration.
        environment: variables of every process.
        loop: in which it is switched, and to which that is compared.
        often: measured in every repeat; others in the first three only.
    """

    name: str
    what: str
    kept: bool
    why: str = ""
    keys: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    loop: Loop = Loop.AS_IT_IS
    often: bool = False

    @property
    def patches(self) -> str:
        """Its loop's patch and its own, with a comma between."""
        return ",".join(filter(None, [self.loop.patches, self.name if self.name in PATCHES else ""]))

    @property
    def variables(self) -> dict[str, str]:
        """Environment of the processes in which the change is switched."""
        return {**self.environment, **_switch(self.patches)}


def _switch(patches: str) -> dict[str, str]:
    return {"LOWFC_ROAD": patches} if patches else {}


_ALL = "(handover: net)"
_APART = spread(os.sched_getaffinity(0))
_LOOP = ("camera", "controller", "mirror")

_AS_IT_IS = (
    Change("awake", "idle processors kept awake", kept=True, often=True, keys={"realtime.stay_awake": False}),
    Change("fifo", "SCHED_FIFO", kept=True, often=True, keys={"realtime.priority": 0}),
    Change(
        "processors",
        "processors of their own",
        kept=True,
        often=True,
        keys={f"realtime.{role}_cpus": [] for role in _LOOP},
    ),
    Change(
        "mirror-apart",
        "mirror off the controller's processor",
        kept=True,
        often=True,
        keys={"realtime.mirror_cpus": _APART.get("realtime.controller_cpus", [])},
    ),
    Change(
        "mirror-ahead",
        "mirror one priority ahead of camera and controller",
        kept=False,
        why="where they share a processor, the mirror works while the controller's put waits",
    ),
    Change(
        "shortcut",
        "sockets beside the bus, for frames to the controller and commands to the mirror",
        kept=True,
        often=True,
    ),
    Change("commands-short", "the socket for commands alone", kept=True, often=True),
    Change("retry", "nobody asks five times a second for who is not there", kept=True, often=True),
    Change(
        "own-thread",
        "frames dealt with in the thread that receives them, not in one that it wakes",
        kept=True,
        often=True,
    ),
    Change(
        "rehearse",
        "each step done a second time, to keep the caches warm",
        kept=True,
        often=True,
        keys={"realtime.rehearse": False},
    ),
    Change(
        "rehearse-late",
        "that shortly before the next frame, not right after the last",
        kept=True,
        often=True,
    ),
    Change("telemetry", "command before telemetry", kept=True),
    Change("locked", "memory locked", kept=True, keys={"realtime.lock_memory": False}),
    Change("memory-kept", "freed memory kept (mallopt)", kept=True),
    Change("collector", "garbage collector frozen and off", kept=True),
    Change("blas", "one BLAS thread", kept=True),
    Change("timer-slack", "timer slack 1 ns", kept=True),
    Change("switch-interval", "interpreter's switch interval 0.1 ms, not 5 ms", kept=False),
    Change("denormals", "denormals flushed to zero", kept=False),
    Change(
        "huge-pages",
        "huge pages (PYTHONMALLOC=malloc, glibc.malloc.hugetlb=1)",
        kept=False,
        environment={"PYTHONMALLOC": "malloc", "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"},
    ),
)
_BY_BUS = (
    Change(
        "one-receiver",
        "zenoh receives in the thread that waits (ZENOH_RUNTIME)",
        kept=True,
        environment={"ZENOH_RUNTIME": "()"},
        loop=Loop.BY_BUS,
    ),
    Change(
        "one-thread",
        "all of zenoh in one thread (ZENOH_RUNTIME)",
        kept=False,
        environment={"ZENOH_RUNTIME": f"(app: {_ALL}, acc: {_ALL}, tx: {_ALL}, rx: {_ALL})"},
        loop=Loop.BY_BUS,
    ),
    Change(
        "stay-python",
        "Python's state kept in zenoh's threads",
        kept=False,
        why="a state of the interpreter's own kept by hand; to be measured anew in nine pairs",
        loop=Loop.BY_BUS,
    ),
    Change("let-send", "sched_yield after a put", kept=True, loop=Loop.BY_BUS),
    Change("bus-first", "zenoh's threads one priority ahead of Python's main thread", kept=False, loop=Loop.BY_BUS),
    Change("channel", "ring channel and a receiving thread, not a callback", kept=False, loop=Loop.BY_BUS),
    Change("socket", "Unix sockets, not TCP", kept=False, why="a reader that stalls loses frames", loop=Loop.BY_BUS),
    Change(
        "low-latency",
        "low-latency transport, without QoS",
        kept=False,
        why="it has no priorities",
        loop=Loop.BY_BUS,
    ),
    Change("qos", "QoS off", kept=False, why="pictures and telemetry may go before frames", loop=Loop.BY_BUS),
    Change("batching", "batching off", kept=False, loop=Loop.BY_BUS),
    Change(
        "express",
        "express publishers",
        kept=False,
        why="a burst of 16 messages fills the queue, the rest is lost",
        loop=Loop.BY_BUS,
    ),
    Change(
        "shared-memory",
        "zenoh's shared memory",
        kept=False,
        why="a receiver that stalls for 100 ms loses messages silently",
        loop=Loop.BY_BUS,
    ),
    Change("queues", "link queues of 2 messages, not 16", kept=False, why="bursts are lost", loop=Loop.BY_BUS),
    Change(
        "password",
        "no user and password",
        kept=False,
        why="anybody on the host could send commands",
        loop=Loop.BY_BUS,
    ),
    Change("memoryview", "payloads as memoryview", kept=False, loop=Loop.BY_BUS),
    Change("bytearray", "payloads as bytearray", kept=False, loop=Loop.BY_BUS),
)
_RECORDING = (
    Change(
        "recorder-apart",
        "recorder off the controller's processor",
        kept=True,
        keys={"realtime.recorder_cpus": []},
        loop=Loop.RECORDING,
    ),
)

CHANGES: tuple[Change, ...] = (*_AS_IT_IS, *_BY_BUS, *_RECORDING)
