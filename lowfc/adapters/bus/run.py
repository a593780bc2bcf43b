"""A run: one loop's runtime directory, ports and secret, so that two loops on one host never mix.

The first process fills the directory under another name, then renames it; all others read it. The directory belongs
to the user (mode 0700), and is under $XDG_RUNTIME_DIR, or under /tmp if that variable is not set.
"""

import contextlib
import fcntl
import json
import os
import random
import re
import secrets
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path

from lowfc.adapters.bus import DEFAULT_RUN as DEFAULT_RUN
from lowfc.contract.codecs.input_file import user_path
from lowfc.contract.errors import BusError, DataFileError, brief, raised_as
from lowfc.contract.messages import Role
from lowfc.contract.network import Network

_LINKS = "links.json"
_CREDENTIALS = "credentials"
_USER = "lowfc"
_RUN_ID = re.compile(r"[a-z0-9][a-z0-9._-]{0,47}")
_LOWEST_PORT = 15000
_CONNECT_S = 1.0
_MAX_START_LENGTH = 20  # characters of a stored start time
_LATEST_START_S = (1 << 32) - 3  # latest start that fits a sequence
_MAX_SOCKET_PATH_BYTES = 107  # bytes of a Unix socket's address
_PORT_RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")
MODE = 0o1600  # of a run's files that must last: private, and sticky, so that systemd-tmpfiles does not remove them


@dataclass(frozen=True, slots=True)
class Links:
    """Endpoints of the processes of a run, and their shared secret.

    Attributes:
        run_id: name of the run.
        ports: loopback TCP port of each listening role: "camera", "controller", "mirror-dm", "recorder", "launcher".
        user: user name of zenoh's user/password authentication.
        secret_file: zenoh's dictionary file, one line "user:password".
        network: the router of a run on several hosts; ports and secret are then not used.
    """

    run_id: str
    ports: dict[str, int]
    user: str
    secret_file: Path
    network: Network = field(default_factory=Network)

    @property
    def secret(self) -> str:
        """The run's password; DataFileError if its file is missing or damaged."""
        try:
            user, _, secret = self.secret_file.read_text(errors="replace").strip().partition(":")
        except OSError as fault:
            raise DataFileError(f"{self.secret_file} cannot be read ({fault.strerror}); {_ADVICE}") from fault
        if user != self.user or not secret:
            raise DataFileError(f"{self.secret_file} should hold one line '{self.user}:password'; {_ADVICE}")
        return secret

    def socket(self, role: str) -> Path | None:
        """Unix socket of a role with a port; None without a port, or if the directory's name is too long for one."""
        return self._socket_path(f"{role}.sock") if role in self.ports else None

    def direct_link(self, role: str) -> Path | None:
        """Socket of a role's direct link; None if the directory's name is too long for one.

        None with a router, whose access control applies to all messages.
        """
        return None if self.network.router else self._socket_path(f"{role}.in")

    def _socket_path(self, name: str) -> Path | None:
        path = self.secret_file.parent / name
        return path if len(os.fsencode(path)) <= _MAX_SOCKET_PATH_BYTES else None

    def live(self) -> set[str]:
        """Roles whose processes listen now; the directory is no evidence, as a killed run leaves it behind.

        With a router, only the router listens: while it does, all roles are returned, as any may be running.
        """
        if self.network.router:
            return set(self.ports) if _listens(*self.network.address) else set()
        return {role for role, port in self.ports.items() if _listens("127.0.0.1", port)}

    @property
    def mirrors(self) -> tuple[str, ...]:
        """Roles of the mirrors."""
        return tuple(role for role in self.ports if role.partition("-")[0] == Role.MIRROR)

    def claim_start(self, role: str, start_s: int) -> int:
        """Claim the start time that a role's process puts into its sequences: `start_s`, or later if already claimed.

        A process that is killed and restarted within one second must not repeat its sequences. If the run's directory
        cannot be written, the start is `start_s`, so that an operator can still request `safe`.
        """
        path = self.secret_file.parent / f"start-{role}"
        with contextlib.suppress(OSError, ValueError), path.open("a+") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            file.seek(0)
            last = file.read(_MAX_START_LENGTH).strip()
            claimed = max(start_s, int(last) + 1) if last.isdecimal() else start_s
            claimed = claimed if claimed <= _LATEST_START_S else start_s
            file.truncate(0)
            file.write(str(claimed))
            return claimed
        return start_s


