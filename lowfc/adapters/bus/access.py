"""Who may do what at the router: zenoh's access control, made from the table of topics; all else is denied.

A process is known by the common name of its certificate, which is its role: "camera", "mirror-dm". Rules are seen from
the router: what comes in from a process, and what goes out to it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from lowfc.adapters.bus.bus import ALL
from lowfc.contract.messages import HEALTH, RECORD_KEY, REQUEST_KEY, TOPICS, Role, Topic

ROUTER = "router"
"""Role of the router itself: its common name, and its name in Health."""
CLOCK_KEY = "lowfc/clock"
"""Key of the router's queryable that everybody sets their envelopes' time by."""

_LOCAL = frozenset({Role.LAUNCHER, Role.REPLAY})  # these have no part in a run on several hosts


@dataclass(frozen=True, slots=True)
class Grant:
    """What a process may do; the keys of those who listen or ask have "*" for names, as theirs have.

    Attributes:
        role: common name of its certificate.
        publishes: keys that it may put, its own names only.
        heard: the same for any name: what others may have asked the router for.
        receives: keys that it may subscribe.
        answers: keys that it may answer questions at, its own names only.
        asked: the same for any name.
        asks: keys that it may ask.
    """

    role: str
    publishes: tuple[str, ...]
    heard: tuple[str, ...]
    receives: tuple[str, ...]
    answers: tuple[str, ...]
    asked: tuple[str, ...]
    asks: tuple[str, ...]


def roles(mirrors: Iterable[str]) -> tuple[str, ...]:
    """Every role that has a certificate, but the router.

    Args:
        mirrors: roles of the mirrors, such as "mirror-dm".
    """
    alone = [role for role in Role if role is not Role.MIRROR and role not in _LOCAL]
    return tuple(sorted([*map(str, alone), *mirrors]))


def grant(role: str) -> Grant:
    """What the table of topics lets a role do."""
    part, _, name = role.partition("-")
    kind = Role(part)
    published = [topic for topic in TOPICS if kind in topic.publisher]
    received = [topic for topic in TOPICS if kind in _receivers(topic)]
    answered = [topic for topic in published if topic.queryable]
    answers = [_own(topic, role, name) for topic in answered]
    asked = [topic.at(ALL) for topic in answered]
    asks = [topic.at(ALL) for topic in received if topic.queryable]
    for key, answering in ((REQUEST_KEY, Role.CONTROLLER), (RECORD_KEY, Role.RECORDER)):
        if kind is answering:
            answers.append(key.format(name=ALL))
            asked.append(key.format(name=ALL))
        if kind is Role.OPERATOR:
            asks.append(key.format(name=ALL))
    return Grant(
        role,
        publishes=tuple(_own(topic, role, name) for topic in published),
        heard=tuple(topic.at(ALL) for topic in published),
        receives=tuple(_own(topic, role, name) if kind is Role.MIRROR else topic.at(ALL) for topic in received),
        answers=tuple(answers),
        asked=tuple(asked),
        asks=(*asks, CLOCK_KEY),
    )


def access_control(mirrors: Iterable[str]) -> dict[str, Any]:
    """Zenoh's `access_control`: one subject, its rules and its policy for each role."""
    rules: list[dict[str, Any]] = []
    subjects, policies = [], []
    for role in roles(mirrors):
        own = _rules(grant(role))
        rules += own
        subjects.append({"id": role, "cert_common_names": [role]})
        policies.append({"subjects": [role], "rules": [rule["id"] for rule in own]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(given: Grant) -> list[dict[str, Any]]:
    """The rules of one role: for each direction, which messages about which keys."""
    lines = (
        ("publishes", "ingress", ["put"], given.publishes),
        ("is listened to", "egress", ["declare_subscriber"], given.heard),
        ("listens", "ingress", ["declare_subscriber"], given.receives),
        ("receives", "egress", ["put"], given.receives),
        ("answers", "ingress", ["declare_queryable", "reply"], given.answers),
        ("is asked", "egress", ["query"], given.asked),
        ("asks", "ingress", ["query"], given.asks),
        ("is answered", "egress", ["declare_queryable", "reply"], given.asks),
    )
    return [
        {
            "id": f"{given.role} {what}",
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": list(keys),
        }
        for what, flow, messages, keys in lines
        if keys
    ]


def _receivers(topic: Topic) -> frozenset[Role]:
    """Who gets a topic: an operator's own programs see what a view sees."""
    return topic.subscribers | ({Role.OPERATOR} if Role.VIEWER in topic.subscribers else frozenset())


def _own(topic: Topic, role: str, name: str) -> str:
    """Key of a topic for the names that a role may use: its own, the mirror's it is, or any mirror's."""
    return topic.at(role if topic is HEALTH else name or ALL)
