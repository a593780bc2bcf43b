"""The simulated camera as a driver: receives mirror states; publishes frames and the true wavefront."""

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from pydantic import Field

from lowfc.adapters.bus.bus import Publisher, Sample
from lowfc.adapters.bus.mailbox import Mailbox
from lowfc.adapters.files import factory
from lowfc.adapters.files.twin_cache import load_or_fit_mirror
from lowfc.adapters.process.service import Service
from lowfc.arrays import Single
from lowfc.contract.codecs.codec import actuators, latency
from lowfc.contract.codecs.input_file import user_path
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import Envelope
from lowfc.contract.errors import BusError, ConfigurationError
from lowfc.contract.messages import MIRROR_STATE, TRUTH, timestamp, wire
from lowfc.control.durations import Durations
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.control.laws.stability import delay_weights
from lowfc.device import CameraSettings, DriverOptions, Exposure, Puts
from lowfc.optics.detector.detector import saturation_dn
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from sim_camera.contrast import Contrast
from sim_camera.disturbance import Disturbance, preset_disturbance, with_sources
from sim_camera.faulty import FaultyFrames, read_fault
from sim_camera.lateness import Lateness
from sim_camera.path import MirrorMotion, MirrorPath
from sim_camera.pixels import pixel_errors
from sim_camera.scene import MAX_TRUTHS, Scene, Truth
from sim_camera.wavefront_statistics import WavefrontAccumulator
from sim_camera.wheel import wheels

PATIENCE_S = 5.0
"""Real time without a state of the mirror after which a run in lockstep ends."""
RECENT_S = 2.0
"""Averaging time of the wavefront statistics reported while the loop runs."""
TRUTHS_S = 0.01
"""Longest time for which frames wait until their truths are computed together; in lockstep they do not wait."""
MAX_WAIT_NS = 500_000_000
"""Longest wait in a call of `expose`: half a second, as for every driver (see `Camera.expose`)."""
_REMEMBERED = 256  # largest number of mirror states that wait, and of publication times of frames that are kept


def disturbance_of(config: Configuration) -> Disturbance:
    """The disturbance of a configuration."""
    section, nm_per_mas = config.disturbance, tilt_nm_per_mas(config.star.diameter_m)
    disturbance = preset_disturbance(
        section.preset,
        config.noll,
        config.seed,
        nm_per_mas,
        config.star.wavelength_nm,
        section.scale,
        {int(index): amplitude for index, amplitude in section.static_nm.items()},
        section.line_width,
    )
    disturbance = with_sources(
        disturbance,
        config.camera.rate_hz,
        {int(index): per_root_s for index, per_root_s in section.drift_nm.items()},
        section.drift_slope,
        section.jitter_mas * nm_per_mas,
        section.shear,
    )
    if not section.wheel_hz:
        return disturbance
    speeds_hz = section.wheel_hz, section.wheel_hz + section.second_wheel_hz
    rms_nm = np.where(np.isin(config.noll, TIP_TILT), section.wheel_mas * nm_per_mas, 0.0)
    count = 2 if section.second_wheel_hz else 1
    spinning = wheels(config.seed, speeds_hz[:count], rms_nm, section.wheel_course, section.wheel_change)
    return replace(disturbance, wheels=spinning)


def scene(config: Configuration, disturbance: Disturbance | None = None) -> Scene:
    """Make the scene of a configuration, with a twin from the cache; `disturbance` replaces the configured one."""
    sensor = factory.sensor(config, lambda _: None)  # `lowfc sim-loop` prints the warnings of the optics
    optics, detector, camera = factory.twin(config, None, lambda _: None), factory.detector(config), config.camera
    disturbance = disturbance_of(config) if disturbance is None else disturbance
    return Scene(
        optics,
        load_or_fit_mirror(sensor, optics, factory.true_mirror(config), notice=lambda _: None),
        detector,
        factory.electrons_per_exposure(config),
        disturbance,
        camera.rate_hz,
        config.seed,
        noise=camera.noise,
        exposure=camera.exposure_fraction,
        instants=camera.instants,
        pixels=pixel_errors(
            detector,
            shape=optics.to_pixels.shape[:1] * 2,
            seed=config.seed,
            nonuniformity=camera.nonuniformity,
            nonlinearity=camera.nonlinearity,
            hot_pixels=camera.hot_pixels,
            hot_pixel_e=camera.hot_pixel_e_s * config.exposure_ns * 1e-9,
        ),
        shear_slopes=factory.shear_slopes(config) if disturbance.shear is not None else None,
    )


