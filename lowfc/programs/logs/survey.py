"""Contents of a log: times, loop modes, events, messages of each topic, and what is missing."""

import contextlib
import dataclasses
import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.history import attached_configuration
from lowfc.adapters.logs.loss_account import LossAccount
from lowfc.adapters.logs.parts import LogFiles, WholeLog
from lowfc.adapters.logs.recovery import RECOVERY
from lowfc.adapters.logs.selection import EVERYTHING, Selection
from lowfc.adapters.logs.writer import being_recorded
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import BadMessageError
from lowfc.contract.events import Level
from lowfc.contract.messages import (
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    HEALTH,
    Log,
    Rate,
    RawImage,
    Topic,
    from_timestamp,
    known_topic,
    wire,
)
from lowfc.control.loop.safety import mode_name

_MIN_FOR_RATE = 10
"""Fewest messages of a topic from which a rate is computed."""


class Digest:
    """SHA-256 over the payloads of the topics that are `deterministic`, key by key.

    The digest of a key is over the SHA-256 of its payloads in order; the digest of the log is over the sorted lines
    "KEY DIGEST". A state requested by the recorder may precede an older one in the log, so states are sorted by
    sequence. Of the states before the first frame only the newest counts, because their number depends on the order in
    which the processes start.
    """

    def __init__(self) -> None:
        self._keys: dict[str, Any] = {}
        self._states: dict[str, dict[int, tuple[int, bytes]]] = {}
        self._first_frame_ns: int | None = None

    def enter(self, topic: Topic, message: Sample) -> None:
        """Add the next message of a log."""
        if not topic.deterministic:
            return
        if topic is FRAME and self._first_frame_ns is None:
            self._first_frame_ns = _time_ns(RawImage, message.payload)
        digest = hashlib.sha256(message.payload).digest()
        if topic.queryable:
            states = self._states.setdefault(message.key, {})
            states[message.sequence] = _time_ns(topic.message, message.payload), digest
        else:
            self._keys.setdefault(message.key, hashlib.sha256()).update(digest)

    def by_key(self) -> dict[str, str]:
        """Hexadecimal digest of each key."""
        digests = {key: digest.hexdigest() for key, digest in self._keys.items()}
        for key, states in self._states.items():
            ordered = [states[sequence] for sequence in sorted(states)]
            early = [digest for time_ns, digest in ordered if time_ns < (self._first_frame_ns or 0)]
            later = [digest for time_ns, digest in ordered if time_ns >= (self._first_frame_ns or 0)]
            digests[key] = hashlib.sha256(b"".join([*early[-1:], *later])).hexdigest()
        return dict(sorted(digests.items()))

    def hexdigest(self) -> str:
        """Hexadecimal digest of the log."""
        lines = [f"{key} {digest}\n" for key, digest in self.by_key().items()]
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def _time_ns(kind: Any, payload: bytes) -> int:
    try:
        return from_timestamp(kind.FromString(payload).timestamp)
    except DecodeError:
        return 0


@dataclass(slots=True)
class _TopicRow:
    """Row of the table of topics: the messages of one key; `starts` holds their publishers and start times."""

    schema: str
    first_ns: int
    last_ns: int
    messages: int = 0
    size: int = 0
    starts: set[tuple[str, int]] = field(default_factory=set)

    def json_object(self, topic: Topic | None, missing: int | None) -> dict[str, Any]:
        length_s = (self.last_ns - self.first_ns) / 1e9
        has_rate = self.messages >= _MIN_FOR_RATE and (topic is None or topic.rate is not Rate.EVENT)
        return {
            "messages": self.messages,
            "rate_hz": round((self.messages - 1) / length_s, 3) if has_rate and length_s > 0 else None,
            "bytes": self.size,
            "restarts": len(self.starts) - len({publisher for publisher, _ in self.starts}),
            "missing": missing,
            "schema": self.schema,
        }


