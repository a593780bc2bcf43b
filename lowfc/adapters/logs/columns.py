"""Messages of the loop as columns, for reports, exports, tuning and views."""

from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Long, Sequences, Single
from lowfc.contract.codecs.codec import encode_step
from lowfc.contract.messages import from_timestamp, wire
from lowfc.control.loop.inputs import Step
from lowfc.control.loop.safety import REASONS, Reason

STAGES = ("transport", "wakeup", "compute", "publish", "frame_to_command")
"""Stages of the controller, whose durations are in ControlTiming."""

# Type code of `array` for each column that is not float32 ("f").
_KINDS = {"sequence": "Q", "time_ns": "q", "mode": "B", "reasons": "q", "saturated_pixels": "q", "instants": "q"}
_BITS = 63  # an integer column has 63 bits besides the sign


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps of the control law in recorded order; every array is (steps,) or (steps, modes).

    Attributes:
        sequence: sequence of the step's frame.
        time_ns: time of that frame, ns since the epoch.
        mode: loop mode, as `LoopMode`.
        reasons: bits `1 << reason`: why the frame was refused, or the limits that acted.
        error_nm: measured modal error, nm rms of wavefront; NaN if the frame was refused.
        pol_nm: pseudo-open-loop modes, nm rms of wavefront; NaN if the frame was refused.
        command_nm: modal command after the step, nm rms of wavefront.
        flux_dn: sum of the good pixels, dark subtracted, DN; 0 if the frame was refused.
        saturated_pixels: number of saturated pixels; 0 if the frame was refused.
    """

    sequence: Sequences
    time_ns: Long
    mode: npt.NDArray[np.uint8]
    reasons: Long
    error_nm: Single
    pol_nm: Single
    command_nm: Single
    flux_dn: Single
    saturated_pixels: Long

    def at(self, rows: npt.NDArray[Any]) -> "Steps":
        """Steps at these rows, by index or boolean mask."""
        return Steps(*(getattr(self, part.name)[rows] for part in fields(self)))


@dataclass(frozen=True, slots=True)
class Truths:
    """Truth of a simulation, one row per frame; empty for a log of real devices.

    If `instants` is not 0, rms values are over the whole frame period, in which the wavefront changes while the mirror
    holds its shape. If it is 0 (older logs, and simulations without such rms values), all values are those at the start
    of the exposure.

    Attributes:
        sequence: sequence of the frame.
        time_ns: time of the frame, ns since the epoch.
        disturbance_nm: (frames, modes) disturbance at the start of the exposure.
        residual_nm: (frames, modes) residual at the start of the exposure.
        sensed_nm: (frames, modes) mean of the residual over the exposure, as the sensor sees it.
        modes_disturbance_rms_nm: (frames, modes) rms of the disturbance over the period.
        modes_residual_rms_nm: (frames, modes) rms of the residual over the period.
        disturbance_rms_nm: rms of the disturbance over the open pupil and the period.
        residual_rms_nm: rms of the residual over the open pupil and the period.
        sampled_residual_rms_nm: rms of the residual over the open pupil at the start of the exposure.
        instants: number of times in the period that the rms values are averaged over; 0: start of the exposure only.
        added_contrast: added contrast of the residual; 0 if not computed.
        added_contrast_flat: added contrast of the disturbance; 0 if not computed.
    """

    sequence: Sequences
    time_ns: Long
    disturbance_nm: Single
    residual_nm: Single
    sensed_nm: Single
    modes_disturbance_rms_nm: Single
    modes_residual_rms_nm: Single
    disturbance_rms_nm: Single
    residual_rms_nm: Single
    sampled_residual_rms_nm: Single
    instants: Long
    added_contrast: Single
    added_contrast_flat: Single

    @property
    def continuous(self) -> bool:
        """Whether rms values are over whole periods."""
        return bool(self.instants.any())


class Columns:
    """Columns that grow row by row, each with a number or a vector per row."""

    def __init__(self, widths: Mapping[str, int] = MappingProxyType({}), /, **kinds: str) -> None:
        """Make columns; `kinds` maps their names to type codes of `array`, `widths` maps names to vector lengths."""
        self._columns: dict[str, array[Any]] = {name: array(kind) for name, kind in kinds.items()}
        self._widths = widths
        self._rows = 0
        self._with_widths = [(column, widths.get(name, 1)) for name, column in self._columns.items()]

    def __len__(self) -> int:
        return self._rows

    def add(self, **values: int | float | Iterable[int | float]) -> bool:
        """Add to every column; if the values do not form complete rows, add nothing and return False.

        Raises:
            OverflowError: a value is out of the range of its column.
        """
        columns = self._columns
        try:
            for name, value in values.items():
                if type(value) is int or type(value) is float:
                    columns[name].append(value)
                else:
                    columns[name].extend(value)  # type: ignore[arg-type]  # not a number here
        except OverflowError:
            self._truncate()
            raise
        rows = len(self._with_widths[0][0])
        for column, width in self._with_widths:
            if len(column) != rows * width:
                self._truncate()
                return False
        self._rows = rows
        return True

    def values(self, name: str) -> npt.NDArray[Any]:
        """Array of one column, (rows,) or (rows, width), not a copy: no row can be added while it exists."""
        column = np.asarray(self._columns[name])
        return column.reshape(self._rows, self._widths[name]) if name in self._widths else column

    def _truncate(self) -> None:
        for column, width in self._with_widths:
            del column[self._rows * width :]


T = TypeVar("T")


class _Rows(Generic[T]):
    """Collects messages with a fixed number of modes as columns of `T`, named as the message's fields."""

    def __init__(self, result_type: type[T], per_mode: Iterable[str], modes: int) -> None:
        self.modes = modes
        self._result_type = result_type
        kinds = {name: _KINDS.get(name, "f") for name in result_type.__annotations__}
        self._columns = Columns(dict.fromkeys(per_mode, modes), **kinds)
        self._same_name = [name for name in kinds if name not in ("sequence", "time_ns")]

    def __len__(self) -> int:
        return len(self._columns)

    def add(self, message: Any) -> bool:
        """Add a message; False if it has another number of modes.

        Raises:
            OverflowError: a value is out of range; the loop never sends such a value.
        """
        special = self._special(message)
        row = {name: getattr(message, name) for name in self._same_name if name not in special} | special
        return self._columns.add(sequence=message.frame_sequence, time_ns=from_timestamp(message.timestamp), **row)

    def _special(self, message: Any) -> dict[str, Any]:
        """Values of the columns that are not simply the message's field of the same name."""
        return {}

    def values(self) -> T:
        """Return the rows as arrays, without those with an infinite value, which the loop never sends."""
        columns = {name: self._columns.values(name) for name in self._result_type.__annotations__}
        rows = np.ones(len(self), np.bool_)
        for values in columns.values():
            rows &= ~np.isinf(values).any(axis=tuple(range(1, values.ndim)))
        return self._result_type(**columns if rows.all() else {name: values[rows] for name, values in columns.items()})


