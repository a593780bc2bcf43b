"""Which messages of a log go back on a run's bus, and in whose place.

Every topic of a log was published by a role of the loop. A replay takes the places of those roles, ports included, so
that a role is played either by the log or by a live process and never by both.
"""

from collections.abc import Collection, Iterator, Sequence
from fnmatch import fnmatchcase

from lowfc.adapters.bus.bus import name_in
from lowfc.adapters.bus.run import Links, mirror_role
from lowfc.contract.errors import BusError, ConfigurationError, nearest
from lowfc.contract.messages import COMMAND, FRAME, HEALTH, TOPICS, Role, Topic, topic_of

_MIRROR = f"{Role.MIRROR}-"


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

        Raises:
            ConfigurationError: a pattern fits no topic, or asks for commands without leave.
            BusError: a live process publishes what was asked for.
        """
        self.live = frozenset(live)
        self._patterns = [pattern.removeprefix("/") for pattern in patterns]
        self._allow_commands = allow_commands
        self._run_id = links.run_id
        keys = list(_keys(links))
        for pattern in self._patterns:
            self._check_pattern(pattern, keys)
        for key in keys:
            if self.asked(key):
                self._check_live(key)
        self._check_mirrors()
        wanted = [role_of(key) for key in keys if self.asked(key) and not self.why_not(key)]
        if self.asked(FRAME.key) and not allow_commands:  # a mirror that came up later would follow the frames
            wanted += filter(_is_mirror, links.ports)
        self.roles = tuple(role for role in dict.fromkeys(wanted) if role)

    def asked(self, key: str) -> bool:
        """Whether the patterns fit a key."""
        return not self._patterns or any(_fits(pattern, key) for pattern in self._patterns)

    def why_not(self, key: str) -> str:
        """Why a key is left out although the patterns fit; empty where it is played."""
        if COMMAND.matches(key) and not self._allow_commands:
            return "commands move a mirror; --allow-commands plays them"
        role = role_of(key)
        if role and not _in_loop(role):
            return f"{role} is no part of the loop"
        return f"{role} is live" if role in self.live else ""

    def _check_pattern(self, pattern: str, keys: list[str]) -> None:
        if COMMAND.matches(pattern) and not self._allow_commands:
            raise ConfigurationError(
                f"{pattern} would move the mirror of whoever listens in run {self._run_id!r}; "
                "add --allow-commands if that is meant"
            )
        known = any(_fits(pattern, key) for key in keys) or any(topic.matches(pattern) for topic in TOPICS)
        if not known:
            raise ConfigurationError(
                f"no topic fits {pattern!r}{nearest(pattern, keys)}; give a key or a shell pattern, "
                "such as 'lowfc/camera/*'"
            )

    def _check_live(self, key: str) -> None:
        """A live device and a recorded one must not mix; what else is live is left out unless it is asked for."""
        role = role_of(key)
        if role in self.live and (role != Role.CONTROLLER or key in self._patterns):
            raise BusError(
                f"{role} of run {self._run_id!r} is live and publishes {key} itself; stop it, replay into another "
                "run (--run), or choose topics that it does not publish (--topics)"
            )

    def _check_mirrors(self) -> None:
        mirrors = sorted(filter(_is_mirror, self.live))
        if mirrors and self.asked(FRAME.key) and not self._allow_commands:
            raise BusError(
                f"{mirrors[0]} of run {self._run_id!r} is live, and a controller that gets the frames of a log would "
                "move it; stop it, or add --allow-commands if that is meant"
            )


def role_of(key: str) -> str:
    """Role of the process that publishes a key; empty for a topic that all share."""
    topic = topic_of(key)
    name = name_in(topic, key)
    if topic is HEALTH:
        return name
    if len(topic.publisher) > 1:
        return ""
    (role,) = topic.publisher
    return mirror_role(name) if role is Role.MIRROR else role


def _is_mirror(role: str) -> bool:
    return role.startswith(_MIRROR)


def _in_loop(role: str) -> bool:
    return role in (Role.CAMERA, Role.CONTROLLER) or _is_mirror(role)


def _keys(links: Links) -> Iterator[str]:
    for topic in TOPICS:
        for name in _names(topic, links):
            yield topic.at(name)


def _names(topic: Topic, links: Links) -> list[str]:
    if topic is HEALTH:
        return sorted(filter(_in_loop, links.ports))
    if topic.at("") == topic.key:
        return [""]
    return sorted(role.removeprefix(_MIRROR) for role in links.ports if _is_mirror(role))


def _fits(pattern: str, key: str) -> bool:
    return fnmatchcase(key, pattern)
