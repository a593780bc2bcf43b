"""The controller's process: applies `advance` to each message; sends the command first, then everything else."""

import threading
from collections import deque
from dataclasses import replace
from functools import partial

from lowfc.adapters.bus.bus import ALL, Query, Sample
from lowfc.adapters.bus.start_check import StartCheck
from lowfc.adapters.files.factory import contrast_of
from lowfc.adapters.process.clock import SimulatedClock
from lowfc.adapters.process.latch import Latch
from lowfc.adapters.process.realtime import yield_to_sender
from lowfc.adapters.process.service import Service
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.state_codec import controller_state, reason_counts
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BadMessageError, CalibrationError
from lowfc.contract.messages import (
    CALIBRATION,
    COMMAND,
    CONTROL_INPUT,
    CONTROLLER_STATE,
    FRAME,
    LAW,
    OFFLOAD,
    PLAY,
    REQUEST,
    REQUEST_KEY,
    SEQUENCE_BOUND,
    STEP,
    TIMING,
    wire,
)
from lowfc.control.cache_warmup import CacheWarmup
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.durations import Durations
from lowfc.control.loop.advance import advance
from lowfc.control.loop.command_channels import ADOPTED
from lowfc.control.loop.inputs import TICK_NS, Input, Load, MirrorReport, Outputs, Reply, Report, Request, Tick
from lowfc.control.loop.loading import holding_cause, misfit_cause, safe_pending, uncalibrated_cause
from lowfc.control.loop.requests import CONFIGURATION, MAX_REPLY_LENGTH, prepared
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import State
from lowfc.programs.core.bench_values import BenchValues
from lowfc.programs.core.camera_reports import CameraReports
from lowfc.programs.core.controller_report import (
    Arrays,
    LastSecond,
    NotClosed,
    Offload,
    StageTiming,
    fill_harm_and_contrast,
)
from lowfc.programs.core.gain_watch import GainWatch
from lowfc.programs.core.mirror_reports import MirrorReports
from lowfc.programs.core.start_up import StartUp, settings_at_start

MIRROR_PATIENCE_S = 1.0
"""Longest time that the start waits for the mirror to report its shape."""
STATE_PERIOD_NS = 1_000_000_000
CHANNEL = "lowfc"  # channel of the mirror that the commands set


