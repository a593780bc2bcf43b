"""When the commands for several hosts create a run, and that docs/howto/hosts.md has the numbers of the code."""

import inspect
import json
import re
import socket
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import pytest

from lowfc.adapters.bus import certificates, routed
from lowfc.adapters.bus.access import ROUTER, roles
from lowfc.adapters.bus.run import open_run, runtime_base
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.clock_offset import FIRST_EXCHANGES, PERIOD_S, RECENT
from lowfc.contract.configuration import Network
from lowfc.contract.errors import BusError
from lowfc.contract.messages import Role, wire
from lowfc.programs.cli.hosts import certs
from tests.e2e.test_hosts import SHIFTS_NS
from tests.support.loops import json_of, lowfc, refusal

DOCUMENT = Path(__file__).parents[2] / "docs" / "howto" / "hosts.md"
NETWORK = Network(router="tls/127.0.0.1:7447", certificates="/etc/lowfc/certs")


@pytest.fixture
def toml(own_runtime: Path) -> Path:
    """A configuration with a router; no run exists."""
    file = own_runtime / "lowfc.toml"
    file.write_text(f'[network]\nrouter = "{NETWORK.router}"\ncertificates = "{NETWORK.certificates}"\n')
    return file


def runs() -> list[str]:
    return [path.name for path in runtime_base().iterdir() if path.is_dir()]


@pytest.mark.usefixtures("toml")
def test_a_missing_run_is_created_only_with_make() -> None:
    show_zenoh = ["config", "zenoh", "--role", "camera", "--run", "tpyo"]
    for command in (["hosts", "--run", "tpyo"], show_zenoh):
        assert "there is no run 'tpyo'" in refusal(*command, kind=BusError)
        assert runs() == []
    created = lowfc(*show_zenoh, "--make")
    assert created.exit_code == 0
    assert runs() == ["tpyo"]
    assert lowfc(*show_zenoh).stdout == created.stdout


@pytest.mark.usefixtures("toml")
def test_a_run_is_created_with_the_mirror_of_the_role() -> None:
    for role in ("mirror-tt", "camera"):  # for the second role, the run exists already
        done = lowfc("config", "zenoh", "--role", role, "--make")
        assert done.exit_code == 0, done.exception
    assert set(open_run("default", ()).links.ports) == {"camera", "controller", "mirror-tt", "recorder"}
    assert "no process of run 'default' reports its health" in refusal("hosts", "--run", "default", kind=BusError)
    refused = refusal("config", "zenoh", "--role", "mirror-Tip Tilt", "--run", "x", "--make")
    assert "mirror.name = 'Tip Tilt'" in refused
    for run in ("default", "x"):
        assert f"run {run!r} has no role 'cam'" in refusal("config", "zenoh", "--role", "cam", "--run", run, "--make")
    assert runs() == ["default"]


@pytest.mark.usefixtures("own_runtime")
def test_the_roles_of_a_run_with_a_router_are_those_of_its_certificates() -> None:
    open_run("bench", network=NETWORK)
    certified = roles(["mirror-dm"])
    for role in certified:
        assert lowfc("config", "zenoh", "--role", role, "--run", "bench").exit_code == 0
    refused = refusal("config", "zenoh", "--role", "launcher", "--run", "bench")
    assert f"run 'bench' has no role 'launcher'; its roles are {', '.join(certified)}" in refused
    documented = re.search(r"Roles are (.*?)\.", DOCUMENT.read_text(), re.DOTALL)
    assert documented
    assert set(re.findall(r"`(.*?)`", documented[1])) == {ROUTER, *certified}


