"""Controller and mirror on a bus in memory, with a camera that exposes on request."""

import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.files import factory, law_file
from lowfc.adapters.process.clock import SIMULATED_START_NS, HostClock, SimulatedClock
from lowfc.adapters.process.latch import Latch
from lowfc.adapters.process.service import Service
from lowfc.arrays import Pixels
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.codecs.law_codec import wire_law
from lowfc.contract.configuration import FIXED_GAINS, Configuration
from lowfc.contract.errors import CalibrationError
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    COMMAND,
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    HEALTH,
    LAW,
    MIRROR_STATE,
    PLAY,
    REQUEST,
    STEP,
    TIMING,
    Message,
    image,
    timestamp,
    wire,
)
from lowfc.contract.published import Published
from lowfc.control import cache_warmup
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import integrator
from lowfc.control.loop.inputs import Request
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import State
from lowfc.device.driver import CameraSettings, camera_state
from lowfc.programs.core.controller import Controller
from lowfc.testing.listener import Listener
from sim_camera.driver import scene as configured_scene
from sim_camera.scene import Scene, Wavefront
from tests.support.in_process_loop import PATIENCE_S, SMALL_MIRROR, ThreadedRun, configuration
from tests.support.loops import until
from tools.law_bench import calibrated

BRIGHT = {"disturbance.preset": "quiet", "star.magnitude": -2.0, "lockstep": True, "mirror.settling_us": 0.0}
configured = partial(configuration, FIXED_GAINS | SMALL_MIRROR | BRIGHT)
CHANGED_CAMERA = wire.CameraState(
    timestamp=timestamp(SIMULATED_START_NS), rows=5, columns=5, bias_dn=100, saturation_dn=65535
).SerializeToString()
CONFIG, CLOSED = configured(), configured(control__start_mode="closed")
GRID = CONFIG.mirror.rows, CONFIG.mirror.columns


class Rig(ThreadedRun):
    """A run in one process, and the messages that its controller and mirror published."""

    def __init__(self, config: Configuration, calibration: Calibration, scene: Scene) -> None:
        super().__init__("test", config, lambda: SimulatedClock() if config.lockstep else HostClock())
        self.calibration, self.scene = calibration, scene
        self.received: dict[str, list[Any]] = {}
        self.offset_nm = np.zeros(GRID, np.float32)
        self._index = 0
        self._newest = threading.Condition()
        self.operator = self.bus("operator")
        for topic in (STEP, COMMAND, MIRROR_STATE, EVENT, REQUEST, TIMING):
            self.operator.subscribe(topic, self._appender(topic.message, topic.key))
        camera = self.bus("camera")
        self.frames, self.settings = camera.publisher(FRAME), camera.publisher(CAMERA_STATE)
        state = camera_state(CameraSettings.configured(config, *scene.shape), SIMULATED_START_NS)
        self.settings.put(state.SerializeToString())
        self.latch = Path(tempfile.mkdtemp()) / "safe"
        self.start(calibration, "a test", self.latch)

    def _appender(self, kind: type[Message], key: str) -> Callable[[Sample], None]:
        def append(sample: Sample) -> None:
            with self._newest:
                self.received.setdefault(key, []).append(kind.FromString(sample.payload))
                self._newest.notify_all()

        return append

    def until(self, what: str, met: Callable[[], bool]) -> None:
        with self._newest:
            assert self._newest.wait_for(met, PATIENCE_S), f"{what} did not happen"

    def put(self, pixels: Pixels, publish_time_ns: int | None = None) -> int:
        """Publish a frame, and wait until the mirror has reported its state after the command of this frame."""
        time_ns = SIMULATED_START_NS + (self._index + 1) * self.config.period_ns
        self._index += 1
        payload = image(pixels, time_ns, "camera").SerializeToString()
        sequence = self.frames.put(payload, publish_time_ns).sequence
        key = MIRROR_STATE.key
        self.until(
            "the mirror's state", lambda: key in self.received and self.received[key][-1].frame_sequence == sequence
        )
        return sequence

    def expose(self, count: int) -> list[Wavefront]:
        """Expose and publish frames with the mirror's present shape plus the offset; return the true wavefronts."""
        truths = []
        for _ in range(count):
            states = self.received.get(MIRROR_STATE.key)
            shape = actuators(states[-1]) if states else None
            total_nm = self.offset_nm if shape is None else shape + self.offset_nm
            pixels = self.scene.expose(self._index, total_nm)
            self.put(pixels)
            truths.append(self.scene.truth(self._index - 1, total_nm).sampled)
        return truths

    def inject(self, modes_nm: npt.ArrayLike) -> None:
        """Add modes to the wavefront, as a second mirror in the same place would."""
        shape = self.calibration.modes_to_actuators @ np.asarray(modes_nm, np.float32)
        self.offset_nm = shape.reshape(GRID)

    def ask(self, name: str, *values: float) -> wire.Request:
        payload = wire.Request(values=values).SerializeToString()
        (answer,) = self.operator.get(f"lowfc/request/{name}", payload, PATIENCE_S)
        return wire.Request.FromString(answer.payload)

    def steps(self, count: int) -> list[wire.ControlStep]:
        self.until("the step", lambda: len(self.received[STEP.key]) >= self._index)
        return self.received[STEP.key][-count:]

    def events(self) -> list[str]:
        return [log.message.split()[0] for log in self.received.get(EVENT.key, [])]

    def stop(self) -> None:
        super().stop()
        assert not any(bus.faults.counts for bus in self.hub.buses)


