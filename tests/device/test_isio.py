"""Camera and mirror drivers for ImageStreamIO streams, against an independent reader and writer."""

import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.image_stream.channels import OtherChannels, other_channel_names
from lowfc.adapters.image_stream.stream import StreamError
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError, RequestRefusedError
from lowfc.contract.messages import COMMAND, CONTROLLER_STATE, MIRROR_STATE, wire
from lowfc.control.loop.safety import Limit
from lowfc.device.drivers.isio import mirror as mirror_module
from lowfc.device.drivers.isio.camera import IsioCamera
from lowfc.device.drivers.isio.mirror import IsioMirror
from lowfc.device.mirror_loop import MirrorLoop, protection_of
from lowfc.device.mirror_protection import Command, Status, apply_command
from lowfc.device.plugins import options
from lowfc.programs.bridge import isio as bridge
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.image_streams.plain import FLOAT32, INT32, UINT16, PlainStream, file_of

CONFIG = Configuration()
ROWS, COLUMNS = 6, 8
GRID = (CONFIG.mirror.rows, CONFIG.mirror.columns)
TIME_NS = 1_700_000_000_000_000_000


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    return tmp_path


def joined(driver: Any) -> tuple[Any, Listener]:
    """A driver in a run, and the listener to its events."""
    listener = Listener(FakeClock())
    driver.join(listener.service("driver"))
    return driver, listener


def camera(**options: Any) -> tuple[IsioCamera, Listener]:
    return joined(IsioCamera(IsioCamera.Options(stream="camnsv", **options), CONFIG))


def mirror(**options: Any) -> tuple[IsioMirror, Listener]:
    return joined(IsioMirror(IsioMirror.Options(stream="dm00disp03", **options), CONFIG))


def shape_nm(seed: int) -> np.ndarray:
    return (20 * np.random.default_rng(seed).standard_normal(GRID)).astype(np.float32)


def channel(folder: Path, name: str = "dm00disp03", *, make: bool = False) -> PlainStream:
    create_or_open = PlainStream.make if make else PlainStream
    return create_or_open(file_of(folder, name), GRID[1], GRID[0], FLOAT32)


@pytest.mark.parametrize(
    ("pixel_type", "options", "pixels", "expected"),
    [
        (UINT16, {}, [0, 1, 65535], [0, 1, 65535]),
        (INT32, {}, [-5, 70_000, 12], [0, 65535, 12]),
        (FLOAT32, {"scale_dn": 2.0, "zero_dn": 100.0}, [np.nan, -10.2, 1e9], [0, 80, 65535]),
        (FLOAT32, {"scale_dn": 0.1, "zero_dn": 1.0}, [np.inf, -np.inf, 94], [65535, 0, 10]),
    ],
)
def test_pixels_of_any_type_are_converted_to_dn(
    folder: Path, pixel_type: int, options: dict[str, float], pixels: list[float], expected: list[int]
) -> None:
    writer = PlainStream.make(file_of(folder, "camnsv"), 3, 1, pixel_type)
    driver, _ = camera(**options)
    writer.write(np.array([pixels]))
    exposure = driver.expose()
    assert exposure.number == 1
    assert exposure.pixels.dtype == np.uint16
    assert exposure.pixels.tolist() == [expected]


@pytest.mark.parametrize(("atime", "expected"), [("end", TIME_NS), ("start", TIME_NS + 2_000_000), ("none", None)])
def test_frames_are_timed_at_the_end_of_the_exposure(folder: Path, atime: str, expected: int | None) -> None:
    writer = PlainStream.make(file_of(folder, "camnsv"), COLUMNS, ROWS, UINT16)
    driver, _ = camera(atime=atime, exposure_us=2000.0)
    writer.write(np.zeros((ROWS, COLUMNS)), TIME_NS)
    exposure = driver.expose()
    assert exposure.end_ns == expected
    assert driver.settings().clock == "realtime"


def test_the_stream_name_comes_from_command_line_or_configuration() -> None:
    assert options(IsioCamera, {}, ("--stream", "camnsv", "--exposure-us", "500")).exposure_us == 500
    assert options(IsioMirror, {"stream": "dm00disp03"}).stream == "dm00disp03"
    with pytest.raises(ConfigurationError, match="nm_per_unit = 1e-46"):  # the stream would get infinite values
        options(IsioMirror, {"stream": "dm00disp03", "nm_per_unit": 1e-46})
    for table, arguments in (({}, ()), ({}, ("--atime", "end"))):
        with pytest.raises(ConfigurationError, match="stream"):
            options(IsioCamera, table, arguments)


