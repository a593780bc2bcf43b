"""The commands for a run on several hosts: make certificates, run the router, list the processes with their clocks."""

import datetime
import json
import re
import sys
import tempfile
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lowfc.adapters.process.extras import package_required
from lowfc.adapters.process.terminal import DEFAULT_RUN, AnyRun, ConfigFile, Json, RunId, configuration
from lowfc.contract.errors import BusError, ConfigurationError
from lowfc.programs.cli.result import Result, print_result, result_field

if TYPE_CHECKING:
    from lowfc.contract.messages import wire

CONNECT_S = 0.5
"""Time for a session to connect to all running processes."""

_POLL_S = 0.1


class HostProcess(Result):
    """A process and the clock of its host."""

    process: str = result_field("process")
    state: str = result_field("state")
    clock_offset_us: float | None = result_field("router's clock minus host's", "us", "+.0f")
    clock_error_us: float | None = result_field("clock error at most", "us", ".0f")


class HostsResult(Result):
    """The processes of a run."""

    run: str = result_field("run")
    processes: list[HostProcess] = result_field("processes")

    def remarks(self) -> list[str]:
        """Why no clock is compared, if none is."""
        compared = any(each.clock_offset_us is not None for each in self.processes)
        return [] if compared else ["no clock is compared: the run has no router, or its router reports no clock"]


def certs(
    folder: Annotated[Path, typer.Argument(help="Folder of the certificate authority; created if missing.")],
    router: Annotated[
        list[str] | None,
        typer.Option(
            help="Host name or IP address of the router, for a new certificate of the router; repeat for several."
        ),
    ] = None,
    mirror: Annotated[
        list[str] | None,
        typer.Option(help="Name of a mirror; may be repeated. Default: those with certificates in the folder, or dm."),
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="Validity of the certificates, days.")] = 825,
    renew: Annotated[
        bool, typer.Option("--renew", help="Also renew existing certificates; they keep their keys.")
    ] = False,
) -> None:
    """Make a certificate for each role of a run on several hosts, and the authority that signs them.

    Copy ca.pem to each host, with ROLE.pem and ROLE.key of each role that runs there; keep ca.key secret.

    Example: lowfc certs certs --router bench.example.org --router 192.168.7.1
    """
    from lowfc.adapters.bus.access import ROUTER, roles
    from lowfc.adapters.bus.run import mirror_role
    from lowfc.contract.configuration import load

    with package_required("making certificates requires the package cryptography", "deploy"):
        from lowfc.adapters.bus.certificates import make_certificates
    existing = sorted(file.stem.removeprefix("mirror-") for file in folder.glob("mirror-*.pem"))
    mirrors = [load(None, {"mirror.name": name}).mirror.name for name in mirror or existing or ["dm"]]
    names = (ROUTER, *roles(map(mirror_role, mirrors)))
    made = make_certificates(folder, names, router or [], days, renew=renew)
    for file in made:
        sys.stdout.write(f"{file}\n")
    sys.stderr.write(f"{len(made)} made, {len(names) - len(made)} existed already; keep {folder / 'ca.key'} secret\n")


def router(
    config: ConfigFile = None,
    run: RunId = DEFAULT_RUN,
    show: Annotated[
        bool, typer.Option("--show", help="Only print the router's configuration, for your own zenohd.")
    ] = False,
) -> None:
    """Run the router of a run on several hosts, with mutual TLS; it passes only what each role may send or receive.

    It listens on network.listen of the configuration, or else on network.router. Your own zenohd works as well, but
    does not compare clocks: each host then stamps envelopes by its own clock.

    Example: lowfc router --config lowfc.toml --run bench
    """
    from lowfc.adapters.bus.access import ROUTER
    from lowfc.adapters.bus.run import open_run
    from lowfc.adapters.bus.zenoh_session import session_config
    from lowfc.adapters.process.join import join

    settings = configuration(config)
    if not settings.network.router:
        raise ConfigurationError(
            'there is no router in the configuration: give --config a file with router = "tls/HOST:PORT" and '
            "certificates in [network]"
        )
    if show:
        with tempfile.TemporaryDirectory(prefix="lowfc-") as temporary:  # --show creates no run
            links = open_run(run, (settings.mirror.name,), Path(temporary), network=settings.network).links
            text = json.dumps(session_config(links, ROUTER), indent=2)
        # each list of plain values on one line
        text = re.sub(r"\[\s+([^][{}]*?)\s+\]", lambda found: f"[{' '.join(found[1].split())}]", text)
        sys.stdout.write(text + "\n")
        return
    service = join(settings, run, ROUTER, [])
    service.catch_signals()
    with closing(service.bus):
        service.state = "running"
        sys.stderr.write(f"routing at {settings.network.listen or settings.network.router}; Ctrl-C ends it\n")
        while service.running:
            service.beat()
            time.sleep(_POLL_S)
        service.finish()


def hosts(config: ConfigFile = None, run: AnyRun = None, as_json: Json = False) -> None:
    """List the processes of a run, and the clock offsets of their hosts from the router.

    With a router, other commands on this host then find the run without its configuration.

    Example: lowfc hosts --config lowfc.toml --run bench
    """
    from lowfc.adapters.bus.routed import certificate_warnings
    from lowfc.adapters.bus.run import open_run, run_path
    from lowfc.adapters.bus.zenoh_bus import ZenohBus
    from lowfc.adapters.process.clock import HostClock
    from lowfc.client import Client, running
    from lowfc.client.runs import the_known_run
    from lowfc.contract.messages import Role

    settings = configuration(config)
    if not settings.network.router or (run is None and running()):
        run = the_known_run(run)
    run = DEFAULT_RUN if run is None else run  # with a router, all processes of the run may be on other hosts
    with ExitStack() as stack:
        exists = run_path(run).is_dir()  # if not, the run is created once a process has answered
        base = None if exists else Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lowfc-")))
        mirrors = () if exists else (settings.mirror.name,)
        links = open_run(run, mirrors, base, network=settings.network).links
        bus = ZenohBus(links, Role.OPERATOR, HostClock())
        stack.callback(bus.close)
        time.sleep(CONNECT_S)
        processes = Client(run, bus=bus).processes()
    if not processes:
        raise BusError(f"no process of run {run!r} reports its health")
    # If the router serves a run of another name, the processes report that name.
    name = next((health.run_id for health in processes.values() if health.run_id), run)
    if links.network.router:
        if name == run:
            open_run(run, mirrors, network=settings.network)  # ctl and view now find the run without the configuration
        for warning in certificate_warnings(links.network, datetime.datetime.now(datetime.UTC)):
            sys.stderr.write(f"warning: {warning}\n")
    rows = [_host_process(health) for _, health in sorted(processes.items())]
    print_result(HostsResult(run=name, processes=rows), as_json=as_json)


def _host_process(health: "wire.Health") -> HostProcess:
    measured = health.router_round_trip_ns > 0
    return HostProcess(
        process=health.process,
        state=health.state,
        clock_offset_us=health.router_offset_ns / 1e3 if measured else None,
        clock_error_us=health.router_round_trip_ns / 2e3 if measured else None,
    )
