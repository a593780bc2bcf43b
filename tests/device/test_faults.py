"""A driver that fails, hangs or talks nonsense: named, counted and tried again, and a mirror kept safe meanwhile."""

from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import numpy as np
import pytest

from lowfc.contract.configuration import load
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import CAMERA_STATE, COMMAND, FRAME, HEALTH, MIRROR_STATE, wire
from lowfc.control.loop.safety import Rejection
from lowfc.device import CameraSettings, Exposure, Single, geometry
from lowfc.device.camera_loop import CameraLoop
from lowfc.device.mirror_loop import MirrorLoop
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener
from lowfc.testing.memory_bus import MemoryBus, MemoryHub

CONFIG = load(None, {"mirror.rows": 4, "mirror.columns": 5})
SETTINGS = CameraSettings(3, 4, exposure_ns=2_000_000, period_ns=4_000_000, number_wrap=1 << 16)
GOOD = np.full((3, 4), 7, np.uint16)
MS = 1_000_000


class Camera:
    """Each exposure is what the next of some functions returns."""

    def __init__(self, clock: FakeClock, *exposures: Callable[[], Any], settings: CameraSettings = SETTINGS) -> None:
        self.clock, self.exposures, self.now = clock, iter(exposures), settings

    def settings(self) -> CameraSettings:
        return self.now

    def expose(self) -> Exposure | None:
        self.clock.advance(self.now.period_ns)
        return next(self.exposures)()

    def close(self) -> None: ...


def good(**fields: Any) -> Callable[[], Exposure]:
    return lambda: Exposure(**{"pixels": GOOD} | fields)


def raising(fault: Exception) -> Callable[[], Any]:
    def fail() -> Any:
        raise fault

    return fail


def exposed(*exposures: Callable[[], Any], frames: int, settings: CameraSettings = SETTINGS) -> Listener:
    hub, clock = MemoryHub(), FakeClock()
    heard = Listener(hub, clock, FRAME, CAMERA_STATE, HEALTH)
    CameraLoop(Camera(clock, *exposures, settings=settings), heard.service("camera"), CONFIG, frames).run()
    assert len(heard.messages(FRAME)) == frames
    return heard


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (raising(OSError("the cable")), "OSError: the cable"),
        (good(pixels=GOOD[1:]), "shape (2, 4)"),
        (good(pixels=np.full((3, 4), np.nan)), "float64"),
        (good(end_ns=1 << 62), "in the future"),
        (good(end_ns=float("nan")), "NaN"),
        (lambda: "nothing", "AttributeError"),
    ],
    ids=["raises", "shape", "NaN", "future", "NaN time", "nonsense"],
)
def test_a_camera_that_fails_is_named_once_counted_and_tried_again(bad: Callable[[], Any], said: str) -> None:
    steady = [good()] * 251  # more than a second
    heard = exposed(good(), bad, bad, bad, *steady, frames=252)
    assert heard.events() == ["STARTED", "DRIVER_FAILED", "DRIVER_BACK", "STOPPED"]
    assert said in heard.said("DRIVER_FAILED")[0]
    assert "after 3 failures" in heard.said("DRIVER_BACK")[0]
    assert heard.messages(HEALTH)[-1].driver_failures == 3


def test_a_camera_that_goes_on_failing_is_left_alone_for_longer_and_longer() -> None:
    hub, clock = MemoryHub(), FakeClock()
    heard = Listener(hub, clock, FRAME)
    camera = Camera(clock, *[raising(OSError("the cable"))] * 9, good())
    begun_ns = clock.now_ns()
    CameraLoop(camera, heard.service("camera"), CONFIG, 1).run()
    assert clock.now_ns() - begun_ns == pytest.approx(7.8e9 + 2 * 4e9, abs=0.1e9)
    assert heard.events().count("DRIVER_FAILED") == 2  # and again after ten seconds


def test_what_a_user_has_to_put_right_ends_the_process() -> None:
    with pytest.raises(ConfigurationError, match="another layout"):
        exposed(raising(ConfigurationError("another layout")), frames=1)


def test_a_camera_that_hangs_is_named_while_it_does() -> None:
    hub, clock = MemoryHub(), FakeClock()
    heard = Listener(hub, clock, FRAME)

    def hang() -> Exposure:
        for _ in range(11):
            loop.watch.look()
        assert heard.events() == ["STARTED", "DRIVER_HANGS"]
        return Exposure(GOOD)

    loop = CameraLoop(Camera(clock, good(), hang, *[good()] * 260), heard.service("camera"), CONFIG, 262)
    loop.run()
    assert heard.events() == ["STARTED", "DRIVER_HANGS", "DRIVER_BACK", "STOPPED"]
    assert loop.watch.failures == 1


