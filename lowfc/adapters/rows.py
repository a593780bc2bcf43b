"""Messages of the loop as columns that grow by rows: what a history and a live view keep of them."""

from array import array
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.history import STAGES, Steps, Truths
from lowfc.contract.messages import from_timestamp, wire

_BITS = 63  # of a column of whole numbers, but for the sign


class Columns:
    """Columns that grow by rows: whole numbers, and vectors of one length."""

    def __init__(self, **kinds: str) -> None:
        self._columns: dict[str, array[Any]] = {name: array(kind) for name, kind in kinds.items()}
        self._ends = [0] * len(kinds)

    def __len__(self) -> int:
        return len(next(iter(self._columns.values())))

    def add(self, **values: int | float | Iterable[int | float]) -> None:
        """Add to every column, or to none.

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
            for column, end in zip(columns.values(), self._ends, strict=True):
                del column[end:]
            raise
        self._ends = list(map(len, columns.values()))

    def taken(self, name: str, width: int | None = None) -> npt.NDArray[Any]:
        """One column, (rows,) or (rows, width)."""
        column = np.array(self._columns[name])
        return column if width is None else column.reshape(len(self), width)


class StepRows:
    """Steps with one number of modes."""

    def __init__(self, modes: int) -> None:
        self.modes = modes
        self._nothing = [np.nan] * modes
        self._columns = Columns(
            sequence="Q",
            time_ns="q",
            mode="B",
            reasons="q",
            error_nm="f",
            pol_nm="f",
            command_nm="f",
            flux_dn="f",
            saturated_pixels="q",
        )

    def __len__(self) -> int:
        return len(self._columns)

    def add(self, step: wire.ControlStep) -> bool:
        """Add a step; False where it has another number of modes.

        Raises:
            OverflowError: a value that nobody of the loop sends.
        """
        error_nm, pol_nm = step.error_nm or self._nothing, step.pol_nm or self._nothing
        if not len(step.command_nm) == len(error_nm) == len(pol_nm) == self.modes:
            return False
        self._columns.add(
            sequence=step.frame_sequence,
            time_ns=from_timestamp(step.timestamp),
            mode=step.mode,
            reasons=bits_of(step.reasons),
            error_nm=error_nm,
            pol_nm=pol_nm,
            command_nm=step.command_nm,
            flux_dn=step.flux_dn,
            saturated_pixels=step.saturated_pixels,
        )
        return True

    def taken(self) -> Steps:
        """All of them."""
        column = self._columns.taken
        return Steps(
            sequence=column("sequence"),
            time_ns=column("time_ns"),
            mode=column("mode"),
            reasons=column("reasons"),
            error_nm=column("error_nm", self.modes),
            pol_nm=column("pol_nm", self.modes),
            command_nm=column("command_nm", self.modes),
            flux_dn=column("flux_dn"),
            saturated_pixels=column("saturated_pixels"),
        )


class TruthRows:
    """What the simulation knew, with one number of modes."""

    def __init__(self, modes: int) -> None:
        self.modes = modes
        self._columns = Columns(
            sequence="Q",
            time_ns="q",
            disturbance_nm="f",
            residual_nm="f",
            disturbance_rms_nm="f",
            residual_rms_nm="f",
        )

    def __len__(self) -> int:
        return len(self._columns)

    def add(self, truth: wire.Truth) -> bool:
        """Add a truth; False where it has another number of modes.

        Raises:
            OverflowError: a value that nobody of the loop sends.
        """
        if not len(truth.residual_nm) == len(truth.disturbance_nm) == self.modes:
            return False
        self._columns.add(
            sequence=truth.frame_sequence,
            time_ns=from_timestamp(truth.timestamp),
            disturbance_nm=truth.disturbance_nm,
            residual_nm=truth.residual_nm,
            disturbance_rms_nm=truth.disturbance_rms_nm,
            residual_rms_nm=truth.residual_rms_nm,
        )
        return True

    def taken(self) -> Truths:
        """All of them."""
        column = self._columns.taken
        return Truths(
            sequence=column("sequence"),
            time_ns=column("time_ns"),
            disturbance_nm=column("disturbance_nm", self.modes),
            residual_nm=column("residual_nm", self.modes),
            disturbance_rms_nm=column("disturbance_rms_nm"),
            residual_rms_nm=column("residual_rms_nm"),
        )


class TimingRows:
    """Durations of the controller's stages."""

    def __init__(self) -> None:
        self._columns = Columns(sequence="Q", **dict.fromkeys(STAGES, "q"))

    def __len__(self) -> int:
        return len(self._columns)

    def add(self, timing: wire.ControlTiming) -> bool:
        """Add the frames of a message; False where its columns differ in length."""
        stages = {one: getattr(timing, f"{one}_ns") for one in STAGES}
        if not all(len(stage) == len(timing.frame_sequence) for stage in stages.values()):
            return False
        self._columns.add(sequence=timing.frame_sequence, **stages)
        return True

    def taken(self) -> tuple[npt.NDArray[np.uint64], dict[str, npt.NDArray[np.int64]]]:
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
