"""Access control at the router: rules from the table of topics, and a real router on loopback."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest
import zenoh

from lowfc.adapters.bus import routed
from lowfc.adapters.bus.access import CLOCK_KEY, ROUTER, access_control, grant, roles
from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import free_ports, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.clock_offset import RECENT, ClockOffset
from lowfc.adapters.process.service import Service
from lowfc.contract.configuration import Network
from lowfc.contract.errors import BusError, DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    COMMAND,
    EVENT,
    FRAME,
    HEALTH,
    MIRROR_STATE,
    STEP,
    TOPICS,
    Role,
    Topic,
)
from tests.support.loops import socket_options, until

certificates = pytest.importorskip("lowfc.adapters.bus.certificates", reason="needs the package cryptography")
ROLES = roles(["mirror-dm"])


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
def test_publish_and_receive_rights_follow_the_table_of_topics(topic: Topic) -> None:
    key = {role: topic.at(role if topic is HEALTH else "dm") for role in ROLES}
    publishers = {role for role in ROLES if _covers(grant(role).publishes, key[role])}
    assert publishers == {role for role in ROLES if Role(role.partition("-")[0]) in topic.publishers}
    receivers = {role for role in ROLES if _covers(grant(role).receives, key[role])}
    subscribers = {role for role in ROLES if Role(role.partition("-")[0]) in topic.subscribers}
    # An operator receives what a viewer receives.
    assert receivers == subscribers | ({"operator"} if "viewer" in subscribers else set())


def _covers(patterns: tuple[str, ...], key: str) -> bool:
    return any(zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(key)) for pattern in patterns)


def test_processes_publish_under_their_own_names_and_only_operators_send_requests() -> None:
    own = {"lowfc/mirror/dm/state", "lowfc/mirror/dm/surface", "lowfc/event", "lowfc/health/mirror-dm"}
    assert set(grant("mirror-dm").publishes) == own
    wildcards = {"controller": {"lowfc/mirror/*/command"}, "bench": {"lowfc/bench/*"}, "operator": {"lowfc/bench/*"}}
    for role in ROLES:
        assert {key for key in grant(role).publishes if "*" in key} == wildcards.get(role, set())
        queries = {key for key in grant(role).queries if "request" in key or "record" in key}
        assert queries == ({"lowfc/request/*", "lowfc/record/*"} if role == "operator" else set())
        assert CLOCK_KEY in grant(role).queries
    assert "lowfc/request/*" in grant("controller").answers
    assert "lowfc/record/*" in grant("recorder").answers


def test_access_control_denies_by_default_and_refers_to_defined_names_only() -> None:
    """Zenoh silently ignores undefined rules or subjects in a policy."""
    control = access_control(["mirror-dm", "mirror-tip"])
    assert control["enabled"]
    assert control["default_permission"] == "deny"
    rules, subjects = ({entry["id"]: entry for entry in control[name]} for name in ("rules", "subjects"))
    assert len(rules) == len(control["rules"])
    assert all(rule["permission"] == "allow" for rule in rules.values())
    assert {"mirror-dm", "mirror-tip"} <= set(subjects)
    assert all(subject["cert_common_names"] == [name] for name, subject in subjects.items())
    for policy in control["policies"]:
        assert set(policy["rules"]) <= set(rules)
        assert set(policy["subjects"]) <= set(subjects)
    assert sorted(name for policy in control["policies"] for name in policy["rules"]) == sorted(rules)


def test_the_best_clock_exchange_is_the_recent_one_with_the_shortest_round_trip() -> None:
    offset = ClockOffset()
    assert offset.offset_ns == 0
    offset.add_exchange(1000, 5600, 2000)  # query in 600 ns, answer in 400 ns: offset 4100, not the true 4000 ns
    assert offset.best == (4100, 1000)
    offset.add_exchange(3000, 7050, 3100)
    assert offset.best == (4000, 100)
    for _ in range(RECENT):
        offset.add_exchange(5000, 9300, 5600)
    assert offset.best == (4000, 600)
    offset.add_exchange(7000, 9_000_000, 8000)  # the other host's clock was set
    assert offset.best == (9_000_000 - 7500, 1000)


class Hosts:
    """A router and buses connected to it, each as on a separate host, all on loopback."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_ports(1)[0]
        self.buses: list[ZenohBus] = []
        self.count = 0
        certificates.make_certificates(folder / "certs", (ROUTER, *ROLES), ["127.0.0.1", "localhost"])

    def network(self, certs: str = "certs", host: str = "127.0.0.1") -> Network:
        return Network(router=f"tls/{host}:{self.port}", certificates=str(self.folder / certs))

    def join(self, role: str, shift_ns: int = 0, network: Network | None = None) -> ZenohBus:
        """Connect a process of this role, on a host of its own whose clock is ahead by `shift_ns`."""
        self.count += 1
        base = self.folder / f"host{self.count}"
        base.mkdir(mode=0o700)
        clock = HostClock(base)
        clock.offset_ns += shift_ns
        run = open_run("hosts", base=base, network=network or self.network())
        self.buses.append(ZenohBus(run.links, role, clock))
        return self.buses[-1]


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[Hosts]:
    joined = Hosts(tmp_path)
    yield joined
    for bus in reversed(joined.buses):
        bus.close()