def _centred_region(name: str, size: int, available: int) -> tuple[int, int]:
    """First row (or column) of the centred readout region, and its number of rows (columns); size 0 means all."""
    if size > available:
        raise ConfigurationError(f"options of the simulated camera: {name} is {size}, the sensor has only {available}")
    return ((available - size) // 2, size) if size else (0, available)


class _Exposed(NamedTuple):
    """A frame: its index (-1 before the first), exposure times, sequence, and the mirror at the exposure's start."""

    frame: int
    start_ns: int
    end_ns: int
    sequence: int
    actuators_nm: Single


class SimulatedCamera:
    """Camera that exposes the optics, star and detector of a configuration frame by frame."""

    class Options(DriverOptions):
        """Readout region, and a fault for tests."""

        rows: int = Field(0, ge=0)
        """Rows of the centred readout region; 0 for all."""
        columns: int = Field(0, ge=0)
        """Columns of the centred readout region; 0 for all."""
        fault: str = ""
        """File (JSON) of a fault to inject into the frames; empty for none."""

    def __init__(self, options: Options, config: Configuration, optics: Scene | None = None) -> None:
        """Build the optics, unless `optics` is given; ConfigurationError if region or fault is invalid."""
        self._config = config
        self._scene = scene(config) if optics is None else optics
        row, rows = _centred_region("rows", options.rows, self._scene.shape[0])
        column, columns = _centred_region("columns", options.columns, self._scene.shape[1])
        self._region = np.s_[row : row + rows, column : column + columns]
        self._fault = read_fault(user_path(options.fault)) if options.fault else None
        configured = CameraSettings.configured(config, rows, columns)
        self._settings = replace(configured, clock="run", region_row=row, region_column=column)
        self._weights = delay_weights(config.camera.delay_frames).astype(np.float32)
        flat = np.zeros((config.mirror.rows, config.mirror.columns), np.float32)
        self._shapes = deque([flat] * len(self._weights), maxlen=len(self._weights))
        self._states: deque[Sample] = deque(maxlen=_REMEMBERED)
        self._arrived = Mailbox()  # a signal's handler may wake it; an Event would deadlock
        self._latched = flat
        # In lockstep a shape applies from the start of an exposure, and the mirror's state already includes settling.
        settling = 0.0 if config.lockstep else config.mirror.settling_us * 1e3 / config.period_ns
        applied = Timing.of(config.camera.delay_frames, config.camera.exposure_fraction).applied
        self._path = MirrorPath(flat, applied - 1, settling)
        self._index, self._origin_ns = 0, 0
        self._exposing = self._exposed = _Exposed(-1, 0, 0, 0, flat)
        # Frames whose truth is not yet computed, each with the mirror's motion in its period.
        self._waiting: list[tuple[_Exposed, MirrorMotion]] = []
        self._truths_at_once = 1 if config.lockstep else min(max(1, int(TRUTHS_S * config.camera.rate_hz)), MAX_TRUTHS)
        # Frame sequence of the newest command that the mirror applied, and sequence of the last frame sent.
        self._newest_state = self._last_frame = 0
        self._published_ns = [(0, 0)] * _REMEMBERED  # sequence and publication time of the last frames
        self._lateness = Lateness()
        self._frame_to_mirror = Durations()
        recent_frames = max(1, round(RECENT_S * config.camera.rate_hz))
        nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
        self._statistics = WavefrontAccumulator(config.noll, nm_per_mas, recent_frames, len(self._scene.instants))
        self._measured: dict[str, float] = {}

    def join(self, service: Service) -> None:
        """Declare the publisher of the truth and subscribe to the mirror."""
        self._service = service
        # Made here, not in `__init__`, because by now the process is limited to one BLAS thread.
        self._contrast = Contrast(factory.contrast_of(self._config))
        self._truths = service.publisher(TRUTH)
        service.bus.subscribe(MIRROR_STATE, self._on_mirror_state, self._config.mirror.name)
        service.on_stop(self._arrived.wake)

    def through(self, publisher: Publisher) -> Puts:
        """The publisher of frames; if the options name a fault, one that injects it."""
        if self._fault is None:
            return publisher
        highest = saturation_dn(factory.detector(self._config))
        return FaultyFrames(self._fault, publisher, self._config.camera.bias_dn, highest, self._service.clock.host_ns)

    def start(self) -> None:
        """Set the time of the first exposure."""
        clock = self._service.clock
        self._origin_ns = clock.now_ns() + (0 if clock.lockstep else min(10 * self._config.period_ns, MAX_WAIT_NS))

    def settings(self) -> CameraSettings:
        """Camera settings of the next exposure."""
        started = self._origin_ns > 0
        return replace(self._settings, time_ns=self._start_ns() + self._config.exposure_ns if started else None)

    def expose(self) -> Exposure | None:
        """Wait for the start of the next exposure, latch the mirror's shape, and compute the frame.

        None if the process is stopping, or if the exposure has not started after `MAX_WAIT_NS`.
        """
        clock, period_ns = self._service.clock, self._config.period_ns
        start_ns = self._start_ns()
        latest_ns = start_ns if clock.lockstep else clock.now_ns() + MAX_WAIT_NS
        clock.sleep_until_ns(min(start_ns, latest_ns))
        if start_ns > latest_ns:
            return None
        behind_ns = clock.now_ns() - start_ns
        if behind_ns > period_ns:  # the host stalled: continue from now rather than catch up in a burst
            self._origin_ns += behind_ns
            start_ns += behind_ns
        if not self._service.running:
            return None
        self._drain()
        self._shapes.appendleft(self._latched)
        actuators_nm = self._latched
        if len(self._weights) > 1:
            actuators_nm = np.tensordot(self._weights, np.array(self._shapes), 1)
        frame = np.ascontiguousarray(self._scene.expose(self._index, actuators_nm)[self._region])
        end_ns = start_ns + self._config.exposure_ns
        self._exposing = _Exposed(self._index, start_ns, end_ns, 0, actuators_nm)
        self._index += 1
        return Exposure(frame, end_ns)

    def sent(self, envelope: Envelope) -> None:
        """Store the frame's publication time; publish the truths of earlier frames once enough of them wait."""
        self._published_ns[envelope.sequence % _REMEMBERED] = (envelope.sequence, envelope.publish_time_ns)
        self._last_frame = envelope.sequence
        self._end_period()
        if len(self._waiting) >= self._truths_at_once:
            self._publish_truths()
        self._exposed = self._exposing._replace(sequence=envelope.sequence)

    def step(self) -> None:
        """Wait until the mirror has applied the command computed from the last frame.

        Raises:
            BusError: no state of the mirror for `PATIENCE_S`.
        """
        while self._newest_state < self._last_frame and self._service.running:
            if not self._states and self._arrived.take(PATIENCE_S) is None and self._service.running:
                raise BusError(self._no_progress())
            self._drain()

    def finish(self) -> None:
        """Publish the last truths and compute the contrast of the run, for the last Health."""
        self._drain()
        self._end_period()
        self._publish_truths()
        self._measured = self._contrast.measure()

    def close(self) -> None:
        """Do nothing: there is no hardware."""

    def fill(self, health: wire.Health) -> None:
        """Add late commands, latency and wavefront to a Health."""
        health.commands_late = self._lateness.total
        if self._frame_to_mirror.count:
            health.frame_to_mirror.CopyFrom(latency(self._frame_to_mirror))
        if wavefront := self._statistics.wavefront():
            health.wavefront.CopyFrom(wire.WavefrontFigures(**(wavefront | self._measured)))
        if recent := self._statistics.recent():
            health.recent_wavefront.CopyFrom(wire.WavefrontFigures(**recent))

    def _start_ns(self) -> int:
        """Start of the next exposure."""
        return self._origin_ns + self._index * self._config.period_ns

    def _end_period(self) -> None:
        """Keep the last exposed frame for its truth; its period is over, so the mirror's motion in it is known."""
        if (index := self._exposed.frame) >= 0:
            self._waiting.append((self._exposed, self._path.motion(index, self._scene.instants)))

    def _publish_truths(self) -> None:
        """Compute and publish the truths of the frames that wait."""
        if not self._waiting:
            return
        waiting, self._waiting = self._waiting, []
        truths = self._scene.truths([(exposed.frame, exposed.actuators_nm, motion) for exposed, motion in waiting])
        instants_nm = np.array([truth.instants_nm for truth in truths])
        middle = instants_nm.shape[2] // 2
        for disturbance_nm, residual_nm in instants_nm[:, :, middle]:
            self._contrast.add(disturbance_nm, residual_nm)
        quadratic = self._contrast.quadratic(instants_nm)
        flat = quadratic[:, 0].sum(axis=1).tolist()
        for (exposed, _), truth, added_flat, added in zip(waiting, truths, flat, quadratic[:, 1], strict=True):
            self._statistics.add(truth, added_flat, added)
            self._publish_truth(exposed, truth, added_flat, added)

    def _publish_truth(self, exposed: _Exposed, truth: Truth, added_flat: float, added: Single) -> None:
        """Publish the truth of a frame, with the contrast that it adds; arguments as for `WavefrontAccumulator.add`."""
        sampled, continuous = truth.sampled, truth.continuous
        message = wire.Truth(
            timestamp=timestamp(exposed.end_ns),
            frame_sequence=exposed.sequence,
            disturbance_nm=sampled.disturbance_nm.tolist(),
            residual_nm=sampled.residual_nm.tolist(),
            disturbance_rms_nm=sampled.disturbance_rms_nm,
            residual_rms_nm=sampled.residual_rms_nm,
            added_contrast_flat=added_flat,
            added_contrast=float(added.sum()),
            wheel_speed_hz=truth.wheel_speed_hz.tolist(),
            shear_diameters=truth.shear.tolist(),
        )
        if continuous is not None:
            message.instants = len(self._scene.instants)
            message.continuous_disturbance_nm.extend(continuous.disturbance_nm.tolist())
            message.continuous_residual_nm.extend(continuous.residual_nm.tolist())
            message.continuous_disturbance_rms_nm = continuous.disturbance_rms_nm
            message.continuous_residual_rms_nm = continuous.residual_rms_nm
            message.sensed_residual_nm.extend(truth.sensed_nm.tolist())
        self._truths.put(message.SerializeToString())

    def _on_mirror_state(self, sample: Sample) -> None:
        self._states.append(sample)
        self._arrived.put(sample)

    def _drain(self) -> None:
        """Process the received mirror states; the next exposure sees the newest shape."""
        while self._states:
            sample = self._states.popleft()
            try:
                state = wire.MirrorState.FromString(sample.payload)
            except DecodeError as error:
                self._service.unreadable(sample.key, error)
                continue
            if not state.actuators:  # the mirror's driver failed: the shape is unknown
                continue
            shape = actuators(state)
            if shape is None or shape.shape != self._latched.shape or not np.isfinite(shape).all():
                self._service.unreadable(sample.key, "the shape is not finite, or not of the configured mirror's grid")
                continue
            self._latched = shape
            latest = self._exposed.frame + 1  # the next exposure starts with this shape, even after a stall of the host
            self._path.applied(self._reached_at(sample.publish_time_ns), shape, latest)
            if state.frame_sequence > self._newest_state:
                self._newest_state = state.frame_sequence
                sequence, published_ns = self._published_ns[state.frame_sequence % _REMEMBERED]
                if sequence == state.frame_sequence:  # otherwise the command is not from a frame, as in a mirror test
                    self._count_late(state.frame_sequence < self._last_frame)
                    self._frame_to_mirror.add(sample.publish_time_ns - published_ns)

    def _reached_at(self, publish_time_ns: int) -> float:
        """Time at which the mirror reached a shape, in periods after the start of the first exposure.

        It is the start of the next exposure in lockstep, before the first exposure, and with a fractional delay, which
        itself moves the shape during an exposure.
        """
        index, start_ns = self._exposed.frame, self._exposed.start_ns
        if self._service.clock.lockstep or index < 0 or self._config.camera.delay_frames % 1:
            return index + 1
        return index + (publish_time_ns - start_ns) / self._config.period_ns

    def _count_late(self, late: bool) -> None:
        """Count a command; report when commands become habitually late, and when this ends."""
        if self._lateness.add(late):
            event = "COMMANDS_LATE" if self._lateness.habitual else "COMMANDS_IN_TIME"
            self._service.event(event, percent=self._lateness.percent)

    def _no_progress(self) -> str:
        """Text of the error of a lockstep run without progress: the frame, and the processes without recent Health."""
        now_ns = self._service.clock.host_ns()
        silent = [
            name
            for name, health in sorted(self._service.last_health.items())
            if now_ns - health.timestamp.ToNanoseconds() > PATIENCE_S * 0.4e9
        ]
        cause = f"no Health from {', '.join(silent)}" if silent else "all processes are alive"
        return f"the mirror did not apply a command for frame {self._index - 1} within {PATIENCE_S:g} s: {cause}"
