"""Drivers in their loops; those that fail, hang or return invalid data are reported, counted and retried."""

import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from threading import Timer
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import pytest

from lowfc.adapters.process.clock import SimulatedClock
from lowfc.contract.codecs.codec import decode_mirror
from lowfc.contract.configuration import load
from lowfc.contract.envelope import count_of, sequence_of, start_of
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import CAMERA_STATE, COMMAND, FRAME, HEALTH, MIRROR_STATE, wire
from lowfc.control.loop.safety import Limit, Rejection
from lowfc.device import CameraSettings, Exposure, MirrorExtras, Single, geometry
from lowfc.device.camera_loop import CameraLoop
from lowfc.device.driver import camera_state
from lowfc.device.mirror_loop import MirrorLoop
from lowfc.device.watch import DriverWatch
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener

CONFIG = load(None, {"mirror.rows": 4, "mirror.columns": 5})
SETTINGS = CameraSettings(3, 4, exposure_ns=2_000_000, period_ns=4_000_000, number_wrap=1 << 16)
GOOD = np.full((3, 4), 7, np.uint16)
MS_NS = 1_000_000


class UnprintableError(Exception):
    """Exception whose `__str__` returns no string."""

    def __str__(self) -> str:
        return 7


class Camera:
    """Camera whose exposures are returned by functions, in turn."""

    def __init__(self, clock: FakeClock, *exposures: Callable[[], Any], settings: CameraSettings = SETTINGS) -> None:
        self.clock, self.exposures, self.current = clock, iter(exposures), settings

    def settings(self) -> CameraSettings:
        return self.current

    def expose(self) -> Exposure | None:
        self.clock.advance(int(self.current.period_ns))
        return next(self.exposures)()

    def close(self) -> None: ...


def good(**fields: Any) -> Callable[[], Exposure]:
    """Function that returns a valid exposure, except for these fields."""
    return lambda: Exposure(**{"pixels": GOOD} | fields)


class CameraBench:
    """A camera in its loop, and a listener to its messages."""

    def __init__(self, *exposures: Callable[[], Any], frames: int = 1, settings: CameraSettings = SETTINGS) -> None:
        self.clock = FakeClock()
        self.listener = Listener(self.clock, FRAME, CAMERA_STATE, HEALTH)
        self.camera = Camera(self.clock, *exposures, settings=settings)
        self.loop = CameraLoop(self.camera, self.listener.service("camera"), frames)


def run_camera_loop(*exposures: Callable[[], Any], frames: int, settings: CameraSettings = SETTINGS) -> Listener:
    """Run a camera until it has published this number of frames."""
    bench = CameraBench(*exposures, frames=frames, settings=settings)
    bench.loop.run()
    assert len(bench.listener.messages(FRAME)) == frames
    return bench.listener


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (Mock(side_effect=OSError("the cable")), "OSError: the cable"),
        (Mock(side_effect=SystemExit("no licence")), "SystemExit: no licence"),
        (Mock(side_effect=UnprintableError), "UnprintableError: (its __str__ fails)"),
        (good(pixels=GOOD[1:]), "shape (2, 4)"),
        (good(pixels=np.full((3, 4), np.nan)), "float64"),
        (good(end_ns=1 << 62), "s ahead of the monotonic clock"),
        (good(end_ns=-(1 << 99)), "end_ns is -"),
        (good(end_ns=float("nan")), "NaN"),
        (good(lost=-1), "lost is -1"),
        (good(lost=1 << 32), "lost is 4294967296"),
        (lambda: "nothing", "expose() returned str"),
        (good(pixels=GOOD.tolist()), "pixels of Exposure are list"),
    ],
    ids=["raises", "exits", "text", "shape", "NaN", "future", "past", "NaN time", "loss", "huge loss", "str", "list"],
)
def test_camera_failures_are_reported_once_counted_and_retried(bad: Callable[[], Any], message: str) -> None:
    recovered = [good()] * 251  # more than 1 s at 250 Hz: then the driver counts as recovered
    listener = run_camera_loop(good(), bad, bad, bad, *recovered, frames=252)
    assert listener.events() == ["STARTED", "DRIVER_FAILED", "DRIVER_BACK", "STOPPED"]
    assert message in listener.event_texts("DRIVER_FAILED")[0]
    assert "after 3 failures" in listener.event_texts("DRIVER_BACK")[0]
    assert listener.messages(HEALTH)[-1].driver_failures == 3


