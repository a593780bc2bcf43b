"""The controller's process: `advance` folded over what the bus brings; the command first, then all the rest."""

import contextlib
import threading
from collections import deque
from contextlib import AbstractContextManager
from functools import partial

from lowfc.adapters.bus.bus import ALL, Query, Sample
from lowfc.adapters.bus.start_check import StartCheck
from lowfc.adapters.files.factory import contrast_of
from lowfc.adapters.process.clock import SimulatedClock
from lowfc.adapters.process.latch import Latch
from lowfc.adapters.process.realtime import let_send
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
    SEQUENCES,
    STEP,
    TIMING,
    wire,
)
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.durations import Durations
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Input, Load, MirrorReport, Outputs, Reply, Report, Request, Tick
from lowfc.control.loop.loading import holding, misfit
from lowfc.control.loop.requests import CONFIGURATION, MOST_REPLY, prepared
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import State
from lowfc.programs.core.bench_values import BenchValues
from lowfc.programs.core.cache_warmup import CacheWarmup
from lowfc.programs.core.camera_signs import CameraSigns
from lowfc.programs.core.controller_report import (
    Arrays,
    LastSecond,
    NotClosed,
    Offload,
    StageTiming,
    fill_worth,
)
from lowfc.programs.core.gain_watch import GainWatch
from lowfc.programs.core.mirror_signs import MirrorSigns
from lowfc.programs.core.start_up import StartUp, settings_under

TICK_NS = 10_000_000
"""Without frames the held command is repeated this often."""
MIRROR_PATIENCE_S = 1.0
"""How long the start waits to learn where the mirror is."""
STATE_PERIOD_NS = 1_000_000_000
CHANNEL = "lowfc"


