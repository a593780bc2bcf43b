"""Measures that no key and no variable switches: one function of lowfc replaced in each process of a run.

Nothing of this is in the product. Where there is no longer anything to replace, `PatchError` says so.
"""

import contextlib
import ctypes
import functools
import os
import platform
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import zenoh
from zenoh.handlers import Callback, RingChannel

from lowfc.adapters import join, realtime, zenoh_bus
from lowfc.adapters.bus import Sample
from lowfc.adapters.clock import Clock
from lowfc.adapters.run import Links
from lowfc.adapters.service import Service
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import Envelope
from lowfc.contract.messages import COMMAND, Role, Topic
from lowfc.control.inputs import Outputs
from lowfc.programs import rehearsal

Config = dict[str, Any]

_OFTEN_S = 1e-4
_PATIENCE_S = 0.1
_RETRY_MS = 200
_QUEUE = 2
_RING = 64
_ENVIRONMENT_BYTES, _MXCSR = 32, 28  # of fenv_t on x86-64
_FLUSH = 0x8040  # denormal results and operands are zero

_replaced: list[tuple[object, str, object]] = []


class PatchError(Exception):
    """What a patch should replace is not there."""


def apply(names: str) -> None:
    """Replace what the changes of these names, with commas between, replace.

    Raises:
        PatchError: there is no such patch, or nothing to replace.
    """
    for name in names.split(","):
        if name not in PATCHES:
            raise PatchError(f"there is no patch {name!r}; there are {', '.join(PATCHES)}")
        PATCHES[name]()


@contextlib.contextmanager
def applied(names: str) -> Iterator[list[tuple[object, str, object]]]:
    """The same for a while; owner, name and original of each attribute that is another now."""
    begun = len(_replaced)
    try:
        apply(names)
        yield _replaced[begun:]
    finally:
        while len(_replaced) > begun:
            owner, attribute, original = _replaced.pop()
            setattr(owner, attribute, original)


def _original(owner: object, name: str) -> Any:
    """An attribute that `owner` itself has."""
    if name not in vars(owner):
        raise PatchError(f"{getattr(owner, '__name__', owner)} has no {name} to replace; mend benchmarks/road")
    return vars(owner)[name]


def _put(owner: object, name: str, new: object) -> None:
    _replaced.append((owner, name, _original(owner, name)))
    setattr(owner, name, new)


def _nothing(*_: object, **__: object) -> None:
    return


def _collector_on() -> None:
    _put(realtime, "gc", SimpleNamespace(collect=_nothing, freeze=_nothing, disable=_nothing))


def _memory_given_back() -> None:
    _put(realtime, "_keep_memory", lambda: "memory not kept")


def _denormals_flushed() -> None:
    original = _original(realtime, "_quiet_interpreter")

    def flushed() -> tuple[str, ...]:
        if platform.machine() != "x86_64":
            raise PatchError("denormals are flushed on x86-64 only")
        libm = ctypes.CDLL("libm.so.6")
        environment = ctypes.create_string_buffer(_ENVIRONMENT_BYTES)
        libm.fegetenv(environment)
        word = ctypes.c_uint32.from_buffer(environment, _MXCSR)
        word.value |= _FLUSH
        libm.fesetenv(environment)
        return (*original(), "denormals flushed")

    _put(realtime, "_quiet_interpreter", flushed)


def _bus_first() -> None:
    original = _original(zenoh_bus.ZenohBus, "__init__")

    @functools.wraps(original)
    def opened(self: zenoh_bus.ZenohBus, links: Links, role: str, clock: Clock, **more: Any) -> None:
        original(self, links, role, clock, **more)
        if os.sched_getscheduler(0) == os.SCHED_FIFO:  # of this thread; zenoh's have theirs already
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(os.sched_getparam(0).sched_priority - 1))

    _put(zenoh_bus.ZenohBus, "__init__", opened)


