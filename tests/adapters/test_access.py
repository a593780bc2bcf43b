"""Who may do what at the router: by the table of topics, and by a real router on loopback."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

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
from tests.support.loops import until

certificates = pytest.importorskip("lowfc.adapters.bus.certificates", reason="needs the package cryptography")
ROLES = roles(["mirror-dm"])


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
def test_who_publishes_and_who_receives_is_what_the_table_says(topic: Topic) -> None:
    key = {role: topic.at(role if topic is HEALTH else "dm") for role in ROLES}
    may_put = {role for role in ROLES if _covers(grant(role).publishes, key[role])}
    assert may_put == {role for role in ROLES if Role(role.partition("-")[0]) in topic.publisher}
    may_hear = {role for role in ROLES if _covers(grant(role).receives, key[role])}
    said = {role for role in ROLES if Role(role.partition("-")[0]) in topic.subscribers}
    assert may_hear == said | ({"operator"} if "viewer" in said else set())


def _covers(keys: tuple[str, ...], key: str) -> bool:
    parts = key.split("/")
    return any(
        len(words := one.split("/")) == len(parts)
        and all(word in ("*", part) for word, part in zip(words, parts, strict=True))
        for one in keys
    )


def test_a_process_publishes_in_its_own_name_only_and_requests_are_an_operators() -> None:
    own = {"lowfc/mirror/dm/state", "lowfc/mirror/dm/surface", "lowfc/event", "lowfc/health/mirror-dm"}
    assert set(grant("mirror-dm").publishes) == own
    for role in ROLES:
        wild = {key for key in grant(role).publishes if "*" in key}
        bench = {"lowfc/bench/*"} if role in ("bench", "operator") else set()
        assert wild == (bench if role != "controller" else {"lowfc/mirror/*/command"})
        asks = {key for key in grant(role).queries if "request" in key or "record" in key}
        assert asks == ({"lowfc/request/*", "lowfc/record/*"} if role == "operator" else set())
        assert CLOCK_KEY in grant(role).queries
    assert "lowfc/request/*" in grant("controller").answers
    assert "lowfc/record/*" in grant("recorder").answers


def test_all_that_is_not_allowed_is_denied_and_every_name_is_there() -> None:
    """Zenoh opens with a policy of rules or subjects that are not there, and does without them."""
    control = access_control(["mirror-dm", "mirror-tip"])
    assert control["enabled"]
    assert control["default_permission"] == "deny"
    rules, subjects = ({one["id"]: one for one in control[name]} for name in ("rules", "subjects"))
    assert len(rules) == len(control["rules"])
    assert all(rule["permission"] == "allow" for rule in rules.values())
    assert {"mirror-dm", "mirror-tip"} <= set(subjects)
    assert all(one["cert_common_names"] == [name] for name, one in subjects.items())
    for policy in control["policies"]:
        assert set(policy["rules"]) <= set(rules)
        assert set(policy["subjects"]) <= set(subjects)
    assert sorted(name for policy in control["policies"] for name in policy["rules"]) == sorted(rules)


def test_the_best_exchange_is_the_quickest_of_the_recent_ones() -> None:
    offset = ClockOffset()
    assert offset.offset_ns == 0
    offset.exchanged(1000, 5600, 2000)  # slow on one way: 4100 rather than 4000
    assert offset.best == (4100, 1000)
    offset.exchanged(3000, 7050, 3100)
    assert offset.best == (4000, 100)
    for _ in range(RECENT):
        offset.exchanged(5000, 9300, 5600)
    assert offset.best == (4000, 600)


class Hosts:
    """A router and buses by it, each as on a host of its own, all on loopback."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_ports(1)[0]
        self.buses: list[ZenohBus] = []
        self.count = 0
        certificates.make_certificates(folder / "certs", (ROUTER, *ROLES), ["127.0.0.1", "localhost"])

    def network(self, certs: str = "certs", host: str = "127.0.0.1") -> Network:
        return Network(router=f"tls/{host}:{self.port}", certificates=str(self.folder / certs))

    def join(self, role: str, shift_ns: int = 0, network: Network | None = None) -> ZenohBus:
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
    made = Hosts(tmp_path)
    yield made
    for bus in reversed(made.buses):
        bus.close()


