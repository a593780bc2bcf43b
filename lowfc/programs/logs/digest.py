"""A digest over what is deterministic in a log: two lockstep runs of one seed have the same."""

import hashlib
from typing import Any

from google.protobuf.message import DecodeError

from lowfc.adapters.logs.reader import Logged
from lowfc.contract.messages import FRAME, RawImage, Topic, from_timestamp


class Digest:
    """SHA-256 over the payloads of the topics that are `deterministic`, key by key.

    A key's digest is over the SHA-256 of each of its payloads in order, the log's over the lines "KEY DIGEST", sorted.
    A state that was answered to the recorder may stand in the log before an older one: states are taken in the order of
    their sequences, and of those from before the first frame the newest, for how many there are depends on who was
    ready first.
    """

    def __init__(self) -> None:
        self._keys: dict[str, Any] = {}
        self._states: dict[str, dict[int, tuple[int, bytes]]] = {}
        self._first_frame_ns: int | None = None

    def enter(self, topic: Topic, message: Logged) -> None:
        """Take the next message of a log."""
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
        found = {key: state.hexdigest() for key, state in self._keys.items()}
        for key, states in self._states.items():
            ordered = [states[sequence] for sequence in sorted(states)]
            early = [digest for time_ns, digest in ordered if time_ns < (self._first_frame_ns or 0)]
            later = [digest for time_ns, digest in ordered if time_ns >= (self._first_frame_ns or 0)]
            found[key] = hashlib.sha256(b"".join([*early[-1:], *later])).hexdigest()
        return dict(sorted(found.items()))

    def of_log(self) -> str:
        """Hexadecimal digest of the log."""
        lines = [f"{key} {digest}\n" for key, digest in self.by_key().items()]
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def _time_ns(kind: Any, payload: bytes) -> int:
    try:
        return from_timestamp(kind.FromString(payload).timestamp)
    except DecodeError:
        return 0
