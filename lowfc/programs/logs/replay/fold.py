"""Replay: the live loop's own `advance`, folded over a log, and every step, command, answer and state compared.

A log numbers what its controller took in. From a complete state on, input after input is taken again and what comes
out is compared with what the log has, byte by byte. Where an input is not in the log, the fold waits for the next
state and counts the steps that it could not check.
"""

import contextlib
from collections.abc import Iterable

from google.protobuf.message import DecodeError

from lowfc.adapters.logs.reader import Logged
from lowfc.contract import published
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import COMMAND, CONTROL_INPUT, CONTROLLER_STATE, FRAME, REQUEST, STEP, topic_of
from lowfc.programs.logs.replay.account import Account
from lowfc.programs.logs.replay.controller_replay import PATIENCE_NS, WHOLE, ControllerReplay, Frames, Share
from lowfc.programs.logs.replay.former import Former

TOPICS = (FRAME, STEP, COMMAND, CONTROL_INPUT, CONTROLLER_STATE, REQUEST, *published.TOPICS)
"""What a replay reads of a log."""


class Replay:
    """Takes the messages of a log, or of several that follow each other, and keeps the account."""

    def __init__(self, tolerance_nm: float = 0.0, share: Share = WHOLE) -> None:
        """Differences up to `tolerance_nm` are none: for a log of another kind of processor.

        Attributes:
            former: what is compared of the log of another version, to be set before the first message.
        """
        self.former: Former | None = None
        self.account = Account()
        self._tolerance_nm = tolerance_nm
        self._share = share
        self._from_ns = share.from_ns - PATIENCE_NS
        self._frames = Frames()
        self._published = published.Published()
        self._lanes: dict[int, ControllerReplay] = {}
        self._last_ns = self._begun_ns = self._ended_ns = 0

    @property
    def duration_s(self) -> float:
        """From the first frame of the share to its last, by their log times."""
        return (self._ended_ns - self._begun_ns) * 1e-9

    def take(self, message: Logged) -> None:
        """Take the next message.

        Raises:
            DataFileError: the log is from before the inputs of the controller were numbered.
        """
        self._last_ns = message.log_time_ns
        topic = topic_of(message.key)
        if message.log_time_ns < self._from_ns and topic not in published.TOPICS:
            return
        if topic is FRAME:
            self._frames.add(message.sequence, message.payload)
            if self._share.from_ns <= message.log_time_ns < self._share.until_ns:
                self._begun_ns = self._begun_ns or message.log_time_ns
                self._ended_ns = message.log_time_ns
        elif topic in published.TOPICS:
            self._published.take(topic, message.payload)
            for lane in self._lanes.values():
                lane.retry_pending = True
        elif topic in TOPICS:
            if topic is STEP and self._share.from_ns <= message.log_time_ns < self._share.until_ns:
                self.account.steps += 1
            with contextlib.suppress(DecodeError):  # its number is missing then, which the fold will find
                self._lane(message).take(message, topic.message)

    @property
    def done(self) -> bool:
        """Whether the share has been replayed: no controller has anything more to say about it."""
        if self._last_ns - self._share.until_ns <= PATIENCE_NS:
            return False
        newest = max(self._lanes, default=0)
        return all(lane.done or start_s < newest for start_s, lane in self._lanes.items())

    def finish(self) -> Account:
        """The log, or the share, has ended."""
        for lane in self._lanes.values():
            lane.go_on(self._last_ns, ended=True)
        return self.account

    def _lane(self, message: Logged) -> ControllerReplay:
        start_s = start_of(message.sequence)
        lane = self._lanes.get(start_s)
        if lane is None:
            known = self._frames, self._published, self.account, self._tolerance_nm, self._share
            lane = self._lanes[start_s] = ControllerReplay(*known, message.log_time_ns, self.former)
        return lane


def replay(messages: Iterable[Logged], tolerance_nm: float = 0.0, share: Share = WHOLE) -> Account:
    """Replay a log's messages from beginning to end, or a share of them.

    Raises:
        DataFileError: see `Replay.take`.
    """
    run = Replay(tolerance_nm, share)
    for message in messages:
        run.take(message)
        if run.done:
            break
    return run.finish()