def test_settings_come_from_options_keywords_and_configuration(folder: Path) -> None:
    keywords: dict[str, float | str | int] = {"tint": 1.5e-3, "y0": 17, "name": "nsv"}
    PlainStream.make(file_of(folder, "camnsv"), COLUMNS, ROWS, UINT16, keywords=keywords)
    driver, _ = camera(gain_e_per_dn=2.5, keywords={"exposure_s": "tint", "region_row": "y0", "bias_dn": "absent"})
    settings = driver.settings()
    expected = (ROWS, COLUMNS, 1_500_000, 17)
    assert (settings.rows, settings.columns, settings.exposure_ns, settings.region_row) == expected
    expected = (2.5, CONFIG.camera.bias_dn, CONFIG.period_ns)
    assert (settings.gain_e_per_dn, settings.bias_dn, settings.period_ns) == expected
    driver, _ = camera(keywords={"gain_e_per_dn": "name"})
    with pytest.raises(StreamError, match="keyword 'name' of stream 'camnsv' is 'nsv'"):
        driver.settings()


@pytest.mark.parametrize(
    ("options", "expected_dn"),
    [
        ({}, 40_100),
        ({"bit_depth": 12}, 4095),
        ({"bit_depth": 16}, 40_100),
        ({"bit_depth": 12, "saturation_dn": 3000}, 3000),
    ],
)
def test_saturation_is_at_most_the_converters_full_scale(
    folder: Path, options: dict[str, float], expected_dn: float
) -> None:
    PlainStream.make(file_of(folder, "camnsv"), COLUMNS, ROWS, UINT16)
    assert camera(**options)[0].settings().saturation_dn == expected_dn


def test_a_silent_or_recreated_stream_is_reported_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lowfc.device.drivers.isio.camera._WAIT_S", 0.01)
    with pytest.raises(StreamError, match="there is no stream 'camnsv'"):
        camera()
    path = file_of(folder, "camnsv")
    writer = PlainStream.make(path, COLUMNS, ROWS, UINT16)
    driver, events = camera()
    driver._image_s += 9.0  # as if the last image were less than two periods old
    assert driver.expose() is None
    assert events.events() == ["STARTED"]
    driver._image_s -= 9.0
    assert driver.expose() is None
    assert driver.expose() is None
    writer.write(np.zeros((ROWS, COLUMNS)))
    assert driver.expose() is not None
    writer.begin(np.zeros((ROWS, COLUMNS)))
    assert driver.expose() is None
    PlainStream.make(path, COLUMNS, ROWS - 2, UINT16).write(np.zeros((ROWS - 2, COLUMNS)))
    exposure = driver.expose()
    assert exposure.pixels.shape == (ROWS - 2, COLUMNS)
    assert driver.settings().rows == ROWS - 2
    assert events.events()[1:] == ["STREAM_SILENT", "STREAM_SILENT", "STREAM_RENEWED"]
    assert "in the middle of an image" in events.event_texts("STREAM_SILENT")[1]
    driver.close()


def test_the_channel_is_created_or_adopted_with_its_shape(folder: Path) -> None:
    driver, _ = mirror()
    assert not driver.position().any()
    assert not driver.beside().any()
    assert driver.apply(shape_nm(1)) is None
    assert np.allclose(channel(folder).pixels[0] * 1000, shape_nm(1), atol=1e-4)
    driver, _ = mirror(nm_per_unit=2000.0)
    assert np.allclose(driver.position(), 2 * shape_nm(1), atol=1e-3)
    driver.close()
    assert channel(folder).count == 1
    PlainStream.make(file_of(folder, "dm00disp03"), GRID[1] + 1, GRID[0], FLOAT32)
    with pytest.raises(StreamError, match=f"{GRID[1] + 1} x {GRID[0]} pixels of float32, expected {GRID[1]} x"):
        mirror()


def test_a_channel_written_by_another_process_is_refused(folder: Path) -> None:
    other = channel(folder, make=True)
    driver, _ = mirror()
    driver.apply(shape_nm(1))
    other.pack("<i", other.writers, os.getppid())
    with pytest.raises(StreamError, match=f"process {os.getppid()} writes stream 'dm00disp03'"):
        mirror()
    other.write(np.zeros(GRID))
    other.pack("<i", other.writers, os.getppid())
    with pytest.raises(RuntimeError, match=f"process {os.getppid()} writes stream 'dm00disp03'"):
        driver.apply(shape_nm(2))
    driver.apply(shape_nm(2))  # the other process has not written again
    assert np.allclose(other.pixels[0] * 1000, shape_nm(2), atol=1e-4)