def test_what_the_table_allows_arrives_or_is_answered_and_nothing_else(hosts: Hosts) -> None:
    hosts.join(ROUTER)
    bus = {role: hosts.join(role) for role in ROLES}
    heard: set[tuple[str, str, str]] = set()  # who, what, from whom

    def hear(role: str) -> Callable[[Sample], None]:
        return lambda sample: heard.add((role, sample.key, sample.payload.decode()))

    topics = (FRAME, CAMERA_STATE, STEP, COMMAND, MIRROR_STATE, CALIBRATION, EVENT)
    for role in ROLES:
        for topic in topics:
            bus[role].subscribe(topic, hear(role), "dm" if role == "mirror-dm" else "*")
    publishers = [bus[role].publisher(topic, "dm") for role in ROLES for topic in topics]
    roles_of = [role for role in ROLES for _ in topics]

    def allowed(role: str, topic: Topic, by: str) -> bool:
        key = topic.at("dm")
        return _covers(grant(role).receives, key) and _covers(grant(by).publishes, key)

    wanted = {
        (role, topic.at("dm"), by)
        for role in ROLES
        for topic in topics
        for by in ROLES
        if role != by and allowed(role, topic, by)
    }
    assert len(wanted) > 30

    def all_there() -> bool:
        for publisher, by in zip(publishers, roles_of, strict=True):
            publisher.put(by.encode())
        return wanted <= heard

    until(all_there)
    time.sleep(0.2)
    assert {one for one in heard if one[0] != one[2]} == wanted  # what one puts oneself one hears at home
    bus["controller"].queryable("lowfc/request/*", lambda query: query.reply(b"done"))
    bus["camera"].queryable("lowfc/request/*", lambda query: query.reply(b"forged"))
    until(lambda: bus["operator"].get("lowfc/request/status"))
    for role in ROLES:
        if role not in ("controller", "camera"):  # who answers a key is asked at home, too
            answers = [sample.payload for sample in bus[role].get("lowfc/request/status")]
            assert answers == ([b"done"] if role == "operator" else [])
        states = {sample.payload.decode() for sample in bus[role].get("lowfc/camera/state")}
        assert states | {role} == {"camera", role}  # its own it gets at home
        assert "camera" in states


def test_times_are_those_of_the_host_that_receives(hosts: Hosts) -> None:
    second_ns = 1_000_000_000
    hosts.join(ROUTER)
    camera, recorder = hosts.join("camera", 3 * second_ns), hosts.join("recorder", -7 * second_ns)
    arrived: list[Sample] = []
    recorder.subscribe(FRAME, arrived.append)
    frames = camera.publisher(FRAME)

    def received() -> bool:
        frames.put(b"frame")
        return len(arrived) > 3

    until(received)
    for bus, shift_ns in ((camera, 3 * second_ns), (recorder, -7 * second_ns)):
        assert bus.offset.best is not None
        assert abs(bus.offset.offset_ns + shift_ns) < second_ns  # exactly: tests/e2e/test_hosts.py
    assert all(abs(sample.receive_time_ns - sample.publish_time_ns) < second_ns for sample in arrived)
    assert Service("camera", "hosts", camera.clock, camera).health().router_round_trip_ns > 0


def test_there_is_one_of_each_role(hosts: Hosts) -> None:
    hosts.join(ROUTER)
    hosts.join("camera").publisher(HEALTH, "camera").put(b"here")
    with pytest.raises(BusError, match="run 'hosts' has a camera already, on this host or another"):
        hosts.join("camera")
    hosts.join("operator").publisher(HEALTH, "operator").put(b"here")
    hosts.join("operator")  # of those who only connect there may be several


