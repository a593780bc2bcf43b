"""The command `lowfc console`."""

import contextlib
import signal
import sys

from lowfc.adapters.process.terminal import AnyRun
from lowfc.contract.errors import ConfigurationError


def console(run: AnyRun = None) -> None:
    """Operate a running loop from one screen of a terminal, at least 100 x 30 characters.

    It shows the verdict and values of `lowfc view` and sends the requests of `lowfc ctl`. Key ? shows the keys.

    Example: lowfc console
    """
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ConfigurationError("the console requires a terminal; `lowfc ctl` operates a loop without one")
    from lowfc.adapters.process.realtime import lower_priority

    lower_priority()
    from lowfc.adapters.bus.run import open_run
    from lowfc.adapters.bus.zenoh_bus import ZenohBus
    from lowfc.adapters.process.join import clock_of
    from lowfc.client.runs import the_run
    from lowfc.contract.configuration import load
    from lowfc.contract.messages import Role
    from lowfc.programs.console.app import RESTARTED, Console

    run_id = the_run(run)
    result: str | None = RESTARTED
    while result == RESTARTED:
        joined = open_run(run_id, ())
        config = joined.path / "config.toml"
        clock = clock_of(load(config if config.exists() else None))
        with contextlib.closing(ZenohBus(joined.links, Role.OPERATOR, clock, monitor=True)) as bus:
            app = Console(bus, run_id, clock, joined.restarted, terminal_gone=lambda: not sys.stdin.isatty())
            for number in (signal.SIGTERM, signal.SIGINT):  # textual's threads would outlive an exception
                signal.signal(number, lambda *_, app=app: app.exit())
            result = app.run()
