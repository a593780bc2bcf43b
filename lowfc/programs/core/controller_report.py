"""What the controller reports beside its steps: stage durations, mean commands to offload, time not closed."""

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
"""Causes of a loop that was not closed, which are named with how often they were."""
MOST_CAUSES = 20
"""Causes that are told apart: a cause may have figures in it, and no two be alike."""


class StageTiming:
    """Durations of the stages of each step, published ten times a second in columns."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._message = wire.ControlTiming()
        self._due_ns = 0

    def add(self, frame_sequence: int, published_ns: int, moments_ns: tuple[int, int, int, int]) -> None:
        """Add a step: when its frame was published, received and taken, when its command was ready and sent."""
        received_ns, taken_ns, ready_ns, sent_ns = moments_ns
        message = self._message
        message.frame_sequence.append(frame_sequence)
        message.transport_ns.append(_column(received_ns - published_ns))
        message.wakeup_ns.append(_column(taken_ns - received_ns))
        message.compute_ns.append(_column(ready_ns - taken_ns))
        message.publish_ns.append(_column(sent_ns - ready_ns))
        message.frame_to_command_ns.append(_column(sent_ns - published_ns))
        if sent_ns >= self._due_ns:
            self.publish(sent_ns)

    def publish(self, now_ns: int) -> None:
        """Publish what there is."""
        self._due_ns = now_ns + TIMING_PERIOD_NS
        if self._message.frame_sequence:
            self._message.timestamp.CopyFrom(timestamp(now_ns))
            self._publisher.put(self._message.SerializeToString())
            self._message = wire.ControlTiming()


class Offload:
    """The mean modal command, once a second by counting frames, as lockstep needs it."""

    def __init__(self, publisher: Publisher, frames: int) -> None:
        self._publisher = publisher
        self._frames = max(1, frames)
        self._noll: tuple[int, ...] = ()
        self._sum_nm, self._count = np.zeros(0), 0

    def add(self, step: Step, noll: tuple[int, ...]) -> None:
        """Add a step of these modes; publish when there are enough."""
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
            self._sum_nm[:] = self._count = 0


class LastSecond:
    """Modal error and light of the frames used in the last second."""

    def __init__(self, period_ns: int) -> None:
        self._rows = np.zeros((max(1, SECOND_NS // period_ns + 1), 3))
        self._count = 0

    def add(self, step: Step, now_ns: int) -> None:
        """Add a step; one whose frame was refused measured nothing."""
        if step.error_nm is not None:
            self._rows[self._count % len(self._rows)] = now_ns, step.error_nm @ step.error_nm, step.flux_dn
            self._count += 1

    def figures(self, state: State, now_ns: int) -> wire.LoopFigures:
        """Figures of the last second; without a frame all are zero."""
        rows = self._rows[: self._count]
        rows = rows[rows[:, 0] > now_ns - SECOND_NS]
        if state.drive is None or not len(rows):
            return wire.LoopFigures()
        _, square_nm2, flux_dn = rows.mean(axis=0).tolist()
        fraction = flux_dn / state.drive.calibration.flux_dn
        return wire.LoopFigures(frames=len(rows), residual_rms_nm=square_nm2**0.5, flux_fraction=fraction)


def fill_worth(health: wire.Health, watch: GainWatch, state: State) -> None:
    """What closing would add, and what the wavefront adds to the dark zone, as measured."""
    health.closing_harm = watch.closing_harm
    measured = watch.added_contrast()
    if measured is None or state.drive is None or not measured[0]:
        return
    flat, each = measured
    name, share = costliest(by_group(state.drive.calibration.noll, each))
    found = health.recent_wavefront
    found.added_contrast_flat, found.added_contrast = flat, float(each.sum())
    found.costliest_modes, found.costliest_share = name, share


class Arrays:
    """Calibration, law and table that is played, published by themselves: states and requests have their identities."""

    def __init__(self, calibrations: Publisher, laws: Publisher, plays: Publisher) -> None:
        self._calibrations, self._laws, self._plays = calibrations, laws, plays

    def publish(self, request: Request) -> None:
        """Publish what a request brings."""
        if request.calibration is not None:
            self._calibrations.put(encode_calibration(request.calibration, request.time_ns))
        if request.law is not None:
            self._laws.put(wire_law(request.law, request.time_ns).SerializeToString())
        if request.played is not None:
            self._plays.put(wire_play(request.played, request.time_ns).SerializeToString())

    def publish_in_use(self, refused: Request, state: State) -> None:
        """Publish again what a refused request has not replaced: whoever asks for the last one gets what is in use."""
        drive = state.drive
        if drive is None:
            return
        play = drive.play
        in_use = Request(
            refused.time_ns,
            refused.name,
            calibration=drive.calibration if refused.calibration is not None else None,
            law=drive.following.law if refused.law is not None and drive.following is not None else None,
            played=play.table if refused.played is not None and play is not None else None,
        )
        self.publish(in_use)


class NotClosed:
    """For how long the loop has not been closed since its first frame, and the causes."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._total_ns = 0
        self._since_ns: int | None = None
        self._cause = ""
        self._causes: Counter[str] = Counter()
        self._times = 0

    def note(self, state: State, now_ns: int) -> tuple[int, str]:
        """Take note of the loop mode; return the time in ns and the causes, the most frequent first."""
        with self._turn:  # a step that ends is noted on the frames' thread
            if not state.frame_sequence:
                return self._total_ns, self._listed()
            before_ns, self._since_ns = self._since_ns, None
            if before_ns is not None:
                self._total_ns += max(0, now_ns - before_ns)
            if state.mode is not LoopMode.CLOSED:
                cause, self._since_ns = state.conditions.mode_cause, now_ns
                if cause and (before_ns is None or cause != self._cause):
                    self._times += 1
                    if cause in self._causes or len(self._causes) < MOST_CAUSES:
                        self._causes[cause] += 1
                self._cause = cause
            return self._total_ns, self._listed()

    def _listed(self) -> str:
        if len(self._causes) < 2:
            return "".join(self._causes)
        named = dict(self._causes.most_common(CAUSES_NAMED))
        if others := self._times - sum(named.values()):
            named["other causes"] = others
        return "; ".join(f"{cause} ({counted(times, 'time')})" for cause, times in named.items())


def _column(duration_ns: int) -> int:
    """Fit a duration into the 32 bits of its column: a camera's clock may be wrong, and a process may be stopped."""
    return min(max(0, duration_ns), 0xFFFF_FFFF)