class Controller:
    """Receives frames, sends commands and answers requests until stopped."""

    def __init__(
        self, config: Configuration, service: Service, calibration: Calibration | None, source: str, latch: Latch
    ) -> None:
        """Join the bus; load the calibration (None: idle), named `source` in events. LowfcError: a file is invalid."""
        name = config.mirror.name
        self._service = service
        self._latch = latch
        self._settings = settings_at_start(latch, config, service.event)
        self._configuration = config.to_toml()
        self._start_up, self._start_pending = StartUp(config), True
        self._gain_watch = GainWatch(self._settings, config.control.on_harm, contrast_of(config).form)
        self._gain_requests: deque[Request] = deque()
        self._latched_safe = latch.safe
        self._safe_signalled = False
        report_ahead = partial(service.event, "START_AHEAD", what="frames")
        self._start_check = StartCheck(service.clock, config.control.max_start_ahead_h, report_ahead)
        warms_up = config.realtime.cache_warmup and not config.lockstep
        self._warmup = CacheWarmup(config.period_ns) if warms_up else None
        self._last_sample: Sample | None = None
        self._valid_ns = round(config.control.command_timeout_ms * 1e6)
        self._state = State()
        self._lock = threading.RLock()  # reentrant: a step or the start may carry out requests while it holds the lock
        self._mirror_adopted = False
        self._first_frame: Sample | None = None
        self._unsubscribe_frames = service.dispatch(
            FRAME, self._received, period_ns=config.period_ns, superseded=partial(self._received, superseded=True)
        )
        self._mirror = MirrorReports(service, name)
        self._camera = CameraReports(service, self._apply_report)
        self._bench = BenchValues(service, self._settings.interlocks, self._apply_report)
        self._commands = service.publisher(COMMAND, name)
        self._steps = service.publisher(STEP)
        self._inputs = service.publisher(CONTROL_INPUT)
        self._states = service.publisher(CONTROLLER_STATE)
        self._requests, self._requests_lock = service.publisher(REQUEST), threading.Lock()
        self._timing = StageTiming(service.publisher(TIMING))
        self._arrays = Arrays(*(service.publisher(topic) for topic in (CALIBRATION, LAW, PLAY)))
        self._offload = Offload(service.publisher(OFFLOAD), round(1e9 / float(OFFLOAD.rate) / config.period_ns))
        self._not_closed = NotClosed()
        self._last_second = LastSecond(config.period_ns)
        self._queries: deque[Query] = deque()
        service.bus.queryable(REQUEST_KEY.format(name=ALL), self._queue_query)
        self._frame_to_command = Durations()
        self._state_due_ns = 0
        self._last_frame_ns = now_ns = service.clock.now_ns()
        if calibration is not None:
            self._arrays.publish(Request(now_ns, "load", calibration=calibration))
            self._apply_report(Load(now_ns, calibration, source))
            if self._state.loop is not None:
                self._gain_watch.prepare(self._state.loop)
        service.awaited = lambda: "" if self._state.frame_sequence else "a camera"

    def run(self) -> None:
        """Do all work but the steps after the first, which the receiving thread makes; `_lock` separates them."""
        self._service.state = "ready"  # from here on the service manager expects a watchdog signal, which `beat` sends
        self._camera.await_first()
        self._adopt_mirror()
        self._bench.query()
        self._service.state = "running"
        with self._lock:
            self._send_start_requests()
            self._mirror_adopted = True
            if self._first_frame is not None:
                self._control_step(self._first_frame)
        while self._service.running:
            wait_ns = None if self._warmup is None else self._warmup.wait_ns(self._service.clock.host_ns())
            camera = self._camera.mailbox.take((TICK_NS if wait_ns is None else min(wait_ns, TICK_NS)) * 1e-9)
            if camera is None and self._warmup is not None and self._warmup.due(self._service.clock.host_ns()):
                self._warm_up()
                continue  # everything else waits until after the frame
            with self._lock:
                self._between_frames(camera)
            if self._safe_signalled:
                self._safe_signalled = False
                now_ns = self._service.clock.now_ns()
                self._carry_out_internal(Request(now_ns, "safe", text="SIGUSR1", requester="a signal"))
            for _ in range(len(self._queries)):
                self._answer(self._queries.popleft())
            while self._gain_requests:
                self._carry_out_internal(self._gain_requests.popleft())
            self._update_latch()
            if self._state.conditions.camera_awaited:
                for sample in self._camera.query():
                    with self._lock:
                        self._camera.apply(sample)
            self._service.beat()
        self._unsubscribe_frames()
        with self._lock:
            self._timing.publish(self._service.clock.host_ns())
        self._latch.close()
        self._service.finish()

    def fill(self, health: wire.Health) -> None:
        """Add mode, counts, latency and statistics of the loop to a Health."""
        health.mode = self._state.mode.value  # type: ignore[assignment]  # same numbers
        health.counts.extend(reason_counts(self._state))
        now_ns = self._service.clock.now_ns()
        health.not_closed_ns, health.not_closed_cause = self._not_closed.note(self._state, now_ns, self._last_frame_ns)
        if self._state.mode is LoopMode.CLOSED:
            health.holding = holding_cause(self._state)
        fill_harm_and_contrast(health, self._gain_watch, self._state)
        health.last_second.CopyFrom(self._last_second.statistics(self._state, self._service.clock.host_ns()))
        if self._frame_to_command.count:
            health.frame_to_command.CopyFrom(codec.latency(self._frame_to_command))

    def _received(self, sample: Sample, *, superseded: bool = False) -> None:
        """Process a frame, on the receiving thread; until the mirror's shape is known, keep only the newest one."""
        with self._lock:
            if not self._mirror_adopted:
                self._first_frame = sample
            elif self._service.running:
                self._control_step(sample, superseded)

    def _control_step(self, sample: Sample, superseded: bool = False) -> None:
        """Do one control step: send the command before anything else is encoded.

        A superseded frame counts as late, whatever its age, and the command is held: frames exposed with the same
        mirror shape must not all be integrated.
        """
        clock, newest_sequence = self._service.clock, self._state.frame_sequence
        start_ns = clock.host_ns()
        age_ns = 0 if clock.lockstep else start_ns - sample.publish_time_ns
        if superseded:
            age_ns = max(age_ns, self._settings.max_frame_age_ns + 1)
        try:
            ahead = self._start_check.ahead(sample.sequence)
            frame = codec.decode_frame(sample.payload, sample.sequence, age_ns, ahead=ahead)
        except BadMessageError as fault:
            self._service.unreadable(sample.key, fault)
            return
        self._bench.update()
        if isinstance(clock, SimulatedClock):
            clock.set_ns(frame.time_ns)
        outputs = self._advance(frame)
        ready_ns = clock.host_ns()
        self._send(outputs)
        sent_ns = self._commands.handed_ns if outputs.command is not None else clock.host_ns()
        yield_to_sender()
        if self._state.frame_sequence != newest_sequence:  # an old frame does not show that the camera is alive
            self._last_frame_ns = clock.now_ns() if clock.lockstep else start_ns
        if not newest_sequence:  # the first frame
            self._not_closed.note(self._state, self._last_frame_ns)
        self._publish(outputs)
        self._watch_gains(outputs)
        self._service.work += 1
        self._frame_to_command.add(sent_ns - sample.publish_time_ns)
        self._timing.add(sample.sequence, sample.publish_time_ns, (sample.receive_time_ns, start_ns, ready_ns, sent_ns))
        if clock.now_ns() >= self._state_due_ns:  # not the frame's time: the camera may have another clock
            self._publish_state(frame.time_ns)
        if self._warmup is not None:
            self._last_sample = sample
            self._warmup.frame_received(sample.receive_time_ns)
            self._camera.mailbox.wake()  # `run` does its other work now, then waits until the next warm-up is due

    def _warm_up(self) -> None:
        """Repeat the last step and discard the result: other work evicts a step's code and data from the caches."""
        with self._lock:
            if self._last_sample is None or self._state.frame_sequence + 1 >= SEQUENCE_BOUND:
                return
            frame = codec.decode_frame(self._last_sample.payload, self._state.frame_sequence + 1, 0)
            _, outputs = advance(self._settings, self._state, frame)
            if outputs.command is not None:
                codec.encode_command(outputs.command, self._valid_ns, CHANNEL, self._state.input_number)

    def _between_frames(self, camera: Sample | None) -> None:
        """Apply new camera settings, bench values and mirror reports; apply a `Tick` if no frame arrives."""
        if camera is not None:
            self._camera.apply(camera)
        if not self._service.clock.lockstep:
            self._bench.update()
            if self._mirror.due:
                self._report_mirror()
        self._send_start_requests()
        silent_ns = self._service.clock.host_ns() - self._last_frame_ns
        if silent_ns >= TICK_NS and not self._service.clock.lockstep:
            self._apply_report(Tick(self._service.clock.now_ns(), silent_ns))

    def _answer(self, query: Query) -> None:
        """Apply an operator's request between two frames; decoding and the reply do not delay frames."""
        now_ns = self._service.clock.now_ns()
        try:
            if query.name == "safe":  # accepted even if its other fields are invalid
                query.payload = codec.only_requester(query.payload)
            request = prepared(self._settings, codec.decode_request(query.payload, query.name, now_ns))
        except ValueError as error:
            request = Request(now_ns, query.name)
            reply = Reply(False, str(error)[:MAX_REPLY_LENGTH], self._state.frame_sequence + 1)
            state, number = self._state, 0
        else:
            reply, state, number = self._carry_out(request)
        message = controller_state(state, self._settings, now_ns) if request.name == "status" else None
        short = Request(request.time_ns, request.name, request.modes, request.values, request.text)
        query.reply(codec.encode_request(short, reply, number, message))  # without the arrays: the requester has them
        with self._requests_lock:  # in lockstep the receiving thread publishes requests, too
            self._requests.put(codec.encode_request(request, reply, number, message))

    def _carry_out(self, request: Request) -> tuple[Reply, State, int]:
        """Carry out a request; return its reply, the state after it, and its input number (0 for `configuration`)."""
        if request.name == CONFIGURATION:
            return Reply(True, self._configuration, self._state.frame_sequence + 1), self._state, 0
        self._arrays.publish(request)
        with self._lock:
            outputs = self._advance(request)
            state = self._state
            self._publish(outputs)
        reply = outputs.reply
        assert reply is not None  # noqa: S101  # every request has an answer
        if not reply.accepted:
            self._arrays.publish_in_use(request, state)
        return reply, state, state.input_number

    def _watch_gains(self, outputs: Outputs) -> None:
        """Update the gain watch after the command; in lockstep, apply its requests before the next frame."""
        if outputs.step is None:
            return
        actions = self._gain_watch.observe(outputs.step, self._state)
        for event in actions.events:
            self._service.event(event.name, **event.details)
        for request in actions.requests:
            if self._service.clock.lockstep:
                self._carry_out_internal(request)
            else:
                self._gain_requests.append(request)
                self._camera.mailbox.wake()

    def _carry_out_internal(self, request: Request) -> Reply:
        """Carry out an internal request, dated by the controller's clock, and publish it like an operator's."""
        request = prepared(self._settings, replace(request, time_ns=self._service.clock.now_ns()))
        reply, _, number = self._carry_out(request)
        with self._requests_lock:
            self._requests.put(codec.encode_request(request, reply, number, None))
        return reply

    def safe_by_signal(self) -> None:
        """Request safe mode from a signal handler; the main thread carries it out."""
        self._safe_signalled = True
        self._camera.mailbox.wake()

    def _update_latch(self) -> None:
        """Set or clear the latch if safe mode began or ended: after the reply, by the latch's own thread."""
        safe = self._state.mode is LoopMode.SAFE or safe_pending(self._settings, self._state)
        if safe is not self._latched_safe:
            self._latched_safe = safe
            self._latch.set(safe)

    def _adopt_mirror(self) -> None:
        """Read the mirror's shape before the first command, so that the mirror does not jump."""
        lockstep = self._service.clock.lockstep
        if lockstep and self._state.loop is not None:  # a lockstep run that has a calibration starts from flat
            self._mirror.close()
            return
        shape = self._mirror.first(MIRROR_PATIENCE_S)
        if shape is not None:
            loop, grid = self._state.loop, shape.actuators_nm.shape
            if loop is not None and grid != loop.calibration.grid:
                raise CalibrationError(
                    f"the mirror has {grid} actuators, the calibration is for {loop.calibration.grid}: load a "
                    "calibration of this mirror"
                )
            self._apply_report(shape)
        if lockstep:
            self._mirror.close()
        elif self._service.running:
            self._report_mirror()

    def _report_mirror(self) -> None:
        """Report the mirror's first shape if it is new, and a fault of the mirror or its end, to the loop."""
        shape = self._mirror.first()
        if shape is not None:  # before the first command: the loop starts from this shape
            self._apply_report(shape)
        fault = self._mirror.fault(self._state)
        if fault or self._state.conditions.mirror_fault:
            self._apply_report(MirrorReport(self._service.clock.now_ns(), fault, self._mirror.last()))

    def _send_start_requests(self) -> None:
        """Request the configured shapes and law like an operator, once the mirror is known and no camera is awaited."""
        state = self._state
        if state.loop is None or state.conditions.camera_awaited or not (self._start_pending and state.may_command):
            return
        self._start_pending = False
        for request in self._start_up.requests(self._state, self._service.clock.now_ns()):
            reply = self._carry_out_internal(request)
            if reply.accepted:
                continue
            law = request.name == "law"
            unfit = law and (misfit_cause(self._state) or uncalibrated_cause(self._state))  # the loop stays open
            # Once the controller runs, clients may have changed the loop, so that a refusal is no fault of the file.
            if unfit or (self._mirror_adopted and request.text != ADOPTED):
                self._service.event("LAW_NOT_IN_FORCE" if law else "FLAT_NOT_IN_FORCE", why=reply.text)
            else:
                self._start_up.handle_refusal(request, reply.text)
                break

    def _advance(self, input_: Input) -> Outputs:
        self._state, outputs = advance(self._settings, self._state, input_)
        return outputs

    def _apply_report(self, report: Report) -> None:
        """Advance by an input that is neither a frame nor a request, and log it if it changed the state."""
        before = self._state
        outputs = self._advance(report)
        self._send(outputs)
        if self._state is not before:
            self._inputs.put(codec.encode_input(report, self._state.input_number))
        self._publish(outputs)

    def _send(self, outputs: Outputs) -> None:
        if outputs.command is not None:
            self._commands.put(codec.encode_command(outputs.command, self._valid_ns, CHANNEL, self._state.input_number))

    def _publish(self, outputs: Outputs) -> None:
        """Publish the step and the events; publish the state if more changed than with every frame."""
        if outputs.step is not None:
            self._steps.put(codec.encode_step(outputs.step, self._state.input_number))
            self._last_second.add(outputs.step, self._service.clock.host_ns())
            if self._state.loop is not None and self._state.loop.calibration.noll:
                self._offload.add(outputs.step, self._state.loop.calibration.noll)
        for event in outputs.events:
            self._service.event(event.name, **event.details)
        if outputs.changed:
            now_ns = self._service.clock.now_ns()
            self._not_closed.note(self._state, now_ns, self._last_frame_ns)
            self._publish_state(now_ns)

    def _publish_state(self, time_ns: int) -> None:
        message = controller_state(self._state, self._settings, time_ns)
        self._states.put(message.SerializeToString())
        self._state_due_ns = self._service.clock.now_ns() + STATE_PERIOD_NS

    def _queue_query(self, query: Query) -> None:
        """Queue a request for the main thread and wake it; runs on the bus's thread."""
        self._queries.append(query)
        self._camera.mailbox.wake()
