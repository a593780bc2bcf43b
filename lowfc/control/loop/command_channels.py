"""Additions to the loop's command: static channels, an offset of the loop's target, a table played frame by frame.

A channel is a mirror shape from a source other than the control law, such as one that digs a dark hole. The sensor sees
it, so the sensor's zero point shifts with it (Subedi et al. 2015, Sect. 1 and 4), after the delay of a command, and the
loop does not remove it. Two kinds of shape do not shift the zero point: the channel `FLAT`, and a probe sequence
("play"), which is for calibration and tests.
"""

from typing import NamedTuple

import numpy as np

from lowfc.arrays import Array, Single
from lowfc.control.identity import identity
from lowfc.control.loop.wording import counted

FLAT = "flat"
"""Channel of the mirror's flat map: the reference image includes it, so it does not shift the zero point."""
ADOPTED = "adopted"
"""Channel of the mirror's shape outside the modes when the controller started or a calibration was loaded."""
EXTERNAL = "external"
"""Channel of shapes that other programs apply to the mirror: the loop does not command it."""
MAX_CHANNELS = 16
MAX_PROBE_NUMBERS = 1 << 24
"""Largest number of elements in the table of a probe sequence, and in its basis."""
MIRROR, OFFSET = "mirror", "offset"
"""Targets of a probe sequence."""
MAX_NAME_LENGTH = 32  # characters


class Channel(NamedTuple):
    """A shape added to the command, (rows, columns), nm of surface, and the part of the shape reached so far.

    Once the command has reached the shape, `reached_nm` is the same array as `shape_nm`; `of` ensures this.
    """

    name: str
    shape_nm: Single
    reached_nm: Single

    @classmethod
    def of(cls, name: str, shape_nm: Single, reached_nm: Single) -> "Channel":
        """A channel that is moving to its shape or has reached it."""
        return cls(name, shape_nm, shape_nm if np.array_equal(shape_nm, reached_nm) else reached_nm)

    @property
    def shifts(self) -> bool:
        """Whether the sensor's zero point shifts with it."""
        return self.name != FLAT

    @property
    def commanded(self) -> bool:
        """Whether the loop sends it to the mirror."""
        return self.name != EXTERNAL

    @property
    def moving(self) -> bool:
        """Whether the command has not reached the shape yet."""
        return self.reached_nm is not self.shape_nm


class PlayTable(NamedTuple):
    """A table (frames, columns) to play, one row for each frame.

    Attributes:
        target: `MIRROR`: a row holds the factors of the shapes in `basis` (columns, actuators), nm of surface; or
            `OFFSET`: a row is added to the loop's target, nm of wavefront of each mode.
        rows: (frames, columns) numbers of the table.
        largest: (columns,) largest absolute number of each column.
        reach_nm: for `MIRROR`, an upper bound of every actuator's deviation from zero, nm of surface; else 0.
        id: identity of target, rows and basis.
    """

    target: str
    rows: Single
    basis: Single
    largest: Array
    reach_nm: float
    id: str


class Play(NamedTuple):
    """A table that is being played: `frames` of its rows (fewer once stopped), the first for frame `first_sequence`."""

    table: PlayTable
    first_sequence: int
    frames: int

    def row(self, sequence: int) -> Single | None:
        """Row for a frame; None before the first and after the last."""
        index = sequence - self.first_sequence
        return self.table.rows[index] if 0 <= index < self.frames else None

    def remaining(self, sequence: int) -> int:
        """Number of rows for this and later frames."""
        return min(max(self.first_sequence + self.frames - sequence, 0), self.frames)

    def finished(self, sequence: int) -> bool:
        """Whether there is no row for this and later frames."""
        return not self.remaining(sequence)