def test_the_router_forwards_exactly_what_the_table_of_topics_allows(hosts: Hosts) -> None:
    hosts.join(ROUTER)
    bus = {role: hosts.join(role) for role in ROLES}
    received: set[tuple[str, str, str]] = set()  # receiver, key, publisher

    def handler(role: str) -> Callable[[Sample], None]:
        return lambda sample: received.add((role, sample.key, sample.payload.decode()))

    topics = (FRAME, CAMERA_STATE, STEP, COMMAND, MIRROR_STATE, CALIBRATION, EVENT)
    for role in ROLES:
        for topic in topics:
            bus[role].subscribe(topic, handler(role), "dm" if role == "mirror-dm" else "*")
    publishers = [(role, bus[role].publisher(topic, "dm")) for role in ROLES for topic in topics]

    def allowed(role: str, topic: Topic, publisher_role: str) -> bool:
        key = topic.at("dm")
        return _covers(grant(role).receives, key) and _covers(grant(publisher_role).publishes, key)

    expected = {
        (role, topic.at("dm"), publisher_role)
        for role in ROLES
        for topic in topics
        for publisher_role in ROLES
        if role != publisher_role and allowed(role, topic, publisher_role)
    }
    assert len(expected) > 30

    def put() -> None:
        for role, publisher in publishers:
            publisher.put(role.encode())

    until(lambda: expected <= received, each=put)
    time.sleep(0.2)
    forwarded = {message for message in received if message[0] != message[2]}  # own messages are delivered locally
    assert forwarded == expected
    bus["controller"].queryable("lowfc/request/*", lambda query: query.reply(b"done"))
    bus["camera"].queryable("lowfc/request/*", lambda query: query.reply(b"forged"))
    until(lambda: bus["operator"].get("lowfc/request/status"))
    for role in ROLES:
        if role not in ("controller", "camera"):  # these answer themselves, without the router
            answers = [sample.payload for sample in bus[role].get("lowfc/request/status")]
            assert answers == ([b"done"] if role == "operator" else [])
        states = {sample.payload.decode() for sample in bus[role].get("lowfc/camera/state")}
        assert {"camera"} <= states <= {"camera", role}  # its own state is answered locally


