"""The loop across hosts: camera, controller, mirror and desk, each in its own network namespace, and a router.

Links are cut, and programs without a valid certificate try to take part. See docs/howto/hosts.md.
"""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from lowfc.adapters.bus.access import ROUTER, roles
from lowfc.adapters.bus.certificates import make_certificates
from lowfc.adapters.files import calibration_file
from lowfc.contract.configuration import load
from tests.support import networks
from tests.support.loops import STILL
from tests.support.networks import ROUTER_ADDRESS, Host, Lab
from tools.law_bench import calibrated

pytestmark = [
    pytest.mark.slow,
    pytest.mark.exclusive,
    pytest.mark.skipif(not networks.namespaces_permitted(), reason="network namespaces cannot be created here"),
]

RUN = "across"
PORT = 7447
TOML = f"""{STILL}
[realtime]
priority = 0
recorder_priority = 0
disable_cpu_idle = false
[recorder]
min_free_mb = 10
[network]
router = "tls/{ROUTER_ADDRESS}:{PORT}"
certificates = "CERTIFICATES"
"""
SHIFTS_NS = {"camera": 37_000_000, "controller": -250_000_000, "mirror": 3_000_000_000, "desk": -1_000_000}
"""Offset of each host's clock."""
HOST_OF = {"camera": "camera", "controller": "controller", "mirror-dm": "mirror", "recorder": "desk"}
"""Host of each process, except the router."""
SUPPORT = Path(__file__).parents[1] / "support"
ROLES = roles(["mirror-dm"])


def copy_certificates(host: Host, authority: Path, *roles_of_host: str) -> None:
    """Copy the certificates of these roles to a host."""
    folder = host.folder / "certs"
    folder.mkdir(mode=0o700, exist_ok=True)
    for name in ("ca.pem", *(f"{role}.{kind}" for role in roles_of_host for kind in ("pem", "key"))):
        (folder / name).write_bytes((authority / name).read_bytes())


class Bench:
    """The loop on its hosts, and an observer of its messages on the router's host."""

    def __init__(self, folder: Path) -> None:
        self.authority = folder / "authority"
        make_certificates(self.authority, (ROUTER, *ROLES), [ROUTER_ADDRESS])
        (folder / "lowfc.toml").write_text(TOML)
        config = load(folder / "lowfc.toml")
        self.rate_hz, calibration = config.camera.rate_hz, calibrated(config)
        self.lab = Lab(folder, SHIFTS_NS)
        for host in self.lab.hosts.values():
            (host.folder / "lowfc.toml").write_text(TOML.replace("CERTIFICATES", str(host.folder / "certs")))
        calibration_file.save(calibration, self.lab["controller"].folder / "calibration.fits")
        copy_certificates(self.lab.middle, self.authority, ROUTER, "viewer")
        copy_certificates(self.lab["desk"], self.authority, "recorder", "operator", "viewer")
        for name in ("camera", "controller"):
            copy_certificates(self.lab[name], self.authority, name)
        copy_certificates(self.lab["mirror"], self.authority, "mirror-dm")
        self.arguments = {
            "router": ["-m", "lowfc", "router"],
            "camera": ["-m", "sim_camera"],
            "mirror-dm": ["-m", "sim_dm"],
            "controller": ["-m", "lowfc", "controller", "--calibration", "{folder}/calibration.fits"],
            "recorder": ["-m", "lowfc", "record", "--folder", "{folder}/logs"],
        }

    def start(self) -> None:
        for name, host in HOST_OF.items():  # before the router: processes may start in any order
            self.begin(self.lab[host], name)
        self.begin(self.lab.middle, "router")
        config = str(self.lab.middle.folder / "lowfc.toml")
        self.lab.middle.start("observer", str(SUPPORT / "host_observer.py"), RUN, config, "viewer")

    def begin(self, host: Host, name: str) -> None:
        arguments = [argument.format(folder=host.folder) for argument in self.arguments[name]]
        host.start(name, *arguments, "--run", RUN, "--config", str(host.folder / "lowfc.toml"))

    def reports(self) -> list[dict[str, Any]]:
        """Every report of the observer so far, one each tenth of a second."""
        lines = self.lab.middle.stderr("observer").splitlines()
        reports = []
        for line in lines:
            with contextlib.suppress(json.JSONDecodeError):
                reports.append(json.loads(line))
        return reports

    def newest(self) -> dict[str, Any]:
        reports = self.reports()
        return reports[-1] if reports else {"good": 0, "following": 0, "status": "", "events": {}}

    def events(self, name: str) -> int:
        return int(self.newest()["events"].get(name, 0))

    def wait(self, condition: Callable[[], object], what: str, timeout_s: float = 30) -> None:
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            self.check_alive()
            assert time.monotonic() < deadline_s, f"timeout: no {what}: {self.newest()}\n{self.stderr_tail()}"
            time.sleep(0.05)

    def wait_until_settled(self, timeout_s: float = 40) -> None:
        """Wait for more than 30 new steps and as many new mirror states, of which more than the last 20 are good."""
        start = len(self.reports())

        def good() -> bool:
            new = self.reports()[start:]
            received = all(sum(report[what] for report in new) > 30 for what in ("steps", "states"))
            return received and new[-1]["good"] > 20 and new[-1]["following"] > 20

        self.wait(good, "closed loop", timeout_s)

    def check_alive(self) -> None:
        for host in self.lab.hosts.values():
            for name, child in host.children.items():
                assert child.status is None, f"{name} on {host.name} ended: {host.stderr(name)}"

    def stderr_tail(self) -> str:
        processes = [(host, name) for host in self.lab.hosts.values() for name in host.children if name != "observer"]
        return "\n".join(f"{name}: {host.stderr(name)[-400:]}" for host, name in processes)


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    bench = Bench(tmp_path_factory.mktemp("hosts"))
    try:
        bench.start()
        bench.wait_until_settled(60)
        yield bench
    finally:
        bench.lab.close()


