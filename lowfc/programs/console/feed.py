"""Readings of the run, several times a second: the verdict of the view's tiles, and figures."""

import threading
import time
from collections import deque
from importlib import import_module
from math import nan
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Bus, Sample, states
from lowfc.adapters.process.clock import Clock
from lowfc.arrays import Pixels, Single
from lowfc.client import Client, configuration_of
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import EVENT, REQUEST, STEP, SURFACE, TRUTH, Role, wire
from lowfc.control.loop.wording import AUTO
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.view.snapshot import SHOWN, Accumulator
from lowfc.programs.view.verdicts.run_state import RunState
from lowfc.programs.view.verdicts.tile import Verdict
from lowfc.programs.view.verdicts.verdict import judge
from lowfc.programs.view.verdicts.watcher import Watcher

CUT_S = 1.5
"""Time without a message of any process after which the console is disconnected: each sends Health twice a second."""
TREND = 60
"""Seconds that the sparklines show, one value each."""
_WAITING = {EVENT: 200, REQUEST: 200, STEP: 4000, TRUTH: 50}  # of the truth so many a reading are enough for an rms
_TOPICS = (*(topic for topic in SHOWN if topic is not SURFACE), REQUEST)
_LATER, _LATER_S = ("lowfc.control.laws.tuning", "scipy.signal"), 4.0
"""Imported after so many seconds: the first figures do without, and a later verdict would stop the screen."""
_AGAIN_S = 5.0  # after which a busy controller is asked again for what it has not answered
_POINT_NS = 1_000_000_000
_UNSEEN = frozenset(("status", "configuration", "renew"))
"""Periodic requests that change nothing."""


class Reading(NamedTuple):
    """The run as it is now.

    Attributes:
        silent_s: since the newest message was sent; None before the first.
        frame, command_nm: the newest, and (modes,) of the last step.
        requests: new ones.
        residual_nm, light: a value for each second, NaN where there is none.
    """

    silent_s: float | None
    state: RunState
    verdict: Verdict
    frame: Pixels | None
    command_nm: Single
    requests: list[wire.Request]
    residual_nm: list[float]
    light: list[float]

    @property
    def connected(self) -> bool:
        """Whether what is shown is new."""
        return self.silent_s is not None and self.silent_s < CUT_S


class Feed:
    """Receives as a monitor does: messages wait in rings that keep the newest, and the loop waits for nobody."""

    def __init__(self, bus: Bus, run_id: str, clock: Clock) -> None:
        """Subscribe."""
        self._bus, self._run_id, self._clock = bus, run_id, clock
        waiting = {topic: _WAITING.get(topic, 1 if topic.latest_only else 100) for topic in _TOPICS}
        self._rings = {topic: bus.ring(topic, waiting[topic]) for topic in _TOPICS}
        self._earlier: deque[Sample] = deque()
        self._accumulator = Accumulator(clock.now_ns() if clock.lockstep else None)
        self._watcher = Watcher()
        self._config: Configuration | None = None
        self._known: set[tuple[str, int]] = set()
        self._frame: Pixels | None = None
        self._command_nm = np.zeros(0, np.float32)
        self._trend: deque[tuple[float, float]] = deque(maxlen=TREND)
        self._point_ns = 0
        self._read_s = self._asked_s = time.monotonic()
        self._catch_up()
        later = threading.Timer(_LATER_S, lambda: [import_module(name) for name in _LATER])
        later.daemon = True
        later.start()

    def read(self) -> Reading:
        """Process the messages received since the last call."""
        now_s, host_ns = time.monotonic(), self._clock.host_ns()
        behind_s, self._read_s = max(0.0, now_s - self._read_s - 0.5), now_s
        requests = [_request(sample) for sample in self._rings[REQUEST].drain()]
        arrived = [self._earlier.popleft() for _ in range(len(self._earlier))]
        for topic, ring in self._rings.items():
            if topic is not REQUEST:
                arrived += ring.drain()
        for sample in arrived:
            self._accumulator.add(sample)
        snapshot = self._accumulator.snapshot(host_ns, behind_s=behind_s)
        there = {(name, one.health.pid) for name, one in snapshot.health.items()}
        lacking = Role.CONTROLLER in snapshot.health and (snapshot.calibration is None or self._config is None)
        if not there <= self._known or (lacking and now_s - self._asked_s > _AGAIN_S):
            self._known = there
            self._catch_up()
        self._watcher.feed(snapshot)
        state = self._watcher.state()
        self._frame = self._frame if snapshot.frame is None else snapshot.frame
        if snapshot.steps.mode.size:
            self._command_nm = snapshot.steps.command_nm[-1]
        self._extend_trend(state, host_ns)
        newest_ns = max(snapshot.sent_ns.values(), default=0)
        per_mas = None if self._config is None else tilt_nm_per_mas(self._config.star.diameter_m)
        return Reading(
            (host_ns - newest_ns) * 1e-9 if newest_ns else None,
            state,
            judge(state, per_mas),
            self._frame,
            self._command_nm,
            [one for one in requests if one is not None and not _by_itself(one)],
            [residual for residual, _ in self._trend],
            [light for _, light in self._trend],
        )

    def _extend_trend(self, state: RunState, host_ns: int) -> None:
        if host_ns - self._point_ns >= _POINT_NS:
            self._point_ns = host_ns
            residual_nm = None if state.wavefront is None else state.wavefront.residual_nm
            light = state.flux if state.frame_silent_s is None else None
            self._trend.append((nan if residual_nm is None else residual_nm, nan if light is None else light))

    def _catch_up(self) -> None:
        """Ask for what was sent before, in a thread: a process that is frozen answers late."""
        self._asked_s = time.monotonic()

        def ask() -> None:
            self._earlier.extend(sample for _, sample in states(self._bus, SHOWN))
            try:
                self._config = configuration_of(Client(self._run_id, bus=self._bus))
            except LowfcError:  # there is no controller yet: it is asked again when one is
                return

        threading.Thread(target=ask, name="earlier", daemon=True).start()


def _by_itself(asked: wire.Request) -> bool:
    """Whether it says nothing new: it changes nothing, or an event tells of the automatic gains that it sets."""
    return asked.name in _UNSEEN or (asked.name == "gain" and asked.text == AUTO and bool(asked.values))


def _request(sample: Sample) -> wire.Request | None:
    try:
        return wire.Request.FromString(sample.payload)
    except DecodeError:
        return None