def _edit(edit: Callable[[Config, Links], None]) -> Callable[[], None]:
    """Patch that changes zenoh's configuration of every process."""

    def replace() -> None:
        original = _original(zenoh_bus, "session_config")

        @functools.wraps(original)
        def edited(links: Links, role: str, **more: Any) -> Config:
            config: Config = original(links, role, **more)
            edit(config, links)
            return config

        _put(zenoh_bus, "session_config", edited)

    return replace


def _asks_often(config: Config, _: Links) -> None:
    config["connect"]["retry"]["period_max_ms"] = _RETRY_MS


def _by_socket(config: Config, links: Links) -> None:
    addresses = {
        f"tcp/127.0.0.1:{port}": f"unixsock-stream/{path}"
        for role, port in links.ports.items()
        if (path := links.socket(role)) is not None
    }
    config["connect"]["endpoints"] = [addresses[one] for one in config["connect"]["endpoints"]]
    del config["downsampling"]  # of whoever comes by socket


def _low_latency(config: Config, _: Links) -> None:
    config["transport"]["unicast"] = {"lowlatency": True, "qos": {"enabled": False}}


def _without_qos(config: Config, _: Links) -> None:
    config["transport"]["unicast"] = {"qos": {"enabled": False}}


def _without_batching(config: Config, _: Links) -> None:
    config["transport"]["link"]["tx"]["queue"]["batching"] = {"enabled": False}


def _short_queues(config: Config, _: Links) -> None:
    size = config["transport"]["link"]["tx"]["queue"]["size"]
    size.update(dict.fromkeys(size, _QUEUE))


def _by_shared_memory(config: Config, _: Links) -> None:
    config["transport"]["shared_memory"]["enabled"] = True


def _commands_by_bus() -> None:
    original = _original(zenoh_bus.ZenohBus, "_shortcut")

    def shortcut(self: zenoh_bus.ZenohBus, topic: Topic, name: str) -> Path | None:
        path: Path | None = None if topic is COMMAND else original(self, topic, name)
        return path

    _put(zenoh_bus.ZenohBus, "_shortcut", shortcut)


def _without_password(config: Config, _: Links) -> None:
    del config["transport"]["auth"]["usrpwd"]


