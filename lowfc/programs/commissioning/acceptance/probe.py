"""Probe sequences of the acceptance tests, the loop's steps during them, and the base classes of the results.

A note with the test's parameters precedes each probe sequence, so that a log can be evaluated like the live loop.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from lowfc.adapters.logs.columns import Steps, count_reasons
from lowfc.adapters.logs.history import History
from lowfc.arrays import Array, Long, Single
from lowfc.client.mirror_watch import INTERRUPTIONS
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.law_codec import driving, integrator_of
from lowfc.contract.codecs.state_codec import calibration_in_use
from lowfc.contract.errors import DataFileError, LowfcError, raised_as
from lowfc.contract.messages import from_timestamp, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws import margins
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.spectra import interpolated
from lowfc.control.laws.stability import settling_frames
from lowfc.control.loop.safety import Limit, LoopMode, Rejection
from lowfc.programs.cli.result import Result, result_field

Kind = Literal["rejection", "linearity", "capture-range", "noise-floor"]

LIMITS = (Limit.MODAL_LIMIT, Limit.STROKE, Limit.SLEW, Limit.NEIGHBOUR)
"""Limits that end a measurement when they act."""
MAX_MISSING = 0.01
"""Largest fraction of a measurement's frames that may be missing or refused."""
_LIMIT_BITS = sum(1 << limit for limit in LIMITS)

ANNOUNCEMENT = "acceptance "
"""First word of a note that announces a test; the test's parameters follow as JSON."""
_ANNOUNCED: dict[Kind, dict[str, Any]] = {
    "rejection": {"period_frames": 0},
    "linearity": {"noll": 0, "averaged": 0},
    "capture-range": {"noll": 0, "level_nm": 0.0, "before": [0, 0], "after": [0, 0]},
    "noise-floor": {"loop": ""},
}
"""The parameters of each test; only the types of the values are used."""
_DISTURBING = ("gain", "leak", "limit", "law", "load", "offset", "channel", "reset", "stop")
"""Requests that make a measurement unusable if they are accepted during it."""


class AcceptanceError(LowfcError):
    """The loop cannot be measured: it was disturbed, or its state does not allow it."""


class ModeResult(Result):
    """A mode, and whether it meets the requirement."""

    noll: int = result_field("mode")
    name: str = result_field("name")
    passed: bool = result_field()
    too_noisy: bool = result_field(default=False)

    def remarks(self) -> Sequence[str]:
        """The verdict at the end of the row, unless the mode passed."""
        return [] if self.passed else ["too noisy" if self.too_noisy else "FAILED"]


class AcceptanceResult(Result):
    """The result of a test; it passed if every mode did."""

    test: str = result_field()
    passed: bool = result_field()

    @property
    def verdict(self) -> str:
        """The test and its verdict."""
        return f"{self.test}: {'passed' if self.passed else 'FAILED'}"

    def remarks(self) -> Sequence[str]:
        """The verdict at the end."""
        return ["", self.verdict]


@dataclass(frozen=True, slots=True)
class Loop:
    """The measured loop: law, modes, configured delay, frame rate, calibration with the reconstructor in use."""

    law: Integrator | LinearLaw
    noll: tuple[int, ...]
    delay_frames: float
    rate_hz: float
    calibration: Calibration

    @property
    def linear(self) -> LinearLaw:
        """The control law as a linear law."""
        if isinstance(self.law, LinearLaw):
            return self.law
        return integrator(self.law.gain, self.law.leak, self.noll, self.delay_frames, self.rate_hz)

    def settling_frames(self) -> int:
        """Settling time, frames."""
        if isinstance(self.law, Integrator):
            return settling_frames(self.law.gain, self.law.leak)
        return margins.settling_frames(self.law, self.delay_frames)

    @property
    def name(self) -> str:
        """Name of the law."""
        return self.law.name if isinstance(self.law, LinearLaw) else "integrator"