def test_a_failing_camera_is_retried_after_increasing_pauses() -> None:
    bench = CameraBench(*[Mock(side_effect=OSError("the cable"))] * 9, good())
    begun_ns = bench.clock.now_ns()
    bench.loop.run()
    pauses_s = 0 + 0.1 + 0.2 + 0.5 + 1 + 2 + 4 + 4 + 4  # after each of nine failures
    assert bench.clock.now_ns() - begun_ns == pytest.approx(pauses_s * 1e9, abs=0.1e9)
    assert bench.listener.events().count("DRIVER_FAILED") == 2  # reported again after 10 s


def test_a_failing_camera_does_not_advance_simulated_time(tmp_path: Path) -> None:
    clock, camera = SimulatedClock(base=tmp_path), Camera(Mock(), *[Mock(side_effect=OSError)] * 2, good())
    begun_ns, service = clock.now_ns(), Listener(clock).service("camera")
    CameraLoop(camera, service, 1).run()
    assert (service.work, clock.now_ns()) == (1, begun_ns)


def test_a_configuration_error_of_a_driver_ends_the_process() -> None:
    with pytest.raises(ConfigurationError, match="another layout"):
        run_camera_loop(Mock(side_effect=ConfigurationError("another layout")), frames=1)


def test_a_hanging_camera_is_reported_while_it_hangs() -> None:
    reported: list[bool] = []

    def hang() -> Exposure:
        for _ in range(11):  # every 0.1 s: the first check notes the call, the tenth after it reaches 1 s, the timeout
            bench.loop.watch.check()
            reported.append("DRIVER_HANGS" in bench.listener.events())
        return Exposure(GOOD)

    bench = CameraBench(good(), hang, *[good()] * 260, frames=262)
    bench.loop.run()
    assert reported == [False] * 10 + [True]
    assert bench.listener.events() == ["STARTED", "DRIVER_HANGS", "DRIVER_BACK", "STOPPED"]
    assert bench.loop.watch.failures == 1