def lone_controller(
    calibration: Calibration | None, latch: Latch, config: Configuration
) -> tuple[Listener, Service, Controller]:
    """A controller without camera and mirror."""
    listener = Listener(SimulatedClock() if config.lockstep else HostClock())
    service = listener.service("controller")
    return listener, service, Controller(config, service, calibration, "a test", latch)


def report_shape(listener: Listener, rows: int = GRID[0], columns: int = GRID[1]) -> None:
    """Publish the state of a flat mirror, as its process does."""
    state = wire.MirrorState(rows=rows, columns=columns, actuators=bytes(4 * rows * columns))
    listener.service("mirror-dm").publisher(MIRROR_STATE, "dm").put(state.SerializeToString())


def mode_of(controller: Controller) -> LoopMode:
    health = wire.Health()
    controller.fill(health)
    return LoopMode(health.mode)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(CONFIG)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return configured_scene(CONFIG)


@contextmanager
def running(config: Configuration, calibration: Calibration, scene: Scene) -> Iterator[Rig]:
    rig = Rig(config, calibration, scene)
    try:
        if not config.lockstep:
            rig.until("the mirror's first state", lambda: MIRROR_STATE.key in rig.received)
        yield rig
    finally:
        rig.stop()


@pytest.fixture
def rig(calibration: Calibration, scene: Scene) -> Iterator[Rig]:
    with running(CONFIG, calibration, scene) as started:
        yield started


def test_closing_the_loop_corrects_every_mode(rig: Rig) -> None:
    injected = 12.0 * np.array([1, -1] * 7)
    rig.inject(injected)
    before = rig.expose(3)[0].residual_rms_nm
    assert rig.ask("gain", 0.25).accepted
    assert rig.ask("close").accepted
    assert rig.expose(120)[-1].residual_rms_nm < 0.2 * before, "the true wavefront is corrected"
    last = rig.steps(20)
    assert all(step.mode == wire.LOOP_MODE_CLOSED for step in last)
    command = np.array([step.command_nm for step in last], float)
    error = np.array([step.error_nm for step in last], float)
    # Noise through an integrator of gain 0.25 is correlated over some 7 frames.
    allowed = 4 * error.std(axis=0) / np.sqrt(20) * 2 + 0.03 * 12
    assert (np.abs(command.mean(axis=0) + injected) < allowed).all()
    assert (np.abs(error.mean(axis=0)) < allowed).all()
    pol = np.array([step.pol_nm for step in last], float).mean(axis=0)
    assert (np.abs(pol - injected) < allowed).all()


def not_closed_ns(rig: Rig) -> int:
    health = wire.Health()
    with rig.controller._lock:  # not in the middle of a step
        rig.controller.fill(health)
    return health.not_closed_ns


def test_the_time_with_the_loop_not_closed_is_counted_from_the_first_frame(rig: Rig) -> None:
    rig.expose(20)
    rig.steps(1)
    assert not_closed_ns(rig) == 19 * CONFIG.period_ns