class Controller:
    """Receives frames, sends commands, answers operators, until stopped."""

    def __init__(
        self, config: Configuration, service: Service, calibration: Calibration | None, source: str, latch: Latch
    ) -> None:
        """Declare everything on the bus and load the calibration; without one, the loop is idle."""
        name = config.mirror.name
        self._service = service
        self._latch = latch
        self._settings = settings_under(latch, config, service.event)
        self._configuration = config.to_toml()
        self._start_up = StartUp(config)
        self._gain_watch = GainWatch(self._settings, config.control.on_harm, contrast_of(config).form)
        self._measured: deque[Request] = deque()
        self._kept_safe = latch.safe
        self._safe_signalled = False
        self._start_check = StartCheck(
            service.clock,
            config.control.max_start_ahead_h,
            lambda start, here: service.event("START_AHEAD", what="frames", start=start, here=here),
        )
        warms_up = config.realtime.cache_warmup and not config.lockstep
        self._warmup = CacheWarmup(config.period_ns) if warms_up else None
        self._last: Sample | None = None
        self._valid_ns = round(config.control.command_timeout_ms * 1e6)
        self._state = State()
        self._turn = threading.Lock()
        self._adopted = False
        self._early: Sample | None = None
        self._leave_camera = service.dispatch(
            FRAME, self._arrived, period_ns=config.period_ns, superseded=partial(self._arrived, superseded=True)
        )
        self._mirror = MirrorSigns(service, name)
        self._camera = CameraSigns(service, self._take)
        self._bench = BenchValues(service, self._settings.interlocks, self._take)
        self._commands = service.publisher(COMMAND, name)
        self._steps = service.publisher(STEP)
        self._inputs = service.publisher(CONTROL_INPUT)
        self._states = service.publisher(CONTROLLER_STATE)
        self._requests = service.publisher(REQUEST)
        self._timing = StageTiming(service.publisher(TIMING))
        self._arrays = Arrays(*(service.publisher(topic) for topic in (CALIBRATION, LAW, PLAY)))
        self._offload = Offload(service.publisher(OFFLOAD), round(1e9 / float(OFFLOAD.rate) / config.period_ns))
        self._not_closed = NotClosed()
        self._last_second = LastSecond(config.period_ns)
        self._queries: deque[Query] = deque()
        service.bus.queryable(REQUEST_KEY.format(name=ALL), self._ask)
        self._frame_to_command = Durations()
        self._state_due_ns = 0
        self._last_frame_ns = service.clock.host_ns()
        now_ns = service.clock.now_ns()
        if calibration is not None:
            self._arrays.publish(Request(now_ns, "load", calibration=calibration))
            self._take(Load(now_ns, calibration, source))
        service.awaited = lambda: "" if self._state.frame_sequence else "a camera"
        service.state = "ready"

    def run(self) -> None:
        """Do all but the frames: those are dealt with where they arrive, one turn each."""
        self._camera.await_first()
        self._adopt_mirror()
        self._bench.ask()
        self._service.state = "running"
        with self._turn:
            self._begin()
            self._adopted = True
            if self._early is not None:
                self._frame(self._early)
        while self._service.running:
            rest_ns = None if self._warmup is None else self._warmup.rest_ns(self._service.clock.host_ns())
            camera = self._camera.wait(min(TICK_NS if rest_ns is None else rest_ns, TICK_NS) * 1e-9)
            if self._warmup is not None and self._warmup.begins(self._service.clock.host_ns()):
                self._warm_up()
                continue  # the rest can wait until the frame has come
            with self._turn:
                self._between_frames(camera)
            if self._safe_signalled:
                self._safe_signalled = False
                now_ns = self._service.clock.now_ns()
                self._enter(Request(now_ns, "safe", text="SIGUSR1", requester="a signal"))
            for _ in range(len(self._queries)):
                self._answer(self._queries.popleft())
            while self._measured:
                self._enter(self._measured.popleft())
            self._keep_safe()
            for sample in self._camera.asked() if self._state.conditions.camera_awaited else ():
                with self._turn:
                    self._camera.take(sample)
            self._service.beat()
        self._leave_camera()
        with self._turn:
            self._timing.publish(self._service.clock.host_ns())
        self._latch.close()
        self._service.finish()

    def fill(self, health: wire.Health) -> None:
        """Add mode, counts and latency to a Health."""
        health.mode = self._state.mode.value  # type: ignore[assignment]  # numbered alike
        health.counts.extend(reason_counts(self._state))
        now_ns = self._service.clock.now_ns()
        health.not_closed_ns, health.not_closed_cause = self._not_closed.note(self._state, now_ns)
        if self._state.mode is LoopMode.CLOSED:
            health.holding = holding(self._state)
        fill_worth(health, self._gain_watch, self._state)
        health.last_second.CopyFrom(self._last_second.figures(self._state, self._service.clock.host_ns()))
        if self._frame_to_command.count:
            health.frame_to_command.CopyFrom(codec.latency(self._frame_to_command))

    def _arrived(self, sample: Sample, *, superseded: bool = False) -> None:
        """On the thread that receives: a frame; the newest one waits until it is known where the mirror is."""
        with self._turn:
            if not self._adopted:
                self._early = sample
            elif self._service.running:
                self._frame(sample, superseded)

    def _frame(self, sample: Sample, superseded: bool = False) -> None:
        """One step: the command goes out before anything else is encoded.

        A frame that was superseded is late, whatever its age, and the command is held: frames exposed under one mirror
        shape must not all be integrated.
        """
        clock, newest = self._service.clock, self._state.frame_sequence
        taken_ns = clock.host_ns()
        age_ns = 0 if clock.lockstep else taken_ns - sample.publish_time_ns
        if superseded:
            age_ns = max(age_ns, self._settings.max_frame_age_ns + 1)
        try:
            ahead = self._start_check.ahead(sample.sequence)
            frame = codec.decode_frame(sample.payload, sample.sequence, age_ns, ahead=ahead)
        except BadMessageError as fault:
            self._service.unreadable(sample.key, fault)
            return
        self._bench.look()
        if isinstance(clock, SimulatedClock):
            clock.set_ns(frame.time_ns)
        outputs = self._advance(frame)
        ready_ns = clock.host_ns()
        self._send(outputs)
        sent_ns = self._commands.handed_ns if outputs.command is not None else clock.host_ns()
        let_send()
        self._publish(outputs)
        self._watch_gains(outputs)
        if self._state.frame_sequence != newest:  # an old one is no sign of a live camera
            self._last_frame_ns = taken_ns
        self._service.work += 1
        self._frame_to_command.add(sent_ns - sample.publish_time_ns)
        moments_ns = sample.receive_time_ns, taken_ns, ready_ns, sent_ns
        self._timing.add(sample.sequence, sample.publish_time_ns, moments_ns)
        if clock.now_ns() >= self._state_due_ns:  # not by the frame's time: a camera's clock may be another
            self._publish_state(frame.time_ns)
        if self._warmup is not None:
            self._last = sample
            self._warmup.came(sample.receive_time_ns)
            self._camera.wake()  # the warm-up does what else is to be done now, and then knows when to

    def _warm_up(self) -> None:
        """Do the last step once more, and forget what came of it: code and data are in the caches for the next frame.

        What happens between two frames pushes them out.
        """
        with self._turn:
            if self._last is None or self._state.frame_sequence + 1 >= SEQUENCES:
                return
            frame = codec.decode_frame(self._last.payload, self._state.frame_sequence + 1, 0)
            _, outputs = advance(self._settings, self._state, frame)
            if outputs.command is not None:
                codec.encode_command(outputs.command, self._valid_ns, CHANNEL, self._state.input_number)

    def _between_frames(self, camera: Sample | None) -> None:
        """Apply what the camera says of itself; without frames, hold."""
        if camera is not None:
            self._camera.take(camera)
        if not self._service.clock.lockstep:
            self._bench.look()
            if self._mirror.due:
                self._judge_mirror()
        silent_ns = self._service.clock.host_ns() - self._last_frame_ns
        if silent_ns >= TICK_NS and not self._service.clock.lockstep:
            self._take(Tick(self._service.clock.now_ns(), silent_ns))

    def _answer(self, query: Query) -> None:
        """Apply what an operator asked between two frames; they do not wait while it is decoded, nor for its answer."""
        now_ns = self._service.clock.now_ns()
        try:
            if query.name == "safe":  # whatever came along with it
                query.payload = codec.only_requester(query.payload)
            request = prepared(self._settings, codec.decode_request(query.payload, query.name, now_ns))
        except ValueError as error:
            request = Request(now_ns, query.name)
            reply, state, taken = Reply(False, str(error)[:MOST_REPLY], self._state.frame_sequence + 1), self._state, 0
        else:
            reply, state, taken = self._carry_out(request)
        shown = controller_state(state, self._settings, now_ns) if request.name == "status" else None
        short = Request(request.time_ns, request.name, request.modes, request.values, request.text)
        query.reply(codec.encode_request(short, reply, taken, shown))  # who asked has the arrays
        self._requests.put(codec.encode_request(request, reply, taken, shown))

    def _carry_out(
        self, request: Request, turn: AbstractContextManager[object] | None = None
    ) -> tuple[Reply, State, int]:
        """The reply, the state after it, and its number; 0 for one that is no input of the control law."""
        if request.name == CONFIGURATION:
            return Reply(True, self._configuration, self._state.frame_sequence + 1), self._state, 0
        self._arrays.publish(request)
        with self._turn if turn is None else turn:
            outputs = self._advance(request)
            state = self._state
            self._publish(outputs)
        reply = outputs.reply
        assert reply is not None  # noqa: S101  # every request has an answer
        if not reply.accepted:
            self._arrays.publish_in_use(request, state)
        return reply, state, state.input_number

    def _watch_gains(self, outputs: Outputs) -> None:
        """After the command: what the loop is worth; in lockstep what follows is entered before the next frame."""
        if outputs.step is None:
            return
        found = self._gain_watch.follow(outputs.step, self._state)
        for event in found.events:
            self._service.event(event.name, **event.details)
        for request in found.requests:
            if self._service.clock.lockstep:
                self._enter(request, turn=contextlib.nullcontext())
            else:
                self._measured.append(request)
                self._camera.wake()

    def _enter(self, request: Request, turn: AbstractContextManager[object] | None = None) -> None:
        """Carry out what no operator asked, and publish it as what they ask."""
        reply, _, taken = self._carry_out(prepared(self._settings, request), turn)
        self._requests.put(codec.encode_request(request, reply, taken, None))

    def safe_by_signal(self) -> None:
        """Make the loop safe as soon as the main thread gets there; to be called from a signal."""
        self._safe_signalled = True
        self._camera.wake()

    def _keep_safe(self) -> None:
        """Let the latch follow the loop mode: after the answer, and by a thread of its own."""
        safe = self._state.mode is LoopMode.SAFE
        if safe is not self._kept_safe:
            self._kept_safe = safe
            self._latch.set(safe)

    def _adopt_mirror(self) -> None:
        """Learn where the mirror is before the first command, so that it does not jump."""
        lockstep = self._service.clock.lockstep
        if lockstep and self._state.drive is not None:  # every lockstep run starts from flat
            self._mirror.close()
            return
        shape = self._mirror.first(MIRROR_PATIENCE_S)
        if shape is not None:
            drive, grid = self._state.drive, shape.actuators_nm.shape
            if drive is not None and grid != drive.calibration.grid:
                raise CalibrationError(
                    f"the mirror has {grid} actuators, the calibration is for {drive.calibration.grid}; use the "
                    "mirror's own calibration"
                )
            self._take(shape)
        if lockstep:
            self._mirror.close()
        elif self._service.running:
            self._judge_mirror()

    def _judge_mirror(self) -> None:
        """Take in whether the mirror follows, while it does not or where that has changed."""
        late = self._mirror.first()
        if late is not None:  # before the first command, it is where the loop starts from
            self._take(late)
        fault = self._mirror.fault(self._state)
        if fault or self._state.conditions.mirror_fault:
            self._take(MirrorReport(self._service.clock.now_ns(), fault, self._mirror.last()))

    def _begin(self) -> None:
        """Ask for what the configuration puts on the mirror, and for its law, as an operator would."""
        for request in self._start_up.requests(self._state, self._service.clock.now_ns()):
            request = prepared(self._settings, request)
            self._arrays.publish(request)
            outputs = self._advance(request)
            assert outputs.reply is not None  # noqa: S101  # every request has an answer
            self._requests.put(codec.encode_request(request, outputs.reply, self._state.input_number, None))
            self._publish(outputs)
            if not outputs.reply.accepted and request.name == "law" and misfit(self._state):
                self._service.event("LAW_NOT_IN_FORCE", why=outputs.reply.text)  # and the loop is open
                continue
            if not outputs.reply.accepted:
                self._start_up.refused(request, outputs.reply.text)
                break

    def _advance(self, taken: Input) -> Outputs:
        self._state, outputs = advance(self._settings, self._state, taken)
        return outputs

    def _take(self, taken: Report) -> None:
        """Advance by what is neither a frame nor a request, and log it where it made a difference."""
        before = self._state
        outputs = self._advance(taken)
        self._send(outputs)
        if self._state is not before:
            self._inputs.put(codec.encode_input(taken, self._state.input_number))
        self._publish(outputs)

    def _send(self, outputs: Outputs) -> None:
        if outputs.command is not None:
            self._commands.put(codec.encode_command(outputs.command, self._valid_ns, CHANNEL, self._state.input_number))

    def _publish(self, outputs: Outputs) -> None:
        """Publish the step and the events, and the state where more of it changed than the next frame shows."""
        if outputs.step is not None:
            self._steps.put(codec.encode_step(outputs.step, self._state.input_number))
            self._last_second.add(outputs.step, self._service.clock.host_ns())
            if self._state.drive is not None and self._state.drive.calibration.noll:
                self._offload.add(outputs.step, self._state.drive.calibration.noll)
        for event in outputs.events:
            self._service.event(event.name, **event.details)
        if outputs.changed:
            now_ns = self._service.clock.now_ns()
            self._not_closed.note(self._state, now_ns)
            self._publish_state(now_ns)

    def _publish_state(self, time_ns: int) -> None:
        message = controller_state(self._state, self._settings, time_ns)
        self._states.put(message.SerializeToString())
        self._state_due_ns = self._service.clock.now_ns() + STATE_PERIOD_NS

    def _ask(self, query: Query) -> None:
        """On the bus's thread: leave the request for the loop, and wake it."""
        self._queries.append(query)
        self._camera.wake()