def test_a_close_that_hangs_is_reported() -> None:
    bench = CameraBench(good())

    def close() -> None:
        for _ in range(50):  # a driver must close within 5 s
            bench.loop.watch.check()
        assert bench.listener.events() == ["STARTED"]
        for _ in range(2):
            bench.loop.watch.check()

    bench.camera.close = close
    bench.loop.run()
    assert bench.listener.events() == ["STARTED", "DRIVER_HANGS", "STOPPED"]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"period_ns": 1e9 / 250}, "period_ns of the settings is 4000000.0, expected a whole number"),
        ({"number_wrap": 0}, "number_wrap of the settings is 0, expected a whole number of 1 or more"),
        ({"read_noise_e": float("nan")}, "read_noise_e of the settings is nan, expected a finite number"),
        ({"gain_e_per_dn": None}, "gain_e_per_dn of the settings is None, expected a finite number"),
        ({"clock": "Realtime"}, "clock of the settings is 'Realtime', expected monotonic, realtime, run"),
    ],
)
def test_the_error_on_an_impossible_setting_names_the_setting(setting: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        camera_state(replace(SETTINGS, **setting), 0)


def test_a_driver_whose_settings_are_of_another_type_is_refused() -> None:
    with pytest.raises(TypeError, match=r"settings\(\) returned dict, expected CameraSettings"):
        CameraBench(settings={"rows": 3})


def test_expose_may_return_none_and_settings_are_published_twice_a_second_meanwhile() -> None:
    bench = CameraBench(settings=replace(SETTINGS, period_ns=2000 * MS_NS))
    results = iter([None] * 200 + [Exposure(GOOD)])

    def wait() -> Exposure | None:
        bench.clock.advance(10 * MS_NS)
        return next(results)

    begun_ns, bench.camera.expose = bench.clock.now_ns(), wait
    bench.loop.run()
    times_ms = [(sample.publish_time_ns - begun_ns) // MS_NS for sample in bench.listener.samples[CAMERA_STATE]]
    assert times_ms == [0, 0, 500, 1000, 1500, 2000], "at the start, before the first exposure, twice a second"
    assert bench.listener.events() == ["STARTED", "STOPPED"]


def test_exposure_times_are_converted_from_the_clock_in_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """The host's monotonic clock is 5 s behind the run's clock, and its wall clock is 2 s behind the run's clock."""
    monkeypatch.setattr(FakeClock, "offset_ns", 5 * 10**9)
    monkeypatch.setattr(FakeClock, "ahead_ns", lambda self: 2 * 10**9)
    start_ns = FakeClock().now_ns()
    for clock, behind_ns in (("monotonic", 5 * 10**9), ("realtime", 2 * 10**9)):
        settings = CameraSettings(3, 4, 2 * MS_NS, 4 * MS_NS, clock=clock)
        listener = run_camera_loop(good(end_ns=start_ns + MS_NS - behind_ns), good(), frames=2, settings=settings)
        times = [frame.timestamp.ToNanoseconds() - start_ns for frame in listener.messages(FRAME)]
        assert times == [MS_NS, 8 * MS_NS], "the second frame is timed at its reception"


def numbered(*numbers: int | np.uint16) -> Listener:
    return run_camera_loop(*[good(number=number) for number in numbers], frames=len(numbers))


def counts(listener: Listener) -> list[int]:
    return [count_of(sample.sequence) for sample in listener.samples[FRAME]]


def test_frame_numbers_are_unwrapped_and_gaps_count_as_lost_frames() -> None:
    listener = numbered(65_533, np.uint16(65_534), np.uint16(1), 2, 5)
    assert counts(listener) == [0, 1, 4, 5, 8]
    assert len({start_of(sample.sequence) for sample in listener.samples[FRAME]}) == 1
    frames = next(count for count in listener.messages(HEALTH)[-1].topics if count.topic == FRAME.key)
    assert (frames.published, frames.missing) == (9, 4)
    assert listener.event_texts("FRAMES_LOST") == ["FRAMES_LOST 2 frames lost by the camera"] * 2, (
        "the second event is published at the end"
    )


@pytest.mark.parametrize("dtype", [np.uint32, np.uint64])
def test_whole_numbers_of_the_settings_may_be_numpy_integers(dtype: Any) -> None:
    settings = replace(SETTINGS, period_ns=dtype(SETTINGS.period_ns), number_wrap=dtype(SETTINGS.number_wrap))
    bench = CameraBench(*[good(number=number) for number in (65_535, 1, 30_000, 0)], settings=settings)
    assert None not in [bench.loop._next_frame() for _ in range(4)], bench.listener.event_texts("DRIVER_FAILED")
    assert camera_state(replace(SETTINGS, bit_depth=np.uint8(12)), 0).saturation_dn == 4095


def test_lost_frames_without_numbers_are_counted() -> None:
    assert counts(run_camera_loop(good(), good(lost=3), good(), frames=3)) == [0, 4, 5]


def test_frame_numbers_that_restart_begin_a_new_start_of_the_camera_even_twice_in_a_second() -> None:
    listener = numbered(30_000, 30_001, 0, 1, 0, 1)
    starts = [start_of(sample.sequence) for sample in listener.samples[FRAME]]
    assert np.diff(starts).tolist() == [0, 1, 0, 1, 0]
    assert counts(listener) == [0, 1, 0, 1, 0, 1]
    settings = {start_of(sample.sequence) for sample in listener.samples[CAMERA_STATE]}
    assert settings == set(starts), "the controller waits for the settings of each start"


def test_a_changed_region_is_published_before_its_first_frame() -> None:
    def cropped() -> Exposure:
        bench.camera.current = CameraSettings(2, 4, 2 * MS_NS, 4 * MS_NS)
        return Exposure(GOOD[1:])

    bench = CameraBench(good(), cropped, frames=2)
    bench.loop.run()
    assert [state.rows for state in bench.listener.messages(CAMERA_STATE)] == [3, 3, 2]
    assert bench.listener.events() == ["STARTED", "STOPPED"]


class Mirror:
    """Mirror whose next calls run the functions in `plan`; when `plan` is empty, it applies the command.

    `heights_nm` has the height of the highest actuator in each command.
    """

    def __init__(self) -> None:
        self.geometry = geometry(CONFIG)
        self.plan: list[Callable[[Single], Any]] = []
        self.heights_nm: list[float] = []

    def apply(self, actuators_nm: Single) -> Single | None:
        self.heights_nm.append(round(float(actuators_nm.max()), 1))
        return self.plan.pop(0)(actuators_nm) if self.plan else actuators_nm

    def close(self) -> None: ...


class MirrorBench:
    """A mirror in its loop, a sender of commands, and the mirror's reported states."""

    def __init__(self, mirror: Mirror) -> None:
        self.clock = FakeClock()
        self.listener = Listener(self.clock, MIRROR_STATE)
        self.service = self.listener.service("mirror-dm")
        self.loop = MirrorLoop(mirror, self.service, CONFIG)
        self._commands = self.listener.bus.publisher(COMMAND, "dm")
        self._numbers: Iterator[int] = count(1)

    def command(self, height_nm: float, grid: tuple[int, int] = (4, 5), start_s: int = 0) -> wire.MirrorState:
        sequence = sequence_of(start_s, next(self._numbers))
        message = wire.MirrorCommand(frame_sequence=sequence, rows=grid[0], columns=grid[1])
        message.valid_for_ns, message.actuators = 10**9, np.full(grid, height_nm, np.float32).tobytes()
        self._commands.put(message.SerializeToString())
        return self.state()

    def tick(self, ms: int = 10) -> wire.MirrorState:
        self.clock.advance(ms * MS_NS)
        self.loop._idle()
        return self.state()

    def state(self) -> Any:
        return self.listener.messages(MIRROR_STATE)[-1]


def test_commands_are_limited_and_the_mirror_goes_flat_after_the_command_timeout() -> None:
    mirror = Mirror()
    bench = MirrorBench(mirror)
    assert mirror.heights_nm == [0.0], "driven to flat at the start: its position is unknown"
    bench.command(200.0)
    assert mirror.heights_nm[1:] == [150.0], "the slew limit of [mirror] acts"
    assert bench.command(200.0, (5, 4)).refused == Limit.WRONG_GRID
    assert bench.command(float("nan")).refused == Limit.NOT_FINITE
    assert len(mirror.heights_nm) == 2
    bench.tick(1001)
    bench.tick()
    assert mirror.heights_nm[2:] == [0.0], "a mirror at rest gets no further call"
    assert bench.listener.events()[-1] == "COMMAND_EXPIRED"


def test_the_mirror_refuses_a_command_whose_sender_started_in_the_future_and_follows_the_next_valid_one() -> None:
    mirror = Mirror()
    bench = MirrorBench(mirror)
    start_s = bench.clock.start_s
    assert bench.command(50.0, start_s=start_s).refused == 0
    assert bench.command(90.0, start_s=start_s + 25 * 3600).refused == Rejection.AHEAD
    assert bench.command(60.0, start_s=start_s).refused == 0, "the refused sequence did not become the newest"
    assert mirror.heights_nm[1:] == [50.0, 60.0]
    assert "START_AHEAD" in bench.listener.events()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (lambda _: 1 / 0, "ZeroDivisionError"),
        (lambda _: sys.exit("no licence"), "SystemExit: no licence"),
        (lambda shape: shape[1:], "(3, 5)"),
        (lambda shape: shape * np.float32(np.nan), "NaN or infinite"),
    ],
    ids=["raises", "exits", "shape", "NaN"],
)
def test_a_failed_mirror_goes_flat_before_it_follows_commands_again(bad: Any, message: str) -> None:
    mirror = Mirror()
    bench = MirrorBench(mirror)
    bench.command(140.0)
    bench.command(280.0)
    mirror.plan = [bad, bad]
    state = bench.command(300.0)
    assert (state.actuators, state.status, state.refused) == (b"", wire.MIRROR_STATUS_EXPIRED, Rejection.NO_MIRROR)
    assert bench.service.health().command_refused == Rejection.NO_MIRROR, "the controller holds because of this"
    bench.command(300.0)
    assert mirror.heights_nm == [0.0, 140.0, 280.0, 300.0], "the mirror gets no further command"
    bench.tick()
    assert (len(mirror.heights_nm), bench.state().actuators) == (5, b""), "the retry follows at once, and fails"
    bench.tick()
    assert len(mirror.heights_nm) == 5, "no call during the pause"
    bench.tick(100)
    assert bench.state().actuators, "the mirror reports its position again"
    assert bench.command(50.0).refused == Rejection.NO_MIRROR
    bench.tick()
    bench.tick()
    assert mirror.heights_nm[4:] == [280.0, 280.0, 130.0, 0.0], "the last certain shape, then flat in slew steps"
    assert not bench.service.health().command_refused
    assert bench.command(50.0).refused == 0
    assert mirror.heights_nm[-1] == 50.0
    failed = bench.listener.event_texts("DRIVER_FAILED")
    assert len(failed) == 1
    assert message in failed[0]
    assert bench.service.health().driver_failures == 2


