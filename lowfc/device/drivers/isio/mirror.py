"""A mirror behind an ImageStreamIO channel: CACAO sums the channels and drives the actuators."""

import math
import time

import numpy as np
from pydantic import Field

from lowfc.adapters.image_stream.channels import (
    OtherChannels,
    channel_names,
    channel_of,
    opened,
    sum_name,
    whole,
)
from lowfc.adapters.image_stream.stream import Stream, stream_path
from lowfc.adapters.process.service import Service
from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration
from lowfc.device import DriverOptions, Geometry, geometry

SUM_WAIT_S = 0.001
"""How long a command waits for the sum to follow it."""
SUM_SILENT_S = 0.5
"""After so long without a new sum the mirror counts as not following."""
SAME_NM = 0.05
"""Difference between what is wanted and what the sum shows that is rounding, of float32 in micrometres."""
_POLL_S = 50e-6
_LOOK_S = 1.0


class IsioMirror:
    """Writes one channel of the mirror, and reads the sum of all."""

    class Options(DriverOptions):
        """Which channel it is."""

        stream: str
        """Name of the channel's stream."""
        nm_per_unit: float = Field(default=1000.0, gt=0)
        """Nanometres of surface that one unit of the stream makes; CACAO's is the micrometre."""
        total: str | None = None
        """Name of the stream with the sum of all channels, read where it is; by default dm00disp of dm00disp03."""

    def __init__(self, options: Options, config: Configuration) -> None:
        """Open the channel, or make it."""
        self._options = options
        self.geometry: Geometry = geometry(config)
        self._grid = self.geometry.rows, self.geometry.columns
        self._channel = channel_of(options.stream, self._grid)
        self._count = self._channel.count
        self._others = OtherChannels(channel_names(options.stream), self._grid)
        self._total_name = sum_name(options.stream) if options.total is None else options.total
        self._beside: tuple[Single | None, Single] = None, np.zeros(self._grid, np.float32)
        self._total: Stream | None = None
        self._looked_s = -_LOOK_S
        self._unanswered_s = math.inf

    def join(self, service: Service) -> None:
        """Keep the process, for its events."""
        self._service = service

    def position(self) -> Single:
        """The channel's content."""
        held = whole(self._channel)
        return np.zeros(self._grid, np.float32) if held is None else held * np.float32(self._options.nm_per_unit)

    def beside(self) -> Single:
        """The other channels' shape on the mirror, without piston, which only the sum has."""
        shape = self._others.sum()
        if shape is not self._beside[0]:
            self._beside = shape, (shape - shape.mean()) * np.float32(self._options.nm_per_unit)
        return self._beside[1]

    def apply(self, actuators_nm: Single) -> Single | None:
        """Write the channel (rows, columns); once the sum has followed, return this channel's part of it."""
        self._check_channel()
        total = self._current_total()
        before = 0 if total is None else total.count
        self._channel.put(actuators_nm / np.float32(self._options.nm_per_unit))
        self._count = self._channel.count
        return None if total is None or not self._followed(total, before) else self._reached(total, actuators_nm)

    def close(self) -> None:
        """Do nothing: the channel keeps its shape, and a writer holds no semaphore."""

    def _check_channel(self) -> None:
        """Make sure that the channel is the one there is, and nobody else's."""
        if not self._channel.current():
            self._channel = channel_of(self._options.stream, self._grid)
            self._count = self._channel.count
            rows, columns = self._grid
            self._service.event("STREAM_RENEWED", stream=self._options.stream, columns=columns, rows=rows)
        if self._channel.count != self._count:
            self._count = self._channel.count
            pid = self._channel.other_writer()
            raise RuntimeError(f"{f'process {pid}' if pid else 'another process'} writes stream {self._channel.name!r}")

    def _current_total(self) -> Stream | None:
        """The stream of the sum, if there is one; searched for once a second."""
        if self._total is not None and self._total.current():
            return self._total
        self._total, now_s = None, time.monotonic()
        if self._total_name and now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            self._total = opened(stream_path(self._total_name), self._grid)
        return self._total

    def _followed(self, total: Stream, before: int) -> bool:
        """Whether the sum was made anew after the channel, within what a command may wait.

        RuntimeError where it has not been for long, so that the mirror does not follow.
        """
        written_s = time.monotonic()
        while (now_s := time.monotonic()) - written_s < SUM_WAIT_S and total.count == before:
            time.sleep(_POLL_S)
        if total.count != before:
            self._unanswered_s = math.inf
            return True
        self._unanswered_s = min(self._unanswered_s, written_s)
        if now_s - self._unanswered_s > SUM_SILENT_S:
            raise RuntimeError(
                f"stream {total.name!r} has not followed {self._channel.name!r} for {SUM_SILENT_S:g} s: the process "
                "that sums the channels does not run"
            )
        return False

    def _reached(self, total: Stream, actuators_nm: Single) -> Single | None:
        """This channel's part of the sum; None if it is as written. Piston belongs to the sum."""
        shape = whole(total)
        if shape is None:
            return None
        rest_nm = (shape - self._others.sum()) * np.float32(self._options.nm_per_unit) - actuators_nm
        rest_nm -= np.median(rest_nm)
        return actuators_nm + rest_nm if np.abs(rest_nm).max() > SAME_NM else None
