"""The bus across hosts: zenoh's configuration of the router and its clients, with mutual TLS."""

import contextlib
import datetime
import errno
import socket
import stat
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import zenoh

from lowfc.adapters.bus.access import ROUTER, access_control
from lowfc.adapters.bus.own_certificate import WARN_DAYS, read_certificate
from lowfc.adapters.bus.zenoh_fault import cause_of
from lowfc.contract.codecs.input_file import user_path
from lowfc.contract.errors import BusError, DataFileError
from lowfc.contract.network import Network
from lowfc.control.loop.wording import counted

CA = "ca.pem"
"""File name of the authority's certificate in a folder of certificates."""
CA_KEY = "ca.key"
"""File name of the authority's key, which must not be on any host of the loop."""

CONNECT_MS = 1000
LINK_LEASE_MS = 2000
"""zenoh's link lease: time without traffic after which a link is closed."""
_ALERT_S = 0.5  # time in which a router that refuses the certificate sends its TLS alert
_ABSENT = {
    *(errno.ECONNREFUSED, errno.ECONNRESET, errno.ETIMEDOUT),
    *(errno.EHOSTUNREACH, errno.EHOSTDOWN, errno.ENETUNREACH, errno.ENETDOWN),
    socket.EAI_AGAIN,
}
"""errno values that mean that the router or the network is not up yet, as do timeouts and handshakes cut short."""


def client_session(network: Network, role: str, sending: dict[str, Any]) -> dict[str, Any]:
    """Zenoh's session configuration of a role in a run on several hosts; it replaces the links on one host.

    `sending` is zenoh's `transport/link/tx`, as on one host.
    """
    return {
        "mode": "client",
        "listen": {"endpoints": []},
        "connect": {
            "endpoints": [network.router],
            # timeout for opening a session; an open session that loses its router retries indefinitely
            "timeout_ms": CONNECT_MS,
            "exit_on_failure": True,
            "retry": {"period_init_ms": 50, "period_max_ms": 1000, "period_increase_factor": 2},
        },
        "transport": _transport(network, role, "connect", sending, verify_name_on_connect=True),
    }


def router_session(network: Network, mirrors: Iterable[str], sending: dict[str, Any]) -> dict[str, Any]:
    """Zenoh's session configuration of the router: TLS only, and access control from the table of topics.

    `mirrors` are roles such as "mirror-dm"; `sending` is zenoh's `transport/link/tx`, as on one host.
    """
    return {
        "mode": "router",
        "listen": {"endpoints": [network.listen or network.router], "exit_on_failure": True, "timeout_ms": 0},
        "connect": {"endpoints": []},
        "transport": _transport(network, ROUTER, "listen", sending),
        "access_control": access_control(mirrors),
    }


def open_by_router(config: zenoh.Config, network: Network, role: str) -> zenoh.Session:
    """Open a session through the router, and wait for the router while it is not running.

    Raises:
        BusError: router and process do not accept each other's certificates; the router cannot be reached for a reason
            other than its absence; or zenoh refuses the session although the router is running.
    """
    reported, failures = "", 0
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as fault:
            trouble = router_trouble(network, role)
            failures = 0 if trouble else failures + 1  # try again once: the router may have started since this attempt
            if failures > 1:
                raise BusError(
                    f"the router at {network.router} accepts {role}'s certificate, but zenoh opens no session: "
                    f"{cause_of(fault)}"
                ) from fault
            if trouble != reported and trouble:
                sys.stderr.write(f"{role}: waiting for the router at {network.router}: {trouble}\n")
                reported = trouble


def router_trouble(network: Network, role: str) -> str:
    """Reason why the router cannot be reached: it is absent or shutting down. Empty if it is running.

    Raises:
        BusError: router and process do not accept each other's certificates, or the router cannot be reached for
            another reason, such as an unknown name.
    """
    import ssl  # slow to import, and only loops on several hosts need it

    ca, certificate, key = certificate_files(network, role)
    host, port = network.address
    try:
        context = ssl.create_default_context(cafile=str(ca))
        context.verify_flags &= ~ssl.VERIFY_X509_STRICT  # the default since Python 3.13, stricter than zenoh
        context.load_cert_chain(certificate, key)
        with (
            socket.create_connection((host, port), CONNECT_MS * 1e-3) as tcp,
            context.wrap_socket(tcp, server_hostname=host) as link,
        ):
            link.settimeout(_ALERT_S)
            with contextlib.suppress(TimeoutError):
                link.recv(1)  # a refusal arrives only here
    except ssl.SSLEOFError:
        return "the connection was closed during the handshake: the router shuts down, or another program listens"
    except ssl.SSLError as fault:
        why = ": ".join(filter(None, (fault.reason or str(fault), getattr(fault, "verify_message", ""))))
        raise BusError(
            f"the router at {network.router} and {certificate} do not accept each other ({why.strip('.')}): "
            f"both must be signed by {ca} and valid today; the router's must be issued for host name {host!r}; see "
            "lowfc certs"
        ) from fault
    except OSError as fault:
        why = fault.strerror or str(fault)
        if isinstance(fault, TimeoutError) or fault.errno in _ABSENT:
            return why
        raise BusError(
            f"the router at {network.router} cannot be reached ({why}): is network.router its name and port, and can "
            "this host resolve it?"
        ) from fault
    return ""


