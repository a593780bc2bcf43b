"""Messages of the loop as columns, a row for each: what reports, exports, what-ifs, tuning and views read of them."""

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
from lowfc.control.loop.safety import REASONS, LoopMode, Reason

STAGES = ("transport", "wakeup", "compute", "publish", "frame_to_command")
"""Durations of the controller, as in ControlTiming."""

_KINDS = {"sequence": "Q", "time_ns": "q", "mode": "B", "reasons": "q", "saturated_pixels": "q", "instants": "q"}
_BITS = 63  # of a column of whole numbers, but for the sign


@dataclass(frozen=True, slots=True)
class Steps:
    """One row for every step, in the order they were recorded; (steps,) or (steps, modes).

    Attributes:
        sequence: of the frame it was made from.
        time_ns: of that frame, nanoseconds since the epoch.
        mode: loop mode, as `LoopMode`.
        reasons: bit `1 << reason` for each reason given.
        error_nm: measured modal error; NaN where the frame was refused. So is pol_nm, pseudo-open-loop.
        command_nm: modal command after the step.
        flux_dn: sum of the good pixels.
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
        """The steps at some rows, by index or by whether each is one."""
        return Steps(*(getattr(self, part.name)[rows] for part in fields(self)))


@dataclass(frozen=True, slots=True)
class Truths:
    """Truth of a simulation, one row per frame; empty for a log of real devices.

    Rms are over the frame's whole period where `instants` is not 0: the star moves while the mirror holds. In older
    logs, and where a simulation does not compute it, they are those at the instant at which the exposure starts.

    Attributes:
        sequence: of the frame.
        time_ns: of that frame, nanoseconds since the epoch.
        disturbance_nm: (frames, modes) at the start of the exposure; so is residual_nm.
        sensed_nm: (frames, modes) mean of the residual over the exposure, as the sensor sees it.
        modes_disturbance_rms_nm: (frames, modes) rms over the period; so is modes_residual_rms_nm.
        disturbance_rms_nm: over the open pupil, rms over the period; so is residual_rms_nm.
        sampled_residual_rms_nm: over the open pupil, at the start of the exposure.
        instants: of the period, over which the rms are; 0 for the start of the exposure alone.
        added_contrast: of the residual, and `added_contrast_flat` of the disturbance; 0 where it was not computed.
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
        """Whether the rms are over whole periods."""
        return bool(self.instants.any())


class Columns:
    """Columns that grow by rows: a number in each row, or a vector."""

    def __init__(self, widths: Mapping[str, int] = MappingProxyType({}), /, **kinds: str) -> None:
        """Columns by name, of the kinds that `array` has; those in `widths` have so many numbers in a row."""
        self._columns: dict[str, array[Any]] = {name: array(kind) for name, kind in kinds.items()}
        self._widths = widths
        self._rows = 0
        self._each = [(column, widths.get(name, 1)) for name, column in self._columns.items()]

    def __len__(self) -> int:
        return self._rows

    def add(self, **values: int | float | Iterable[int | float]) -> bool:
        """Add to every column; to none, and return False, where the values do not make whole rows.

        Raises:
            OverflowError: a value is beyond what its column can hold.
        """
        columns = self._columns
        try:
            for name, value in values.items():
                if type(value) is int or type(value) is float:
                    columns[name].append(value)
                else:
                    columns[name].extend(value)  # type: ignore[arg-type]  # the numbers are above
        except OverflowError:
            self._cut()
            raise
        rows = len(self._each[0][0])
        for column, width in self._each:
            if len(column) != rows * width:
                self._cut()
                return False
        self._rows = rows
        return True

    def taken(self, name: str) -> npt.NDArray[Any]:
        """One column, (rows,) or (rows, width)."""
        column = np.array(self._columns[name])
        return column.reshape(self._rows, self._widths[name]) if name in self._widths else column

    def _cut(self) -> None:
        for column, width in self._each:
            del column[self._rows * width :]


T = TypeVar("T")


class _Rows(Generic[T]):
    """Messages with one number of modes as columns of `T`, whose fields are called as the message's."""

    def __init__(self, made: type[T], wide: Iterable[str], modes: int) -> None:
        self.modes = modes
        self._made = made
        kinds = {name: _KINDS.get(name, "f") for name in made.__annotations__}
        self._columns = Columns(dict.fromkeys(wide, modes), **kinds)
        self._alike = [name for name in kinds if name not in ("sequence", "time_ns")]

    def __len__(self) -> int:
        return len(self._columns)

    def add(self, message: Any) -> bool:
        """Add a message; False where it has another number of modes.

        Raises:
            OverflowError: a value that nobody of the loop sends.
        """
        special = self._special(message)
        row = {name: getattr(message, name) for name in self._alike if name not in special} | special
        return self._columns.add(sequence=message.frame_sequence, time_ns=from_timestamp(message.timestamp), **row)

    def _special(self, message: Any) -> dict[str, Any]:
        """Values that are not as in the message."""
        return {}

    def taken(self) -> T:
        """All of them."""
        return self._made(**{name: self._columns.taken(name) for name in self._made.__annotations__})


