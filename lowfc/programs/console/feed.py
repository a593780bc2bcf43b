"""Readings of the run, several times a second: verdict and tiles as in the view, and values."""

import contextlib
import threading
import time
from collections import deque
from math import nan
from typing import NamedTuple

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Bus, Sample
from lowfc.adapters.process.clock import Clock
from lowfc.arrays import Pixels, Single
from lowfc.client import Client, configuration_of
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BadMessageError, LowfcError
from lowfc.contract.messages import REQUEST, Role, checked_time_ns, wire
from lowfc.control.loop.wording import AUTO
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.view.monitor import Monitor, import_late_modules
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.run_state import RunState
from lowfc.programs.view.verdicts.tile import Verdict
from lowfc.programs.view.verdicts.verdict import judge

DISCONNECTED_S = 1.5
"""Time without a message after which the console counts as disconnected; each process sends Health twice a second."""
TREND_S = 34
"""Span of the sparklines, one column per second."""
_IMPORT_AFTER_S = 4.0
"""Time after which a thread does the slow imports: the first values do not need them."""
_PUNCTUAL_S = 0.5
"""Longest time between two readings; after a longer one, the messages received meanwhile count as delayed."""
_TREND_STEP_NS = 1_000_000_000  # time from one value of a sparkline to the next
_HIDDEN_REQUESTS = frozenset(("status", "configuration", "renew"))
"""Requests that programs repeat periodically, and that leave the loop unchanged."""


class Reading(NamedTuple):
    """Present state of the run.

    Attributes:
        silent_s: age of the newest message; None before the first message.
        state: state of the run, from which the verdict is made.
        verdict: verdict, tiles and facts of the view.
        frame: newest frame; None before the first frame.
        command_nm: modal command of the last step, (modes,) nm rms of wavefront; empty before the first step.
        requests: requests received since the previous reading, without `_HIDDEN_REQUESTS`.
        residual_nm: residual, nm rms of wavefront, one value per second; NaN if unknown.
        light: flux as a fraction of the calibration's flux, one value per second; NaN if unknown.
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
        """Whether messages of the run arrive."""
        return self.silent_s is not None and self.silent_s < DISCONNECTED_S


class Feed(Monitor):
    """Reads a run several times a second; it also queries the configuration."""

    _query_timeout_s = 1.0  # longer than in the base class, since queries have their own thread here

    def __init__(self, bus: Bus, run_id: str, clock: Clock) -> None:
        """Subscribe."""
        super().__init__(bus, clock)
        self._run_id, self._requests = run_id, bus.ring(REQUEST, 200)
        self._config: Configuration | None = None
        self._configured: set[tuple[str, int]] = set()  # role and start, Unix s, of the controller that sent `_config`
        self._frame: Pixels | None = None
        self._trend: deque[tuple[float, float]] = deque(maxlen=TREND_S)
        self._point_ns = 0
        self._read_s = time.monotonic()
        self._query()
        imports = threading.Timer(_IMPORT_AFTER_S, import_late_modules)
        imports.daemon = True
        imports.start()

    def read(self) -> Reading:
        """Process the messages received since the last call, and return the present state."""
        now_s, host_ns = time.monotonic(), self._clock.host_ns()
        behind_s, self._read_s = max(0.0, now_s - self._read_s - _PUNCTUAL_S), now_s
        requests = [_request(sample) for sample in self._requests.drain()]
        snapshot = self.snapshot(host_ns, behind_s)
        state = self.watcher.state()
        self._frame = self._frame if snapshot.frame is None else snapshot.frame
        self._extend_trend(state, host_ns)
        newest_ns = max(snapshot.sent_ns.values(), default=0)
        nm_per_mas = None if self._config is None else tilt_nm_per_mas(self._config.star.diameter_m)
        return Reading(
            (host_ns - newest_ns) * 1e-9 if newest_ns else None,
            state,
            judge(state, nm_per_mas),
            self._frame,
            self.steps.command_nm[-1:].ravel(),
            [request for request in requests if request is not None],
            [residual for residual, _ in self._trend],
            [light for _, light in self._trend],
        )

    def _extend_trend(self, state: RunState, host_ns: int) -> None:
        if host_ns - self._point_ns >= _TREND_STEP_NS:
            self._point_ns = host_ns - host_ns % _TREND_STEP_NS  # readings do not fall on whole seconds
            residual_nm = None if state.wavefront is None else state.wavefront.residual_nm
            light = state.flux if state.frame_silent_s is None else None
            self._trend.append((nan if residual_nm is None else residual_nm, nan if light is None else light))

    def _complete(self, snapshot: Snapshot) -> bool:
        return super()._complete(snapshot) and self._config is not None

    def _query(self) -> None:
        """Query in a thread, because a suspended process delays the answer.

        The configuration is queried once for each start of the controller, because each query is a request in the log.
        """
        query = super()._query

        def query_all() -> None:
            with contextlib.suppress(LowfcError):  # the console ends, or there is no controller that sends Health yet
                query()
                controller = {process for process in self._known_processes if process[0] == Role.CONTROLLER}
                if self._config is None or controller != self._configured:
                    self._config = configuration_of(Client(self._run_id, bus=self._bus))
                    self._configured = controller

        threading.Thread(target=query_all, name="query", daemon=True).start()


def _request(sample: Sample) -> wire.Request | None:
    """Decode a request; None if it is unreadable, in `_HIDDEN_REQUESTS`, or the controller's own for automatic gains.

    An event reports these gains.
    """
    try:
        request = wire.Request.FromString(sample.payload)
        checked_time_ns(request.timestamp)
    except (DecodeError, BadMessageError):
        return None
    automatic = request.name == "gain" and request.text == AUTO and bool(request.values)
    return None if automatic or request.name in _HIDDEN_REQUESTS else request