class CommandChannels(NamedTuple):
    """All additions to the command.

    Attributes:
        channels: sorted by name.
        sum_nm: (rows, columns) sum of the commanded channels as far as reached.
        shift_nm: (modes,) shift of the sensor's zero point by the channels.
        shifts_nm: `shift_nm` of the last frames, newest first, one for each weight of the delay.
        offset_nm: (modes,) the loop's target, nm of wavefront rms.
        play: the current probe sequence; None if there is none.
    """

    channels: tuple[Channel, ...]
    sum_nm: Single
    shift_nm: Single
    shifts_nm: tuple[Single, ...]
    offset_nm: Single
    play: Play | None = None

    @classmethod
    def none(cls, grid: tuple[int, int], modes: int, frames: int) -> "CommandChannels":
        """No additions; `frames` is the number of weights of the delay."""
        zero = np.zeros(modes, np.float32)
        return cls((), np.zeros(grid, np.float32), zero, (zero,) * frames, zero)

    @property
    def moving(self) -> bool:
        """Whether the command may change with the next frame even in an open loop."""
        return self.play is not None or any(channel.moving for channel in self.channels)

    def target_nm(self, sequence: int) -> Single:
        """The loop's target (modes,) for a frame."""
        row = self.play.row(sequence) if self.play is not None and self.play.table.target == OFFSET else None
        return self.offset_nm if row is None else self.offset_nm + row

    def played_nm(self, sequence: int) -> Single | None:
        """The shape (rows, columns) played for a frame, nm of surface; None if none is."""
        if self.play is None or self.play.table.target != MIRROR:
            return None
        row = self.play.row(sequence)
        return None if row is None else (row @ self.play.table.basis).reshape(self.sum_nm.shape)

    def moved(self, sequence: int, step_nm: float, to_modes: Single) -> "CommandChannels":
        """A copy for the next command: every channel moves towards its shape, all together by at most `step_nm`."""
        play = None if self.play is not None and self.play.finished(sequence) else self.play
        moving = sum(channel.moving for channel in self.channels)
        if not moving:
            return self._replace(play=play)
        step = np.float32(step_nm / moving)
        return self._replace(play=play).with_all(tuple(_nearer(channel, step) for channel in self.channels), to_modes)

    def with_all(self, channels: tuple[Channel, ...], to_modes: Single) -> "CommandChannels":
        """A copy with these channels instead of its own; channels that have reached flat are left out."""
        kept = tuple(channel for channel in channels if channel.shape_nm.any() or channel.reached_nm.any())
        commanded = [channel for channel in kept if channel.commanded]
        zero = np.zeros_like(self.sum_nm)
        own_shifting_nm = sum((channel.reached_nm for channel in commanded if channel.shifts), zero)
        sum_nm = own_shifting_nm + sum((channel.reached_nm for channel in commanded if not channel.shifts), zero)
        shifting_nm = sum((channel.reached_nm for channel in kept if not channel.commanded), own_shifting_nm)
        return self._replace(channels=kept, sum_nm=sum_nm, shift_nm=to_modes @ shifting_nm.reshape(-1))

    def with_shape(self, name: str, shape_nm: Single, to_modes: Single) -> "CommandChannels":
        """A copy with a new shape for a channel, approached from its current one; `EXTERNAL` is reached at once.

        Raises:
            ValueError: the name is invalid, or there are too many channels.
        """
        plain = name.isascii() and name == name.lower() and name.replace("-", "").isalnum()
        if not (plain and name[0].isalpha() and len(name) <= MAX_NAME_LENGTH):
            raise ValueError(f"a channel's name is up to 32 of a-z, 0-9 and -, a letter first; got {name!r}")
        before = self.channel(name)
        if before is None and shape_nm.any() and len(self.channels) >= MAX_CHANNELS:
            raise ValueError(f"there are {MAX_CHANNELS} channels already, which is the most: remove one")
        if name == EXTERNAL:
            return self.with_channel(Channel(name, shape_nm, shape_nm), to_modes).at_once(self)
        reached_nm = np.zeros_like(shape_nm) if before is None else before.reached_nm
        return self.with_channel(Channel.of(name, shape_nm, reached_nm), to_modes)

    def at_once(self, before: "CommandChannels") -> "CommandChannels":
        """A copy in which the change of `shift_nm` from `before` to now also applies to the last frames."""
        change_nm = self.shift_nm - before.shift_nm
        return self._replace(shifts_nm=tuple(shift_nm + change_nm for shift_nm in self.shifts_nm))

    def channel(self, name: str) -> Channel | None:
        """The channel of that name; None if there is none."""
        return next((channel for channel in self.channels if channel.name == name), None)

    def with_channel(self, channel: Channel, to_modes: Single) -> "CommandChannels":
        """A copy with this channel, which replaces a channel of the same name."""
        channels = {each.name: each for each in (*self.channels, channel)}
        return self.with_all(tuple(channels[name] for name in sorted(channels)), to_modes)

    def stopped(self, sequence: int) -> "CommandChannels":
        """A copy whose probe sequence ends after this frame; the next command removes its last shape."""
        if self.play is None:
            return self
        remaining = min(max(sequence + 1 - self.play.first_sequence, 0), self.play.frames)
        return self._replace(play=self.play._replace(frames=remaining))

    def passed(self, frames: int = 1) -> "CommandChannels":
        """A copy advanced by some frames, in which the sensor sees the present shift of the zero point."""
        newest = (self.shift_nm,) * min(frames, len(self.shifts_nm))
        return self._replace(shifts_nm=(*newest, *self.shifts_nm)[: len(self.shifts_nm)])

    def settled(self) -> "CommandChannels":
        """A copy as if the channels had always had their current shapes."""
        return self.passed(len(self.shifts_nm))

    def restarted_from_flat(self, to_modes: Single, *, only_flat: bool = False) -> "CommandChannels":
        """A copy for a command that relaxes to zero: commanded channels restart from flat, and the probe sequence ends.

        With `only_flat`, all channels but `FLAT` and `EXTERNAL` are removed.
        """
        flat = np.zeros_like(self.sum_nm)
        kept = (
            Channel.of(channel.name, channel.shape_nm, flat if channel.commanded else channel.shape_nm)
            for channel in self.channels
            if channel.name in (FLAT, EXTERNAL) or not only_flat
        )
        return self._replace(play=None).with_all(tuple(kept), to_modes)