def test_the_time_with_the_loop_not_closed_ends_with_the_newest_frame(calibration: Calibration, scene: Scene) -> None:
    with running(configured(lockstep=False), calibration, scene) as rig:
        rig.expose(2)
        before_ns = not_closed_ns(rig)
        rig.until("NO_FRAMES", lambda: "NO_FRAMES" in rig.events())
        assert not_closed_ns(rig) == before_ns > 0


def test_a_reply_names_the_first_frame_that_the_request_affects(rig: Rig) -> None:
    rig.expose(5)
    newest = rig.steps(1)[0].frame_sequence
    answer = rig.ask("close")
    assert (answer.accepted, answer.reply, answer.frame_sequence) == (True, "loop closed", newest + 1)
    rig.expose(1)
    step = rig.steps(1)[0]
    assert (step.frame_sequence, step.mode) == (answer.frame_sequence, wire.LOOP_MODE_CLOSED)
    refused = rig.ask("gain", 9.0)
    assert not refused.accepted
    assert "unstable" in refused.reply
    status = rig.ask("status")
    assert status.state.mode == wire.LOOP_MODE_CLOSED
    assert status.state.frame_sequence == newest + 1
    assert not rig.ask("dance").accepted
    (bad,) = rig.operator.get("lowfc/request/gain", b"\xff\xff", PATIENCE_S)
    assert "could not be read" in wire.Request.FromString(bad.payload).reply
    rig.until("five published requests", lambda: len(rig.received.get(REQUEST.key, [])) == 5)
    published = [(request.name, request.accepted) for request in rig.received[REQUEST.key]]
    assert published == [("close", True), ("gain", False), ("status", True), ("dance", False), ("gain", False)]


def test_safe_mode_flattens_the_mirror_and_is_latched(rig: Rig) -> None:
    rig.inject(10.0 * np.ones(14))
    rig.ask("close")
    rig.expose(10)
    assert actuators(rig.received[MIRROR_STATE.key][-1]).any()
    assert rig.ask("safe").accepted
    assert not rig.ask("close").accepted
    rig.expose(5)
    assert not actuators(rig.received[MIRROR_STATE.key][-1]).any()
    assert rig.steps(1)[0].mode == wire.LOOP_MODE_SAFE
    until(rig.latch.exists)
    assert rig.ask("clear").accepted
    rig.expose(1)
    until(lambda: not rig.latch.exists())
    assert rig.steps(1)[0].mode == wire.LOOP_MODE_OPEN
    assert {"SAFED", "MODE_CHANGED"} <= set(rig.events())


def test_a_change_of_the_cameras_settings_opens_the_loop(rig: Rig) -> None:
    rig.expose(1)
    rig.ask("close")
    rig.settings.put(CHANGED_CAMERA)
    rig.until("CAMERA_CHANGED", lambda: "CAMERA_CHANGED" in rig.events())
    rig.expose(1)
    assert rig.steps(1)[0].mode == wire.LOOP_MODE_OPEN


def test_frames_with_wrong_times_do_not_stop_the_controller(calibration: Calibration, scene: Scene) -> None:
    """A frame of 1970 counts as late, and a frame from the future is used.

    Durations are clipped, and without frames the command is repeated.
    """
    with running(configured(lockstep=False), calibration, scene) as rig:
        pixels = scene.expose(0, rig.offset_nm)
        rig.put(pixels, publish_time_ns=1)
        rig.put(pixels, publish_time_ns=2**62)
        rig.put(pixels)
        reasons = [list(step.reasons) for step in rig.steps(3)]
        assert reasons[0] == [wire.REASON_LATE]
        assert reasons[1] == []
        sent = len(rig.received[COMMAND.key])
        rig.until("a repeated command", lambda: len(rig.received[COMMAND.key]) > sent + 3)
        rig.until("NO_FRAMES", lambda: "NO_FRAMES" in rig.events())
    assert max(rig.received[TIMING.key][0].transport_ns) == 2**32 - 1


