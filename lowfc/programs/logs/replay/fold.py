"""Replay of a log: its messages go to one `ControllerReplay` for each start of the controller.

A log numbers the inputs of its controller. From a complete state on, the inputs are applied one by one, and the results
are compared with the log byte by byte. If an input is missing from the log, the replay waits for the next state and
counts the steps that it could not check.
"""

import contextlib
from collections.abc import Mapping

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.writer import PART
from lowfc.contract import published
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import COMMAND, CONTROL_INPUT, CONTROLLER_STATE, FRAME, REQUEST, STEP, topic_of
from lowfc.programs.logs.replay.account import Account
from lowfc.programs.logs.replay.controller_replay import PATIENCE_NS, WHOLE, Context, ControllerReplay, Segment
from lowfc.programs.logs.replay.frames import Frames

TOPICS = (FRAME, STEP, COMMAND, CONTROL_INPUT, CONTROLLER_STATE, REQUEST, *published.TOPICS)
"""Topics that a replay reads."""


class Replay:
    """Replay of a log, or of consecutive logs, message by message."""

    def __init__(self, tolerance_nm: float = 0.0, segment: Segment = WHOLE, kernel: str = "") -> None:
        """Replay a segment of the log; tolerance and kernel are those of `Context`."""
        self.context = Context(tolerance_nm, segment, kernel=kernel)
        self._controllers: dict[int, ControllerReplay] = {}
        self._recording = "", ""
        self._last_ns = 0

    def begin_file(self, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """Begin a file; if it is of another recording, forget controllers and frames: lockstep runs share sequences."""
        recording = metadata.get("lowfc", {}).get("run", ""), metadata.get(PART, {}).get("of", "")
        if recording != self._recording:
            self.finish()
            self._controllers.clear()
            self.context.frames = Frames()
        self._recording = recording

    def add(self, message: Sample) -> None:
        """Add the next message."""
        context, topic = self.context, topic_of(message.key)
        self._last_ns = now_ns = message.receive_time_ns
        if now_ns < context.segment.from_ns - PATIENCE_NS and topic not in published.TOPICS:
            return
        in_segment = context.segment.from_ns <= now_ns < context.segment.until_ns
        if topic is FRAME:
            context.frames.add(message.sequence, message.payload)
            if in_segment:
                context.account.span_ns = context.account.span_ns[0] or now_ns, now_ns
        elif topic in published.TOPICS:
            context.published.store(topic, message.payload)
            for controller in self._controllers.values():
                controller.retry_pending = True
        elif topic in TOPICS:
            context.account.steps += topic is STEP and in_segment
            with contextlib.suppress(DecodeError):  # the input of an unreadable message counts as missing
                self._controller(message).add(message, topic.message)

    @property
    def done(self) -> bool:
        """Whether every controller has replayed its part of the segment."""
        if self._last_ns - self.context.segment.until_ns <= PATIENCE_NS:
            return False
        newest = max(self._controllers, default=0)
        return all(controller.done or start_s < newest for start_s, controller in self._controllers.items())

    def finish(self) -> Account:
        """Replay the rest at the end of the log or segment, and return the account."""
        for controller in self._controllers.values():
            controller.proceed(self._last_ns, ended=True)
        return self.context.account

    def _controller(self, message: Sample) -> ControllerReplay:
        start_s = start_of(message.sequence)
        if start_s not in self._controllers:
            self._controllers[start_s] = ControllerReplay(self.context, message.receive_time_ns)
        return self._controllers[start_s]
