"""Zenoh's configuration of each role: links on one host, or by a router across several. All settings were measured."""

from typing import Any

from lowfc.adapters.bus.access import ROUTER
from lowfc.adapters.bus.bus import ALL
from lowfc.adapters.bus.routed import client_session, router_session
from lowfc.adapters.bus.run import Links
from lowfc.contract.messages import TOPICS

_SOCKET = "unixsock-stream"
_GLANCES_HZ = 40.0  # a view draws 30 pictures a second; each finds a new one
_BATCH_BYTES = 65535  # zenoh's own
_SMALL_BATCH_BYTES = 16384  # of a monitor, which keeps messages: each holds the buffer that it came in
_SPARE_BUFFERS = 1024  # without them it makes and clears one for every message
_PRIORITIES = ("real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background")


def session_config(links: Links, role: str, *, monitor: bool = False) -> dict[str, Any]:
    """Zenoh's configuration for a role of a run; a role without a port of its own only connects.

    A run on several hosts goes by its router: see `routed`. For `monitor` see `ZenohBus`.
    """
    batch_bytes = _SMALL_BATCH_BYTES if monitor else _BATCH_BYTES
    sending = {
        "batch_size": batch_bytes,  # of both directions: the smaller one of both ends holds
        # A full queue delays a put by at most 1 ms, then the message is dropped; at 0 bursts are lost.
        "queue": {
            "size": dict.fromkeys(_PRIORITIES, 16),
            "congestion_control": {"drop": {"wait_before_drop": 1000}},
        },
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
    glanced_at = [{"key_expr": topic.at(ALL), "freq": _GLANCES_HZ} for topic in TOPICS if topic.latest_only]
    return {
        "mode": "peer",
        # Peers do not forward, so each connects to all others; with a timeout of -1 any start order works.
        "listen": {"endpoints": [one for one in listening if one], "exit_on_failure": True, "timeout_ms": 0},
        "connect": {
            "endpoints": [
                (_socket(links, name) if monitor else None) or _address(links, name)
                for name in sorted(links.ports)
                if name != role
            ],
            "timeout_ms": -1,
            "exit_on_failure": False,
            # A newcomer connects to all others itself. Five attempts a second to reach an absent process (a recorder,
            # say) made a frame late each time.
            "retry": {"period_init_ms": 50, "period_max_ms": 4000, "period_increase_factor": 2},
        },
        # Opening waits `delay` ms for the links that are not there yet; running processes are connected within a few.
        "scouting": scouting,
        "transport": {
            "auth": {
                "usrpwd": {
                    "user": links.user,
                    "password": links.secret,
                    "dictionary_file": str(links.secret_file),
                }
            },
            "link": {
                "tx": sending,
                "rx": {"buffer_size": _SPARE_BUFFERS * batch_bytes if monitor else batch_bytes},
            },
            # Gains nothing at these sizes, and a receiver descheduled for 100 ms loses messages silently.
            "shared_memory": {"enabled": False},
        },
        # Monitors connect by socket, and are sent no more pictures than they draw: writing them costs the loop, too.
        "downsampling": [
            {
                "id": "glances",
                "flows": ["egress"],
                "messages": ["put"],
                "link_protocols": [_SOCKET],
                "rules": glanced_at,
            }
        ],
    }


def _address(links: Links, role: str) -> str:
    return f"tcp/127.0.0.1:{links.ports[role]}"


def _socket(links: Links, role: str) -> str | None:
    path = links.socket(role)
    return None if path is None else f"{_SOCKET}/{path}"