def test_message_times_are_converted_to_the_receiving_hosts_clock(hosts: Hosts) -> None:
    second_ns = 1_000_000_000
    hosts.join(ROUTER)
    camera, recorder = hosts.join("camera", 3 * second_ns), hosts.join("recorder", -7 * second_ns)
    arrived: list[Sample] = []
    recorder.subscribe(FRAME, arrived.append)
    frames = camera.publisher(FRAME)
    until(lambda: len(arrived) > 3, each=lambda: frames.put(b"frame"))
    for bus, shift_ns in ((camera, 3 * second_ns), (recorder, -7 * second_ns)):
        assert abs(bus.offset.offset_ns + shift_ns) < second_ns  # tests/e2e/test_hosts.py checks the accuracy
    assert all(abs(sample.receive_time_ns - sample.publish_time_ns) < second_ns for sample in arrived)
    assert Service("camera", "hosts", camera.clock, camera).health().router_round_trip_ns > 0


def test_a_camera_starts_after_its_wait_for_a_mirror_on_another_host(hosts: Hosts) -> None:
    """Camera and mirror wait for each other's Health. The mirror may receive commands under its own name only."""
    hosts.join(ROUTER)
    camera, mirror = (
        Service(role, "hosts", bus.clock, bus)
        for role, bus in ((role, hosts.join(role)) for role in ("camera", "mirror-dm"))
    )
    camera.state = mirror.state = "ready"
    until(lambda: camera.last_health and mirror.last_health, each=lambda: (camera.beat(), mirror.beat()))
    until(lambda: not camera.wait_for(["mirror-dm"], 0.0), each=lambda: (camera.beat(), mirror.beat()))
    commands = {key for key in grant("mirror-dm").receives if key.endswith("/command")}
    assert commands == {"lowfc/mirror/dm/command"}


def test_a_role_runs_only_once_across_hosts(hosts: Hosts) -> None:
    hosts.join(ROUTER)
    hosts.join("camera").publisher(HEALTH, "camera").put(b"here")
    with pytest.raises(BusError, match="run 'hosts' has a camera already, on this host or another"):
        hosts.join("camera")
    hosts.join("operator").publisher(HEALTH, "operator").put(b"here")
    hosts.join("operator")  # roles that only connect may run several times


