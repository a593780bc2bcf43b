"""Emulated hosts on one machine: network namespaces with their own addresses, joined by a bridge.

A namespace exists while a process runs in it. Each is held by a `cat` that ends when its pipe is closed, and all other
processes end with the test process, so that nothing is left behind.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from lowfc.adapters.process.child import Child
from lowfc.adapters.process.clock import HostClock

SUBNET = "10.77.0"
ROUTER_ADDRESS = f"{SUBNET}.1"


def namespaces_permitted() -> bool:
    """Whether this machine permits network namespaces with a bridge."""
    if shutil.which("unshare") is None or shutil.which("nsenter") is None or shutil.which("ip") is None:
        return False
    trial = "ip link add name trial type bridge && ip link add name one type veth peer name two"
    return subprocess.run(["unshare", "--net", "sh", "-c", trial], capture_output=True, check=False).returncode == 0


class Host:
    """A namespace with its own folder for runtime files."""

    def __init__(self, name: str, address: str, folder: Path, clock_shift_ns: int = 0) -> None:
        self.name = name
        self.address = address
        self.folder = folder / name
        hold = ["unshare", "--net", "sh", "-c", "echo && exec cat"]
        self.holder = subprocess.Popen(hold, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        # Until the holder has printed a line, the namespace may not exist, and commands would run in our own.
        assert self.holder.stdout.readline(), "no namespace was created"
        self.children: dict[str, Child] = {}
        home = self.folder / "runtime" / "lowfc"
        home.mkdir(mode=0o700, parents=True)
        HostClock(home)  # stores the clock offset of this boot; it is shifted for this host
        for file in home.glob("clock-*"):
            file.write_text(str(int(file.read_text()) + clock_shift_ns))

    @property
    def environment(self) -> Mapping[str, str]:
        return os.environ | {"XDG_RUNTIME_DIR": str(self.folder / "runtime"), "OMP_NUM_THREADS": "1"}

    def inside(self, *arguments: str) -> list[str]:
        return ["nsenter", f"--net=/proc/{self.holder.pid}/ns/net", *arguments]

    def ip(self, *arguments: str) -> None:
        subprocess.run(self.inside("ip", *arguments), check=True, capture_output=True)

    def run(self, *arguments: str, timeout_s: float = 60) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            self.inside(sys.executable, "-P", *arguments),
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            env=self.environment,
            cwd=self.folder,
        )

    def start(self, name: str, *arguments: str) -> Child:
        child = Child(
            name,
            self.inside(sys.executable, "-P", *arguments),
            self.folder / f"{name}.stderr",
            self.environment,
            death_signal=signal.SIGKILL,
        )
        child.start()
        self.children[name] = child
        return child

    def stderr(self, name: str) -> str:
        return (self.folder / f"{name}.stderr").read_text(errors="replace")

    def close(self) -> None:
        for child in self.children.values():
            child.stop(5.0)
        self.holder.communicate()


class Lab:
    """A central host with the bridge, and hosts with one link each that can be cut."""

    def __init__(self, folder: Path, shifts_ns: Mapping[str, int]) -> None:
        """Create the hosts, with clock shifts by name."""
        self.middle = Host("middle", ROUTER_ADDRESS, folder)
        self.hosts = {self.middle.name: self.middle}
        try:
            self.middle.ip("link", "add", "name", "bridge", "type", "bridge")
            self.middle.ip("address", "add", f"{ROUTER_ADDRESS}/24", "dev", "bridge")
            for device in ("lo", "bridge"):
                self.middle.ip("link", "set", device, "up")
            for number, (name, shift_ns) in enumerate(shifts_ns.items(), start=11):
                host = self.hosts[name] = Host(name, f"{SUBNET}.{number}", folder, shift_ns)
                ends = ("link", "add", "name", name, "type", "veth", "peer", "name", "eth0", "netns")
                self.middle.ip(*ends, str(host.holder.pid))
                self.middle.ip("link", "set", name, "master", "bridge", "up")
                host.ip("address", "add", f"{host.address}/24", "dev", "eth0")
                for device in ("lo", "eth0"):
                    host.ip("link", "set", device, "up")
        except BaseException:
            self.close()
            raise

    def __getitem__(self, name: str) -> Host:
        return self.hosts[name]

    @contextlib.contextmanager
    def cut(self, name: str) -> Iterator[None]:
        """Drop all traffic to and from a host silently."""
        self.middle.ip("link", "set", name, "nomaster")
        try:
            yield
        finally:
            self.middle.ip("link", "set", name, "master", "bridge")

    def close(self) -> None:
        for host in reversed(list(self.hosts.values())):
            host.close()