def test_a_loop_whose_latch_cannot_be_written_starts_open(calibration: Calibration, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    warnings: list[str] = []
    _, service, controller = lone_controller(calibration, Latch([tmp_path / "file" / "safe"], warnings.append), CLOSED)
    assert service.awaited() == "a camera"
    assert service.state == "starting", (
        "not ready before a camera reports: opening it may outlast the watchdog's timeout"
    )
    assert (mode_of(controller), len(warnings)) == (LoopMode.OPEN, 1)


def test_a_signal_makes_the_loop_safe(rig: Rig) -> None:
    rig.ask("close")
    rig.expose(1)
    rig.controller.safe_by_signal()
    rig.until("SAFED", lambda: "SAFED" in rig.events())
    rig.until("the request in the log", lambda: rig.received[REQUEST.key][-1].text == "SIGUSR1")
    logged = rig.received[REQUEST.key][-1]
    assert (logged.name, logged.accepted, logged.requester) == ("safe", True, "a signal")
    rig.expose(3)
    assert not actuators(rig.received[MIRROR_STATE.key][-1]).any()
    assert rig.received[COMMAND.key][-1].safe
    assert rig.received[MIRROR_STATE.key][-1].safe
    until(rig.latch.exists)


def test_oversized_requests_are_refused_before_decoding(rig: Rig) -> None:
    """The replies are short: they do not repeat the requests."""
    for name in ("step", "gain", "note", "channel", "dance"):
        values = wire.Request(modes=range(200_000), values=[1.0] * 200_000, text="x" * 100).SerializeToString()
        (answer,) = rig.operator.get(f"lowfc/request/{name}", values, PATIENCE_S)
        reply = wire.Request.FromString(answer.payload)
        assert not reply.accepted
        assert "holds at most" in reply.reply
        assert len(answer.payload) < 2000
    (answer,) = rig.operator.get("lowfc/request/" + "x" * 5000, b"", PATIENCE_S)
    assert len(wire.Request.FromString(answer.payload).reply) <= 1000


def test_states_refer_to_law_and_probe_sequence_by_identity(rig: Rig) -> None:
    """The arrays of law and probe sequence are separate messages, which can be queried."""
    rig.expose(1)
    settings = factory.settings(rig.config)
    noll = rig.calibration.noll
    present = settings.integrator(noll)
    law = integrator(present.gain, present.leak, noll, settings.delay_frames, rig.config.camera.rate_hz)
    table = np.zeros((50_000, 14), np.float32)
    play = wire.Request(text="offset", table=table.tobytes(), columns=14)
    for name, request in (("law", wire.Request(law=wire_law(law))), ("play", play)):
        (answer,) = rig.operator.get(f"lowfc/request/{name}", request.SerializeToString(), PATIENCE_S)
        assert wire.Request.FromString(answer.payload).accepted
    (answer,) = rig.operator.get(CONTROLLER_STATE.key)
    state = wire.ControllerState.FromString(answer.payload)
    assert (state.law.id, state.law.transition, state.play.table, state.play.frames) == (law.id, b"", b"", 50_000)
    assert len(answer.payload) < 20_000
    logged = rig.received[REQUEST.key][-1]
    assert (logged.play_id, logged.table) == (state.play.id, b"")
    published = Published()
    for topic in (CALIBRATION, LAW, PLAY):
        (answer,) = rig.bus("recorder").get(topic.key)
        published.store(topic, answer.payload)
    assert list(published.calibrations) == [rig.calibration.id] == [state.calibration_id]
    assert list(published.laws) == [law.id]
    assert published.plays[state.play.id].rows.shape == (50_000, 14)


def test_safe_mode_outlives_the_controller(calibration: Calibration, tmp_path: Path) -> None:
    """The latch is a file; it also acts on a controller without a calibration, once an operator loads one."""
    file = tmp_path / "safe"

    def mode(at_start: Calibration | None = calibration) -> LoopMode:
        latch = Latch([file])
        controller = lone_controller(at_start, latch, CLOSED)[2]
        controller._update_latch()
        latch.close()  # otherwise it would write the file again
        if at_start is None:
            controller._carry_out_internal(Request(SIMULATED_START_NS, "load", calibration=calibration))
        return mode_of(controller)

    assert mode() is LoopMode.CLOSED
    file.touch()
    assert mode(None) is LoopMode.SAFE
    assert mode() is LoopMode.SAFE
    file.unlink()
    assert mode() is LoopMode.CLOSED


def test_a_mirror_with_another_grid_than_the_calibration_is_refused(calibration: Calibration, tmp_path: Path) -> None:
    listener, _, controller = lone_controller(calibration, Latch([tmp_path / "safe"]), configured(lockstep=False))
    report_shape(listener, 20, 20)
    with pytest.raises(CalibrationError, match="20, 20"):
        controller.run()


def test_start_requests_wait_for_the_mirror_and_the_cameras_settings(calibration: Calibration, tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.ones(GRID, np.float32))
    flat = configured(lockstep=False, mirror__flat=str(tmp_path / "flat.npy"))
    for at_start in (None, calibration):
        listener, _, controller = lone_controller(at_start, Latch([tmp_path / "safe"]), flat)
        controller._report_mirror()
        controller._send_start_requests()
        assert controller._start_pending
        report_shape(listener)
        controller._report_mirror()
        for awaited in (True, False):
            conditions = controller._state.conditions._replace(camera_awaited=awaited)
            controller._state = controller._state._replace(conditions=conditions)
            controller._between_frames(None)
            assert controller._start_pending is awaited
        assert [channel.name for channel in controller._state.loop.command_channels.channels] == ["flat"]


def test_without_a_calibration_the_configured_law_is_not_in_force(tmp_path: Path) -> None:
    """The controller continues, so that a bench can be commissioned again with its configuration."""
    noll = CONFIG.noll
    law_file.save(integrator([0.3] * len(noll), [0.0] * len(noll), noll, 1.0, CONFIG.camera.rate_hz), tmp_path / "law")
    config = configured(lockstep=False, control__law=str(tmp_path / "law"))
    listener, _, controller = lone_controller(None, Latch([tmp_path / "safe"]), config)
    report_shape(listener)
    controller._report_mirror()
    controller._between_frames(None)
    until(lambda: "LAW_NOT_IN_FORCE" in listener.events())


def test_start_requests_refused_because_clients_changed_the_loop_do_not_end_the_controller(
    calibration: Calibration, tmp_path: Path
) -> None:
    shape, noll = np.full(GRID, 500, np.float32), (2, 3)
    np.save(tmp_path / "flat.npy", shape)
    law_file.save(integrator([0.3] * 2, [0.0] * 2, noll, 1.0, CONFIG.camera.rate_hz), tmp_path / "law")
    config = configured(lockstep=False, mirror__flat=str(tmp_path / "flat.npy"), control__law=str(tmp_path / "law"))
    listener, _, controller = lone_controller(calibration, Latch([tmp_path / "safe"]), config)
    controller._mirror_adopted = True  # as in `run` if the mirror has not reported within `MIRROR_PATIENCE_S`
    controller._carry_out_internal(Request(0, "channel", text="dig", actuators_nm=shape.reshape(-1)))
    controller._send_start_requests()
    until(lambda: {"LAW_NOT_IN_FORCE", "FLAT_NOT_IN_FORCE"} <= set(listener.events()))


def test_an_automatic_gain_request_with_the_time_of_a_frame_ends_no_lease(
    calibration: Calibration, tmp_path: Path
) -> None:
    _, _, controller = lone_controller(calibration, Latch([tmp_path / "safe"]), configured(lockstep=False))
    assert controller._carry_out_internal(Request(0, "lease", (), (5.0,), "somebody", lease_id=1)).accepted
    reply = controller._carry_out_internal(Request(2**62, "gain", (), (0.1,), "auto"))  # its time is a frame's
    assert (reply.accepted, "the loop is reserved for somebody" in reply.text) == (False, True)


def test_a_mirror_fault_counts_from_the_second_faulty_health_and_is_replaced_after_two_equal_ones(
    calibration: Calibration, tmp_path: Path
) -> None:
    """A mirror that has just recovered reports once that it has no command. An unknown reason is a fault, too."""
    listener, _, controller = lone_controller(calibration, Latch([tmp_path / "safe"]), configured(lockstep=False))
    report_shape(listener)
    assert controller._mirror.first() is not None
    mirror_health = listener.bus.publisher(HEALTH, "mirror-dm")
    expired, refused = wire.Health(command_expired=True), wire.Health(command_refused=99)  # type: ignore[arg-type]
    for health, fault in (
        (refused, ""),
        (expired, "gets no commands"),
        (refused, "gets no commands"),
        (refused, "refuses commands: 99"),
        (expired, "refuses commands: 99"),
        (wire.Health(), ""),
    ):
        mirror_health.put(health.SerializeToString())
        assert controller._mirror.fault(State(commanded=True)) == fault


def test_a_warm_up_changes_no_state_publishes_nothing_and_loses_no_settings(
    calibration: Calibration, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    unchanged: list[bool] = []  # for each warm-up
    original = Controller._warm_up

    monkeypatch.setattr(cache_warmup, "LEAD_NS", 30_000_000)  # a host that runs other tests is sometimes late
    with running(configured(lockstep=False, camera__rate_hz=20.0), calibration, scene) as rig:

        def counts() -> list[int]:
            return [len(rig.received.get(topic.key, ())) for topic in (STEP, COMMAND, TIMING)]

        def checked_warm_up(self: Controller) -> None:
            before, counts_before = self._state, counts()
            original(self)
            unchanged.append(self._state is before and counts() == counts_before)

        monkeypatch.setattr(Controller, "_warm_up", checked_warm_up)
        for index in range(5):
            pixels = scene.expose(index, rig.offset_nm)
            rig.put(pixels)
            time.sleep(0.1)  # two periods
        assert [list(step.reasons) for step in rig.steps(5)] == [[]] * 5
        monkeypatch.setattr(rig.controller._warmup, "due", lambda now_ns: True)
        rig.settings.put(CHANGED_CAMERA)
        rig.until("CAMERA_CHANGED", lambda: "CAMERA_CHANGED" in rig.events())
    assert len(unchanged) >= 3
    assert all(unchanged)


def test_an_exception_in_frame_processing_ends_the_controller(
    calibration: Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the bus's thread only counted the exception, the loop would stop silently."""
    monkeypatch.setattr("lowfc.programs.core.controller.MIRROR_PATIENCE_S", 0.01)
    listener, _, controller = lone_controller(calibration, Latch([tmp_path / "safe"]), configured(lockstep=False))
    monkeypatch.setattr(controller, "_control_step", Mock(side_effect=ArithmeticError("one and one is three")))
    frames = listener.service("camera").publisher(FRAME)
    late = threading.Timer(0.2, frames.put, [b""])
    late.start()
    with pytest.raises(ArithmeticError, match="three"):
        controller.run()
    late.join()


def test_only_the_newest_of_the_queued_frames_is_integrated(calibration: Calibration, scene: Scene) -> None:
    """All ten saw the same mirror shape, so that the command may change by gain times error once, not ten times."""
    # 5 Hz, so that a stall of this host is shorter than a period.
    config = configured(lockstep=False, camera__rate_hz=5.0, control__start_mode="closed")
    with running(config, calibration, scene) as rig:
        rig.inject(2.0 * np.eye(14)[3])
        pixels = scene.expose(0, rig.offset_nm)
        payload = image(pixels, 1, "camera").SerializeToString()
        dispatch = next(arrival for arrival in rig.services[0].arrivals if arrival.key == FRAME.key)
        until(lambda: rig.controller._mirror_adopted)
        now_ns = HostClock().now_ns()
        newest = rig.settings.last[1].sequence + 100
        for age in range(9, -1, -1):  # periods; all arrive at once, as after a pause of the controller
            dispatch.put(Sample(FRAME.key, payload, newest - age, now_ns - age * config.period_ns, now_ns))
        steps = rig.received[STEP.key][-10:]
    used = [step for step in steps if not step.reasons]
    assert len(steps) == 10
    assert used == steps[-1:]
    assert all(list(step.reasons) == [wire.REASON_LATE] for step in steps[:-1])
    assert abs(used[0].error_nm[3]) > 1
    assert used[0].command_nm[3] == pytest.approx(-config.control.gain * used[0].error_nm[3], rel=1e-3)


NOT_FINITE = np.full(GRID, np.nan, np.float32).tobytes()


@pytest.mark.parametrize("actuators", [b"", NOT_FINITE])
def test_refused_commands_do_not_reset_the_command_timeout(
    calibration: Calibration, scene: Scene, actuators: bytes
) -> None:
    with running(configured(lockstep=False, control__command_timeout_ms=50.0), calibration, scene) as rig:
        rig.put(scene.expose(0, rig.offset_nm))
        rig.services[0].stop("the controller has died")
        rig.threads[0].join(PATIENCE_S)
        another_publisher = rig.bus("other").publisher(COMMAND, "dm")
        refused_command = wire.MirrorCommand(
            rows=GRID[0], columns=GRID[1], actuators=actuators, frame_sequence=2**63, valid_for_ns=10**9
        ).SerializeToString()
        until(lambda: "COMMAND_EXPIRED" in rig.events(), each=lambda: another_publisher.put(refused_command))
