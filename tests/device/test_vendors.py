"""Drivers of vendors' cameras, on emulators and stand-ins: normal operation, lost frames, missing packages."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Client
from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import CAMERA_STATE, FRAME, HEALTH, Role, wire
from lowfc.device import plugins
from lowfc.device.camera_loop import CameraLoop
from lowfc.device.drivers import aravis
from lowfc.device.drivers.aravis import AravisCamera
from lowfc.device.drivers.basler import BaslerCamera
from lowfc.device.drivers.genicam import GenicamOptions
from lowfc.testing.listener import Listener
from tests.support.loops import command, in_background, interrupt, start, until

CONFIG = load(None, {"camera.rate_hz": 200.0})
OPTIONS = {"rows": 60, "columns": 80, "region_row": 16, "region_column": 32, "rate_hz": 200.0, "exposure_us": 500.0}


def run(driver: Any, frames: int) -> tuple[Listener, list[int]]:
    """Run a driver's loop for a number of frames; return the listener and the count in each frame's sequence."""
    listener = Listener(HostClock(), FRAME, CAMERA_STATE)
    CameraLoop(driver, listener.service("camera"), frames).run()
    counts = [sample.sequence & 0xFFFFFFFF for sample in listener.samples[FRAME]]
    return listener, counts


@pytest.mark.parametrize(("name", "package"), [("basler", "pypylon"), ("aravis", "gi")])
def test_a_missing_package_gives_install_advice(monkeypatch: pytest.MonkeyPatch, name: str, package: str) -> None:
    for module in (package, f"{package}.pylon"):
        monkeypatch.setitem(sys.modules, module, None)
    driver = plugins.load("camera", name)
    options = GenicamOptions(rows=8, columns=8)
    with pytest.raises(ConfigurationError, match=rf"the driver {name} .*{package}.* install"):
        driver(options, CONFIG)
    (need,) = driver.needs(options)
    assert not need.found
    assert "install " in need.advice


@pytest.mark.parametrize("source", ["", " : OutOfRangeException thrown in node 'Gain' (file 'x.h', line 1)"])
def test_a_refusal_by_a_basler_camera_is_reported_without_the_library_source(
    source: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise RuntimeError(f"Cannot set 'Gain'.{source}")

    stub = SimpleNamespace(DeviceInfo=refuse, GenericException=RuntimeError)
    for module in ("pylon", "genicam"):
        monkeypatch.setitem(sys.modules, f"pypylon.{module}", stub)
    with pytest.raises(ConfigurationError, match=r"^Basler camera \(the first found\): Cannot set 'Gain'\.$"):
        BaslerCamera(GenicamOptions(rows=8, columns=8), CONFIG)


def test_settings_default_to_the_configuration() -> None:
    settings = GenicamOptions(rows=8, columns=9, region_row=3, pixel_format="Mono10", rate_hz=500.0).settings(CONFIG)
    assert (settings.rows, settings.columns, settings.region_row, settings.region_column) == (8, 9, 3, 0)
    assert (settings.bit_depth, settings.saturation_dn, settings.period_ns) == (10, 1023, 2_000_000)
    assert settings.exposure_ns == CONFIG.exposure_ns


class Buffers:
    """Stand-in for a stream of aravis: buffers of 2 x 3 pixels with the given frame numbers; 0 for a failed buffer.

    At first, the queue holds all but the last `later` buffers. By default it is empty: each buffer arrives when the
    driver waits for it.
    """

    def __init__(self, *numbers: int, later: int = 99) -> None:
        self.numbers, self.pushed, self.later = list(numbers), 0, later

    def timeout_pop_buffer(self, wait_us: int) -> Any:
        if not self.numbers:
            return None
        number = self.numbers.pop(0)
        data = np.arange(6, dtype="<u2").tobytes()
        methods = {
            "get_status": "whole" if number else "missing-packets",
            "get_image_height": 2,
            "get_image_width": 3,
            "get_image_data": data,
            "get_system_timestamp": time.time_ns(),
            "get_frame_id": number,
        }
        return SimpleNamespace(**{name: lambda value=value: value for name, value in methods.items()})

    def get_n_buffers(self) -> tuple[int, int]:
        return 32, len(self.numbers) - self.later

    def push_buffer(self, buffer: Any) -> None:
        self.pushed += 1


def test_gige_frame_numbers_wrap_to_one_and_buffers_are_returned() -> None:
    driver, stream = object.__new__(AravisCamera), Buffers(65531, 65532, 65533, 65534, 65535, 0, 2, later=2)
    driver._aravis = SimpleNamespace(BufferStatus=SimpleNamespace(SUCCESS="whole"))
    driver._settings, driver._stream = GenicamOptions(rows=2, columns=3).settings(CONFIG), stream
    driver._camera = SimpleNamespace(start_acquisition=lambda: None, stop_acquisition=lambda: None)
    listener, counts = run(driver, 3)
    assert counts == [0, 1, 3], "frame number 1 was lost, at the wrap"
    assert listener.messages(FRAME)[0].data == np.arange(6, dtype="<u2").tobytes()
    assert stream.pushed == 7


@pytest.mark.parametrize("kind", [AravisCamera, BaslerCamera])
def test_a_disconnected_camera_is_opened_again(kind: Any) -> None:
    driver, opened = object.__new__(kind), list[str]()

    def open_at_the_third_attempt(name: str) -> None:
        opened.append(name)
        if len(opened) < 3:
            raise OSError("no such device")
        driver._lost = False

    silent = SimpleNamespace(IsValid=lambda: False)
    driver._camera = SimpleNamespace(IsCameraDeviceRemoved=lambda: not opened, RetrieveResult=lambda *_: silent)
    driver._pylon, driver.start = SimpleNamespace(TimeoutHandling_Return=1), lambda: opened.append("started")
    driver._open, driver._serial, driver._name, driver._stream = open_at_the_third_attempt, "7", "7", Buffers()
    if kind is AravisCamera:
        driver._mark_lost(None)  # the library's signal
    for _ in range(2):
        with pytest.raises(OSError, match="no such device"):
            driver.expose()
    assert [driver.expose(), driver.expose()] == [None, None]
    assert opened == ["7", "7", "7", "started"]


@pytest.fixture
def emulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pylon's emulation of a camera."""
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    pytest.importorskip("pypylon.pylon", reason="needs pypylon")


