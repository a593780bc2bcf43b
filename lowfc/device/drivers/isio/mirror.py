"""Driver of a mirror behind an ImageStreamIO channel: CACAO sums the channels and drives the actuators."""

import contextlib
import math
import time

import numpy as np
from pydantic import Field

from lowfc.adapters.image_stream.channels import (
    OtherChannels,
    complete_shape,
    open_channel,
    opened,
    other_channel_names,
    sum_name,
)
from lowfc.adapters.image_stream.stream import Stream, StreamError, stream_path
from lowfc.adapters.process.service import Service
from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration
from lowfc.device import DriverOptions, Geometry, geometry

SUM_WAIT_S = 0.001
"""Time that a command waits for the sum to be updated."""
SUM_SILENT_S = 0.5
"""Time without an updated sum after which the mirror counts as not following commands."""
SAME_NM = 0.05
"""Largest difference between commanded and reached shape, nm, that float32 rounding in micrometres explains."""
_POLL_S = 50e-6
_SEARCH_S = 0.1
"""Period of the search for an absent sum, which must be found well within `SUM_SILENT_S` after it was recreated."""


class IsioMirror:
    """Mirror driver that writes one channel and reads the sum of all channels."""

    class Options(DriverOptions):
        """The mirror's streams."""

        stream: str
        """Name of the channel's stream."""
        nm_per_unit: float = Field(default=1000.0, ge=1e-9, le=1e9)
        """Surface per unit of the stream, nm; CACAO's unit is the micrometre."""
        total: str | None = None
        """Stream with the sum of all channels; default: dm00disp for dm00disp03, read once it exists; empty: none."""

    def __init__(self, options: Options, config: Configuration) -> None:
        """Open the channel, or create it."""
        self._options = options
        self.geometry: Geometry = geometry(config)
        self._grid = self.geometry.rows, self.geometry.columns
        self._channel = open_channel(options.stream, self._grid)
        self._count = self._channel.count
        self._other_channels = OtherChannels(other_channel_names(options.stream), self._grid)
        self._total_name = sum_name(options.stream) if options.total is None else options.total
        self._beside: tuple[Single | None, Single] = None, np.zeros(self._grid, np.float32)
        self._total: Stream | None = None
        self._total_expected = bool(options.total)
        self._searched_s = -_SEARCH_S
        self._unanswered_s, self._sum_count = math.inf, 0

    def join(self, service: Service) -> None:
        """Keep the process's service for events."""
        self._service = service

    def position(self) -> Single | None:
        """Present shape of the channel; only partly the new one if its writer died during a write.

        None if it is not finite: at its start the mirror's process then writes zeros.
        """
        self._reopen()
        shape = complete_shape(self._channel, self._channel.data[0].astype(np.float32))
        return None if shape is None else shape * np.float32(self._options.nm_per_unit)

    def beside(self) -> Single:
        """Sum of the other channels without its piston, which the process that sums them may subtract."""
        shape = self._other_channels.sum()
        if shape is not self._beside[0]:
            self._beside = shape, (shape - shape.mean()) * np.float32(self._options.nm_per_unit)
        return self._beside[1]

    def apply(self, actuators_nm: Single) -> Single | None:
        """Write the channel (rows, columns), nm of surface.

        If the sum of the channels follows within `SUM_WAIT_S` and this channel's part of it is not the command, that
        part is returned; else None.
        """
        self._reopen()
        self._check_writer()
        total = self._current_total()
        before = 0 if total is None else total.count
        self._channel.put(actuators_nm / np.float32(self._options.nm_per_unit))
        self._count, written_s = self._channel.count, time.monotonic()
        if total is not None and self._wait_for_sum(total, before):
            self._unanswered_s = math.inf
            return self._reached(total, actuators_nm)
        if self._total_expected:
            self._check_silence(total, before, written_s)
        return None

    def close(self) -> None:
        """Do nothing: the channel keeps its shape, and a writer holds no semaphore."""

    def _reopen(self) -> None:
        """Reopen the channel if it was recreated; RuntimeError if it is unusable."""
        if self._channel.current():
            return
        try:
            self._channel = open_channel(self._options.stream, self._grid)
        except StreamError as fault:  # a LowfcError ends the process; another exception is retried
            raise RuntimeError(str(fault)) from fault
        self._count = self._channel.count
        rows, columns = self._grid
        self._service.event("STREAM_RENEWED", stream=self._options.stream, columns=columns, rows=rows)

    def _check_writer(self) -> None:
        """RuntimeError if another process writes the channel."""
        if self._channel.count != self._count:
            self._count = self._channel.count
            pid = self._channel.other_writer()
            raise RuntimeError(f"{f'process {pid}' if pid else 'another process'} writes stream {self._channel.name!r}")

    def _current_total(self) -> Stream | None:
        """Stream of the sum, if it exists; once found, it is expected from then on."""
        if self._total is not None and self._total.current():
            return self._total
        self._total, now_s = None, time.monotonic()
        if self._total_name and now_s - self._searched_s >= _SEARCH_S:
            self._searched_s = now_s
            with contextlib.suppress(StreamError):
                self._total = opened(stream_path(self._total_name), self._grid)
                self._total_expected = True
        return self._total

    def _wait_for_sum(self, total: Stream, before: int) -> bool:
        """Wait up to `SUM_WAIT_S` until the sum has another count than `before`; return whether it has."""
        end_s = time.monotonic() + SUM_WAIT_S
        while total.count == before and time.monotonic() < end_s:
            time.sleep(_POLL_S)
        return total.count != before

    def _check_silence(self, total: Stream | None, before: int, written_s: float) -> None:
        """RuntimeError if the sum has not followed for `SUM_SILENT_S`, so that the mirror counts as not following.

        `before` is the sum's count before this command: if it has changed since the last command, the sum follows late.
        """
        self._unanswered_s = min(self._unanswered_s, written_s) if before == self._sum_count else written_s
        self._sum_count = before
        if time.monotonic() - self._unanswered_s <= SUM_SILENT_S:
            return
        if total is None:
            rows, columns = self._grid
            raise RuntimeError(
                f"there is no stream {self._total_name!r} of {columns} x {rows} float32 pixels for the sum of the "
                "channels: start the process that sums them, or correct the option `total`"
            )
        raise RuntimeError(
            f"stream {total.name!r} has not followed {self._channel.name!r} for {SUM_SILENT_S:g} s: the process "
            "that sums the channels is not running"
        )

    def _reached(self, total: Stream, actuators_nm: Single) -> Single | None:
        """This channel's part of the sum, with its piston ignored; None if it is as written."""
        shape = complete_shape(total)
        if shape is None:
            return None
        deviation_nm = (shape - self._other_channels.sum()) * np.float32(self._options.nm_per_unit) - actuators_nm
        deviation_nm -= np.median(deviation_nm)
        return actuators_nm + deviation_nm if np.abs(deviation_nm).max() > SAME_NM else None