def test_a_driver_without_a_frame_is_none_that_fails() -> None:
    assert exposed(lambda: None, lambda: None, good(), frames=1).events() == ["STARTED", "STOPPED"]


def test_the_end_of_an_exposure_is_by_the_clock_that_the_settings_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """A host whose monotonic clock is 5 s short of the run's, and whose wall clock is 2 s behind it."""
    monkeypatch.setattr(FakeClock, "offset_ns", 5 * 10**9)
    monkeypatch.setattr(FakeClock, "ahead_ns", lambda self: 2 * 10**9)
    start_ns = FakeClock().now_ns()
    for clock, behind_ns in (("monotonic", 5 * 10**9), ("realtime", 2 * 10**9)):
        settings = CameraSettings(3, 4, 2 * MS, 4 * MS, clock=clock)
        heard = exposed(good(end_ns=start_ns + MS - behind_ns), good(), frames=2, settings=settings)
        times = [frame.timestamp.ToNanoseconds() - start_ns for frame in heard.messages(FRAME)]
        assert times == [MS, 8 * MS], "the second is of its reception"


def numbered(*numbers: int) -> Listener:
    return exposed(*[good(number=number) for number in numbers], frames=len(numbers))


def counts(heard: Listener) -> list[int]:
    return [count_of(sample.sequence) for sample in heard.samples[FRAME]]


def test_numbers_that_wrap_go_on_and_gaps_are_frames_that_the_camera_lost() -> None:
    heard = numbered(65_533, 65_534, 1, 2, 5)
    assert counts(heard) == [0, 1, 4, 5, 8]
    assert len({start_of(sample.sequence) for sample in heard.samples[FRAME]}) == 1
    last = next(one for one in heard.messages(HEALTH)[-1].topics if one.topic == FRAME.key)
    assert (last.published, last.missing) == (9, 4)
    assert heard.said("FRAMES_LOST") == ["FRAMES_LOST 2 frames lost by the camera"], "at most twice a second"


def test_frames_lost_without_numbers_are_counted_too() -> None:
    assert counts(exposed(good(), good(lost=3), good(), frames=3)) == [0, 4, 5]


def test_numbers_that_begin_again_are_a_new_start_twice_in_a_second_too() -> None:
    heard = numbered(30_000, 30_001, 0, 1, 0, 1)
    starts = [start_of(sample.sequence) for sample in heard.samples[FRAME]]
    assert np.diff(starts).tolist() == [0, 1, 0, 1, 0]
    assert counts(heard) == [0, 1, 0, 1, 0, 1]
    settings = {start_of(sample.sequence) for sample in heard.samples[CAMERA_STATE]}
    assert settings == set(starts), "the controller waits for those of each start"


def test_a_region_that_changes_is_told_before_its_first_frame() -> None:
    hub, clock = MemoryHub(), FakeClock()
    heard = Listener(hub, clock, FRAME, CAMERA_STATE)

    def cropped() -> Exposure:
        camera.now = CameraSettings(2, 4, 2 * MS, 4 * MS)
        return Exposure(GOOD[1:])

    camera = Camera(clock, good(), cropped)
    CameraLoop(camera, heard.service("camera"), CONFIG, 2).run()
    assert [state.rows for state in heard.messages(CAMERA_STATE)] == [3, 3, 2]
    assert heard.events() == ["STARTED", "STOPPED"]


class Mirror:
    """What the next calls do comes first from `plan`; then it follows."""

    def __init__(self) -> None:
        self.geometry = geometry(CONFIG)
        self.plan: list[Callable[[Single], Any]] = []
        self.heights_nm: list[float] = []

    def apply(self, actuators_nm: Single) -> Single | None:
        self.heights_nm.append(round(float(actuators_nm.max()), 1))
        return self.plan.pop(0)(actuators_nm) if self.plan else actuators_nm

    def close(self) -> None: ...


