"""Zenoh's configuration for each role: peers on one host, a router across hosts; settings chosen by measurement."""

import contextlib
import ctypes
import os
import socket
import struct
import threading
from pathlib import Path
from typing import Any

import zenoh
from zenoh.handlers import Callback

from lowfc.adapters.bus.access import ROUTER
from lowfc.adapters.bus.bus import ALL
from lowfc.adapters.bus.routed import LINK_LEASE_MS, client_session, router_session
from lowfc.adapters.bus.run import Links
from lowfc.contract.messages import TOPICS

_SOCKET = "unixsock-stream"
_DISPLAY_HZ = 40.0  # a viewer draws 30 images a second, each from a new message
_BATCH_BYTES = 65535  # zenoh's default
_SMALL_BATCH_BYTES = 16384  # of a monitor: each message that it keeps occupies a whole receive buffer
_OPEN_MS = 2000  # limit of a link's opening; closing waits as long for a suspended process. zenoh's default is 10 s
_SPARE_BUFFERS = 1024  # of a monitor; otherwise zenoh allocates and clears one for every message
_PRIORITIES = ("real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background")

_kept = threading.local()


def keep_thread_state() -> None:
    """Keep the Python state of this zenoh thread from one callback to the next.

    Otherwise each callback creates and destroys it, with a memory mapping and page faults: a quarter of the time of a
    round trip over the bus.
    """
    if not hasattr(_kept, "thread"):
        ctypes.pythonapi.PyGILState_Ensure()
        _kept.thread = True


def prevent_slow_closing(session: zenoh.Session) -> None:
    """Set options of this process's TCP sockets after each new link of a session, so that closing a link never blocks.

    SO_LINGER is turned off. With zenoh's 10 s, closing the link of a suspended process (SIGSTOP) blocks the receive
    thread for 10 s, and no request is answered meanwhile. The kernel still sends what was written.

    Across hosts, TCP_USER_TIMEOUT is set to zenoh's link lease. Otherwise a link that was cut while data waited in its
    buffer is not closed until the network is back and the kernel sends again, up to two minutes later.
    """

    def changed(event: zenoh.LinkEvent) -> None:
        if event.kind != zenoh.SampleKind.PUT or event.link.src.startswith(_SOCKET):  # a Unix socket closes at once
            return
        tls_port = event.link.dst.rpartition(":")[2] if event.link.dst.startswith("tls/") else ""
        for descriptor in (int(path.name) for path in Path("/proc/self/fd").iterdir()):
            with contextlib.suppress(OSError):  # not a socket, or closed since
                opened = socket.socket(fileno=descriptor)
                try:
                    if opened.family in (socket.AF_INET, socket.AF_INET6):
                        opened.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
                        if str(opened.getpeername()[1]) == tls_port:
                            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, LINK_LEASE_MS)
                finally:
                    opened.detach()

    session.info.declare_link_events_listener(Callback(changed, indirect=False), history=True)


def session_config(links: Links, role: str, *, monitor: bool = False) -> dict[str, Any]:
    """Zenoh's configuration for a role of a run; a role without its own port only connects.

    A run on several hosts uses its router: see `routed`. For `monitor` see `ZenohBus`.
    """
    batch_bytes = _SMALL_BATCH_BYTES if monitor else _BATCH_BYTES
    sending = {
        "batch_size": batch_bytes,  # in both directions: a link uses the smaller value of its two ends
        # A full queue delays a put by at most 1 ms, then the message is dropped; without this delay bursts are lost.
        "queue": {"size": dict.fromkeys(_PRIORITIES, 16), "congestion_control": {"drop": {"wait_before_drop": 1000}}},
    }
    scouting = {"delay": 100, "multicast": {"enabled": False}, "gossip": {"enabled": False}}
    if links.network.router:
        routed = (
            router_session(links.network, links.mirrors, sending)
            if role == ROUTER
            else client_session(links.network, role, sending)
        )
        return routed | {"scouting": scouting}
    listening = [_address(links, role), _socket(links, role)] if role in links.ports else []
    throttled = [{"key_expr": topic.at(ALL), "freq": _DISPLAY_HZ} for topic in TOPICS if topic.latest_only]
    return {
        "mode": "peer",
        # Peers do not forward, so each connects to all that listen; with a timeout of -1 any start order works.
        "listen": {"endpoints": [link for link in listening if link], "exit_on_failure": True, "timeout_ms": 0},
        "connect": {
            "endpoints": [
                (_socket(links, name) if monitor else None) or _address(links, name)
                for name in sorted(links.ports)
                if name != role
            ],
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {
                "period_init_ms": 50,
                # A new process connects to all others that listen. Each attempt to reach an absent process (such as
                # the recorder) delays a frame, so attempts are rare. A role without a port cannot be reached: it must
                # attempt often itself.
                "period_max_ms": 4000 if role in links.ports else 200,
                "period_increase_factor": 2,
            },
        },
        # Opening waits `delay` ms for missing links; running processes are connected within a few ms.
        "scouting": scouting,
        "transport": {
            "unicast": {"open_timeout": _OPEN_MS},
            "auth": {
                "usrpwd": {"user": links.user, "password": links.secret, "dictionary_file": str(links.secret_file)}
            },
            "link": {"tx": sending, "rx": {"buffer_size": _SPARE_BUFFERS * batch_bytes if monitor else batch_bytes}},
            # No gain at the sizes of our messages, and a receiver descheduled for 100 ms loses messages silently.
            "shared_memory": {"enabled": False},
        },
        # Monitors, which connect by Unix socket, get these topics at display rate: sending costs the loop time.
        "downsampling": [
            {"id": "monitor", "flows": ["egress"], "messages": ["put"], "link_protocols": [_SOCKET], "rules": throttled}
        ],
    }


def _address(links: Links, role: str) -> str:
    return f"tcp/127.0.0.1:{links.ports[role]}"


def _socket(links: Links, role: str) -> str | None:
    path = links.socket(role)
    return None if path is None else f"{_SOCKET}/{path}"


def receive_in_one_thread() -> None:
    """Make zenoh receive and decode messages in one thread; call it before the first session.

    A process that blocks on input then need not wake a second thread. In a process that computes meanwhile, one thread
    would delay messages. Child processes inherit the setting.
    """
    os.environ.setdefault("ZENOH_RUNTIME", "(rx: (handover: net))")