@pytest.mark.parametrize("dtype", [np.float64, np.int32, np.float32])
def test_positions_of_any_number_type_are_copied_as_float32(dtype: type) -> None:
    mirror, reached = Mirror(), np.full((4, 5), 100, dtype)
    bench = MirrorBench(mirror)
    mirror.plan = [lambda _: reached]
    shape = decode_mirror(bench.command(140.0).SerializeToString())
    assert (shape.actuators_nm == 100).all()
    reached[:] = 0  # the driver uses its array again
    assert (bench.loop._status.surface_nm == 100).all()


def test_a_hanging_mirror_reports_no_position_and_goes_flat_before_the_next_command() -> None:
    mirror = Mirror()
    bench = MirrorBench(mirror)
    bench.command(100.0)

    def hang(shape: Single) -> Single:
        for _ in range(5):  # the first notes the call; the fifth check after it, below, reaches the timeout of 0.5 s
            bench.loop.watch.check()
        assert bench.listener.events() == ["STARTED"]
        bench.loop.watch.check()
        state = bench.state()
        assert (state.actuators, state.status) == (b"", wire.MIRROR_STATUS_EXPIRED)
        assert bench.service.health().command_refused == Rejection.NO_MIRROR
        return shape

    mirror.plan = [hang]
    assert bench.command(110.0).actuators == b"", "a result after the timeout is discarded"
    assert bench.command(120.0).refused == Rejection.NO_MIRROR
    assert mirror.heights_nm == [0.0, 100.0, 110.0]
    bench.tick()
    bench.tick()
    assert mirror.heights_nm[3:] == [100.0, 0.0], "the last certain shape first, then flat"
    assert bench.command(30.0).refused == 0
    assert bench.listener.events() == ["STARTED", "DRIVER_HANGS", "COMMAND_REFUSED", "COMMAND_BACK"]
    assert bench.loop.watch.failures == 1


