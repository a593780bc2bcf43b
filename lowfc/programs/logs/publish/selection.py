"""Which messages of a log go back on a run's bus, and in whose place.

Every topic of a log was published by a role of the loop. A replay takes the places of those roles, ports included, so
that a role is played either by the log or by a live process and never by both.
"""

from collections.abc import Collection, Sequence
from fnmatch import fnmatchcase

from lowfc.adapters.bus.bus import name_in
from lowfc.adapters.bus.run import Links, mirror_role
from lowfc.contract.errors import BusError, ConfigurationError, nearest
from lowfc.contract.messages import BENCH, COMMAND, FRAME, HEALTH, TOPICS, Role, topic_of


class Selection:
    """Decides for every key of a log whether it is played.

    Attributes:
        roles: whose places the replay takes, in the order of the topics; those of all mirrors with frames, unless a
            live mirror may be moved.
        live: roles that others play.
    """

    def __init__(
        self, links: Links, patterns: Sequence[str], live: Collection[str], *, allow_commands: bool = False
    ) -> None:
        """Choose among the topics of a run.

        Args:
            links: of the run.
            patterns: names or shell patterns of keys; everything when empty.
            live: roles of the run that processes play, or shall play.
            allow_commands: whether a live mirror may be moved.
        """
        self.live = frozenset(live)
        self._patterns = [pattern.removeprefix("/") for pattern in patterns]
        self._allow_commands = allow_commands
        keys, run = _keys(links), f"run {links.run_id!r}"
        for pattern in self._patterns:
            if COMMAND.matches(pattern) and not allow_commands:
                raise ConfigurationError(
                    f"{pattern} would move a mirror that listens in {run}; add --allow-commands if that is meant"
                )
            if not any(fnmatchcase(key, pattern) for key in keys) and not any(one.matches(pattern) for one in TOPICS):
                raise ConfigurationError(
                    f"no topic fits {pattern!r}{nearest(pattern, keys)}; give a key or a shell pattern, "
                    "such as 'lowfc/camera/*'"
                )
        asked = list(filter(self.asked, keys))
        for key in asked:
            # A live device and a recorded one must not mix; what a live controller publishes is left out unless named.
            role = role_of(key)
            if role in self.live and (role != Role.CONTROLLER or key in self._patterns):
                raise BusError(
                    f"{role} of {run} is live and publishes {key} itself; stop it, replay into another run (--run), "
                    "or choose topics that it does not publish (--topics)"
                )
        wanted = [role_of(key) for key in asked if not self.why_not(key)]
        if FRAME.key in asked and not allow_commands:  # a mirror that came up later would follow the frames
            wanted += links.mirrors
            if mirrors := sorted(self.live.intersection(links.mirrors)):
                raise BusError(
                    f"{mirrors[0]} of {run} is live, and a controller that gets the frames of a log would move it; "
                    "stop it, or add --allow-commands if that is meant"
                )
        self.roles = tuple(role for role in dict.fromkeys(wanted) if role)

    def asked(self, key: str) -> bool:
        """Whether the patterns fit a key."""
        return not self._patterns or any(fnmatchcase(key, pattern) for pattern in self._patterns)

    def why_not(self, key: str) -> str:
        """Why a key is left out although the patterns fit; empty where it is played."""
        if COMMAND.matches(key) and not self._allow_commands:
            return "commands move a mirror; --allow-commands plays them"
        role = role_of(key)
        if role and not _in_loop(role):
            return f"{role} is no part of the loop"
        return f"{role} is live" if role in self.live else ""


def role_of(key: str) -> str:
    """Role of the process that publishes a key; empty for a topic that all share."""
    topic = topic_of(key)
    name = name_in(topic, key)
    if topic is HEALTH:
        return name
    if topic is BENCH:  # of a log, it would speak for what is on the bench now
        return Role.BENCH
    if len(topic.publisher) > 1:
        return ""
    (role,) = topic.publisher
    return mirror_role(name) if role is Role.MIRROR else role


def _in_loop(role: str) -> bool:
    return role.partition("-")[0] in (Role.CAMERA, Role.CONTROLLER, Role.MIRROR)


def _keys(links: Links) -> list[str]:
    mirrors = [role.removeprefix(f"{Role.MIRROR}-") for role in links.mirrors] or [""]
    names = dict.fromkeys(TOPICS, mirrors) | {HEALTH: list(filter(_in_loop, links.ports))}
    return list(dict.fromkeys(topic.at(name) for topic in TOPICS for name in names[topic]))