@dataclass(frozen=True, slots=True)
class ProbeResponse:
    """Response of the loop to one probe sequence, or a recording without a probe, frame by frame.

    Attributes:
        parameters: parameters of the test, from the announcing note.
        loop: the measured loop; its frame rate is that of these frames.
        target: what the probe was added to, `mirror` or `offset`; empty without a probe.
        table: probe amplitudes (frames, columns); (frames, 0) without a probe.
        error_nm: modal error (frames, modes); NaN where a frame is missing or was refused.
        pol_nm: pseudo-open-loop modes (frames, modes); NaN as in `error_nm`.
        command_nm: modal command (frames, modes) after each frame; NaN where the frame is missing.
        mode: loop mode (frames,), 0 where a frame is missing.
        reasons: bits `1 << reason` (frames,): why the frame was refused, or the limits that acted.
    """

    parameters: dict[str, Any]
    loop: Loop
    target: str
    table: Single
    error_nm: Array
    pol_nm: Array
    command_nm: Array
    mode: npt.NDArray[np.uint8]
    reasons: Long

    @property
    def limits_hit(self) -> list[str]:
        """Names of the limits that acted; they end a probe sequence."""
        return [reason.name for reason in count_reasons(self.reasons) if reason in LIMITS]

    @property
    def missing(self) -> int:
        """Number of frames without a measurement."""
        return int(np.count_nonzero(~np.isfinite(self.error_nm).all(axis=1)))

    def check(self, mode: LoopMode) -> None:
        """Raise AcceptanceError with the cause if the measurement was disturbed."""
        other = self.mode[(self.mode != 0) & (self.mode != mode)]
        if other.size:
            raise AcceptanceError(
                f"the loop became {LoopMode(int(other[0])).in_words} during a measurement in mode "
                f"{mode.in_words}: measure again"
            )
        if self.limits_hit:
            probe = " and ended the probe: use a smaller amplitude, or" if self.target else ":"
            raise AcceptanceError(
                f"a limit acted ({', '.join(self.limits_hit)}){probe} measure when the disturbance is smaller"
            )
        if self.missing > MAX_MISSING * len(self.error_nm):
            raise AcceptanceError(
                f"{self.missing} of {len(self.error_nm)} frames are missing or were refused (limit "
                f"{MAX_MISSING:.0%}): `lowfc info` and `lowfc ctl status` show the reasons"
            )

    def filled(self, values: Array) -> Array:
        """`values` (frames, modes) with missing frames interpolated."""
        present = np.isfinite(values).all(axis=1)
        return interpolated(np.flatnonzero(present), values[present], len(values))


def selected_modes(requested: Sequence[int], noll: Sequence[int]) -> tuple[int, ...]:
    """The requested Noll indices, all if there are none; AcceptanceError if the loop does not control one of them."""
    unknown = sorted(set(requested) - set(noll))
    if unknown:
        raise AcceptanceError(f"Noll modes {unknown} are not controlled; the loop controls {', '.join(map(str, noll))}")
    return tuple(requested or noll)


def logged_responses(history: History, kind: Kind) -> list[ProbeResponse]:
    """The loop's responses to a test in a log; DataFileError if one is missing, incomplete or disturbed."""
    path, calibration = history.log.path, history.calibration
    announced = _announced(history.requests, kind)
    if calibration is None or not announced:
        raise DataFileError(f"{path}: contains no `lowfc acceptance {kind}`")
    modes, responses = len(calibration.noll), []
    for parameters, request in announced:
        frames = parameters.pop("frames")
        first, play = request.frame_sequence, request.name == "play"
        sequence = history.steps.sequence
        limited = sequence[(sequence >= first) & (history.steps.reasons & _LIMIT_BITS != 0)].tolist()
        end = min([first + frames, *limited[:1]])  # a limit that acts ends the measurement
        _check_undisturbed(history, first, end, play=play)
        absent = 0 if limited else first + frames - 1 - int(sequence.max(initial=first - 1))
        if absent > MAX_MISSING * frames:
            named = [f"{key} {parameters[key]}" for key in ("noll", "level_nm", "loop") if key in parameters]
            raise DataFileError(
                f"{path}: ends {absent} of {frames} frames before the end of a measurement "
                f"({', '.join([kind, *named])}): give all files of the log, or measure again"
            )
        request_ns = from_timestamp(request.timestamp)  # select states by time: a state after `clear` has no frame
        states = [state for state in history.controllers if len(state.gain) == modes]
        before = [state for state in states if from_timestamp(state.timestamp) <= request_ns]
        if not before:
            raise DataFileError(f"{path}: does not contain the state of the controller before the test")
        in_use = history.published.calibrations.get(before[-1].calibration_id, calibration)
        target, table = "", np.zeros((frames, 0), np.float32)
        with raised_as(DataFileError, ValueError, path):
            loop = loop_of(before[-1], in_use, history.rate_hz, history.published.laws)
            if play:
                target, table = request.text, codec.request(request, "play", 0, plays=history.published.plays).table
        responses.append(probe_response(parameters, loop, target, table, first, history.steps))
    return responses