def test_a_call_that_returns_while_it_is_reported_as_hanging_ends_after_the_report() -> None:
    order: list[object] = []
    bench = CameraBench()
    watch = DriverWatch(bench.listener.service("mirror-dm"), 0.1, lambda: order.append("reported"))
    returning = threading.Thread(target=lambda: order.append(watch.returned()))
    watch.begin()
    watch.check()
    with patch.object(watch, "_count", lambda: (returning.start(), returning.join(0.2))):
        watch.check()
    returning.join()
    assert order == ["reported", False]


def test_a_mirror_that_fails_at_the_start_is_retried() -> None:
    mirror = Mirror()
    mirror.plan = [lambda _: 1 / 0]
    bench = MirrorBench(mirror)
    assert bench.command(30.0).refused == Rejection.NO_MIRROR
    bench.tick()
    assert bench.command(30.0).refused == 0
    assert mirror.heights_nm == [0.0, 0.0, 30.0]


def test_a_mirror_may_derive_from_the_class_of_optional_methods() -> None:
    mirror = type("Derived", (Mirror, MirrorExtras), {})()
    bench = MirrorBench(mirror)
    assert bench.command(30.0).refused == 0
    assert mirror.heights_nm == [0.0, 30.0]
    assert bench.listener.events() == ["STARTED"]


@pytest.mark.parametrize("fault", [lambda: 1 / 0, lambda: np.full((4, 5), np.nan)], ids=["raises", "NaN"])
def test_a_fault_in_reading_the_shape_of_other_programs_is_a_failure_of_the_driver(fault: Callable[[], Any]) -> None:
    mirror = Mirror()
    mirror.beside = fault
    bench = MirrorBench(mirror)
    assert bench.command(30.0).refused == Rejection.NO_MIRROR
    assert bench.listener.events() == ["STARTED", "DRIVER_FAILED", "COMMAND_REFUSED"]
    assert bench.service.health().last_warning.endswith(f"NO_MIRROR, {bench.loop.watch.why}")


def test_a_mirror_starts_from_the_position_that_its_driver_reads() -> None:
    mirror = Mirror()
    mirror.position = lambda: np.full((4, 5), 200, np.float32)
    bench = MirrorBench(mirror)
    bench.command(190.0)
    assert mirror.heights_nm == [190.0], "no jump to flat"
    mirror.plan = [lambda _: 1 / 0] * 3
    bench.command(180.0)
    for ms in (10, 10, 100, 200):
        bench.tick(ms)
    assert mirror.heights_nm[-3:] == [50.0] * 3, "each retry is within the slew limit of the 200 nm read back"


def test_a_driver_is_closed_after_its_last_command_and_called_no_more() -> None:
    mirror, calls = Mirror(), list[str]()

    def fill(_: wire.Health) -> None:
        """Let the driver's last command end 0.1 s after this call."""
        calls.append("fill")
        if bench.loop._driver_lock.locked():
            Timer(0.1, lambda: (calls.append("applied"), bench.loop._driver_lock.release())).start()

    mirror.fill = fill
    mirror.close = lambda: calls.append("close")
    bench = MirrorBench(mirror)
    bench.service.stop("the test")
    bench.loop._driver_lock.acquire()  # as while the driver applies a command
    bench.loop.run()
    assert calls[-3:] == ["fill", "applied", "close"]
