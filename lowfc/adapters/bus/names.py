"""Names of processes and mirrors on the bus, bounded in number: a faulty program could invent names without end."""

from lowfc.adapters.bus.bus import name_in
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import HEALTH, Role, Topic, wire

MAX_NAMES = 64
"""Largest number of names on one topic, in addition to those of `Role`."""
MAX_NAME_LENGTH = 128
MAX_HEALTH_BYTES = 256_000
"""Largest Health: enough for a recorder's with `MAX_HEALTH_LOGS` logs whose paths have up to 240 bytes."""
MAX_HEALTH_LOGS = 1000
"""Largest number of logs in a recorder's Health, which then lists the newest."""


class Names:
    """The names received on each topic."""

    def __init__(self) -> None:
        self._by_topic: dict[str, set[str]] = {}

    def admit(self, topic: Topic, key: str) -> str:
        """Name of the mirror or process in a key of this topic; empty for a topic without one.

        BadMessageError if the name is too long, or is new although `MAX_NAMES` names are known already.
        """
        name = name_in(topic, key)
        names = self._by_topic.setdefault(topic.key, set())
        if name in names:
            return name
        if len(name) > MAX_NAME_LENGTH:
            raise BadMessageError(f"a name has up to {MAX_NAME_LENGTH} characters, got {len(name)}: {name[:40]!r}...")
        if name not in _ROLES:
            if len(names) >= MAX_NAMES:
                raise BadMessageError(f"{MAX_NAMES} names are known on this topic, and there is no room for {name!r}")
            names.add(name)
        return name

    def health(self, key: str, payload: bytes) -> tuple[str, wire.Health]:
        """Name and Health of a process.

        BadMessageError as for `admit`, or if the message is too large; DecodeError if it is not a Health.
        """
        if len(payload) > MAX_HEALTH_BYTES:
            raise BadMessageError(f"a Health has up to {MAX_HEALTH_BYTES} bytes, got {len(payload)}")
        health = wire.Health.FromString(payload)
        return self.admit(HEALTH, key), health


_ROLES = frozenset(Role)
