"""Files in deploy: valid systemd units, containers, and processes that report to their supervisor.

One test starts the processes as their units do, with its own socket in place of systemd's.
"""

import contextlib
import itertools
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest
import typer
import yaml

from lowfc.adapters.bus.run import DEFAULT_RUN, open_run
from lowfc.adapters.process.latch import latch_files
from lowfc.adapters.process.realtime import _LATENCY_DEVICE
from lowfc.adapters.process.supervision import Supervisor, status_line
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.messages import wire
from lowfc.programs.cli.config import commented
from lowfc.programs.core.controller import MIRROR_PATIENCE_S
from sim_camera.driver import PATIENCE_S
from tests.support.loops import until

DEPLOY = Path(__file__).parents[2] / "deploy"
UNITS = sorted(path.name for path in (DEPLOY / "systemd").glob("*.service"))
LOOP = ("lowfc-controller.service", "lowfc-sim-camera.service", "lowfc-sim-mirror.service")
COMMON = "lowfc-.service.d/10-common.conf"
INSTALLED = "/opt/lowfc/bin/"
CONFIGURED = "/etc/lowfc/lowfc.toml"
MAX_EXPOSURE_SCORE = 2.0
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")


def settings(name: str) -> dict[str, list[str]]:
    """Every value of every key of a unit and of the common drop-in, in order."""
    found = defaultdict(list)
    for line in "\n".join((DEPLOY / "systemd" / file).read_text() for file in (name, COMMON)).splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found[key].append(value)
    return found


def processors(name: str) -> set[int]:
    """Processors of a unit on a host with sixteen processors."""
    (affinity,) = settings(name)["CPUAffinity"]
    ends = [[int(end) for end in span.split("-")] for span in affinity.split()]
    return {cpu for first, *last in ends for cpu in range(first, max([first, *last]) + 1) if cpu < 16}


def command(name: str) -> list[str]:
    """Command of a unit, without path and calibration."""
    (line,) = settings(name)["ExecStart"]
    assert line.startswith(INSTALLED)
    return line.removeprefix(INSTALLED).replace("$CALIBRATION", "").split()


def program(arguments: list[str]) -> str:
    """Name of the program in a command line; typer ends the test on an unknown option."""
    import sim_camera.__main__ as camera
    import sim_dm.__main__ as mirror
    from lowfc.programs.cli import main

    apps = {"lowfc": main.app, "sim-camera": camera.app, "sim-dm": mirror.app}
    with typer.main.get_command(apps[arguments[0]]).make_context(arguments[0], arguments[1:]) as context:
        if arguments[0] != "lowfc":
            return arguments[0]
        name, part, rest = context.command.resolve_command(context, [*context._protected_args, *context.args])
        part.make_context(name, rest, parent=context).close()
        return str(name)


@pytest.fixture
def units(tmp_path: Path) -> Path:
    """The units with the paths of the programs installed here."""
    folder = tmp_path / "units" / "systemd"
    shutil.copytree(DEPLOY / "systemd", folder)
    for path in folder.glob("*.service"):
        path.write_text(path.read_text().replace(INSTALLED, f"{Path(sys.executable).parent}/"))
    return folder