@pytest.mark.basler
def test_a_basler_camera_that_gets_no_trigger_is_silent_and_invalid_settings_are_refused(emulated: None) -> None:
    driver = BaslerCamera(GenicamOptions(**OPTIONS, camera="0815-0001", trigger="Line1"), CONFIG)
    driver.start()
    assert driver.expose() is None
    assert (driver._camera.TriggerSource.Value, driver._camera.TriggerMode.Value) == ("Line1", "On")
    driver.close()
    for options, why in [
        ({"columns": 9999}, "9999 must be"),
        ({"trigger": "Line9"}, "Line9"),
        ({"camera": "7"}, "7: No"),
    ]:
        with pytest.raises(ConfigurationError, match=f"Basler camera .*{why}"):
            BaslerCamera(GenicamOptions(**{**OPTIONS, **options}), CONFIG)
    assert all(need.found for need in BaslerCamera.needs(GenicamOptions(**OPTIONS)))


@pytest.mark.basler
def test_a_basler_camera_is_configured_and_failed_buffers_count_as_lost_frames(emulated: None) -> None:
    driver = BaslerCamera(GenicamOptions(**OPTIONS, gain=6.0, pixel_format="Mono12"), CONFIG)
    camera = driver._camera
    camera.ExposureAuto.Value = camera.GainAuto.Value = "Continuous"
    driver._configure(GenicamOptions(**OPTIONS, gain=6.0, pixel_format="Mono12"))
    assert (camera.ExposureAuto.Value, camera.GainAuto.Value) == ("Off", "Off")
    assert (camera.Width.Value, camera.Height.Value, camera.OffsetX.Value, camera.OffsetY.Value) == (80, 60, 32, 16)
    assert (camera.Gain.Value, camera.TriggerMode.Value) == (pytest.approx(6.0, abs=0.1), "Off")
    assert (driver.settings().exposure_ns, driver.settings().period_ns) == (500_000, 5_000_000)
    camera.ForceFailedBufferCount.Value = 7
    camera.ForceFailedBuffer.Execute()
    expose = driver.expose

    def fail_later() -> Any:
        exposure = expose()
        if exposure is not None and exposure.number == 20:
            camera.ForceFailedBuffer.Execute()
        return exposure

    driver.expose = fail_later
    listener, counts = run(driver, 60)
    assert counts[-1] - 59 >= 7, "the seven buffers that fail after frame 20 count as lost"
    assert "FRAMES_LOST" in listener.events()
    pixels = np.frombuffer(listener.messages(FRAME)[0].data, "<u2")
    assert pixels.size == 60 * 80
    assert 255 < pixels.max() < 4096