@pytest.fixture
def bench(started: Bench) -> Bench:
    """The bench, once its loop has settled after the previous test."""
    started.wait_until_settled()
    return started


def test_a_host_has_its_own_network_from_the_start(tmp_path: Path) -> None:
    for number in range(20):
        host = Host(f"host{number}", "", tmp_path)
        namespaces = {Path(f"/proc/{process}/ns/net").readlink() for process in ("self", host.holder.pid)}
        host.close()
        assert len(namespaces) == 2


def clock_offset_ns(host: Host) -> int:
    """The offset that a host adds to the monotonic clock, which all hosts share here, to get nanoseconds since 1970."""
    return int(next((host.folder / "runtime" / "lowfc").glob("clock-*")).read_text())


def test_clock_offsets_are_measured_and_requests_and_a_view_work_from_another_host(bench: Bench) -> None:
    desk = bench.lab["desk"]
    done = desk.run("-m", "lowfc", "hosts", "--run", RUN, "--json")
    assert done.returncode == 0, done.stderr
    rows = {row["process"]: row for row in json.loads(done.stdout)["processes"]}
    assert {*HOST_OF, ROUTER} <= set(rows)
    for process, host in HOST_OF.items():
        truth_us = (clock_offset_ns(bench.lab.middle) - clock_offset_ns(bench.lab[host])) / 1e3
        assert rows[process]["clock_error_us"] > 0
        assert abs(rows[process]["clock_offset_us"] - truth_us) <= rows[process]["clock_error_us"] + 0.001
    done = desk.run("-m", "lowfc", "ctl", "open", "--run", RUN)
    assert done.returncode == 0, done.stderr
    bench.wait(lambda: bench.newest()["good"] == 0, "open loop")
    assert desk.run("-m", "lowfc", "ctl", "close", "--run", RUN).returncode == 0
    bench.wait_until_settled()
    view = desk.run("-m", "lowfc", "view", "--run", RUN, "--save", "seen.rrd", "--seconds", "2", timeout_s=90)
    assert view.returncode == 0, view.stderr
    assert (desk.folder / "seen.rrd").stat().st_size > 10_000