def analyze(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(["systemd-analyze", *arguments], cwd=folder, capture_output=True, text=True, check=False)


def exposure_score(folder: Path, name: str) -> float:
    """Score of a unit in `systemd-analyze security`, 0 (safe) to 10."""
    done = analyze(folder, "security", "--offline=yes", "--no-pager", name)
    return float(re.search(rf"exposure level for {name}: ([\d.]+)", done.stdout)[1])


@needs_systemd
def test_systemd_accepts_the_units(units: Path) -> None:
    verify = ("verify", "--man=no", "--generators=no", "--recursive-errors=yes")
    names = [*UNITS, "lowfc.target"]
    done = analyze(units, *verify, *names)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    common = units / COMMON
    common.write_text(common.read_text().replace("ProtectSystem=", "ProtectSystme="))
    assert "ProtectSystme" in analyze(units, *verify, *names).stderr, "a misspelt key is reported"


@needs_systemd
def test_the_units_are_hardened(units: Path, tmp_path: Path) -> None:
    scores = {name: exposure_score(units, name) for name in UNITS}
    assert max(scores.values()) < MAX_EXPOSURE_SCORE, scores
    shutil.copy(units / UNITS[0], tmp_path)
    assert exposure_score(tmp_path, UNITS[0]) > 3 * MAX_EXPOSURE_SCORE  # without the common drop-in


@needs_systemd
def test_the_user_and_the_folders_of_the_services_are_created(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    for tool in (["systemd-sysusers"], ["systemd-tmpfiles", "--create"]):
        kind = tool[0].removeprefix("systemd-")
        done = subprocess.run(
            [*tool, f"--root={tmp_path}", DEPLOY / f"{kind}.d" / "lowfc.conf"],
            capture_output=True,
            text=True,
            check=False,
        )
        if os.geteuid() == 0:  # only root may change owners
            assert done.returncode == 0, done.stderr
    (line,) = (tmp_path / "etc" / "passwd").read_text().splitlines()
    name, _, number, _, _, home, shell = line.split(":")
    assert (name, home, Path(shell).name) == ("lowfc", "/var/lib/lowfc", "nologin")
    modes = {"run/lowfc": 0o700, "var/lib/lowfc": 0o750, "etc/lowfc": 0o755}
    assert {path: (tmp_path / path).stat().st_mode & 0o777 for path in modes} == modes
    if os.geteuid() == 0:
        owners = [(tmp_path / path).stat().st_uid for path in modes]
        assert owners == [int(number), int(number), 0]


def test_the_units_match_the_programs_and_the_configuration() -> None:
    realtime = Configuration().realtime
    programs = ["controller", "record", "router", "sim-camera", "sim-dm", "view"]
    assert sorted(program(command(name)) for name in UNITS) == programs
    for name in UNITS:
        unit = settings(name)
        assert unit["Type"] == ["notify"]
        assert unit["Restart"] == ["on-failure"]
        assert unit["After"][-1] == "network.target time-sync.target"
        is_controller = command(name)[:2] == ["lowfc", "controller"]  # compiles the fused step, if configured
        assert ("MemoryDenyWriteExecute" in unit) != is_controller
        assert f"NUMBA_CACHE_DIR=/var/cache/{unit['CacheDirectory'][0]}/numba" in unit["Environment"]
        assert unit["WantedBy"] == unit["PartOf"] == ["lowfc.target"]
        priority = {"lowfc-recorder.service": realtime.recorder_priority, "lowfc-viewer.service": 0}.get(
            name, realtime.priority
        )
        assert unit["LimitRTPRIO"] == ([str(priority)] if priority else [])
        assert ("RestrictRealtime" in unit) == (priority == 0)
        assert unit["DeviceAllow"] == ([f"{_LATENCY_DEVICE} w"] if priority == realtime.priority else [])
        others = [processors(other) for other in LOOP if other != name]
        assert all(processors(name).isdisjoint(other) for other in others)
        assert len(processors(name)) == 1 or name not in LOOP
    assert Path(_LATENCY_DEVICE).name in (DEPLOY / "udev" / "70-lowfc.rules").read_text()
    # The router starts first and stops last, so that the recorder receives the end of the run.
    after_router = " ".join(settings("lowfc-router.service")["Before"]).split()
    assert {*after_router, "lowfc-router.service"} == set(UNITS)
    # The longest waits of controller and camera must not trigger the watchdog.
    assert float(settings("lowfc-controller.service")["WatchdogSec"][0]) > MIRROR_PATIENCE_S
    assert float(settings("lowfc-sim-camera.service")["WatchdogSec"][0]) > PATIENCE_S


def test_the_readme_of_deploy_names_the_files_of_the_latch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runtime, state = tmp_path / "run", tmp_path / "state"
    runtime.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    monkeypatch.setenv("STATE_DIRECTORY", str(state))  # as systemd sets it for the controller
    first, second = latch_files(open_run(DEFAULT_RUN))
    text = (DEPLOY / "README.md").read_text()
    assert f"`/run/lowfc/{first.relative_to(runtime)}`" in text
    assert f"`/var/lib/lowfc/{second.relative_to(state)}`" in text


def test_the_documented_commands_install_every_file(tmp_path: Path) -> None:
    lines = re.findall(r"^    sudo (install .*)$", (DEPLOY / "README.md").read_text(), re.MULTILINE)
    (tmp_path / "lowfc").mkdir()
    for line in lines:
        subprocess.run(["bash", "-ec", line.replace(" /etc/", f" {tmp_path}/")], cwd=DEPLOY, check=True)
    installed = {path.relative_to(tmp_path).as_posix(): path.read_text() for path in files_in(tmp_path)}
    expected = {f"systemd/system/{path.relative_to(DEPLOY / 'systemd')}": path for path in files_in(DEPLOY / "systemd")}
    expected |= {f"{kind}/lowfc.conf": DEPLOY / kind / "lowfc.conf" for kind in ("sysusers.d", "tmpfiles.d")}
    expected |= {
        "udev/rules.d/70-lowfc.rules": DEPLOY / "udev/70-lowfc.rules",
        "lowfc/lowfc.toml": DEPLOY / "lowfc.toml",
    }
    assert installed == {name: path.read_text() for name, path in expected.items()}


def files_in(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_the_shipped_configuration_file_has_the_defaults() -> None:
    shipped = DEPLOY / "lowfc.toml"
    advice = "lowfc config show > deploy/lowfc.toml"
    assert shipped.read_text() == commented(Configuration()) + "\n", advice
    assert load(shipped) == Configuration()
    lines = shipped.read_text().splitlines()
    keys = re.compile(r"#?[a-z_]+ = ")
    assert all(before.startswith("# ") for before, line in itertools.pairwise(lines) if keys.match(line))


def test_the_containers_run_the_commands_of_the_units() -> None:
    services = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    for name, service in services.items():
        unit = f"lowfc-{f'sim-{name}' if name in ('camera', 'mirror') else name}.service"
        assert service["command"] == command(unit)
        assert program(service["command"])
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["read_only"]
        assert "ports" not in service
        assert "privileged" not in service
        assert set(map(int, service["cpuset"].split(","))) <= processors(unit)
        assert [str(service.get("ulimits", {}).get("rtprio", ""))] == (settings(unit)["LimitRTPRIO"] or [""])
        assert f"./lowfc.toml:{CONFIGURED}:ro" in service["volumes"]
    assert len(services) == len(UNITS) - 1  # all except the router
    assert program(services["controller"]["healthcheck"]["test"][1:]) == "ctl"
    for name in ("controller", "recorder"):  # for latch and logs, because the root is read-only
        assert any(volume.endswith(":/var/lib/lowfc") for volume in services[name]["volumes"])
    containerfile = (DEPLOY / "Containerfile").read_text()
    last_stage = containerfile.rpartition("\nFROM ")[2]
    assert re.search(r"^USER [1-9]\d*:[1-9]\d*$", last_stage, re.MULTILINE)
    images = re.findall(r"^FROM (\S+)", containerfile, re.MULTILINE)
    assert all(":" in image and "latest" not in image for image in images)
    for sources in re.findall(r"^COPY (?!--)(.+) \S+$", containerfile, re.MULTILINE):
        assert all((DEPLOY.parent / source).exists() or source == "build/dist/" for source in sources.split())


class Manager:
    """Stand-in for systemd: receives a process's notifications; the short queue of its socket may drop some."""

    def __init__(self, path: Path, watchdog_s: float) -> None:
        self.environment = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": str(round(watchdog_s * 1e6))}
        self.begun_s = time.monotonic()
        self._received: list[str] = []
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))
        self.socket.setblocking(False)

    @property
    def notifications(self) -> list[str]:
        with contextlib.suppress(BlockingIOError):
            while True:
                self._received.append(self.socket.recv(4096).decode())
        return self._received

    @property
    def beats(self) -> int:
        return self.notifications.count("WATCHDOG=1")

    def status(self) -> str:
        statuses = [line.removeprefix("STATUS=") for line in self.notifications if line.startswith("STATUS=")]
        return statuses[-1] if statuses else ""


WATCHDOG_S = 0.2
HANGING = """
import os, sys, time
import lowfc.programs.core.controller as process
from lowfc.__main__ import main
advance = process.advance
def advance_or_hang(*arguments):
    while os.path.exists(HANGS):
        time.sleep(1)
    return advance(*arguments)
process.advance = advance_or_hang
main()
"""
"""A controller whose step does not return while a file exists."""


class Supervised:
    """A process started as by its unit, with a stand-in for systemd."""

    def __init__(self, name: str, folder: Path) -> None:
        unit = f"lowfc-{name}.service"
        self.name = name
        self.manager = Manager(folder / f"{name}.notify", WATCHDOG_S)
        program, *arguments = [str(DEPLOY / "lowfc.toml") if word == CONFIGURED else word for word in command(unit)]
        arguments += ["--run", "supervised"]
        start = [str(Path(sys.executable).parent / program)]
        if name == "controller":
            start = [sys.executable, "-c", HANGING.replace("HANGS", repr(str(folder / "hang")))]
        self.stderr_file = folder / f"{name}.stderr"
        with self.stderr_file.open("wb") as stderr:
            environment = os.environ | self.manager.environment | {"PYTHONFAULTHANDLER": "1"}
            self.process = subprocess.Popen([*start, *arguments], cwd=folder, stderr=stderr, env=environment)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.manager.socket.close()


@pytest.mark.exclusive
def test_processes_notify_systemd_that_they_are_ready_alive_and_stopping(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        names = ("recorder", "sim-mirror", "controller", "sim-camera")
        processes = {name: stack.enter_context(contextlib.closing(Supervised(name, tmp_path))) for name in names}
        for child in processes.values():
            until(lambda child=child: "READY=1" in child.manager.notifications and child.manager.beats > 5)
            # One WATCHDOG=1 per half of the timeout, as systemd advises; two more are tolerated.
            most_beats = (time.monotonic() - child.manager.begun_s) / (WATCHDOG_S / 2) + 2
            assert child.manager.beats <= most_beats, f"{child.name} sends WATCHDOG=1 only as often as needed"
        controller, mirror = processes["controller"], processes["sim-mirror"]
        until(lambda: re.fullmatch(r"running, open, \d+ Hz", controller.manager.status()))

        def quiet() -> bool:
            """Whether the controller sends no WATCHDOG=1 while the mirror, with the same period, sends five."""
            time.sleep(0.05)  # receive what was sent before
            controller_beats, mirror_beats = controller.manager.beats, mirror.manager.beats
            until(lambda: mirror.manager.beats >= mirror_beats + 5)
            return controller.manager.beats == controller_beats

        assert not quiet()
        controller.process.send_signal(signal.SIGSTOP)
        assert quiet()
        controller.process.send_signal(signal.SIGCONT)
        assert not quiet()
        (tmp_path / "hang").touch()
        until(lambda: "COMMAND_EXPIRED" in mirror.stderr_file.read_text())  # the controller sends nothing
        assert quiet()
        controller.process.send_signal(signal.SIGABRT)  # as systemd does when the watchdog expires
        assert controller.process.wait(20) == -signal.SIGABRT
        assert "advance_or_hang" in controller.stderr_file.read_text()  # the journal shows where it hung
        remaining = [child for child in processes.values() if child is not controller]
        for child in remaining:
            assert "STOPPING=1" not in child.manager.notifications
            child.process.send_signal(signal.SIGTERM)
        # A list, so that each round reads every queue: a full one would drop the last notifications.
        until(
            lambda: (
                False not in [bool(one.manager.notifications) and one.process.poll() is not None for one in remaining]
            )
        )
        for child in remaining:
            assert child.process.returncode == 0, child.stderr_file.read_text()
            notifications = child.manager.notifications
            assert notifications.count("READY=1") == notifications.count("STOPPING=1") == 1
            assert child.manager.status().startswith("stopped")


def test_a_watchdog_of_another_process_and_a_missing_service_manager_are_ignored(tmp_path: Path) -> None:
    variables = {"NOTIFY_SOCKET": str(tmp_path / "nobody"), "WATCHDOG_USEC": "1000000"}
    assert Supervisor(variables | {"WATCHDOG_PID": str(os.getpid())}).period_ns == 500_000_000
    no_timeout = variables | {"WATCHDOG_USEC": "0"}
    for environment in ({"WATCHDOG_USEC": "1000000"}, variables | {"WATCHDOG_PID": str(os.getppid())}, no_timeout):
        unsupervised = Supervisor(environment)
        assert unsupervised.period_ns is None
        unsupervised.ready()
        unsupervised.alive(0)
        unsupervised.stopping()
        unsupervised.send_status(wire.Health())


def test_the_loop_does_not_wait_for_a_service_manager_that_does_not_read() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("")  # an abstract socket, as systemd may use
        name = manager.getsockname().decode().replace("\0", "@", 1)
        supervisor = Supervisor({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2"})
        for count in range(2000):  # more than the socket's queue holds
            supervisor.alive(count * 1000)
        assert manager.recv(4096) == b"WATCHDOG=1"


def test_the_service_managers_socket_may_have_an_at_sign_in_its_name(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "user@1.sock"))
        manager.setblocking(False)
        Supervisor({"NOTIFY_SOCKET": manager.getsockname()}).ready()
        assert manager.recv(4096) == b"READY=1"


def test_a_status_is_one_line() -> None:
    health = wire.Health(state="ready", rate_hz=3.2, recording=wire.Recording(failure="disk full\nREADY=1"))
    assert status_line(health) == "ready, 3.2 Hz, recording failed: disk full READY=1"
    safe = wire.Health(state="running", rate_hz=1000.4, mode=wire.LOOP_MODE_SAFE)
    assert status_line(safe) == "running, in safe mode, 1000 Hz"