@pytest.fixture
def fake_camera(request: pytest.FixtureRequest) -> Iterator[None]:
    """Aravis's fake camera on loopback; it loses 5 of 1000 packets, or the number given by the test."""
    program = shutil.which("arv-fake-gv-camera-0.8")
    if program is None:
        pytest.skip("needs arv-fake-gv-camera-0.8 (Debian: apt install aravis-tools)")
    try:
        library = aravis._aravis()
    except ConfigurationError as fault:
        pytest.skip(str(fault))
    arguments = [program, "-i", "127.0.0.1", "-s", "LOWFC", "-r", str(getattr(request, "param", 5))]
    with subprocess.Popen(arguments) as process:
        try:
            for _ in range(50):
                library.update_device_list()
                if library.get_n_devices():
                    break
                time.sleep(0.1)
            yield
        finally:
            process.kill()


@pytest.mark.aravis
@pytest.mark.filterwarnings("ignore:DynamicImporter:ImportWarning")
def test_an_aravis_camera_is_configured_and_incomplete_frames_count_as_lost(fake_camera: None) -> None:
    settings = {**OPTIONS, "rate_hz": 100.0, "camera": "127.0.0.1", "pixel_format": "Mono16"}
    driver = AravisCamera(GenicamOptions(**settings, gain=2.0), CONFIG)
    driver._camera.set_gain_auto(driver._aravis.Auto.CONTINUOUS)
    driver._configure(GenicamOptions(**settings, gain=2.0))
    assert driver._camera.get_gain_auto() == driver._aravis.Auto.OFF
    region = driver._camera.get_region()
    assert (region.x, region.y, region.width, region.height) == (32, 16, 80, 60)
    assert (driver.settings().exposure_ns, driver.settings().period_ns) == (500_000, 10_000_000)
    assert driver._camera.get_gain() == 2.0
    listener, counts = run(driver, 250)
    assert counts[-1] > 249, "some frames are incomplete"
    assert counts == sorted(set(counts))
    assert listener.events()[:1] == ["STARTED"]
    assert "FRAMES_LOST" in listener.events()
    assert not any(name.startswith("DRIVER") for name in listener.events())
    assert all(need.found for need in AravisCamera.needs(GenicamOptions(**settings)))
    for wrong in ({"columns": 9999}, {"pixel_format": "Mono14"}, {"camera": "Nobody-7"}):
        with pytest.raises(ConfigurationError, match=r"^camera "):
            AravisCamera(GenicamOptions(**{**settings, **wrong}), CONFIG)


@contextmanager
def _newest_healths(run_id: str) -> Iterator[dict[str, wire.Health]]:
    """Newest Health of each process of a run, by name."""
    newest: dict[str, wire.Health] = {}

    def received(sample: Sample) -> None:
        health = wire.Health.FromString(sample.payload)
        newest[health.process] = health

    with closing(ZenohBus(open_run(run_id).links, Role.OPERATOR, HostClock())) as bus:
        bus.subscribe(HEALTH, received)
        yield newest


FAILING = """
from pathlib import Path
from lowfc.device.drivers.basler import BaslerCamera

class Failing(BaslerCamera):
    failed = 0

    def expose(self):
        exposure = super().expose()
        if exposure is not None and exposure.number // 20 > self.failed:
            self.failed += 1
            self._camera.ForceFailedBufferCount.Value = 1
            self._camera.ForceFailedBuffer.Execute()
        return exposure

    def close(self):
        super().close()
        Path("failed").write_text(str(self.failed))
"""
FAST = """
[camera]
rate_hz = 600
bit_depth = 12

[control]
start_mode = "closed"
tilt_gain = 0.2
gain = 0.05

[drivers.failing]
rows = 80
columns = 80
pixel_format = "Mono12"
"""


