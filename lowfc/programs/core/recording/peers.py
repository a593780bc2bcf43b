"""State of the other processes of a run for the recorder: their Health, and the states that each log starts with."""

import contextlib
from concurrent.futures import Future, ThreadPoolExecutor

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Bus, Sample, last_messages, name_in
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import CAMERA_STATE, HEALTH, TOPICS, wire


class Peers:
    """The last `Health.state` of each process; `newest` has the last message of every queryable key but Health.

    A log starts with the messages in `newest`: calibration, law, probe table, bench values, and the states of camera
    and controller.
    """

    def __init__(self, bus: Bus) -> None:
        self.newest: dict[str, Sample] = {}
        self._bus = bus
        self._states: dict[str, tuple[int, str]] = {}
        self._query_due = False
        self._queried: set[tuple[str, int]] = set()
        self._thread = ThreadPoolExecutor(1, "query")
        self._answers: Future[list[Sample]] | None = None

    def note(self, sample: Sample, health: wire.Health) -> None:
        """Store the state of a process, unless a later start of the process has already reported."""
        name, start_s = name_in(HEALTH, sample.key), start_of(sample.sequence)
        last_start_s, _ = self._states.get(name, (-1, ""))
        self._query_due |= start_s > last_start_s
        if start_s >= last_start_s:
            self._states[name] = start_s, health.state

    def stopped(self, except_name: str) -> bool:
        """Whether all processes except `except_name` have reported that they stopped."""
        return all(state == "stopped" for name, (_, state) in self._states.items() if name != except_name)

    def store(self, sample: Sample) -> bool:
        """Store a calibration or state unless the same or a newer one is known; return whether it was stored."""
        kept = self.newest.get(sample.key)
        newer = kept is None or (kept.publish_time_ns, kept.sequence) < (sample.publish_time_ns, sample.sequence)
        if newer:
            self.newest[sample.key] = sample
        return newer

    def camera(self) -> wire.CameraState | None:
        """The camera's newest state; None if there is none, or if it cannot be read."""
        sample = self.newest.get(CAMERA_STATE.key)
        with contextlib.suppress(DecodeError):
            return wire.CameraState.FromString(sample.payload) if sample is not None else None
        return None

    def already_received(self, sample: Sample) -> bool:
        """Whether a query returned this message before the bus delivered it; true once per message."""
        was_queried = (sample.key, sample.sequence) in self._queried
        self._queried.discard((sample.key, sample.sequence))
        return was_queried

    def query(self) -> list[Sample]:
        """Query calibration and states; return those that are new: published before this process started, or lost."""
        return self._store_new(self._query_all())

    def query_soon(self) -> None:
        """Query at the next opportunity: a message may have been lost."""
        self._query_due = True

    def query_in_background(self, *, start: bool) -> list[Sample]:
        """With `start`, query if a query is due; return the new messages among the answers since the last call.

        A thread does the query, because a frozen process answers late.
        """
        if start and self._query_due and self._answers is None:
            self._answers = self._thread.submit(self._query_all)
            self._query_due = False
        if self._answers is None or not self._answers.done():
            return []
        answers, self._answers = self._answers, None
        return self._store_new(answers.result())

    def _query_all(self) -> list[Sample]:
        return [sample for _, sample in last_messages(self._bus, TOPICS)]

    def _store_new(self, answers: list[Sample]) -> list[Sample]:
        new = [sample for sample in answers if self.store(sample)]
        self._queried.update((sample.key, sample.sequence) for sample in new)
        return new