class _Express:
    """A session whose publishers are express."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def declare_publisher(self, key: str, **settings: Any) -> zenoh.Publisher:
        if settings["express"] is not False:
            raise PatchError("publishers are express already; mend benchmarks/road")
        return self._session.declare_publisher(key, **(settings | {"express": True}))


def _express() -> None:
    original = _original(zenoh_bus, "declare_publisher")

    def declared(session: zenoh.Session, topic: Topic, key: str) -> zenoh.Publisher:
        publisher: zenoh.Publisher = original(_Express(session), topic, key)
        return publisher

    _put(zenoh_bus, "declare_publisher", declared)


def _channel() -> None:
    convert = _original(zenoh_bus, "_sample")

    def subscribe(
        self: zenoh_bus.ZenohBus, topic: Topic, handler: Callable[[Sample], None], name: str
    ) -> Callable[[], None]:
        subscriber = self._session.declare_subscriber(topic.at(name), RingChannel(_RING))
        left = threading.Event()

        def receive() -> None:
            with contextlib.suppress(zenoh.ZError):  # the session ends
                while not left.is_set():
                    handler(convert(subscriber.recv(), self.clock.host_ns()))
                # zenoh refuses it while another thread receives
                subscriber.undeclare()  # type: ignore[no-untyped-call]

        threading.Thread(target=receive, daemon=True).start()
        return left.set

    _put(zenoh_bus.ZenohBus, "_subscribe", subscribe)


def _own_thread() -> None:
    def handover(
        self: Service, topic: Topic, handler: Callable[[Sample], None], name: str = "", **_: object
    ) -> Callable[[], None]:
        mailbox = self.mailbox(topic, name)

        def work() -> None:
            while self.running:
                sample = mailbox.take(_PATIENCE_S)
                if sample is not None:
                    handler(sample)

        threading.Thread(target=work, daemon=True).start()
        return _nothing

    _put(Service, "handover", handover)


def _payload(kind: Callable[[bytes], Any]) -> Callable[[], None]:
    """Patch that hands each payload to zenoh as something else than bytes."""

    def replace() -> None:
        original = _original(zenoh_bus.ZenohPublisher, "put")

        @functools.wraps(original)
        def put(self: zenoh_bus.ZenohPublisher, payload: bytes, *more: Any, **named: Any) -> Envelope:
            envelope: Envelope = original(self, kind(payload), *more, **named)
            return envelope

        _put(zenoh_bus.ZenohPublisher, "put", put)

    return replace


def _mirror_ahead() -> None:
    original = _original(join, "prepare")

    @functools.wraps(original)
    def prepare(config: Configuration, role: str, cpus: list[int]) -> realtime.Granted:
        if role.startswith(Role.MIRROR) and config.realtime.priority:
            ahead = {"priority": config.realtime.priority + 1}
            config = config.model_copy(update={"realtime": config.realtime.model_copy(update=ahead)})
        granted: realtime.Granted = original(config, role, cpus)
        return granted

    _put(join, "prepare", prepare)


def _telemetry_first() -> None:
    from lowfc.programs.controller import Controller

    send, tell = _original(Controller, "_send"), _original(Controller, "_tell")
    told: list[Outputs] = []

    def told_before(self: Controller, outputs: Outputs) -> None:
        tell(self, outputs)
        told[:] = [outputs]
        send(self, outputs)

    def told_once(self: Controller, outputs: Outputs) -> None:
        if not told or told[0] is not outputs:
            tell(self, outputs)

    _put(Controller, "_send", told_before)
    _put(Controller, "_tell", told_once)


def _stay_python() -> None:
    """Keep Python's state of zenoh's threads from one callback to the next; it is made for each otherwise."""
    known = threading.local()
    plain: Any = Callback

    def staying(handler: Callable[[Any], None], *drop: Callable[[], None], **how: bool) -> Any:
        def received(message: Any) -> None:
            if not hasattr(known, "thread"):
                ctypes.pythonapi.PyGILState_Ensure()
                known.thread = True
            handler(message)

        return plain(received, *drop, **how)

    _put(zenoh_bus, "Callback", staying)


PATCHES: dict[str, Callable[[], None]] = {
    "collector": _collector_on,
    "switch-interval": lambda: _put(realtime, "_SWITCH_INTERVAL_S", _OFTEN_S),
    "memory-kept": _memory_given_back,
    "blas": lambda: _put(realtime, "threadpool_limits", _nothing),
    "timer-slack": lambda: _put(realtime, "sharpen_sleep", _nothing),
    "denormals": _denormals_flushed,
    "stay-python": _stay_python,
    "let-send": lambda: _put(realtime, "let_send", _nothing),
    "mirror-ahead": _mirror_ahead,
    "rehearse-late": lambda: _put(rehearsal, "LEAD_NS", 10**9),
    "commands-short": _commands_by_bus,
    "shortcut": lambda: _put(zenoh_bus.ZenohBus, "_shortcut", _nothing),
    "retry": _edit(_asks_often),
    "bus-first": _bus_first,
    "socket": _edit(_by_socket),
    "low-latency": _edit(_low_latency),
    "qos": _edit(_without_qos),
    "batching": _edit(_without_batching),
    "queues": _edit(_short_queues),
    "shared-memory": _edit(_by_shared_memory),
    "password": _edit(_without_password),
    "express": _express,
    "own-thread": _own_thread,
    "channel": _channel,
    "memoryview": _payload(memoryview),
    "bytearray": _payload(bytearray),
    "telemetry": _telemetry_first,
}
"""By the name of the change in `benchmarks.road.changes`."""
