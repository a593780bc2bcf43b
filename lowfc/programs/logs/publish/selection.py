"""Choice of the keys of a log to republish, and of the roles to republish them in.

Most topics of a log were published by a role of the loop: camera, controller or a mirror. `lowfc publish` takes over
the roles of the topics that it publishes, including their ports, so that each role belongs either to the log or to a
live process, never to both.
"""

from collections.abc import Collection, Sequence
from fnmatch import fnmatchcase

from lowfc.adapters.bus.bus import name_in
from lowfc.adapters.bus.run import Links, mirror_role
from lowfc.contract.errors import BusError, ConfigurationError, nearest
from lowfc.contract.messages import BENCH, COMMAND, FRAME, HEALTH, TOPICS, Role, topic_of


class PublishedKeys:
    """Decides for every key of a log whether it is published.

    Attributes:
        roles: roles to take over, in the order of the topics. If frames are selected and no live mirror may be moved,
            the roles of all mirrors are among them, so that no mirror can join the run.
        live: roles of live processes.
    """

    def __init__(
        self, links: Links, patterns: Sequence[str], live: Collection[str], *, allow_commands: bool = False
    ) -> None:
        """Choose among the topics of a run.

        Args:
            links: links of the run.
            patterns: keys or shell patterns of keys; if empty, all keys.
            live: roles of the run that live processes have or will have.
            allow_commands: whether a live mirror may be moved.
        """
        self.live = frozenset(live)
        self._patterns = [pattern.removeprefix("/") for pattern in patterns]
        self._allow_commands = allow_commands
        keys, run = _keys(links), f"run {links.run_id!r}"
        for pattern in self._patterns:
            if COMMAND.matches(pattern) and not allow_commands:
                raise ConfigurationError(
                    f"{pattern} would move a live mirror of {run}; add --allow-commands if that is intended"
                )
            if not any(fnmatchcase(key, pattern) for key in keys) and not any(one.matches(pattern) for one in TOPICS):
                raise ConfigurationError(
                    f"no topic fits {pattern!r}{nearest(pattern, keys)}; give a key or a shell pattern, "
                    "such as 'lowfc/camera/*'"
                )
        selected = list(filter(self.matches, keys))
        for key in selected:
            # Live and recorded devices must not mix; topics of a live controller are left out unless named.
            role = role_of(key)
            if role in self.live and (role != Role.CONTROLLER or key in self._patterns):
                raise BusError(
                    f"{role} of {run} is live and publishes {key} itself; stop it, publish in another run (--run), "
                    "or choose topics that it does not publish (--topics)"
                )
        roles = [role_of(key) for key in selected if not self.exclusion_reason(key)]
        if FRAME.key in selected and not allow_commands:  # commands computed from the frames would move a mirror
            roles += links.mirrors
            if mirrors := sorted(self.live.intersection(links.mirrors)):
                raise BusError(
                    f"{mirrors[0]} of {run} is live, and a controller that receives the frames of a log would move it; "
                    "stop it, or add --allow-commands if that is intended"
                )
        self.roles = tuple(role for role in dict.fromkeys(roles) if role)

    def matches(self, key: str) -> bool:
        """Whether a key matches the patterns."""
        return not self._patterns or any(fnmatchcase(key, pattern) for pattern in self._patterns)

    def exclusion_reason(self, key: str) -> str:
        """Reason why a matching key is left out; empty if it is published."""
        if COMMAND.matches(key) and not self._allow_commands:
            return "commands move a mirror; --allow-commands publishes them"
        role = role_of(key)
        if role and not _in_loop(role):
            return f"{role} is not part of the loop"
        return f"{role} is live" if role in self.live else ""


def role_of(key: str) -> str:
    """Role of the process that publishes a key; empty for a topic with several publishers."""
    topic = topic_of(key)
    name = name_in(topic, key)
    if topic is HEALTH:
        return name
    if topic is BENCH:  # not published: an interlock would act on a recorded value
        return Role.BENCH
    if len(topic.publishers) > 1:
        return ""
    (role,) = topic.publishers
    return mirror_role(name) if role is Role.MIRROR else role


def _in_loop(role: str) -> bool:
    return role.partition("-")[0] in (Role.CAMERA, Role.CONTROLLER, Role.MIRROR)


def _keys(links: Links) -> list[str]:
    mirrors = [role.removeprefix(f"{Role.MIRROR}-") for role in links.mirrors] or [""]
    names = dict.fromkeys(TOPICS, mirrors) | {HEALTH: list(filter(_in_loop, links.ports))}
    return list(dict.fromkeys(topic.at(name) for topic in TOPICS for name in names[topic]))
