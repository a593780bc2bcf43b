"""Input of a report: the history of a run, and the law in force at each step."""

import contextlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf.timestamp_pb2 import Timestamp

from lowfc.adapters.logs.columns import rows_of
from lowfc.adapters.logs.history import History, read_history
from lowfc.adapters.logs.parts import LogFiles, WholeLog
from lowfc.arrays import Array
from lowfc.contract.codecs.law_codec import driving, overruled
from lowfc.contract.envelope import COUNT_BITS
from lowfc.contract.messages import Role, from_timestamp, wire
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.what_if import has_new_exposure
from lowfc.control.loop import guard
from lowfc.control.loop.safety import Rejection

Results = dict[str, Any]
"""Results by their names in `--json`; NaN becomes null there."""


@dataclass(frozen=True, slots=True)
class LawInForce:
    """A control law in force: gain and leak (modes,) of the integrator, delay, and the linear law used instead.

    Attributes:
        first: row of the first step under the law; comparisons of laws ignore `first` and `linear`.
        law_id: identity of the linear law, "unknown" if the state has none; empty without a linear law.
        law_name: name of the linear law; "integrator" without a linear law.
        overruled: groups of modes that the integrator drives instead of the law.
        linear: the linear law; None if there is none, if it is not in the log or has other modes, or if the
            integrator drives any group of modes.
    """

    first: int = field(compare=False)
    gain: tuple[float, ...]
    leak: tuple[float, ...]
    delay_frames: float
    law_id: str = ""
    law_name: str = "integrator"
    overruled: tuple[str, ...] = ()
    linear: LinearLaw | None = field(default=None, compare=False)

    @property
    def known(self) -> bool:
        """Whether `linear`, or without it the integrator, describes the whole controller."""
        return not self.law_id or self.linear is not None or set(self.overruled) == set(guard.NAMES)


@dataclass(frozen=True, slots=True)
class Run:
    """The history of a run, and its laws.

    Attributes:
        history: contents of the log.
        laws: laws in order; the law of steps before the first one is unknown.
    """

    history: History
    laws: tuple[LawInForce, ...]

    def seconds(self, host_ns: npt.ArrayLike) -> Array:
        """Convert host times to frame time, seconds since the first step.

        Times between the frames are interpolated. In lockstep frame time is simulated; otherwise it differs from host
        time by an offset. If the log has no frame that belongs to a step, the result is host time since its beginning.
        """
        history, host = self.history, np.asarray(host_ns, dtype=np.int64)
        rows = rows_of(history.frame_sequence, history.steps.sequence)
        published, frame_ns = history.frame_publish_ns[rows >= 0], history.steps.time_ns[rows[rows >= 0]]
        if not published.size:
            return np.asarray((host - history.span_ns[0]) * 1e-9, dtype=np.float64)
        order = np.argsort(published, kind="stable")
        published, frame_ns = published[order], frame_ns[order]
        inside = np.interp(
            (host - published[0]) * 1e-9, (published - published[0]) * 1e-9, (frame_ns - frame_ns[0]) * 1e-9
        )
        outside = np.minimum(host - published[0], 0) + np.maximum(host - published[-1], 0)
        return np.asarray(inside + outside * 1e-9 + (frame_ns[0] - history.steps.time_ns[0]) * 1e-9, dtype=np.float64)

    @property
    def step_s(self) -> Array:
        """Time of each step since the first one."""
        time_ns = self.history.steps.time_ns
        return np.asarray((time_ns - time_ns[:1]) * 1e-9)


def read_run(files: LogFiles, progress: Callable[[int, int], None] | None = None) -> Run:
    """Read a log, complete or not, to its end; damaged parts are skipped and listed by the history's reader."""
    history = read_history(WholeLog(files, progress))
    history.true  # noqa: B018  # joined and cached now, while the steps still have the log's sequences
    steps, timed = history.steps, np.flatnonzero(has_new_exposure(history.steps.reasons))
    if 0 < timed.size < steps.sequence.size:
        # A step whose frame is ahead of the clock gets the sequence and the time of the step before; a step with an
        # old frame gets only that time.
        rows = timed[np.maximum(np.searchsorted(timed, np.arange(steps.sequence.size), "right") - 1, 0)]
        ahead = steps.reasons >> Rejection.AHEAD & 1 == 1
        time_ns = np.maximum(np.where(ahead, 0, steps.time_ns), steps.time_ns[rows])
        sequence = np.where(ahead, steps.sequence[rows], steps.sequence)
        history.steps = replace(steps, sequence=sequence, time_ns=time_ns)
    return Run(history, _laws_in_force(history))


def row_after(history: History, frame_sequence: int, time: Timestamp) -> int:
    """Row of the first step after the steps of a frame.

    If the frame has no step, the row is that of the first later frame from the same start of the camera. Without such
    a frame it is that of the first step after `time`, which is on the controller's clock, unlike the times of steps.
    """
    sequence = history.steps.sequence
    rows = np.flatnonzero(sequence == frame_sequence)
    if not rows.size:  # the frame was lost, or the controller had none since its start or a `clear`
        later = (sequence > frame_sequence) & (sequence >> COUNT_BITS == frame_sequence >> COUNT_BITS)
        if later.any():
            return int(np.argmax(later))
        rows = np.flatnonzero(
            history.steps.time_ns + history.camera_clock_offset_ns(Role.CONTROLLER) <= from_timestamp(time)
        )
    return int(rows[-1]) + 1 if rows.size else 0


def _laws_in_force(history: History) -> tuple[LawInForce, ...]:
    """The laws of a run, from the states that controllers publish at every change."""
    steps = history.steps
    found: list[LawInForce] = []
    for state in history.controllers:
        if len(state.gain) != steps.command_nm.shape[1] or not steps.sequence.size:
            continue
        first = row_after(history, state.frame_sequence, state.timestamp)
        law = LawInForce(first, _shortest(state.gain), _shortest(state.leak), _shortest([state.delay_frames])[0])
        if state.HasField("law"):
            law = _with_linear_law(law, state, history.published.laws)
        while found and found[-1].first >= first:
            found.pop()
        if not found or found[-1] != law:
            found.append(law)
    return tuple(law for law in found if law.first < steps.sequence.size)


def _with_linear_law(found: LawInForce, state: wire.ControllerState, laws: Mapping[str, LinearLaw]) -> LawInForce:
    groups, linear = tuple(overruled(state)), None
    with contextlib.suppress(ValueError):  # the log does not contain the law
        linear = driving(state, laws)
    law_id = state.law.id if linear is None else linear.id
    if linear is not None and (groups or len(linear.noll) != len(found.gain)):
        linear = None
    return replace(found, law_id=law_id or "unknown", law_name=state.law.name, overruled=groups, linear=linear)


def _shortest(singles: Iterable[float]) -> tuple[float, ...]:
    """Shortest decimal of a single-precision number: 0.05, not 0.0500000007."""
    return tuple(float(str(np.float32(value))) for value in singles)