@dataclass(frozen=True, slots=True)
class Run:
    """One run and its directory, made at `created_ns` (the file system's time)."""

    run_id: str
    path: Path
    links: Links
    created_ns: int

    def restarted(self) -> bool:
        """Whether a later run of this name has replaced this one, so that a process must join again."""
        with contextlib.suppress(FileNotFoundError):
            return (self.path / _LINKS).stat().st_ctime_ns != self.created_ns
        return False

    def remove(self) -> None:
        """Delete the directory; for the process that created the run, when all others have ended."""
        shutil.rmtree(self.path, ignore_errors=True)


_ADVICE = "stop the processes of this run, remove its directory and start again"


def _listens(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), _CONNECT_S).close()
    except OSError:
        return False
    return True


def new_run_id() -> str:
    """Make an unused name for a run: UTC time and a random part."""
    return f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{secrets.token_hex(3)}"


def open_run(
    run_id: str,
    mirrors: tuple[str, ...] = ("dm",),
    base: Path | None = None,
    listeners: tuple[str, ...] = (),
    network: Network | None = None,
) -> Run:
    """Open the run of that name; the first call with `mirrors` creates its directory, ports and secret.

    Args:
        run_id: name of the run.
        mirrors: names of its mirrors; empty to join a run that exists, whatever its mirrors.
        base: parent of its directory; the user's runtime directory when None.
        listeners: additional roles with a port, if this call creates the run: a launcher must listen to receive from a
            viewer, which only connects.
        network: router and certificates of the run, if this call creates it. An existing run must have the same ones,
            unless `network` has no router, or a launcher created the run: a launcher's runs stay on one host.

    Raises:
        BusError: the name is invalid; the run exists without one of `mirrors`, or with another network; `mirrors` is
            empty and the run does not exist; or too few ports are free.
        DataFileError: the run's directory is damaged, or cannot be made.
    """
    path, requested = run_path(run_id, base), _absolute(network or Network())
    if not path.is_dir():
        if not mirrors:
            raise BusError(f"there is no run {run_id!r}")
        with raised_as(DataFileError, OSError, f"{path} cannot be made"):
            _make(path, mirrors, listeners, requested)
    own_directory(path)
    links = _read(path)
    if requested.router and requested != links.network and Role.LAUNCHER not in links.ports:
        present = links.network
        at_router = f"on {present.router} with certificates {present.certificates!r}"
        where = at_router if present.router else "on this host alone"
        raise BusError(
            f"run {run_id!r} is {where}, and the configuration has {requested.router} with {requested.certificates!r}; "
            f"{_ADVICE} ({path}), or start another run"
        )
    for role in map(mirror_role, mirrors):
        if role not in links.ports:
            raise BusError(
                f"run {run_id!r} has no {role!r} (it has {', '.join(sorted(links.ports))}); "
                f"start another run, or {_ADVICE} with that mirror: {path}"
            )
    return Run(run_id, path, links, (path / _LINKS).stat().st_ctime_ns)


def run_path(run_id: str, base: Path | None = None) -> Path:
    """Directory of a run below `base` (as in `open_run`), which may not exist; BusError if the name is invalid."""
    if not _RUN_ID.fullmatch(run_id):
        raise BusError(
            "a run's name is up to 48 of a-z, 0-9, '.', '_', '-' and begins with a letter or digit; got "
            f"{brief(run_id)}"
        )
    return (runtime_base() if base is None else base) / run_id


def mirror_role(name: str) -> str:
    """Role of the process of the mirror `name`."""
    return f"{Role.MIRROR}-{name}"


def runtime_path() -> Path:
    """Path of the user's runtime directory for lowfc, which may not exist."""
    configured = os.environ.get("XDG_RUNTIME_DIR")
    return Path(configured) / "lowfc" if configured else Path("/tmp") / f"lowfc-{os.geteuid()}"  # noqa: S108  # own_directory() checks it


def runtime_base() -> Path:
    """The user's runtime directory for lowfc, created if it does not exist.

    DataFileError if it belongs to another user, is accessible to others, or is not a directory.
    """
    base = runtime_path()
    try:
        base.mkdir(mode=0o700, exist_ok=True)
    except FileExistsError:
        raise DataFileError(f"{base} should be a directory; remove it") from None
    except OSError as fault:
        raise DataFileError(
            f"{base} cannot be made ({fault.strerror}); set XDG_RUNTIME_DIR to a directory of yours, or unset it"
        ) from fault
    return own_directory(base)