class StepRows(_Rows[Steps]):
    """Collects steps with a fixed number of modes."""

    def __init__(self, modes: int) -> None:
        super().__init__(Steps, ("error_nm", "pol_nm", "command_nm"), modes)
        self._not_measured = [np.nan] * modes

    def _special(self, message: wire.ControlStep) -> dict[str, Any]:
        measured = {name: getattr(message, name) or self._not_measured for name in ("error_nm", "pol_nm")}
        return measured | {"reasons": bits_of(message.reasons)}


class TruthRows(_Rows[Truths]):
    """Collects the truth of a simulation with a fixed number of modes."""

    def __init__(self, modes: int) -> None:
        per_mode = ("disturbance_nm", "residual_nm", "sensed_nm", "modes_disturbance_rms_nm", "modes_residual_rms_nm")
        super().__init__(Truths, per_mode, modes)

    def _special(self, message: wire.Truth) -> dict[str, Any]:
        if message.instants:
            return {
                "sensed_nm": message.sensed_residual_nm,
                "modes_disturbance_rms_nm": message.continuous_disturbance_nm,
                "modes_residual_rms_nm": message.continuous_residual_nm,
                "disturbance_rms_nm": message.continuous_disturbance_rms_nm,
                "residual_rms_nm": message.continuous_residual_rms_nm,
                "sampled_residual_rms_nm": message.residual_rms_nm,
            }
        return {
            "sensed_nm": message.residual_nm,
            "modes_disturbance_rms_nm": map(abs, message.disturbance_nm),
            "modes_residual_rms_nm": map(abs, message.residual_nm),
            "sampled_residual_rms_nm": message.residual_rms_nm,
        }