class RouterWatch:
    """Reports on standard error why a process has lost its router, and when it is back."""

    def __init__(self, network: Network, role: str) -> None:
        self._network = network
        self._role = role
        self._reported = ""

    def update(self, *, linked: bool) -> None:
        """Report a change of the link; call it periodically."""
        if linked:
            why = ""
        else:
            try:
                why = router_trouble(self._network, self._role) or "it is running, and the link is being restored"
            except BusError as fault:
                why = str(fault)
        if why != self._reported:
            self._reported = why
            text = f"no link to the router at {self._network.router}: {why}" if why else "the router is back"
            with contextlib.suppress(OSError):  # a closed terminal must not end this thread: it also compares clocks
                sys.stderr.write(f"{self._role}: {text}\n")


def certificate_files(network: Network, role: str) -> tuple[Path, Path, Path]:
    """Files of the authority, of a role's certificate and of its key."""
    folder = user_path(network.certificates)
    return folder / CA, folder / f"{role}.pem", folder / f"{role}.key"


def require_certificate(network: Network, role: str) -> None:
    """Check this host's certificate of a role before connecting.

    DataFileError if its files cannot be read, it is not valid, or it is another role's: the router would refuse it, or
    accept it and forward nothing.
    """
    files = certificate_files(network, role)
    for file in files:
        try:
            file.open("rb").close()
        except OSError as fault:
            raise DataFileError(
                f"{file} cannot be read ({fault.strerror}): the router accepts no process without it; make it where "
                "the authority's key is (lowfc certs) and copy it here"
            ) from fault
    name = read_certificate(*files, server=role == ROUTER).name
    if name != role:
        raise DataFileError(
            f"{files[1]} is the certificate of {name!r}, and this process is {role!r}: the router would accept it and "
            f"forward nothing; copy {role}.pem and {role}.key of that role here"
        )


def certificate_warnings(network: Network, now: datetime.datetime) -> list[str]:
    """Warnings on this host's certificates: absent, invalid, near expiry (`WARN_DAYS`), or a key that all can read."""
    folder = user_path(network.certificates)
    roles = sorted(key.stem for key in folder.glob("*.key") if key.name != CA_KEY)
    warnings = [] if roles else [f"{folder} has no certificate with its key, ROLE.pem and ROLE.key"]
    for role in roles:
        try:
            certificate = read_certificate(*certificate_files(network, role), server=role == ROUTER)
        except DataFileError as fault:
            warnings.append(str(fault))
            continue
        key = folder / f"{role}.key"
        if key.stat().st_mode & stat.S_IROTH:
            warnings.append(f"{key} can be read by every user of this host, who could then act as {role}: chmod o-rwx")
        if (left := certificate.ends - now) < datetime.timedelta(days=WARN_DAYS):
            days, remedy = counted(left.days, "day"), ": lowfc certs FOLDER --renew"
            if certificate.ends_with_authority:
                remedy = f", because {CA} expires then: create all of them anew in an empty folder (lowfc certs)"
            warnings.append(f"{role}'s certificate expires in {days}, on {certificate.ends:%Y-%m-%d}{remedy}")
    return warnings


def _transport(network: Network, role: str, end: str, sending: dict[str, Any], **more: object) -> dict[str, Any]:
    """Transport section of zenoh for a role: `end` is "connect" (router: "listen"); `more` are other keys of `tls`."""
    ca, certificate, key = certificate_files(network, role)
    return {
        "link": {
            "protocols": ["tls"],  # the only permitted protocol
            "tls": {
                "root_ca_certificate": str(ca),
                "enable_mtls": True,
                f"{end}_certificate": str(certificate),
                f"{end}_private_key": str(key),
                **more,
            },
            # A closed link is restored as soon as possible. Messages sent while a link is silent wait, and arrive stale
            # if it recovers before it is closed.
            "tx": {**sending, "lease": LINK_LEASE_MS, "keep_alive": 4},
        },
        "shared_memory": {"enabled": False},
    }