def test_a_foreign_certificate_is_refused_with_the_reason(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    hosts.join(ROUTER)
    monkeypatch.setattr(routed, "CONNECT_MS", 100)
    certificates.make_certificates(hosts.folder / "foreign", ("camera",), [])
    foreign = hosts.folder / "foreign"
    with pytest.raises(BusError, match=r"do not accept each other .CERTIFICATE_VERIFY_FAILED: [^()]+[^.]\): both must"):
        hosts.join("camera", network=hosts.network("foreign"))
    (foreign / "ca.pem").write_bytes((hosts.folder / "certs" / "ca.pem").read_bytes())
    with pytest.raises(DataFileError, match=r"camera\.pem is not a valid certificate .* signed by .*lowfc certs"):
        hosts.join("camera", network=hosts.network("foreign"))


def test_a_wrong_or_missing_certificate_is_reported_before_a_session_opens(hosts: Hosts) -> None:
    (hosts.folder / "certs" / "viewer.key").unlink()
    with pytest.raises(DataFileError, match=r"viewer\.key cannot be read .No such file.*lowfc certs"):
        hosts.join("viewer")
    for kind in ("pem", "key"):
        (hosts.folder / "certs" / f"recorder.{kind}").replace(hosts.folder / "certs" / f"camera.{kind}")
    with pytest.raises(DataFileError, match=r"camera\.pem is the certificate of 'recorder'.*this process is 'camera'"):
        hosts.join("camera")
    for kind in ("pem", "key"):
        (hosts.folder / "certs" / f"camera.{kind}").replace(hosts.folder / "certs" / f"router.{kind}")
    with pytest.raises(DataFileError, match=r"router\.pem is not a valid certificate"):
        hosts.join(ROUTER)


def test_a_lost_router_is_reported_with_the_reason(hosts: Hosts, capfd: pytest.CaptureFixture[str]) -> None:
    stderr: list[str] = []

    def await_report(text: str) -> None:
        until(lambda: text in "".join(stderr), each=lambda: stderr.append(capfd.readouterr().err))

    router = hosts.join(ROUTER)
    hosts.join("camera")
    until(
        lambda: socket_options(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT).count(routed.LINK_LEASE_MS) == 2
    )  # at both ends of the link
    router.close()
    await_report(f"camera: no link to the router at tls/127.0.0.1:{hosts.port}: Connection refused\n")
    hosts.join(ROUTER)
    await_report("camera: the router is back\n")


def test_an_unknown_host_name_of_the_router_and_a_session_that_does_not_open_are_reported_at_once(
    hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosts.join(ROUTER)
    monkeypatch.setattr(routed, "_ALERT_S", 0.01)
    monkeypatch.setattr("lowfc.adapters.bus.routed.zenoh.open", Mock(side_effect=zenoh.ZError("this and that")))
    with monkeypatch.context() as patch:
        unknown = Mock(side_effect=socket.gaierror(socket.EAI_NONAME, "Name or service not known"))
        patch.setattr("lowfc.adapters.bus.routed.socket.create_connection", unknown)
        with pytest.raises(BusError, match=r"nowhere\.invalid.*cannot be reached .*resolve it"):
            hosts.join("camera", network=hosts.network(host="nowhere.invalid"))
    with pytest.raises(BusError, match="accepts camera's certificate, but zenoh opens no session: this and that"):
        hosts.join("camera")


def test_a_roles_certificate_is_not_accepted_as_the_routers(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    # The router's check of its own certificate is off, as in a program that poses as the router.
    monkeypatch.setattr("lowfc.adapters.bus.zenoh_bus.require_certificate", lambda *_: None)
    folder = hosts.folder / "false"
    folder.mkdir()
    for name, source in (("ca.pem", "ca.pem"), ("router.pem", "camera.pem"), ("router.key", "camera.key")):
        (folder / name).write_bytes((hosts.folder / "certs" / source).read_bytes())
    hosts.join(ROUTER, network=hosts.network("false"))
    monkeypatch.setattr(routed, "CONNECT_MS", 100)
    with pytest.raises(BusError, match="do not accept each other"):
        hosts.join("recorder")


def test_a_run_keeps_the_network_of_its_first_opening(tmp_path: Path) -> None:
    network = Network(router="tls/bench:7447", certificates=str(tmp_path))
    first = open_run("hosts", base=tmp_path, network=network)
    assert first.links.network == network
    for later in (None, Network(), network):
        assert open_run("hosts", base=tmp_path, network=later).links.network == network
    other = Network(router="tls/elsewhere:7447", certificates=str(tmp_path))
    with pytest.raises(BusError, match=r"run 'hosts' is on tls/bench:7447 .* has tls/elsewhere:7447 .* remove its dir"):
        open_run("hosts", base=tmp_path, network=other)
    assert open_run("alone", base=tmp_path).links.network == Network()
    with pytest.raises(BusError, match="run 'alone' is on this host alone, and"):
        open_run("alone", base=tmp_path, network=network)
    open_run("launched", base=tmp_path, listeners=(Role.LAUNCHER,))  # a launcher's run stays on its host
    assert open_run("launched", base=tmp_path, network=network).links.network == Network()


def test_the_router_file_in_deploy_matches_the_table_of_topics(tmp_path: Path) -> None:
    """`lowfc router --show` generates the file, as its header says."""
    file = Path(__file__).parents[2] / "deploy" / "zenoh" / "router.json5"
    text = "".join(line for line in file.read_text().splitlines(keepends=True) if not line.startswith("//"))
    network = Network(router="tls/bench.example.org:7447", certificates="/etc/lowfc/certs")
    links = open_run("hosts", base=tmp_path, network=network).links
    assert json.loads(text) == session_config(links, ROUTER)
