"""Access control at the router: the table of topics defines what is permitted, all other messages are denied.

The common name of a process's certificate is its role: "camera", "mirror-dm". Directions are seen from the router:
ingress is from a process to the router, egress from the router to a process.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from lowfc.adapters.bus.bus import ALL
from lowfc.contract.messages import COMMAND, HEALTH, RECORD_KEY, REQUEST_KEY, TOPICS, Role, Topic

ROUTER = "router"
"""Role of the router itself: its common name, and its name in Health."""
CLOCK_KEY = "lowfc/clock"
"""Key of the queryable that answers with the router's time, with which envelopes are stamped on several hosts."""

_LOCAL = frozenset({Role.LAUNCHER, Role.REPLAY})  # never part of a run on several hosts


@dataclass(frozen=True, slots=True)
class Grant:
    """Rights of a role, as lists of keys.

    `subscribed` are the role's keys to which other processes may subscribe, `queried` those that they may query. A role
    publishes Health under its own name only; a mirror publishes, answers queries and receives commands only under its
    own name. All other keys have "*" in place of a name.
    """

    role: str
    publishes: tuple[str, ...]
    subscribed: tuple[str, ...]
    receives: tuple[str, ...]
    answers: tuple[str, ...]
    queried: tuple[str, ...]
    queries: tuple[str, ...]


def roles(mirrors: Iterable[str]) -> tuple[str, ...]:
    """Every role with a certificate except the router, including `mirrors` such as "mirror-dm"."""
    unnamed = [role for role in Role if role is not Role.MIRROR and role not in _LOCAL]
    return tuple(sorted([*map(str, unnamed), *mirrors]))


def grant(role: str) -> Grant:
    """Rights of a role according to the table of topics."""
    part, _, name = role.partition("-")
    kind = Role(part)
    published = [topic for topic in TOPICS if kind in topic.publishers]
    receiver = Role.VIEWER if kind is Role.OPERATOR else kind  # an operator's own programs receive what viewers receive
    received = [topic for topic in TOPICS if {kind, receiver} & topic.subscribers]
    answered = [topic for topic in published if topic.queryable]
    answers = [_own(topic, role, name) for topic in answered]
    queried = [topic.at(ALL) for topic in answered]
    queries = [topic.at(ALL) for topic in received if topic.queryable]
    for key, answering in ((REQUEST_KEY, Role.CONTROLLER), (RECORD_KEY, Role.RECORDER)):
        if kind is answering:
            answers.append(key.format(name=ALL))
            queried.append(key.format(name=ALL))
        if kind is Role.OPERATOR:
            queries.append(key.format(name=ALL))
    return Grant(
        role,
        publishes=tuple(_own(topic, role, name) for topic in published),
        subscribed=tuple(topic.at(ALL) for topic in published),
        receives=tuple(topic.at(name if topic is COMMAND and name else ALL) for topic in received),
        answers=tuple(answers),
        queried=tuple(queried),
        queries=(*queries, CLOCK_KEY),
    )


def access_control(mirrors: Iterable[str]) -> dict[str, Any]:
    """Zenoh's `access_control`: one subject, its rules and its policy for each role."""
    rules: list[dict[str, Any]] = []
    subjects, policies = [], []
    for role in roles(mirrors):
        role_rules = _rules(grant(role))
        rules += role_rules
        subjects.append({"id": role, "cert_common_names": [role]})
        policies.append({"subjects": [role], "rules": [rule["id"] for rule in role_rules]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def _rules(rights: Grant) -> list[dict[str, Any]]:
    """Rules of one role: permitted messages and keys in each direction."""
    lines = (
        ("publishes", "ingress", ["put"], rights.publishes),
        ("is subscribed to", "egress", ["declare_subscriber"], rights.subscribed),
        ("subscribes", "ingress", ["declare_subscriber"], rights.receives),
        ("receives", "egress", ["put"], rights.receives),
        ("answers", "ingress", ["declare_queryable", "reply"], rights.answers),
        ("is queried", "egress", ["query"], rights.queried),
        ("queries", "ingress", ["query"], rights.queries),
        ("is answered", "egress", ["declare_queryable", "reply"], rights.queries),
    )
    return [
        {
            "id": f"{rights.role} {what}",
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": list(keys),
        }
        for what, flow, messages, keys in lines
        if keys
    ]


def _own(topic: Topic, role: str, name: str) -> str:
    """Key of a topic with the name that a role may use: the role itself (Health), its mirror's name, or any name."""
    return topic.at(role if topic is HEALTH else name or ALL)
