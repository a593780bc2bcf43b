"""Every change that was tried on the way down: what it is, whether it was kept and why not, and how it is switched."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from benchmarks.road.patches import PATCHES
from lowfc.adapters.realtime import spread


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
        record: the recorder runs beside, in the loop it is compared with too.
        often: measured in every repeat; others in the first three only.
    """

    name: str
    what: str
    kept: bool
    why: str = ""
    keys: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    record: bool = False
    often: bool = False

    @property
    def variables(self) -> dict[str, str]:
        """Environment of the processes in which the change is switched."""
        return {**self.environment, **({"LOWFC_ROAD": self.name} if self.name in PATCHES else {})}


_ALL = "(handover: net)"
_APART = spread(os.sched_getaffinity(0))
_LOOP = ("camera", "controller", "mirror")

CHANGES: tuple[Change, ...] = (
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
    Change("locked", "memory locked", kept=True, often=True, keys={"realtime.lock_memory": False}),
    Change("memory-kept", "freed memory kept (mallopt)", kept=True, often=True),
    Change("collector", "garbage collector frozen and off", kept=True, often=True),
    Change("blas", "one BLAS thread", kept=True, often=True),
    Change("switch-interval", "interpreter's switch interval 0.1 ms, not 5 ms", kept=False),
    Change("stay-python", "Python's state kept in zenoh's threads", kept=True, often=True),
    Change("timer-slack", "timer slack 1 ns", kept=True),
    Change("let-send", "sched_yield after a put", kept=True, often=True),
    Change("mirror-ahead", "mirror one priority ahead of the controller", kept=True, often=True),
    Change("bus-first", "zenoh's threads one priority ahead of Python's main thread", kept=False),
    Change(
        "one-receiver",
        "zenoh receives in the thread that waits (ZENOH_RUNTIME)",
        kept=True,
        often=True,
        environment={"ZENOH_RUNTIME": "()"},
    ),
    Change(
        "one-thread",
        "all of zenoh in one thread (ZENOH_RUNTIME)",
        kept=False,
        environment={"ZENOH_RUNTIME": f"(app: {_ALL}, acc: {_ALL}, tx: {_ALL}, rx: {_ALL})"},
    ),
    Change("own-thread", "frames dealt with in zenoh's thread, not in one that it wakes", kept=True, often=True),
    Change(
        "rehearse",
        "each step done a second time, to keep the caches warm",
        kept=True,
        often=True,
        keys={"realtime.rehearse": False},
    ),
    Change("telemetry", "command before telemetry", kept=True, often=True),
    Change("channel", "ring channel and a receiving thread, not a callback", kept=False, often=True),
    Change(
        "socket",
        "Unix sockets, not TCP",
        kept=False,
        why="a reader that stalls loses frames",
        often=True,
    ),
    Change("low-latency", "low-latency transport, without QoS", kept=False, why="it has no priorities", often=True),
    Change("qos", "QoS off", kept=False, why="pictures and telemetry may go before frames"),
    Change("batching", "batching off", kept=False),
    Change("express", "express publishers", kept=False, why="a burst of 16 messages fills the queue, the rest is lost"),
    Change(
        "shared-memory",
        "zenoh's shared memory",
        kept=False,
        why="a receiver that stalls for 100 ms loses messages silently",
        often=True,
    ),
    Change("queues", "link queues of 2 messages, not 16", kept=False, why="bursts are lost"),
    Change("password", "no user and password", kept=False, why="anybody on the host could send commands"),
    Change("memoryview", "payloads as memoryview", kept=False),
    Change("bytearray", "payloads as bytearray", kept=False),
    Change("denormals", "denormals flushed to zero", kept=False),
    Change(
        "huge-pages",
        "huge pages (PYTHONMALLOC=malloc, glibc.malloc.hugetlb=1)",
        kept=False,
        environment={"PYTHONMALLOC": "malloc", "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"},
    ),
    Change(
        "recorder-apart",
        "recorder off the controller's processor, recording",
        kept=True,
        often=True,
        keys={"realtime.recorder_cpus": []},
        record=True,
    ),
)