def seen_nm(weights: tuple[tuple[int, np.float32], ...], newest_first: tuple[Single, ...]) -> Single:
    """Commands or shifts (modes,) as the last exposure saw them, nm of wavefront rms."""
    (lag, weight), *others = weights
    seen: Single = newest_first[lag] if weight == 1 else weight * newest_first[lag]
    for lag, weight in others:
        seen = seen + weight * newest_first[lag]
    return seen


def play_table(target: str, rows: Single, basis: Single) -> PlayTable:
    """Make a table to play, checked as far as possible without the loop; shapes as in `PlayTable`, nm.

    Raises:
        ValueError: the target is unknown, table and shapes do not match or are too large, or a number is not finite.
    """
    if target not in (MIRROR, OFFSET):
        raise ValueError(f"the target of a probe sequence is {MIRROR} or {OFFSET}, got {target!r}")
    if rows.ndim != 2 or not rows.size:
        raise ValueError(f"a probe sequence has a row per frame and a column per shape or mode, got {rows.shape}")
    columns = rows.shape[1]
    if target == MIRROR and (not basis.size or basis.size % columns):
        shapes = f"{counted(columns, 'shape')} of equal size"
        raise ValueError(f"a probe sequence on a mirror needs {shapes}, got {basis.size} actuators in all")
    if max(rows.size, basis.size) > MAX_PROBE_NUMBERS:
        raise ValueError(
            f"a probe sequence has at most {MAX_PROBE_NUMBERS} numbers, {MAX_PROBE_NUMBERS // columns} rows of "
            f"{columns} columns; got {max(rows.size, basis.size)}: play it in parts"
        )
    if not (np.isfinite(rows).all() and np.isfinite(basis).all()):
        raise ValueError("every number of a probe sequence must be finite")
    basis = basis.reshape(columns, -1) if target == MIRROR else np.zeros((0, 0), np.float32)
    largest = np.abs(rows).max(axis=0).astype(np.float64)
    reach_nm = float((largest @ np.abs(basis)).max()) if basis.size else 0.0
    table_id = identity((("target", target), ("table", rows), ("columns", columns), ("basis", basis)))
    return PlayTable(target, rows, basis, largest, reach_nm, table_id)


def _nearer(channel: Channel, step_nm: np.float32) -> Channel:
    """The channel moved towards its shape by at most `step_nm` in each actuator."""
    remaining_nm = channel.shape_nm - channel.reached_nm
    if np.abs(remaining_nm).max() <= step_nm:
        return channel._replace(reached_nm=channel.shape_nm)
    return channel._replace(reached_nm=channel.reached_nm + np.clip(remaining_nm, -step_nm, step_nm))