def test_a_log_of_several_hosts_states_the_clock_error_of_its_latencies(bench: Bench) -> None:
    desk = bench.lab["desk"]
    done = desk.run("-m", "lowfc", "ctl", "record", "stop", "--run", RUN)
    assert done.returncode == 0, done.stderr
    log = next(path for path in (desk.folder / "logs").iterdir() if path.suffix == ".mcap")
    done = desk.run("-m", "lowfc", "latency", str(log), "--json", timeout_s=90)
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    bound_us = results["host"]["clock_error_us"]
    assert bound_us > 0
    # By the hosts' own clocks, frames would arrive 287 ms before they are sent, and the mirror would move 3 s late.
    for span in ("frame_to_command", "frame_to_mirror", "command_to_mirror"):
        assert -bound_us < results["latency_us"][span]["p50"] < 100_000
    text = desk.run("-m", "lowfc", "latency", str(log), timeout_s=90)
    assert "on several hosts, with the measured offsets of their clocks" in text.stdout + text.stderr
    assert desk.run("-m", "lowfc", "ctl", "record", "start", "--run", RUN).returncode == 0


def test_without_the_cameras_link_the_command_is_held_and_repeated(bench: Bench) -> None:
    before = bench.events("controller NO_FRAMES")
    with bench.lab.cut("camera"):
        bench.wait(lambda: bench.events("controller NO_FRAMES") > before, "NO_FRAMES")
        start = len(bench.reports())
        bench.wait(lambda: len(bench.reports()) > start + 15, "output of a second and a half")
        during = bench.reports()[start + 5 :]
        # the controller repeats the held command, so that it does not expire at the mirror
        assert all(report["steps"] == 0 for report in during)
        assert all(report["status"] == "MIRROR_STATUS_FOLLOWING" for report in during)
        heights_nm = {round(report["highest_nm"], 3) for report in during}
        assert len(heights_nm) == 1, heights_nm
    bench.wait_until_settled()
    assert bench.events("controller FRAMES_BACK") > 0


def test_without_the_mirrors_link_its_command_timeout_acts(bench: Bench) -> None:
    mirror = bench.lab["mirror"]
    before = mirror.stderr("mirror-dm").count("COMMAND_EXPIRED")
    with bench.lab.cut("mirror"):
        bench.wait(lambda: mirror.stderr("mirror-dm").count("COMMAND_EXPIRED") > before, "COMMAND_EXPIRED")
        assert "relaxing to flat" in mirror.stderr("mirror-dm")
        start = len(bench.reports())
        bench.wait(lambda: len(bench.reports()) > start + 10, "output of a second")
        assert sum(report["states"] for report in bench.reports()[start + 5 :]) == 0
    bench.wait_until_settled()


def test_without_the_controllers_link_the_mirror_relaxes_and_the_controller_holds(bench: Bench) -> None:
    controller = bench.lab["controller"]
    before = controller.stderr("controller").count("NO_FRAMES"), bench.events("mirror-dm COMMAND_EXPIRED")
    with bench.lab.cut("controller"):
        bench.wait(lambda: bench.events("mirror-dm COMMAND_EXPIRED") > before[1], "COMMAND_EXPIRED")
        bench.wait(lambda: controller.stderr("controller").count("NO_FRAMES") > before[0], "NO_FRAMES")
        bench.wait(lambda: bench.newest()["highest_nm"] < 0.1, "flat mirror")
        assert bench.newest()["status"] == "MIRROR_STATUS_EXPIRED"
    bench.wait_until_settled()


def test_without_the_desks_link_the_loop_continues(bench: Bench) -> None:
    events = ("controller NO_FRAMES", "mirror-dm COMMAND_EXPIRED")
    before, lost = [bench.events(name) for name in events], bench.events("recorder MESSAGES_LOST")
    start = len(bench.reports())
    with bench.lab.cut("desk"):
        bench.wait(lambda: len(bench.reports()) > start + 40, "output of four seconds")
        assert [bench.events(name) for name in events] == before
        during = bench.reports()[start:]
        assert sum(report["steps"] for report in during) > 0.8 * 4 * bench.rate_hz
        assert sum("FOLLOWING" in report["status"] for report in during) > 0.9 * len(during)
    bench.wait(lambda: bench.events("recorder MESSAGES_LOST") > lost, "report of the recorder's losses")
    bench.wait_until_settled()


def test_the_loop_recovers_after_a_restart_of_the_router(bench: Bench) -> None:
    router = bench.lab.middle.children.pop("router")
    router.process.kill()
    router.stop(5.0)
    bench.begin(bench.lab.middle, "router")
    bench.wait_until_settled()