def own_directory(path: Path) -> Path:
    """Check that `path` is a directory of this user, closed to all others and not a link; otherwise DataFileError."""
    with raised_as(DataFileError, OSError, f"{path} cannot be read"):  # such as a run that ends at this moment
        status = path.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o077:
        raise DataFileError(
            f"{path} should be a directory of user {os.geteuid()} with mode 700, and is "
            f"{stat.filemode(status.st_mode)} of user {status.st_uid}; remove it if it is not somebody else's"
        )
    return path


def write_once(path: Path, text: str) -> str:
    """Write a file unless it exists, and return its text; simultaneous writers get the same text."""
    with contextlib.suppress(FileNotFoundError):
        return path.read_text(errors="replace")
    with tempfile.NamedTemporaryFile("w", prefix=f".{path.name}-", dir=path.parent) as draft:
        os.fchmod(draft.fileno(), MODE)
        draft.write(text)
        draft.flush()
        with contextlib.suppress(FileExistsError):
            os.link(draft.name, path)
    return path.read_text(errors="replace")


def _absolute(network: Network) -> Network:
    """Network with absolute paths, so that it is the same in any working directory."""
    if not network.router:
        return Network()
    return network.model_copy(update={"certificates": str(user_path(network.certificates).absolute())})


def _make(path: Path, mirrors: tuple[str, ...], listeners: tuple[str, ...], network: Network) -> None:
    """Create the directory under another name and rename it; if another process was first, its directory is used."""
    # Monitors connect and do not listen: there may be several, and no other process connects to them.
    roles = [Role.CAMERA, Role.CONTROLLER, *map(mirror_role, mirrors), Role.RECORDER, *listeners]
    used = set[int]()  # ports of other runs: on a shared port, a killed run would seem live and could not listen again
    for other in path.parent.glob(f"*/{_LINKS}"):
        with contextlib.suppress(DataFileError):
            used |= set(_read(other.parent).ports.values())
    links = {
        "run_id": path.name,
        "user": _USER,
        "ports": dict(zip(map(str, roles), free_ports(len(roles), used), strict=True)),
        **({"network": network.model_dump()} if network.router else {}),
    }
    draft = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))  # mode 0700
    try:
        for name, text in ((_LINKS, json.dumps(links, indent=2)), (_CREDENTIALS, f"{_USER}:{secrets.token_hex(32)}\n")):
            (draft / name).touch(MODE)
            (draft / name).write_text(text)
        draft.rename(path)
    except OSError:
        shutil.rmtree(draft)
        if not path.is_dir():
            raise


def _read(path: Path) -> Links:
    file = path / _LINKS
    try:
        links = json.loads(file.read_text())
        ports = {str(role): int(port) for role, port in links["ports"].items()}
        if links["run_id"] != path.name or not all(0 < port < 1 << 16 for port in ports.values()):
            raise ValueError("it belongs to another run, or has an invalid port")
        network = Network.model_validate(links.get("network", {}))
        return Links(path.name, ports, str(links["user"]), path / _CREDENTIALS, network)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as fault:
        raise DataFileError(
            f"{file} should hold run_id, user and ports as JSON, and could not be read ({fault}); {_ADVICE}: {path}"
        ) from fault


def free_ports(count: int, excluded: AbstractSet[int] = frozenset()) -> list[int]:
    """Return free loopback TCP ports below the ephemeral range and not in `excluded`; BusError if too few are free.

    An outgoing connection could take an ephemeral port before the role listens on it. A repeated attempt to connect to
    an ephemeral port without a listener could get this port on its own side, and connect to itself. If the ephemeral
    range begins at 15000 or below, the kernel chooses ports within it.
    """
    candidates = sorted({*range(_LOWEST_PORT, int(_PORT_RANGE.read_text().split()[0]))} - excluded)
    chooser = random.SystemRandom()
    with contextlib.ExitStack() as sockets:
        ports: list[int] = []
        for _ in range(1000):
            port = chooser.choice(candidates) if candidates else 0
            probe = sockets.enter_context(socket.socket())
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            ports.append(probe.getsockname()[1])
            if len(ports) == count:
                return ports
    raise BusError(f"found only {len(ports)} of {count} free TCP ports on 127.0.0.1; stop what occupies them")