def test_a_foreign_certificate_is_told_so(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    hosts.join(ROUTER)
    monkeypatch.setattr(routed, "CONNECT_MS", 100)
    certificates.make_certificates(hosts.folder / "foreign", ("camera",), [])
    others = hosts.folder / "foreign"
    with pytest.raises(BusError, match=r"do not accept each other .CERTIFICATE_VERIFY_FAILED"):
        hosts.join("camera", network=hosts.network("foreign"))
    (others / "ca.pem").write_bytes((hosts.folder / "certs" / "ca.pem").read_bytes())
    with pytest.raises(DataFileError, match=r"camera\.pem is not a valid certificate .* signed by .*lowfc certs"):
        hosts.join("camera", network=hosts.network("foreign"))


def test_a_wrong_or_missing_certificate_is_named_before_a_session_is_opened(hosts: Hosts) -> None:
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


def test_a_process_that_loses_its_router_says_why(hosts: Hosts, capfd: pytest.CaptureFixture[str]) -> None:
    said = ""

    def told(text: str) -> Callable[[], bool]:
        def look() -> bool:
            nonlocal said
            said += capfd.readouterr().err
            return text in said

        return look

    router = hosts.join(ROUTER)
    hosts.join("camera")
    router.close()
    until(told(f"camera: no link to the router at tls/127.0.0.1:{hosts.port}: Connection refused\n"))
    hosts.join(ROUTER)
    until(told("camera: the router is back\n"))


def test_a_router_is_not_waited_for_where_that_does_not_help(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    def refuse(config: object) -> None:
        raise zenoh.ZError("this and that")

    hosts.join(ROUTER)
    monkeypatch.setattr(routed, "_ALERT_S", 0.01)
    monkeypatch.setattr("lowfc.adapters.bus.routed.zenoh.open", refuse)
    with monkeypatch.context() as patch:
        patch.setattr("lowfc.adapters.bus.routed.socket.create_connection", unknown)
        with pytest.raises(BusError, match=r"nowhere\.invalid.*cannot be reached .*resolve it"):
            hosts.join("camera", network=hosts.network(host="nowhere.invalid"))
    with pytest.raises(BusError, match="accepts camera's certificate, but zenoh opens no session: this and that"):
        hosts.join("camera")


def test_a_role_does_not_pass_for_the_router(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lowfc.adapters.bus.zenoh_bus.require_certificate", lambda *_: None)  # as in a router of theirs
    folder = hosts.folder / "false"
    folder.mkdir()
    for name, source in (("ca.pem", "ca.pem"), ("router.pem", "camera.pem"), ("router.key", "camera.key")):
        (folder / name).write_bytes((hosts.folder / "certs" / source).read_bytes())
    hosts.join(ROUTER, network=hosts.network("false"))
    monkeypatch.setattr(routed, "CONNECT_MS", 100)
    with pytest.raises(BusError, match="do not accept each other"):
        hosts.join("recorder")


def test_a_run_remembers_its_way(tmp_path: Path) -> None:
    way = Network(router="tls/bench:7447", certificates=str(tmp_path))
    made = open_run("hosts", base=tmp_path, network=way)
    assert made.links.network == way
    for later in (None, Network(), way):
        assert open_run("hosts", base=tmp_path, network=later).links.network == way
    other = Network(router="tls/elsewhere:7447", certificates=str(tmp_path))
    with pytest.raises(BusError, match=r"run 'hosts' is on tls/bench:7447 .* has tls/elsewhere:7447 .* remove its dir"):
        open_run("hosts", base=tmp_path, network=other)
    assert open_run("alone", base=tmp_path).links.network == Network()
    with pytest.raises(BusError, match="run 'alone' is on this host alone"):
        open_run("alone", base=tmp_path, network=way)
    open_run("launched", base=tmp_path, listeners=(Role.LAUNCHER,))  # stays on its host
    assert open_run("launched", base=tmp_path, network=way).links.network == Network()


@pytest.mark.parametrize("router", ["tcp/bench:7447", "tls/bench", "bench:7447", "tls/:7447x"])
def test_a_router_is_a_tls_endpoint_with_certificates(router: str) -> None:
    with pytest.raises(ValueError, match="router"):
        Network(router=router, certificates="certs")
    with pytest.raises(ValueError, match="certificates: a folder is needed"):
        Network(router="tls/bench:7447")
    assert Network(router="tls/[fe80::1]:7447", certificates="certs").address == ("fe80::1", 7447)


def test_the_routers_file_in_deploy_is_the_one_of_the_table(tmp_path: Path) -> None:
    """Made by `lowfc router --show`; see the file's head."""
    file = Path(__file__).parents[2] / "deploy" / "zenoh" / "router.json5"
    text = "".join(line for line in file.read_text().splitlines(keepends=True) if not line.startswith("//"))
    way = Network(router="tls/bench.example.org:7447", certificates="/etc/lowfc/certs")
    links = open_run("hosts", base=tmp_path, network=way).links
    assert json.loads(text) == session_config(links, ROUTER)