FORGER = """
import sys, time
import zenoh
from lowfc.contract.envelope import Envelope
from lowfc.contract.messages import timestamp, wire

try:
    session = zenoh.open(zenoh.Config.from_json5(open(sys.argv[1]).read()))
except zenoh.ZError:
    print("refused")
    sys.exit()
received, answers = set(), set()
for key in ("**", "lowfc/**", "lowfc/mirror/dm/command", "lowfc/camera/frame", "lowfc/control/step", "lowfc/event"):
    session.declare_subscriber(
        key, lambda sample: received.add(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
    )
command = wire.MirrorCommand(
    timestamp=timestamp(time.time_ns()), frame_sequence=2**62, channel="forged", valid_for_ns=10**9, rows=34,
    columns=34, actuators=b"\\x00\\x00\\xc8\\x42" * 34 * 34,
)
for _ in range(100):
    attachment = Envelope(2**62, time.time_ns()).encode()
    session.put("lowfc/mirror/dm/command", command.SerializeToString(), attachment=attachment)
    time.sleep(0.01)
for key in ("lowfc/request/status", "lowfc/request/safe", "lowfc/record/stop", "@/*/router/**"):
    answers |= {str(reply.ok.key_expr) for reply in session.get(key, timeout=1.0) if reply.ok is not None}
print(sorted(received), sorted(answers))
session.close()
"""


def forge(host: Host, certificate: Path | None, protocol: str = "tls") -> str:
    """Publish forged commands in a separate session; return received topics and answered queries, or `refused`."""
    tls = {"root_ca_certificate": str(host.folder / "certs" / "ca.pem"), "enable_mtls": True}
    if certificate is not None:
        tls |= {
            "connect_certificate": str(certificate.with_suffix(".pem")),
            "connect_private_key": str(certificate.with_suffix(".key")),
        }
    endpoints = [f"{protocol}/{ROUTER_ADDRESS}:{PORT}"]
    config = {
        "mode": "client",
        "connect": {"endpoints": endpoints, "timeout_ms": 3000, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": {"tls": tls}},
    }
    file = host.folder / "forger.json5"
    file.write_text(json.dumps(config))
    done = host.run("-c", FORGER, str(file))
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_forged_command_with_the_controllers_certificate_reaches_the_mirror(bench: Bench) -> None:
    """The router lets this role's commands through, so the next test would detect a forged command that passes."""
    copy_certificates(bench.lab["desk"], bench.authority, "controller")
    before = bench.events("mirror-dm COMMAND_REFUSED")
    forge(bench.lab["desk"], bench.lab["desk"].folder / "certs" / "controller")
    bench.wait(
        lambda: (
            bench.events("mirror-dm COMMAND_REFUSED") > before
            or any(report["highest_nm"] > 90 for report in bench.reports()[-30:])
        ),
        "forged command at the mirror",
    )
    mirror = bench.lab["mirror"]
    mirror.children.pop("mirror-dm").stop(5.0)  # otherwise it waits for a frame later than the forged command's
    bench.begin(mirror, "mirror-dm")
    bench.wait_until_settled()


def test_a_forger_receives_no_message_and_no_answer_and_moves_no_mirror(bench: Bench, tmp_path: Path) -> None:
    """A forger has a certificate of another role, of no known role or of a foreign authority, or none, or no TLS."""
    camera, desk = bench.lab["camera"], bench.lab["desk"]
    make_certificates(bench.authority, ["stranger"], [])
    make_certificates(tmp_path, ROLES, [])
    copy_certificates(desk, bench.authority, "stranger")
    before = bench.events("mirror-dm COMMAND_REFUSED")
    start = len(bench.reports())
    assert forge(camera, camera.folder / "certs" / "camera") in ("[] []", "['lowfc/event'] []")  # events are public
    assert forge(desk, desk.folder / "certs" / "stranger") == "[] []"
    for certificate, protocol in ((tmp_path / "controller", "tls"), (None, "tls"), (None, "tcp")):
        assert forge(desk, certificate, protocol) == "refused"
    reports = bench.reports()[start:]
    assert len(reports) > 3
    assert all(report["highest_nm"] < 50 for report in reports)
    assert bench.events("mirror-dm COMMAND_REFUSED") == before
    bench.wait_until_settled()