def test_a_channel_that_is_being_created_is_awaited(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = file_of(folder, "dm00disp03")
    driver, events = mirror()
    driver.apply(shape_nm(1))
    path.write_bytes(b"")
    with pytest.raises(StreamError, match="stream 'dm00disp03' is being created"):
        mirror()
    with pytest.raises(RuntimeError, match="stream 'dm00disp03' is being created"):
        driver.apply(shape_nm(1))
    monkeypatch.setattr("lowfc.adapters.image_stream.channels._CREATION_S", 10.0)
    channel(folder, "complete", make=True)
    creation = threading.Timer(0.05, lambda: file_of(folder, "complete").rename(path))
    creation.start()
    driver.apply(shape_nm(1))
    creation.join()
    assert channel(folder).count == 1
    assert events.events()[1:] == ["STREAM_RENEWED"]


def test_commands_fail_while_another_process_writes_the_recreated_channel(folder: Path) -> None:
    driver, events = mirror()
    other = channel(folder, make=True)
    other.write(np.zeros(GRID))
    other.pack("<i", other.writers, os.getppid())
    with pytest.raises(RuntimeError, match=f"process {os.getppid()} writes stream 'dm00disp03'"):
        driver.apply(shape_nm(1))
    assert other.count == 1
    assert events.events()[1:] == []


class Sum(threading.Thread):
    """Stand-in for the process that sums the channels: clips the sum, then subtracts its mean."""

    def __init__(self, folder: Path, delay_s: float = 0.0) -> None:
        super().__init__(daemon=True)
        self.delay_s = delay_s
        self.total = channel(folder, "dm00disp", make=True)
        self.others = channel(folder, "dm00disp00", make=True)
        self.own, self.running = channel(folder), True
        self.own.reserve_semaphore(4)  # the semaphore that `run` waits for
        self.start()

    def run(self) -> None:
        while self.running:
            if self.own.wait(4, 0.01):
                time.sleep(self.delay_s)
                total = np.clip(self.own.pixels[0] + self.others.pixels[0], -0.5, 0.5)
                self.total.write(total - total.mean())


def test_the_reached_position_comes_from_the_sum_of_channels(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirror_module, "SUM_WAIT_S", 2.0)
    monkeypatch.setattr(mirror_module, "_SEARCH_S", 0.0)
    channel(folder, make=True)
    summing = Sum(folder)
    driver, _ = mirror()
    others_nm = shape_nm(3) + 100
    summing.others.write(others_nm / 1000)
    assert driver.apply(shape_nm(1)) is None  # reached as written, except for piston
    assert np.allclose(driver.beside(), others_nm - others_nm.mean(), atol=1e-3)
    too_far = shape_nm(2)
    too_far[5, 7] = 600
    reached = driver.apply(too_far)
    assert reached[5, 7] == pytest.approx(500 - others_nm[5, 7], abs=0.1)
    assert np.abs(np.delete(reached - too_far, 5 * GRID[1] + 7)).max() < 0.1
    summing.running = False
    summing.join()
    monkeypatch.setattr(mirror_module, "SUM_WAIT_S", 0.001)
    monkeypatch.setattr(mirror_module, "SUM_SILENT_S", 0.5)
    assert driver.apply(shape_nm(1)) is None  # within SUM_SILENT_S a late sum is tolerated
    time.sleep(0.6)
    with pytest.raises(RuntimeError, match="'dm00disp' has not followed 'dm00disp03'"):
        driver.apply(shape_nm(1))


def test_a_mirror_whose_sum_is_always_late_counts_as_following(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirror_module, "SUM_SILENT_S", 0.1)
    channel(folder, make=True)
    summing = Sum(folder, delay_s=0.01)
    driver, _ = mirror()
    for seed in range(5):
        assert driver.apply(shape_nm(seed)) is None
        time.sleep(0.05)
    assert summing.total.count == 5
    summing.running = False
    summing.join()


def test_a_mirror_whose_expected_sum_is_absent_counts_as_not_following(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mirror_module, "SUM_SILENT_S", 0.01)
    monkeypatch.setattr(mirror_module, "_SEARCH_S", 0.0)

    def check_failure_without_sum(driver: IsioMirror, name: str) -> None:
        assert driver.apply(shape_nm(1)) is None
        time.sleep(0.02)
        with pytest.raises(RuntimeError, match=f"no stream '{name}' of {GRID[1]} x {GRID[0]} float32 pixels"):
            driver.apply(shape_nm(1))

    driver, _ = mirror(total="dm99disp")
    check_failure_without_sum(driver, "dm99disp")
    for total in (None, ""):  # by default the sum is read if it exists; with an empty name none is read
        driver, _ = mirror(total=total)
        assert driver.apply(shape_nm(1)) is None
        time.sleep(0.02)
        assert driver.apply(shape_nm(1)) is None
    monkeypatch.setattr(mirror_module, "SUM_WAIT_S", 2.0)
    driver, _ = mirror()
    summing = Sum(folder)
    assert driver.apply(shape_nm(1)) is None
    file_of(folder, "dm00disp").unlink()
    check_failure_without_sum(driver, "dm00disp")
    summing.total = channel(folder, "dm00disp", make=True)
    assert driver.apply(shape_nm(1)) is None, "the sum follows again"
    assert summing.total.count
    summing.running = False
    summing.join()


def test_a_channel_whose_writer_died_while_writing_stays_in_the_sum(folder: Path) -> None:
    dark_hole, turbulence, interrupted = (channel(folder, f"dm00disp0{index}", make=True) for index in range(3))
    dark_hole.write(shape_nm(1) / 1000)
    interrupted.begin(shape_nm(2) / 1000)
    others = OtherChannels(other_channel_names("dm00disp03"), GRID)
    assert np.allclose(1000 * others.sum(), shape_nm(1) + shape_nm(2), atol=1e-3)
    dark_hole.begin(shape_nm(3) / 1000)
    turbulence.write(shape_nm(4) / 1000)
    assert np.allclose(1000 * others.sum(), shape_nm(1) + shape_nm(2) + shape_nm(4), atol=1e-3)
    dark_hole.write(np.full(GRID, np.nan))
    assert np.allclose(1000 * others.sum(), shape_nm(2) + shape_nm(4), atol=1e-3)


def test_a_channel_read_between_its_counter_and_its_flag_is_read_again(folder: Path) -> None:
    dark_hole = channel(folder, "dm00disp00", make=True)
    others = OtherChannels(other_channel_names("dm00disp03"), GRID)
    assert not others.sum().any()
    dark_hole.begin(shape_nm(1) / 1000)
    dark_hole.pack("<Q", 264, dark_hole.count + 1)  # the counter, cnt0
    assert not others.sum().any()
    dark_hole.pack("B", 288, 0)  # the flag `write`
    assert np.allclose(1000 * others.sum(), shape_nm(1), atol=1e-3)


def test_a_shrunk_channel_is_no_longer_read(folder: Path) -> None:
    dark_hole, turbulence = (channel(folder, f"dm00disp0{index}", make=True) for index in (0, 4))
    driver, _ = mirror()
    dark_hole.write(shape_nm(1) / 1000)
    turbulence.write(shape_nm(2) / 1000)
    others = OtherChannels(other_channel_names("dm00disp03"), GRID)
    assert np.allclose(1000 * others.sum(), shape_nm(1) + shape_nm(2), atol=1e-3)
    os.truncate(file_of(folder, "dm00disp04"), 0)
    assert np.allclose(1000 * others.sum(), shape_nm(1), atol=1e-3)
    channel(folder, "dm00disp00", make=True).write(shape_nm(3) / 1000)
    assert np.allclose(1000 * others.sum(), shape_nm(3), atol=1e-3), "a recreated channel is found at once"
    os.truncate(file_of(folder, "dm00disp03"), 0)
    with pytest.raises(RuntimeError, match="stream 'dm00disp03' is being created"):
        driver.position()
    channel(folder, make=True).write(shape_nm(1) / 1000)
    assert np.allclose(driver.position(), shape_nm(1), atol=1e-3)


def test_the_position_from_a_channel_whose_writer_died_is_its_present_content(folder: Path) -> None:
    channel(folder, make=True).begin(shape_nm(1) / 1000)
    driver, _ = mirror()
    assert np.allclose(driver.position(), shape_nm(1), atol=1e-3)
    channel(folder).write(np.full(GRID, np.nan))
    assert driver.position() is None


def test_the_mirror_writes_zeros_over_a_channel_that_is_not_finite(folder: Path) -> None:
    def filled_with_nan() -> PlainStream:
        stream = channel(folder)
        stream.write(np.full(GRID, np.nan))
        return stream

    channel(folder, make=True)
    stream, clock = filled_with_nan(), FakeClock()
    listener = Listener(clock, MIRROR_STATE)
    loop = MirrorLoop(mirror()[0], listener.service("mirror-dm"), CONFIG)
    assert not stream.pixels.any(), "zeros are written at the start"
    command = wire.MirrorCommand(frame_sequence=1, rows=GRID[0], columns=GRID[1], valid_for_ns=10**9)
    command.actuators = shape_nm(1).tobytes()
    commands = listener.bus.publisher(COMMAND, "dm")
    commands.put(command.SerializeToString())
    assert stream.pixels.any()
    filled_with_nan()
    commands.put(command.SerializeToString())
    for _ in range(2):  # the last shape, then flat
        clock.advance(10_000_000)
        loop._idle()
    assert not stream.pixels.any(), "zeros are written after another process wrote NaN"
    (failed,) = listener.event_texts("DRIVER_FAILED")
    assert "another process writes stream 'dm00disp03'" in failed
    commands.put(command.SerializeToString())
    assert np.allclose(stream.pixels[0] * 1000, shape_nm(1), atol=1e-3)


def test_the_stroke_limit_applies_to_the_sum_of_channels() -> None:
    protection = protection_of(mirror()[0], CONFIG)
    flat, beside, target = (np.zeros(GRID, np.float32) for _ in range(3))
    beside[2, 2], beside[4, 4], beside[6, 6], beside[8, 8] = 700, 900, -900, 700
    target[2, 2], target[4, 4], target[6, 6], target[8, 8], target[9, 9] = 100, 100, 100, -100, 100
    command = Command("lowfc", 1, TIME_NS, 10**9, target, np.ones(2, np.float32))
    status, reason = apply_command(protection, Status(flat, flat), command, TIME_NS, lambda shape, _: shape, beside)
    assert reason is None
    assert status.limits_hit == (Limit.STROKE,)
    assert not status.command_nm.size
    reached = status.surface_nm
    assert reached[2, 2] == pytest.approx(50, abs=0.1)
    assert reached[4, 4] == 0  # the other channels already exceed the stroke in this direction
    assert (reached[6, 6], reached[8, 8], reached[9, 9]) == (100, -100, 100)
    assert np.abs(reached + beside)[2, 2] < CONFIG.mirror.stroke_nm / 2
    status, _ = apply_command(protection, Status(flat, flat), command, TIME_NS, lambda shape, _: shape, flat)
    assert np.array_equal(status.surface_nm, target)
    assert not status.limits_hit


def test_a_prefix_that_gives_an_invalid_stream_name_is_refused_at_the_start(folder: Path) -> None:
    bus, clock = MemoryBus(MemoryHub(), "operator", FakeClock()), FakeClock()
    for prefix in ("a/b", "x" * 72):
        with pytest.raises(StreamError, match="a stream's name has 1 to 79 bytes without '/'"):
            bridge.StepStreams(bus, clock, prefix)
    assert list(folder.iterdir()) == []


def test_a_refused_report_of_other_channels_is_repeated_every_two_seconds(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested_s: list[float] = []
    refused_until_s = 5.0

    def request(name: str, shape_nm: np.ndarray) -> None:
        requested_s.append(round(now_s, 1))
        assert (name, shape_nm.max()) == ("external", 40)
        if now_s < refused_until_s:
            raise RequestRefusedError("reserved by a calibration")

    now_s = 0.0
    monkeypatch.setattr(bridge, "time", SimpleNamespace(monotonic=lambda: now_s))
    client: Any = SimpleNamespace(mirror_grid=lambda: GRID, channel=request)
    bus = MemoryBus(MemoryHub(), "operator", FakeClock())
    channel(folder, "dm00disp01", make=True).write(np.full(GRID, 0.04, np.float32))
    others = bridge.ExternalChannels(client, bus, ["dm00disp01"], 1000.0)
    for tick in range(100):
        now_s = tick * 0.1
        others.report_changes()
    assert requested_s == [0.0, 2.0, 4.0, 6.0], "three reports are refused, then one is accepted"


def test_a_shape_of_other_channels_is_removed_only_if_the_controller_has_one(folder: Path) -> None:
    requests: list[object] = []
    client: Any = SimpleNamespace(mirror_grid=lambda: GRID, channel=lambda *arguments: requests.append(arguments))
    hub = MemoryHub()
    states = MemoryBus(hub, "controller", FakeClock()).publisher(CONTROLLER_STATE)
    channel(folder, "dm00disp01", make=True).write(np.zeros(GRID, np.float32))
    others = bridge.ExternalChannels(client, MemoryBus(hub, "operator", FakeClock()), ["dm00disp01"], 1000.0)
    others.report_changes()
    assert requests == []
    reported = wire.Channel(name="external", actuators=np.ones(GRID, np.float32).tobytes())
    states.put(wire.ControllerState(channels=[reported]).SerializeToString())
    others.report_changes()
    assert requests == [("external", None)]
