"""The command `lowfc gateway`: offer a run to a control system until stopped."""

import contextlib
import signal
import sys
import threading
import time
from typing import Any

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.join import clock_of
from lowfc.adapters.process.terminal import AnyRun, ConfigFile, configuration
from lowfc.client import Client
from lowfc.client.runs import the_run
from lowfc.contract.configuration import load
from lowfc.contract.messages import Role
from lowfc.programs.gateway.offer import Put, status_of, variables
from lowfc.programs.gateway.watch import Watch

PERIOD_S = 0.1
"""Of all variables."""
TURN_S = 0.005
"""Shortest time between two updates, however fast a variable changes."""
BENCH_PERIOD_S = 0.25
"""How often a bench value is published again while its variable is connected."""


def epics(run: AnyRun = None, config: ConfigFile = None) -> None:
    """Offer a run by EPICS PV Access: figures as PVs, requests as puts, and other servers' PVs as bench values.

    Example: lowfc gateway epics --run bench
    """
    from lowfc.programs.gateway.epics import EpicsGateway, protocol

    protocol()  # what is missing is missed first
    joined = open_run(the_run(run), ())
    own, links = joined.path / "config.toml", joined.links
    known = configuration(config) if config is not None or not own.exists() else load(own)
    clock, stop = clock_of(known), threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with contextlib.ExitStack() as stack:
        bus = ZenohBus(links, Role.OPERATOR, clock, monitor=True)
        stack.callback(bus.close)
        loop, turn = Client(links.run_id, bus=bus), threading.Lock()
        offered, news = tuple(variables()), threading.Event()

        def ask(put: Put, value: Any) -> None:
            with turn:
                put(loop, value)

        gateway = EpicsGateway(known.gateway, offered, ask, news.set)
        stack.callback(gateway.close)
        where = f"{known.gateway.listen}:{gateway.port}, PVs {known.gateway.prefix}*"
        sys.stderr.write(f"gateway: run {links.run_id} by PV Access at {where}\n")
        watch, due_s, bench_s = Watch(bus, clock), 0.0, 0.0
        while not stop.is_set():
            now_s = time.monotonic()
            if news.is_set() or now_s >= bench_s:
                news.clear()
                bench_s = now_s + BENCH_PERIOD_S
                for name, value in list(gateway.bench.items()):
                    loop.bench(name, value)
            if now_s >= due_s:
                due_s = now_s + PERIOD_S
                seen = watch.look()
                status = status_of(seen, links.run_id)
                values = {one.name: one.read(seen, status) for one in offered if one.read is not None}
                gateway.update(values, "" if seen.connected else "the controller does not answer")
            news.wait(max(0.0, min(due_s, bench_s) - time.monotonic()))
            stop.wait(TURN_S)