class Bench:
    def __init__(self, mirror: Mirror) -> None:
        hub, self.clock = MemoryHub(), FakeClock()
        self.heard = Listener(hub, self.clock, MIRROR_STATE)
        self.service = self.heard.service("mirror-dm")
        self.loop = MirrorLoop(mirror, self.service, CONFIG)
        self._commands = MemoryBus(hub, "controller", self.clock).publisher(COMMAND, "dm")
        self._numbers: Iterator[int] = count(1)

    def command(self, height_nm: float) -> wire.MirrorState:
        told = wire.MirrorCommand(frame_sequence=next(self._numbers), rows=4, columns=5, valid_for_ns=10**9)
        told.actuators = np.full((4, 5), height_nm, np.float32).tobytes()
        self._commands.put(told.SerializeToString())
        return self.state()

    def tick(self, ms: int = 10) -> wire.MirrorState:
        self.clock.advance(ms * MS)
        self.loop._wait()
        return self.state()

    def state(self) -> Any:
        return self.heard.messages(MIRROR_STATE)[-1]


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (lambda _: 1 / 0, "ZeroDivisionError"),
        (lambda shape: shape[1:], "(3, 5)"),
        (lambda shape: shape * np.float32(np.nan), "finite"),
    ],
    ids=["raises", "shape", "NaN"],
)
def test_a_mirror_whose_driver_fails_goes_to_flat_before_it_follows_again(bad: Any, said: str) -> None:
    mirror = Mirror()
    bench = Bench(mirror)
    bench.command(140.0)
    bench.command(280.0)
    mirror.plan = [bad, bad]
    state = bench.command(300.0)
    assert (state.actuators, state.status, state.refused) == (b"", wire.MIRROR_STATUS_EXPIRED, Rejection.NO_MIRROR)
    assert bench.service.health().command_refused == Rejection.NO_MIRROR, "so that the controller holds"
    bench.command(300.0)
    assert mirror.heights_nm == [0.0, 140.0, 280.0, 300.0], "it gets no further command"
    bench.tick()
    assert (len(mirror.heights_nm), bench.state().actuators) == (5, b""), "tried at once, and failed again"
    bench.tick()
    assert len(mirror.heights_nm) == 5, "left alone for a while"
    bench.tick(100)
    assert bench.state().actuators, "it says where it is again"
    assert bench.command(50.0).refused == Rejection.NO_MIRROR
    bench.tick()
    assert mirror.heights_nm[4:] == [130.0, 130.0, 0.0], "to flat, by no more than the slew limit"
    assert not bench.service.health().command_refused
    assert bench.command(50.0).refused == 0
    assert mirror.heights_nm[-1] == 50.0
    failed = bench.heard.said("DRIVER_FAILED")
    assert len(failed) == 1
    assert said in failed[0]
    assert bench.service.health().driver_failures == 2


def test_a_mirror_whose_driver_hangs_says_no_position_and_is_flat_before_it_follows_again() -> None:
    mirror = Mirror()
    bench = Bench(mirror)
    bench.command(100.0)

    def hang(shape: Single) -> Single:
        for _ in range(6):
            bench.loop.watch.look()
        state = bench.state()
        assert (state.actuators, state.status) == (b"", wire.MIRROR_STATUS_EXPIRED)
        assert bench.service.health().command_refused == Rejection.NO_MIRROR
        return shape

    mirror.plan = [hang]
    assert bench.command(110.0).actuators == b"", "what it says at last is no longer so"
    assert bench.command(120.0).refused == Rejection.NO_MIRROR
    assert mirror.heights_nm == [0.0, 100.0, 110.0]
    bench.tick()
    assert mirror.heights_nm[3:] == [0.0], "its idle state, before anything else"
    assert bench.command(30.0).refused == 0
    assert bench.heard.events() == ["STARTED", "DRIVER_HANGS", "COMMAND_REFUSED", "COMMAND_BACK"]
    assert bench.loop.watch.failures == 1


def test_a_mirror_that_fails_as_the_process_starts_is_tried_again() -> None:
    mirror = Mirror()
    mirror.plan = [lambda _: 1 / 0]
    bench = Bench(mirror)
    assert bench.command(30.0).refused == Rejection.NO_MIRROR
    bench.tick()
    assert bench.command(30.0).refused == 0
    assert mirror.heights_nm == [0.0, 0.0, 30.0]


def test_a_mirror_that_says_what_it_holds_is_taken_from_there() -> None:
    mirror = Mirror()
    mirror.position = lambda: np.full((4, 5), 200, np.float32)  # type: ignore[attr-defined]
    bench = Bench(mirror)
    bench.command(190.0)
    assert mirror.heights_nm == [190.0], "no jump to flat"
    mirror.plan = [lambda _: 1 / 0]
    bench.command(180.0)
    bench.tick()
    assert mirror.heights_nm[-1] == 50.0, "from the 200 nm that it holds"