def steps_as_columns(steps: Iterable[Step], modes: int) -> Steps:
    """Convert the steps of a running loop to the columns that a log's steps have."""
    rows = StepRows(modes)
    for step in steps:
        rows.add(wire.ControlStep.FromString(encode_step(step, 0)))
    return rows.values()


def count_reasons(bits: Long) -> dict[Reason, int]:
    """Number of rows with each reason, without reasons that do not occur."""
    counts = {reason: int(np.count_nonzero(bits & (1 << reason))) for reason in REASONS} if bits.any() else {}
    return {reason: count for reason, count in counts.items() if count}


class TimingRows:
    """Collects the durations of the controller's stages."""

    def __init__(self) -> None:
        self._columns = Columns(sequence="Q", **dict.fromkeys(STAGES, "q"))

    def add(self, timing: wire.ControlTiming) -> bool:
        """Add the frames of a message; False if its columns differ in length."""
        stages = {stage: getattr(timing, f"{stage}_ns") for stage in STAGES}
        return self._columns.add(sequence=timing.frame_sequence, **stages)

    def values(self) -> tuple[Sequences, dict[str, Long]]:
        """Sequences of the frames, and for each of `STAGES` its duration in every frame, ns."""
        return self._columns.values("sequence"), {stage: self._columns.values(stage) for stage in STAGES}


def bits_of(reasons: Iterable[int]) -> int:
    """Combine reasons as bits `1 << reason`; OverflowError if a reason is out of range."""
    bits = 0
    for reason in reasons:
        if not 0 <= reason < _BITS:
            raise OverflowError(f"a reason must be at least 0 and below {_BITS}; got {reason}")
        bits |= 1 << reason
    return bits


def rows_of(sequence: Sequences, among: Sequences) -> Long:
    """Row in `among` of each sequence, the first if there are several, -1 if there is none."""
    if not among.size:
        return np.full(sequence.shape, -1, np.int64)
    order = np.argsort(among, kind="stable")
    places = np.minimum(np.searchsorted(among, sequence, sorter=order), among.size - 1)
    rows = order[places]
    return np.where(among[rows] == sequence, rows, -1).astype(np.int64)


def joined(values: npt.NDArray[Any], rows: Long) -> npt.NDArray[Any]:
    """Rows of `values`; NaN for row -1."""
    selected = values[rows] if values.size else np.zeros((rows.size, *values.shape[1:]), np.float32)
    selected[rows < 0] = np.nan
    return selected


def exposure_fraction(camera: wire.CameraState | None) -> float | None:
    """Exposure divided by period; None if not known."""
    return camera.exposure_ns / camera.period_ns if camera is not None and camera.period_ns else None


def frame_rate_hz(camera: wire.CameraState | None, steps: Steps) -> float:
    """Frame rate from the camera's period if known, otherwise from the median interval of steps; 0 without steps."""
    if camera is not None and camera.period_ns:
        return 1e9 / camera.period_ns
    intervals_ns = np.diff(steps.time_ns)
    median_ns = float(np.median(intervals_ns)) if intervals_ns.size else 0.0
    return 1e9 / median_ns if median_ns > 0 else 0.0