class StepRows(_Rows[Steps]):
    """Steps with one number of modes."""

    def __init__(self, modes: int) -> None:
        super().__init__(Steps, ("error_nm", "pol_nm", "command_nm"), modes)
        self._nothing = [np.nan] * modes

    def _special(self, message: wire.ControlStep) -> dict[str, Any]:
        measured = {"error_nm": message.error_nm or self._nothing, "pol_nm": message.pol_nm or self._nothing}
        return measured | {"reasons": bits_of(message.reasons)}


class TruthRows(_Rows[Truths]):
    """Truth of a simulation, with one number of modes."""

    def __init__(self, modes: int) -> None:
        wide = ("disturbance_nm", "residual_nm", "sensed_nm", "modes_disturbance_rms_nm", "modes_residual_rms_nm")
        super().__init__(Truths, wide, modes)

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


def of_steps(steps: Iterable[Step], modes: int) -> Steps:
    """Steps of a running loop, as a log's."""
    rows = StepRows(modes)
    for step in steps:
        rows.add(wire.ControlStep.FromString(encode_step(step, 0)))
    return rows.taken()


def count_reasons(bits: Long) -> dict[Reason, int]:
    """How often each reason was given, of those that were."""
    counts = {reason: int(np.count_nonzero(bits & (1 << reason))) for reason in REASONS} if bits.any() else {}
    return {reason: count for reason, count in counts.items() if count}


def mode_name(number: int) -> str:
    """Name of a loop mode, also of one that this version does not know."""
    return LoopMode(number).name.lower() if number in list(LoopMode) else f"mode {number}"


class TimingRows:
    """Durations of the controller's stages."""

    def __init__(self) -> None:
        self._columns = Columns(sequence="Q", **dict.fromkeys(STAGES, "q"))

    def __len__(self) -> int:
        return len(self._columns)

    def add(self, timing: wire.ControlTiming) -> bool:
        """Add the frames of a message; False where its columns differ in length."""
        stages = {stage: getattr(timing, f"{stage}_ns") for stage in STAGES}
        return self._columns.add(sequence=timing.frame_sequence, **stages)

    def taken(self) -> tuple[Sequences, dict[str, Long]]:
        """Sequence (frames,) of each frame, and each of `STAGES` in ns."""
        return self._columns.taken("sequence"), {stage: self._columns.taken(stage) for stage in STAGES}


def bits_of(reasons: Iterable[int]) -> int:
    """Bit `1 << reason` for each.

    Raises:
        OverflowError: there is no such bit.
    """
    bits = 0
    for reason in reasons:
        if not 0 <= reason < _BITS:
            raise OverflowError(f"a reason is a bit below {_BITS}; got {reason}")
        bits |= 1 << reason
    return bits


def rows_of(sequence: Sequences, among: Sequences) -> Long:
    """Row in `among` of each sequence, the first one where there are several; -1 where there is none."""
    if not among.size:
        return np.full(sequence.shape, -1, np.int64)
    order = np.argsort(among, kind="stable")
    places = np.minimum(np.searchsorted(among, sequence, sorter=order), among.size - 1)
    rows = order[places]
    return np.where(among[rows] == sequence, rows, -1).astype(np.int64)


def joined(values: npt.NDArray[Any], rows: Long) -> npt.NDArray[Any]:
    """These rows of `values`; NaN for row -1."""
    found = values[rows] if values.size else np.zeros((rows.size, *values.shape[1:]), np.float32)
    found[rows < 0] = np.nan
    return found


def exposure_fraction(camera: wire.CameraState | None) -> float | None:
    """Exposure over period; None where they are not known."""
    return camera.exposure_ns / camera.period_ns if camera is not None and camera.period_ns else None


def frame_rate_hz(camera: wire.CameraState | None, steps: Steps) -> float:
    """Frame rate: the camera's period where it is known, the median interval of the steps otherwise; 0 for none."""
    if camera is not None and camera.period_ns:
        return 1e9 / camera.period_ns
    intervals_ns = np.diff(steps.time_ns)
    median_ns = float(np.median(intervals_ns)) if intervals_ns.size else 0.0
    return 1e9 / median_ns if median_ns > 0 else 0.0