@pytest.mark.basler
@pytest.mark.exclusive
def test_a_closed_loop_counts_every_failed_buffer(emulated: None, tmp_path: Path, own_runtime: Path) -> None:
    """One failed buffer in twenty at 600 Hz; the emulation's images are no sensor frames, so the loop refuses some."""
    (tmp_path / "failing.py").write_text(FAILING)
    (tmp_path / "bench.toml").write_text(FAST)
    arguments = "--run failing --config bench.toml"
    with (
        _newest_healths("failing") as health,
        in_background(tmp_path, f"lowfc controller {arguments}", f"lowfc mirror sim {arguments}"),
    ):
        until(lambda: {"controller", "mirror-dm"} <= set(health))
        with in_background(tmp_path, f"lowfc camera failing.py:Failing {arguments}"):
            until(lambda: "camera" in health and health["camera"].state == "running")
            time.sleep(5)
        until(lambda: health["camera"].state == "stopped")
        time.sleep(1.0)  # wait for a Health of the controller after the last frame
        with Client("failing") as client:
            status = client.status().state
    (sent,) = (count for count in health["camera"].topics if count.topic == FRAME.key)
    (received,) = (count for count in health["controller"].topics if count.topic == FRAME.key)
    refusals = (wire.REASON_LATE, wire.REASON_SATURATED, wire.REASON_DARK, wire.REASON_STUCK)
    refused = sum(entry.count for entry in status.counts if entry.reason in refusals)
    failed = int((tmp_path / "failed").read_text())
    assert sent.missing == received.missing >= failed - 1  # the last failure may come after the last frame
    assert failed > sent.published // 25
    assert sent.published - sent.missing == received.received
    assert received.received - received.skipped == status.frames_used + refused


@pytest.mark.basler
def test_a_camera_that_gets_no_trigger_reports_the_wait_and_ends_at_ctrl_c(
    emulated: None, tmp_path: Path, own_runtime: Path
) -> None:
    options = "--rows 60 --columns 80 --trigger Line1 --camera 0815-0001"
    process = start(tmp_path, "camera", "basler", "--run", "dark", *options.split())
    try:
        lines = [process.stderr.readline() for _ in range(2)]
    finally:
        _, stderr = interrupt(process)
    assert lines == ["camera: ready (run dark)\n", "camera: waiting for the camera's first frame (run dark)\n"]
    assert "after 0 frames: SIGINT" in stderr
    assert process.returncode in (0, 130)


PLAYING = """
from lowfc.device.drivers.basler import BaslerCamera

class Playing(BaslerCamera):
    def start(self):
        self._camera.ImageFilename.Value, self._camera.ImageFileMode.Value = "images", "On"
        self._camera.TestImageSelector.Value = "Off"
        super().start()
"""


@pytest.mark.basler
@pytest.mark.exclusive
def test_a_16_bit_basler_camera_passes_conformance(emulated: None, tmp_path: Path, own_runtime: Path) -> None:
    """Pylon plays 16-bit images of a spot; its own test images have 8 bits in any format."""
    (tmp_path / "playing.py").write_text(PLAYING)
    (tmp_path / "images").mkdir()
    y, x = np.mgrid[:80, :80]
    spot = 100 + 20_000 * np.exp(-((y - 40) ** 2 + (x - 38) ** 2) / 200)
    for number in range(20):
        pixels = np.random.default_rng(number).poisson(spot).astype(np.uint16)
        Image.fromarray(pixels).save(tmp_path / f"images/{number:02}.png")
    _conforms(tmp_path, "playing.py:Playing", 'pixel_format = "Mono16"\n', rate_hz=500)


@pytest.mark.aravis
@pytest.mark.exclusive
@pytest.mark.parametrize("fake_camera", [0], indirect=True)
def test_an_aravis_camera_passes_conformance(fake_camera: None, tmp_path: Path, own_runtime: Path) -> None:
    _conforms(tmp_path, "aravis", 'camera = "127.0.0.1"\npixel_format = "Mono16"\n', rate_hz=100)


def _conforms(folder: Path, driver: str, options: str, rate_hz: float) -> None:
    exposure = "exposure_fraction = 0.25\n"
    (folder / "bench.toml").write_text(
        f"[camera]\nrate_hz = {rate_hz}\n{exposure}"
        f"[drivers.{plugins.section(driver)}]\nrows = 80\ncolumns = 80\n{options}"
    )
    arguments = "--run vendor --config bench.toml"
    with _newest_healths("vendor") as health, in_background(folder, f"lowfc camera {driver} {arguments}"):
        until(lambda: "camera" in health and health["camera"].state == "running")
        results = json.loads(command(folder, f"lowfc conformance camera {arguments} --json"))
    wrong = [check for check in results["checks"] if check["status"] == "wrong"]
    assert not wrong
