"""Reports of the controller besides its steps: durations, offload, the last second, arrays, time not closed."""

import threading
from collections import Counter

import numpy as np

from lowfc.adapters.bus.bus import Publisher
from lowfc.contract.codecs.calibration_codec import encode_calibration
from lowfc.contract.codecs.law_codec import wire_law, wire_play
from lowfc.contract.messages import timestamp, wire
from lowfc.control.loop.inputs import Request, Step
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import State
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.added_contrast import by_group, costliest
from lowfc.programs.core.gain_watch import GainWatch

TIMING_PERIOD_NS = 100_000_000
SECOND_NS = 1_000_000_000
CAUSES_NAMED = 4
"""Number of causes that are listed with their counts: those that lasted longest in total, the longest first."""
MAX_CAUSES = 200
"""Largest number of different causes counted: a cause may contain values, so that their number has no limit."""


class StageTiming:
    """Durations of the stages of each step, published in columns every TIMING_PERIOD_NS."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._message = wire.ControlTiming()
        self._due_ns = 0

    def add(self, frame_sequence: int, published_ns: int, times_ns: tuple[int, int, int, int]) -> None:
        """Add a step.

        Args:
            frame_sequence: sequence of the step's frame.
            published_ns: time at which the frame was published.
            times_ns: times at which the frame was received, the step began and was computed, and the command was sent.
        """
        received_ns, start_ns, ready_ns, sent_ns = times_ns
        message = self._message
        message.frame_sequence.append(frame_sequence)
        message.transport_ns.append(_clipped(received_ns - published_ns))
        message.wakeup_ns.append(_clipped(start_ns - received_ns))
        message.compute_ns.append(_clipped(ready_ns - start_ns))
        message.publish_ns.append(_clipped(sent_ns - ready_ns))
        message.frame_to_command_ns.append(_clipped(sent_ns - published_ns))
        if sent_ns >= self._due_ns:
            self.publish(sent_ns)

    def publish(self, now_ns: int) -> None:
        """Publish the columns collected so far."""
        self._due_ns = now_ns + TIMING_PERIOD_NS
        if self._message.frame_sequence:
            self._message.timestamp.CopyFrom(timestamp(now_ns))
            self._publisher.put(self._message.SerializeToString())
            self._message = wire.ControlTiming()


class Offload:
    """The modal command averaged over `frames` frames, published once for each average.

    Frames are counted, and no clock is read, so that runs are reproducible.
    """

    def __init__(self, publisher: Publisher, frames: int) -> None:
        self._publisher = publisher
        self._frames = max(1, frames)
        self._noll: tuple[int, ...] = ()
        self._sum_nm, self._count = np.zeros(0), 0

    def add(self, step: Step, noll: tuple[int, ...]) -> None:
        """Add a step with these modes; publish the average once it is over `frames` frames."""
        if self._noll != noll:
            self._sum_nm, self._count, self._noll = np.zeros(len(noll)), 0, noll
        self._sum_nm += step.command_nm
        self._count += 1
        if self._count >= self._frames:
            message = wire.ModalOffload(
                timestamp=timestamp(step.time_ns),
                frame_sequence=step.frame_sequence,
                noll=noll,
                command_nm=(self._sum_nm / self._count).tolist(),
                frames=self._count,
            )
            self._publisher.put(message.SerializeToString())
            self._sum_nm, self._count = np.zeros(len(noll)), 0


class LastSecond:
    """Modal error and flux of the frames used in the last second.

    If frames arrive faster than the configured rate, only the newest are counted.
    """

    def __init__(self, period_ns: int) -> None:
        self._rows = np.zeros((SECOND_NS // period_ns + 1, 3))  # time, ns; squared modal error, nm^2; flux, DN
        self._count = 0

    def add(self, step: Step, now_ns: int) -> None:
        """Add a step; a step without a measurement, of a refused frame, is ignored."""
        if step.error_nm is not None:
            self._rows[self._count % len(self._rows)] = now_ns, step.error_nm @ step.error_nm, step.flux_dn
            self._count += 1

    def statistics(self, state: State, now_ns: int) -> wire.LoopFigures:
        """Statistics of the last second; all zero without a frame."""
        rows = self._rows[: self._count]
        rows = rows[rows[:, 0] > now_ns - SECOND_NS]
        if state.loop is None or not len(rows):
            return wire.LoopFigures()
        _, square_nm2, flux_dn = rows.mean(axis=0).tolist()
        fraction = flux_dn / state.loop.calibration.flux_dn
        return wire.LoopFigures(frames=len(rows), residual_rms_nm=square_nm2**0.5, flux_fraction=fraction)


def fill_harm_and_contrast(health: wire.Health, watch: GainWatch, state: State) -> None:
    """Add to a Health why closing would increase the residual (empty if not), and the measured added contrast."""
    health.closing_harm = watch.closing_harm
    measured = watch.added_contrast()
    if measured is None or state.loop is None or not measured[0]:
        return
    uncorrected, by_mode = measured
    name, share = costliest(by_group(state.loop.calibration.noll, by_mode))
    recent = health.recent_wavefront
    recent.added_contrast_flat, recent.added_contrast = uncorrected, float(by_mode.sum())
    recent.costliest_modes, recent.costliest_share = name, share


class Arrays:
    """Publishes calibration, law and probe table separately; states and requests refer to them by identity."""

    def __init__(self, calibrations: Publisher, laws: Publisher, plays: Publisher) -> None:
        self._calibrations, self._laws, self._plays = calibrations, laws, plays

    def publish(self, request: Request) -> None:
        """Publish the arrays of a request."""
        if request.calibration is not None:
            self._calibrations.put(encode_calibration(request.calibration, request.time_ns))
        if request.law is not None:
            self._laws.put(wire_law(request.law, request.time_ns).SerializeToString())
        if request.played is not None:
            self._plays.put(wire_play(request.played, request.time_ns).SerializeToString())

    def publish_in_use(self, refused: Request, state: State) -> None:
        """After a refused request, publish the arrays in use again, so that the last ones published are in use."""
        loop = state.loop
        if loop is None:
            return
        play, calibrated = loop.play, bool(loop.calibration.noll)
        in_use = Request(
            refused.time_ns,
            refused.name,
            calibration=loop.calibration if refused.calibration is not None and calibrated else None,
            law=loop.law_runner.law if refused.law is not None and loop.law_runner is not None else None,
            played=play.table if refused.played is not None and play is not None else None,
        )
        self.publish(in_use)


class NotClosed:
    """Total time for which the loop was not closed, from the first frame to the newest, and its causes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._total_ns = 0
        self._since_ns: int | None = None
        self._cause = ""
        self._causes: Counter[str] = Counter()
        self._caused_ns: Counter[str] = Counter()
        self._occurrences = 0

    def note(self, state: State, now_ns: int, newest_ns: int | None = None) -> tuple[int, str]:
        """Note the loop mode; return the total time not closed, ns, and its causes as text, the longest first.

        `newest_ns` is the time of the newest frame if it is not `now_ns`.
        """
        with self._lock:  # called from the main and the receiving thread
            if not state.frame_sequence:
                return self._total_ns, self._causes_in_words()
            before_ns, self._since_ns = self._since_ns, None
            if before_ns is not None:
                lasted_ns = max(0, (now_ns if newest_ns is None else newest_ns) - before_ns)
                self._total_ns, now_ns = self._total_ns + lasted_ns, before_ns + lasted_ns
                if self._cause in self._causes:
                    self._caused_ns[self._cause] += lasted_ns
            if state.mode is not LoopMode.CLOSED:
                cause, self._since_ns = state.conditions.mode_cause, now_ns
                if cause and (before_ns is None or cause != self._cause):
                    self._occurrences += 1
                    if cause in self._causes or len(self._causes) < MAX_CAUSES:
                        self._causes[cause] += 1
                self._cause = cause
            return self._total_ns, self._causes_in_words()

    def _causes_in_words(self) -> str:
        if len(self._causes) < 2:
            return "".join(self._causes)
        longest = sorted(self._causes, key=self._caused_ns.__getitem__, reverse=True)[:CAUSES_NAMED]
        named = {cause: self._causes[cause] for cause in longest}
        if others := self._occurrences - sum(named.values()):
            named["other causes"] = others
        return "; ".join(f"{cause} ({counted(times, 'time')})" for cause, times in named.items())


def _clipped(duration_ns: int) -> int:
    """Clip a duration to the 32 bits of its column: a camera's clock may be wrong, or a process was stopped."""
    return min(max(0, duration_ns), 0xFFFF_FFFF)
