"""The command `lowfc gateway`: connect a run to a control system until stopped."""

import contextlib
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.join import clock_of
from lowfc.adapters.process.terminal import AnyRun, ConfigFile, configuration
from lowfc.client import Client
from lowfc.client.runs import the_known_run
from lowfc.contract.configuration import load
from lowfc.contract.messages import Role
from lowfc.programs.cli.status import json_object
from lowfc.programs.gateway.epics import EpicsGateway, protocol
from lowfc.programs.gateway.variables import Put, variables
from lowfc.programs.gateway.watch import Watch
from lowfc.programs.view.monitor import import_late_modules

PERIOD_S = 0.1
"""Update period of the variables."""
MIN_PERIOD_S = 0.005
"""Shortest time between two updates, however fast a variable changes."""
BENCH_PERIOD_S = 0.25
"""Period at which a bench value is published again while its variable is connected."""


def epics(run: AnyRun = None, config: ConfigFile = None) -> None:
    """Serve a run by EPICS PV Access: values as PVs, requests as puts, and other servers' PVs as bench values.

    While the run is stopped, the gateway waits; then it joins the run again.

    Example: lowfc gateway epics --run bench
    """
    protocol()  # raises at once if p4p is missing
    import_late_modules()
    joined = open_run(the_known_run(run), ())
    run_id, run_config = joined.run_id, joined.path / "config.toml"
    settings = configuration(config) if config is not None or not run_config.exists() else load(run_config)
    clock = clock_of(settings)
    signalled = list[int]()  # not an Event: the handler of a second signal could wait for its lock forever
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: signalled.append(number))
    bus = ZenohBus(joined.links, Role.OPERATOR, clock, monitor=True)

    def request(put: Put, value: Any) -> None:
        put(Client(run_id, bus=bus), value)  # called on the variable's own thread: `safe` waits for no other put

    def ended() -> bool:
        return bool(signalled) or joined.restarted()

    with contextlib.ExitStack() as stack:
        stack.callback(lambda: bus.close())
        gateway = EpicsGateway(settings.gateway, tuple(variables()), request)
        stack.callback(gateway.close)
        served_at = f"{settings.gateway.listen}:{gateway.port}, PVs {settings.gateway.prefix}*"
        sys.stderr.write(f"gateway: run {run_id} by PV Access at {served_at}\n")
        while True:
            _serve(Client(run_id, bus=bus), Watch(bus, clock), gateway, ended)
            if signalled:
                return
            bus.close()
            joined = open_run(run_id, ())
            bus = ZenohBus(joined.links, Role.OPERATOR, clock, monitor=True)
            sys.stderr.write(f"gateway: run {run_id} was started again, and the gateway has joined it\n")


def _serve(client: Client, watch: Watch, gateway: EpicsGateway, ended: Callable[[], bool]) -> None:
    """Post the variables and publish the bench values of one run until it has `ended`."""
    due_s, bench_s = 0.0, 0.0
    while not ended():
        now_s = time.monotonic()
        if gateway.changed.is_set() or now_s >= bench_s:
            gateway.changed.clear()
            bench_s = now_s + BENCH_PERIOD_S
            for name, value in list(gateway.bench.items()):
                client.bench(name, value)
        if now_s >= due_s:
            due_s = now_s + PERIOD_S
            view = watch.update()
            status = json_object(view.state, view.processes, client.run_id)
            values = {each.name: each.read(view, status) for each in gateway.variables if each.read is not None}
            gateway.update(values, "" if view.connected else "the controller does not answer")
        gateway.changed.wait(max(0.0, min(due_s, bench_s) - time.monotonic()))
        time.sleep(MIN_PERIOD_S)
