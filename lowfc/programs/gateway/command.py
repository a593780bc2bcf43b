"""The command `lowfc gateway`: connect a run to a control system until stopped."""

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
from lowfc.programs.gateway.variables import Put, status_of, variables
from lowfc.programs.gateway.watch import Watch

PERIOD_S = 0.1
"""Update period of the variables."""
MIN_PERIOD_S = 0.005
"""Shortest time between two updates, however fast a variable changes."""
BENCH_PERIOD_S = 0.25
"""Period at which a bench value is published again while its variable is connected."""


def epics(run: AnyRun = None, config: ConfigFile = None) -> None:
    """Serve a run by EPICS PV Access: values as PVs, requests as puts, and other servers' PVs as bench values.

    Example: lowfc gateway epics --run bench
    """
    from lowfc.programs.gateway.epics import EpicsGateway, protocol

    protocol()  # raises now if p4p is missing
    joined = open_run(the_run(run), ())
    of_run, links = joined.path / "config.toml", joined.links
    known = configuration(config) if config is not None or not of_run.exists() else load(of_run)
    clock, stop = clock_of(known), threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with contextlib.ExitStack() as stack:
        bus = ZenohBus(links, Role.OPERATOR, clock, monitor=True)
        stack.callback(bus.close)
        loop, offered, changed = Client(links.run_id, bus=bus), tuple(variables()), threading.Event()

        def request(put: Put, value: Any) -> None:
            put(Client(links.run_id, bus=bus), value)  # on a thread of the server: `safe` waits for no other put

        gateway = EpicsGateway(known.gateway, offered, request, changed.set)
        stack.callback(gateway.close)
        where = f"{known.gateway.listen}:{gateway.port}, PVs {known.gateway.prefix}*"
        sys.stderr.write(f"gateway: run {links.run_id} by PV Access at {where}\n")
        watch, due_s, bench_s = Watch(bus, clock), 0.0, 0.0
        while not stop.is_set():
            now_s = time.monotonic()
            if changed.is_set() or now_s >= bench_s:
                changed.clear()
                bench_s = now_s + BENCH_PERIOD_S
                for name, value in list(gateway.bench.items()):
                    loop.bench(name, value)
            if now_s >= due_s:
                due_s = now_s + PERIOD_S
                view = watch.update()
                status = status_of(view, links.run_id)
                values = {one.name: one.read(view, status) for one in offered if one.read is not None}
                gateway.update(values, "" if view.connected else "the controller does not answer")
            changed.wait(max(0.0, min(due_s, bench_s) - time.monotonic()))
            stop.wait(MIN_PERIOD_S)