def test_lowfc_hosts_stores_its_connection_under_the_name_of_the_run_that_answers(
    toml: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lowfc.adapters.bus.zenoh_bus.ZenohBus", Mock())
    answers = {"camera": wire.Health(process="camera", run_id="bench")}
    monkeypatch.setattr("lowfc.client.Client", lambda *_, **__: Mock(processes=lambda: answers))
    for run in ("bnch", "bench"):
        assert json_of("hosts", "--config", toml, "--run", run)["run"] == "bench"
    assert runs() == ["bench"]


@pytest.mark.usefixtures("own_runtime")
def test_a_run_that_cannot_be_joined_is_listed_with_the_reason_and_hides_no_other_run() -> None:
    bench = ZenohBus(open_run("bench").links, Role.CAMERA, HostClock())
    with socket.create_server(("127.0.0.1", 0)) as router, closing(bench):
        address = f"tls/127.0.0.1:{router.getsockname()[1]}"
        open_run("across", network=NETWORK.model_copy(update={"router": address}))
        listed = json_of("runs")
        text = lowfc("runs").stdout
    assert [run["run"] for run in listed["runs"]] == ["bench"]
    (why,) = listed["not_joined"].values()
    assert "ca.pem cannot be read" in why
    assert text.splitlines()[1] == f"across  cannot be joined: {why}"


@pytest.mark.usefixtures("own_runtime")
def test_a_run_whose_router_does_not_answer_is_not_called_absent() -> None:
    open_run("stopped")
    open_run("across", network=NETWORK)
    no_answer = f"the router of run 'across' at {NETWORK.router} does not answer"
    assert refusal("ctl", "status", "--run", "across", kind=BusError).startswith(f"{no_answer}: is it running")
    assert no_answer in refusal("ctl", "status", kind=BusError)
    assert "there is no run 'stopped'" in refusal("ctl", "status", "--run", "stopped", kind=BusError)


@pytest.mark.usefixtures("toml")
@pytest.mark.parametrize("command", ["record", "sim-loop", "config zenoh --role x", "config zenoh --role x --make"])
def test_a_run_name_that_is_too_long_or_empty_is_refused(command: str) -> None:
    for name in ("x" * 300, ""):
        error = refusal(*command.split(), "--run", name, kind=BusError)
        assert "--make" not in error
        assert len(error) < 300
        assert "a run's name is up to 48 of" in error


def test_the_configuration_of_the_router_is_shown_without_creating_its_run(toml: Path) -> None:
    done = lowfc("router", "--show", "--config", toml, "--run", "bench")
    assert done.exit_code == 0
    assert json.loads(done.stdout)["listen"]["endpoints"] == [NETWORK.router]
    assert runs() == []


def test_lowfc_hosts_creates_no_run_if_the_router_cannot_be_joined(toml: Path) -> None:
    assert "the router accepts no process without it" in refusal("hosts", "--config", toml, "--run", "bench")
    assert "a run's name is up to 48 of" in refusal("hosts", "--config", toml, "--run", "")
    assert runs() == []


def test_the_numbers_of_the_document_are_those_of_the_code() -> None:
    text = " ".join(DOCUMENT.read_text().split())
    retry = routed.client_session(NETWORK, "camera", {})["connect"]["retry"]
    shifts = [f"{ns / 1e9:g} s" if abs(ns) >= 1e9 else f"{ns / 1e6:g} ms" for ns in SHIFTS_NS.values()]
    assert inspect.signature(certs).parameters["days"].default == certificates.DAYS
    assert retry["period_max_ms"] == 1000
    for sentence in (
        f"Certificates are valid for {certificates.DAYS} days",
        f"A link that is silent for {routed.LINK_LEASE_MS / 1000:g} s is closed, and",
        "reconnection is tried at least every second",
        f"{FIRST_EXCHANGES} times before its first message and then {1 / PERIOD_S:g} times a second",
        f"the shortest round trip of the last {RECENT}:",
        f"shifted by {', '.join(shifts[:-1])} and {shifts[-1]}",
        f"with clocks {max(SHIFTS_NS.values()) / 1e9:g} s apart",
    ):
        assert sentence in text
    assert not re.findall(r"\d+ (?:us|MHz|kB|MB|%)", text)  # measured values are on generated pages only