class _MessageCounts:
    """Counts of a log's messages; `selection`: the messages that the recorder was to write."""

    def __init__(self, selection: Selection = EVERYTHING) -> None:
        self._selection = selection
        self._losses = LossAccount(selection)
        self._rows: dict[str, _TopicRow] = {}
        self._events: Counter[str] = Counter()
        self._modes: list[str] = []
        self._begin_ns: int | None = None
        self._end_ns = 0

    def enter(self, topic: Topic | None, message: Sample, schema: str) -> None:
        """Count a message."""
        now_ns = message.receive_time_ns
        row = self._rows.setdefault(message.key, _TopicRow(schema, now_ns, now_ns))
        row.messages += 1
        row.size += len(message.payload)
        row.first_ns, row.last_ns = min(row.first_ns, now_ns), max(row.last_ns, now_ns)
        if topic is None:
            return
        self._end_ns = max(self._end_ns, now_ns)
        if not topic.queryable and (self._begin_ns is None or now_ns < self._begin_ns):
            self._begin_ns = now_ns  # states and calibration, queried at the log's start, may be hours old
        self._losses.enter(topic, message, recorded=True)
        publisher = ""  # set for events: several processes publish their key
        with contextlib.suppress(BadMessageError, DecodeError):  # a log holds unreadable messages, too
            if topic is HEALTH:
                self._losses.reconcile(message, wire.Health.FromString(message.payload))
            elif topic is CONTROLLER_STATE:
                mode = mode_name(wire.ControllerState.FromString(message.payload).mode)
                if self._modes[-1:] != [mode]:
                    self._modes.append(mode)
            elif topic is EVENT:
                event = Log.FromString(message.payload)
                publisher = event.name
                if event.level >= Level.WARNING:
                    self._events[event.message.partition(" ")[0]] += 1
        row.starts.add((publisher, start_of(message.sequence)))

    def json_object(self) -> dict[str, Any]:
        """The counts as a dictionary."""
        missing = self._losses.lost()
        begin = None if self._begin_ns is None else datetime.fromtimestamp(self._begin_ns / 1e9, UTC)
        topics = {}
        for key, row in sorted(self._rows.items()):
            is_counted = (topic := known_topic(key)) is None or self._selection.records_all(topic)
            topics[key] = row.json_object(topic, missing.get(key, 0) if is_counted else None)
        return {
            "start": None if begin is None else begin.isoformat(timespec="milliseconds"),
            "duration_s": None if self._begin_ns is None else round((self._end_ns - self._begin_ns) / 1e9, 3),
            "messages": sum(row.messages for row in self._rows.values()),
            "messages_missing": sum(missing.values()),
            "topics": topics,
            "missing_topics": {key: count for key, count in missing.items() if key not in self._rows},
            "loop_modes": self._modes,
            "events": dict(self._events.most_common()),
        }


def survey(
    log: LogFiles, progress: Callable[[int, int], None] | None = None, *, digest: bool = False
) -> dict[str, Any]:
    """Summary of a log, complete or not, from all of its messages; `digest` adds digests of the log and of each key."""
    reader, counts, digests = WholeLog(log, progress), _MessageCounts(), Digest()
    for number, message in enumerate(reader):
        if not number:
            counts = _MessageCounts(reader.selection)  # the selection is known from the first message on
        topic = known_topic(message.key)
        counts.enter(topic, message, reader.schema_of(message))
        if digest and topic is not None:
            digests.enter(topic, message)
    configuration, remarks = attached_configuration(reader)
    content = counts.json_object()
    for key, hexadecimal in digests.by_key().items():
        content["topics"][key]["digest"] = hexadecimal
    return {
        "log": str(reader.path),
        "files": [str(path) for path in reader.paths],
        **({"digest": digests.hexdigest()} if digest else {}),
        "lockstep": configuration.lockstep if configuration is not None else None,
        "selection": reader.selection.description,
        "bytes": reader.size,
        "state": _state(reader),
        **content,
        "unreadable": reader.unreadable,
        "damage": [dataclasses.asdict(damage) for damage in reader.damage],
        "metadata": reader.metadata,
        "attachments": {name: len(data) for name, data in reader.attachments.items()},
        "remarks": remarks,
    }


def _state(reader: WholeLog) -> str:
    if reader.damage or reader.unreadable:
        return "damaged"
    if reader.complete:
        return "complete"
    return "recording" if any(map(being_recorded, reader.paths)) else "truncated"


def recovery_in_words(metadata: Mapping[str, Mapping[str, str]]) -> str:
    """Text on the source of a recovered log and on what was left out; empty for any other log."""
    recovery = metadata.get(RECOVERY)
    if recovery is None:
        return ""
    unfinished = ", which was incomplete" if recovery.get("source_finished") == "false" else ""
    parts, unreadable = recovery.get("left_out", "?"), recovery.get("unreadable", "?")
    return (
        f"recovered from {recovery.get('source', '?')}{unfinished}; "
        f"left out: damaged parts {parts}, unreadable messages {unreadable}"
    )
