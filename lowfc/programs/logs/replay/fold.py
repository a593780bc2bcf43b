"""Replay: the live loop's own `advance`, folded over a log, and every step, command, answer and state compared.

A log numbers what its controller took in. From a complete state on, input after input is taken again and what comes
out is compared with what the log has, byte by byte. Where an input is not in the log, the fold waits for the next
state and counts the steps that it could not check.
"""

import contextlib
from collections.abc import Iterable

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.contract import published
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import COMMAND, CONTROL_INPUT, CONTROLLER_STATE, FRAME, REQUEST, STEP, topic_of
from lowfc.programs.logs.replay.account import Account
from lowfc.programs.logs.replay.controller_replay import PATIENCE_NS, WHOLE, Context, ControllerReplay, Share

TOPICS = (FRAME, STEP, COMMAND, CONTROL_INPUT, CONTROLLER_STATE, REQUEST, *published.TOPICS)
"""What a replay reads of a log."""


class Replay:
    """Takes the messages of a log, or of several that follow each other, and keeps the account."""

    def __init__(self, tolerance_nm: float = 0.0, share: Share = WHOLE, kernel: str = "") -> None:
        """Differences up to `tolerance_nm` are none: for a log of another kind of processor, or another `kernel`."""
        self.context = Context(tolerance_nm, share, kernel=kernel)
        self._controllers: dict[int, ControllerReplay] = {}
        self._last_ns = self._begun_ns = self._ended_ns = 0

    @property
    def duration_s(self) -> float:
        """From the first frame of the share to its last, by their log times."""
        return (self._ended_ns - self._begun_ns) * 1e-9

    def take(self, message: Sample) -> None:
        """Take the next message."""
        context, topic = self.context, topic_of(message.key)
        self._last_ns = now_ns = message.receive_time_ns
        if now_ns < context.share.from_ns - PATIENCE_NS and topic not in published.TOPICS:
            return
        inside = context.share.from_ns <= now_ns < context.share.until_ns
        if topic is FRAME:
            context.frames.add(message.sequence, message.payload)
            if inside:
                self._begun_ns, self._ended_ns = self._begun_ns or now_ns, now_ns
        elif topic in published.TOPICS:
            context.published.take(topic, message.payload)
            for controller in self._controllers.values():
                controller.retry_pending = True
        elif topic in TOPICS:
            context.account.steps += topic is STEP and inside
            with contextlib.suppress(DecodeError):  # its number is missing then, which the fold will find
                self._controller(message).take(message, topic.message)

    @property
    def done(self) -> bool:
        """Whether the share has been replayed by every controller."""
        if self._last_ns - self.context.share.until_ns <= PATIENCE_NS:
            return False
        newest = max(self._controllers, default=0)
        return all(controller.done or start_s < newest for start_s, controller in self._controllers.items())

    def finish(self) -> Account:
        """The log, or the share, has ended."""
        for controller in self._controllers.values():
            controller.go_on(self._last_ns, ended=True)
        return self.context.account

    def _controller(self, message: Sample) -> ControllerReplay:
        start_s = start_of(message.sequence)
        if start_s not in self._controllers:
            self._controllers[start_s] = ControllerReplay(self.context, message.receive_time_ns)
        return self._controllers[start_s]


def replay(messages: Iterable[Sample], tolerance_nm: float = 0.0, share: Share = WHOLE, kernel: str = "") -> Account:
    """Replay a log's messages from beginning to end, or a share of them."""
    run = Replay(tolerance_nm, share, kernel)
    for message in messages:
        run.take(message)
        if run.done:
            break
    return run.finish()
