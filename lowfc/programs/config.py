"""What a configuration says: every key with its sentence, or the bus session of a role."""

import json

from lowfc.adapters.clock import HostClock
from lowfc.adapters.run import open_run, runtime_base
from lowfc.adapters.zenoh_bus import session_config
from lowfc.client import running
from lowfc.contract.configuration import Configuration, keys
from lowfc.contract.errors import BusError


def commented(config: Configuration) -> str:
    """TOML of a configuration, each key with its sentence above it."""
    sentences = {name: " ".join((info.description or "").split()) for name, info in keys().items()}
    lines, section = [], ""
    for line in config.to_toml().splitlines():
        if line.startswith("["):
            section = line.strip("[]") + "."
        key = section + line.split(" = ")[0]
        if " = " in line and key in sentences:
            lines.append(f"# {sentences[key]}")
        lines.append(line)
    return "\n".join(lines)


def zenoh_session(run_id: str, role: str, *, make: bool) -> str:
    """Zenoh's configuration file for a program that plays a role in a run, made where it may be and is not there.

    Raises:
        BusError: there is no such run, or it has no such role.
    """
    if not make and not (runtime_base() / run_id).is_dir():
        raise BusError(
            f"there is no run {run_id!r}: start one of its processes first, or make it with --make; running are "
            f"{', '.join(running()) or 'none'}"
        )
    run = open_run(run_id)
    known = sorted({*run.links.ports, "operator", "launcher"})
    if role not in known:
        raise BusError(f"run {run_id!r} has no role {role!r}; there are {', '.join(known)}")
    HostClock()  # its file says what time the messages of this host go by
    return json.dumps(session_config(run.links, role), indent=2)