def _check_undisturbed(history: History, first: int, end: int, *, play: bool) -> None:
    """Raise DataFileError if a request (with `play` also an event) disturbed the frames `first` to `end` - 1."""
    path, sequence = history.log.path, history.steps.sequence
    for request in history.requests:
        if request.accepted and request.name in _DISTURBING and first < request.frame_sequence < end:
            raise DataFileError(f"{path}: request {request.name!r} disturbed the measurement")
    times_ns = history.steps.time_ns[(sequence >= first) & (sequence < end)]
    if not (play and times_ns.size):
        return
    for _, event in history.events:
        event_ns = from_timestamp(event.timestamp) - history.camera_clock_offset_ns(event.name)
        if event.message.startswith(INTERRUPTIONS) and times_ns[0] <= event_ns <= times_ns[-1]:
            raise DataFileError(f"{path}: {event.message}, during the measurement")


def _announced(requests: Sequence[wire.Request], kind: Kind) -> list[tuple[dict[str, Any], wire.Request]]:
    """Parameters and starting request of each measurement of a test; of a repeated measurement, only the last."""
    latest: dict[str, tuple[dict[str, Any], wire.Request]] = {}
    starting = "note" if kind == "noise-floor" else "play"  # noise-floor has no probe sequence
    parameters: dict[str, Any] | None = None
    for request in requests:
        if request.name == "note" and request.accepted and request.text.startswith(ANNOUNCEMENT):
            parameters = _parameters(request.text, kind)
        if request.name == starting and parameters is not None:
            if request.accepted:
                latest[str([parameters.get(key) for key in ("noll", "level_nm", "loop")])] = parameters, request
            parameters = None
    return list(latest.values())


def _parameters(note: str, kind: Kind) -> dict[str, Any] | None:
    """The parameters of a test that a note announces; None for a note of another test, or of an operator."""
    try:
        parameters = json.loads(note.removeprefix(ANNOUNCEMENT))
    except (ValueError, RecursionError):
        return None
    if not isinstance(parameters, dict) or parameters.pop("test", None) != kind:
        return None
    needed = {"frames": 1, **_ANNOUNCED[kind]}
    complete = all(_types(parameters.get(name)) == _types(value) for name, value in needed.items())
    return parameters if complete and parameters["frames"] > 0 else None


def _types(value: object) -> object:
    return list(map(type, value)) if isinstance(value, list) else type(value)


def probe_response(
    parameters: dict[str, Any], loop: Loop, target: str, table: Single, first: int, steps: Steps
) -> ProbeResponse:
    """The steps of a probe sequence from frame `first` on, one row per frame; the frame rate is that of these steps."""
    frames = len(table)
    new = (steps.reasons & (1 << Rejection.REPEATED | 1 << Rejection.OUT_OF_ORDER)) == 0
    steps = steps.at(new & (steps.sequence >= first) & (steps.sequence < first + frames))
    rows = (steps.sequence - np.uint64(first)).astype(np.int64)
    if len(rows) > 1:
        rate_hz = float((rows[-1] - rows[0]) * 1e9 / (steps.time_ns[-1] - steps.time_ns[0]))
        loop = replace(loop, rate_hz=rate_hz)
    error_nm, pol_nm, command_nm = (np.full((frames, steps.error_nm.shape[1]), np.nan) for _ in range(3))
    mode, reasons = np.zeros(frames, np.uint8), np.zeros(frames, np.int64)
    error_nm[rows], pol_nm[rows], command_nm[rows] = steps.error_nm, steps.pol_nm, steps.command_nm
    mode[rows], reasons[rows] = steps.mode, steps.reasons
    return ProbeResponse(parameters, loop, target, table, error_nm, pol_nm, command_nm, mode, reasons)


def loop_of(
    state: wire.ControllerState, calibration: Calibration, rate_hz: float, laws: Mapping[str, LinearLaw]
) -> Loop:
    """The loop that a controller state describes; `laws` contains its linear law, if it has one."""
    law, in_use = driving(state, laws) or integrator_of(state), calibration_in_use(state, calibration)
    return Loop(law, calibration.noll, state.delay_frames, rate_hz, in_use)
