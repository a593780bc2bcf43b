"""Drivers as users write them: they are found by name, their options are validated, and loops run them."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from typer.testing import CliRunner

from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import CAMERA_STATE, FRAME
from lowfc.device import (
    CameraClock,
    CameraSettings,
    Configuration,
    DriverOptions,
    Exposure,
    Need,
    Single,
    geometry,
    plugins,
    run_camera,
)
from lowfc.device.camera_loop import CameraLoop
from lowfc.device.driver import CameraExtras
from lowfc.device.mirror_loop import protection_of
from lowfc.device.run import camera_beside
from lowfc.programs.commissioning.doctor.devices import device_checks
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener
from sim_camera.__main__ import app as sim_camera_app
from tests.support.loops import lowfc

GRID = (4, 5)
CONFIG = load(None, {"mirror.rows": GRID[0], "mirror.columns": GRID[1]})
MS_NS = 1_000_000


class Ramp:
    """Camera of 3 x 4 pixels whose level increases by 1 DN per frame."""

    class Options(DriverOptions):
        level: int = 7
        """Level before the first frame, DN."""
        ports: tuple[int, ...] = ()
        """A list."""
        binning: Literal[1, 2] | None = None

    def __init__(self, options: Options, config: Configuration) -> None:
        self.level, self.closed = options.level, False

    def settings(self) -> CameraSettings:
        return CameraSettings(3, 4, exposure_ns=2 * MS_NS, period_ns=4 * MS_NS, bit_depth=12)

    def expose(self) -> Exposure | None:
        self.level += 1
        return Exposure(np.full((3, 4), self.level, np.uint16))

    def close(self) -> None:
        self.closed = True


class IdleMirror:
    """Mirror that does nothing."""

    def __init__(self, options: DriverOptions, config: Configuration) -> None:
        self.geometry = geometry(config)

    def apply(self, actuators_nm: Single) -> None: ...

    def close(self) -> None: ...


def test_a_camera_publishes_what_its_driver_returns() -> None:
    clock = FakeClock()
    listener = Listener(clock, FRAME, CAMERA_STATE)
    driver = Ramp(Ramp.Options(), CONFIG)
    CameraLoop(driver, listener.service("camera"), frames=3).run()
    frames = listener.messages(FRAME)
    assert [frame.data for frame in frames] == [np.full((3, 4), level, np.uint16).tobytes() for level in (8, 9, 10)]
    assert {frame.timestamp.ToNanoseconds() for frame in frames} == {clock.now_ns()}
    state = listener.messages(CAMERA_STATE)[-1]
    assert (state.rows, state.columns, state.saturation_dn, state.exposure_ns) == (3, 4, 4095, 2 * MS_NS)
    assert driver.closed
    assert listener.events() == ["STARTED", "STOPPED"]


def test_the_tighter_of_driver_and_configured_limits_applies() -> None:
    driver = IdleMirror(DriverOptions(), load(None, {"mirror.rows": 4, "mirror.columns": 5, "mirror.slew_nm": 30.0}))
    assert protection_of(driver, CONFIG).limits.slew_nm == 30.0
    with pytest.raises(ConfigurationError, match=r"4 x 5 actuators; .* say 34 x 34"):
        protection_of(driver, Configuration())
    for step_nm in (-1.0, 1000.0, float("nan")):
        driver.geometry = replace(driver.geometry, step_nm=step_nm)
        with pytest.raises(ConfigurationError, match=f"smallest step is {step_nm:g} nm"):
            protection_of(driver, CONFIG)


def test_options_come_from_configuration_and_command_line() -> None:
    config = load(None, {"drivers.ramp.level": 3, "drivers.both.camera": {"level": 4}, "drivers.both.mirror": {}})
    assert plugins.opened("camera", "ramp", config, (), Ramp).level == 3
    assert plugins.opened("camera", "both:Class", config, (), Ramp).level == 4
    for table, arguments in (({"level": 3}, ("--level", "5", "--ports=[1, 2]")), ({"level": 5, "ports": [1, 2]}, ())):
        options = plugins.options(Ramp, table, arguments)
        assert (options.level, options.ports) == (5, (1, 2))
    assert plugins.options(Ramp, {}, ("--binning", "2")).binning == 2
    assert ("--binning <1|2>", "") in plugins.options_help(Ramp)
    assert plugins._parsed(("--total", "", "--stream=")) == {"total": "", "stream": ""}
    nested = load(None, {"drivers": {"package": {"module": {"level": 6}}}})
    assert plugins.opened("camera", "package.module:Class", nested, (), Ramp).level == 6
    for kind in plugins.KINDS:
        option_called_camera = {"camera": "a serial number, not the part for cameras"}
        config = load(None, {"drivers.basler": option_called_camera})
        assert plugins.table(config, kind, "basler") == option_called_camera
    for table, arguments, why in [
        ({"levle": 1}, (), "there is no 'levle'; there are level, ports, binning"),
        ({"level": 7, "camera": {"level": 1}}, (), "has options, or the parts camera and mirror"),
        ({"level": "7"}, (), "level = '7'"),
        ({}, ("--level", "x"), "level = 'x'"),
        ({}, ("level",), "--name value"),
        ({}, ("--level",), "--name value"),
    ]:
        with pytest.raises(ConfigurationError, match=why):
            plugins.options(Ramp, table, arguments)


def test_a_driver_is_found_by_entry_point_or_by_module_and_class(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert plugins.load("camera", "sim").__name__ == "SimulatedCamera"
    assert plugins.load("mirror", "sim").__name__ == "SimulatedMirror"
    (tmp_path / "beside_me.py").write_text("class Mine:\n    settings = expose = close = None\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert plugins.load("camera", "beside_me:Mine").__name__ == "Mine"
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/in_a_folder.py").write_text("class Mine:\n    settings = expose = close = None\n")
    assert plugins.load("camera", "folder/in_a_folder.py:Mine").__name__ == "Mine"
    assert plugins.section("folder/in_a_folder.py:Mine") == "in_a_folder"
    for name, why in [
        ("sin", "did you mean 'sim'"),
        ("beside_me:Other", "has no attribute 'Other'"),
        ("nowhere:X", "No module named 'nowhere'"),
    ]:
        with pytest.raises(ConfigurationError, match=why):
            plugins.load("camera", name)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        (
            "own_cdll.py",
            "import ctypes\n\nctypes.CDLL('libvendor.so')\n",
            r"OSError: libvendor.* \(own_cdll.py, line 3\)$",
        ),
        ("own_syntax.py", "x = 1\nclass\n", r"SyntaxError: invalid syntax \(own_syntax.py, line 2\)$"),
        ("own_import.py", "import no_vendor\n", r"No module named 'no_vendor' \(own_import.py, line 1\)$"),
        ("own-name.py", "class Own: ...\n", "letters, digits and _, as in .*: rename the file"),
        ("own.name.py", "class Own: ...\n", "letters, digits and _, as in .*: rename the file"),
    ],
)
def test_a_driver_that_cannot_be_imported_gives_an_error_of_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, text: str, message: str
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / file).write_text(text)
    with pytest.raises(ConfigurationError, match=f"^the driver '.*' cannot be loaded: .*{message}"):
        plugins.load("camera", f"{tmp_path / file}:Own")


def test_driver_sections_of_a_configuration_are_checked(tmp_path: Path) -> None:
    (tmp_path / "mine.py").touch()
    good = {"drivers.sim": {"camera": {"fault": ""}}, "drivers.json": {"any": 1}, "drivers.mine.level": 1}
    assert plugins.faults(load(None, good | {"drivers.in_another_folder.level": 1}), tmp_path) == []
    bad = {"drivers.sim": {"camera": {"falt": ""}}, "drivers.sin.x": 1, "drivers.my/file": {"x": 1}}
    unknown_option, unknown_driver, _ = plugins.faults(load(None, bad), tmp_path)
    assert "'falt'" in unknown_option
    assert "did you mean 'sim'" in unknown_driver
    (misplaced_option,) = plugins.faults(load(None, {"drivers.sim.rows": 40}), tmp_path)
    assert "belong in [drivers.sim.camera] or [drivers.sim.mirror]" in misplaced_option


class RequiredOption(Ramp):
    class Options(DriverOptions):
        frame_rows: int


OWN = '''
from typing import Literal
from lowfc.device import DriverOptions

class Own:
    class Options(DriverOptions):
        peak_dn: int = 8000
        """Brightest pixel."""
        serial: str
        wait_s: float | None = None
        mode: Literal["slow", "fast"] | None = None
        config: str = ""

    settings = expose = apply = close = None
'''


@pytest.mark.parametrize("kind", ["camera", "mirror"])
def test_the_help_lists_the_drivers_options(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "own_driver.py").write_text(OWN)
    arguments = [kind, "--run", "bench", f"{tmp_path}/own_driver.py:Own", "--help"]
    *_, heading, peak, serial, wait, mode = lowfc(*arguments).output.rstrip().splitlines()
    assert heading == f"Options of the driver {arguments[3]}:"
    assert " ".join(peak.split()) == "--peak-dn <int> Brightest pixel. [default: 8000]"
    assert serial.split() == ["--serial", "<str>", "[required]"]
    assert (wait.split(), mode.split()) == (["--wait-s", "<float>"], ["--mode", "<slow|fast>"])
    assert "Options of the driver" not in lowfc(kind, "--help").output
    assert "--rows <int>" in lowfc("camera", "sim", "-h").output
    assert "--rows <int>" in CliRunner().invoke(sim_camera_app, ["-h"]).output


def test_doctor_checks_the_requirements_of_a_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = [Need("a cable", "cable 7", ""), Need("a camera", "", "switch it on")]
    monkeypatch.setattr(Ramp, "needs", lambda options: needs, raising=False)
    monkeypatch.setattr(plugins, "load", lambda kind, name: Ramp)
    checks = list(device_checks("sim", load(None, {"drivers.sim.mirror": {"levle": 1}})))
    assert [f"{check.name} {check.status}" for check in checks] == [
        *("camera sim ok", "camera sim: a cable ok", "camera sim: a camera wrong", "mirror sim wrong")
    ]
    assert [check.advice for check in checks[1:3]] == ["", "switch it on"]
    assert "[drivers.sim.mirror] of a configuration" in checks[3].advice


def test_doctor_reports_a_fault_in_the_requirements_of_a_users_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(IdleMirror, "needs", lambda options: 1 / 0, raising=False)
    checks = list(device_checks(f"{__name__}:IdleMirror", CONFIG))
    assert [f"{check.name.split()[0]} {check.status}" for check in checks] == ["mirror ok", "mirror wrong"]
    assert "requirements cannot be checked: ZeroDivisionError" in checks[1].got
    (missing_option,) = device_checks(f"{__name__}:RequiredOption", CONFIG)
    assert f"[drivers.{__name__}]" in missing_option.advice


def test_doctor_shows_what_a_driver_found_as_text(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = [Need("a device", Path("/dev/mirror"), ""), ("a fan", 2, ""), Need("a licence", None, "buy it")]
    monkeypatch.setattr(IdleMirror, "needs", lambda options: needs, raising=False)
    _, *checks = device_checks(f"{__name__}:IdleMirror", CONFIG)
    assert [check.got for check in checks] == ["/dev/mirror", "2", "not found"]
    monkeypatch.setattr(IdleMirror, "needs", lambda options: "a licence", raising=False)
    assert "requirements cannot be checked: TypeError" in [*device_checks(f"{__name__}:IdleMirror", CONFIG)][1].got


def test_a_factory_without_a_name_can_be_a_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    factory = partial(Ramp)
    monkeypatch.setattr(plugins, "load", lambda kind, name: factory)
    assert [check.got for check in device_checks("basler", CONFIG)] == ["functools:partial"]
    with pytest.raises(ConfigurationError, match="options of the driver: there is no 'x'"):
        plugins.options(factory, {"x": 1})


class FailingSettings(Ramp):
    def settings(self) -> CameraSettings:
        raise RuntimeError("no link")


class FailingInit(Ramp):
    def __init__(self, options: DriverOptions, config: Configuration) -> None:
        raise ValueError("serial 7 is not there")


class UncheckedOptions(Ramp):
    class Options:
        level: int = 7


class Incomplete:
    """A driver without two of the required methods."""

    def expose(self) -> None:
        """Return nothing."""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere/half.py:Half", "there is no file nowhere/half.py"),
        (f"{'a' * 300}.py:Half", "File name too long"),
        (f"{__name__}:RequiredOption", "frame_rows is missing: --frame-rows VALUE, or frame_rows in"),
        (f"{__name__}:UncheckedOptions", "derive its class Options from lowfc.device.DriverOptions"),
        (f"{__name__}:Incomplete", "is no camera: it has no settings and no close"),
        (
            f"{__name__}:FailingInit",
            r"cannot be opened: ValueError: serial 7 is not there \(test_drivers.py, line \d+\)",
        ),
    ],
)
def test_a_driver_that_cannot_be_opened_gives_an_error_of_one_sentence(name: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        plugins.opened("camera", name, CONFIG)


def test_a_fault_in_the_first_settings_gives_an_error_of_one_sentence() -> None:
    camera = FailingSettings(FailingSettings.Options(), CONFIG)
    message = r"the camera cannot be started: RuntimeError: no link \(test_drivers.py, line \d+\)"
    # run_camera changes the scheduling class of its thread, which ends with the test
    with ThreadPoolExecutor(1) as thread, pytest.raises(ConfigurationError, match=message):
        thread.submit(run_camera, camera, CONFIG, "unset").result()
    assert camera.closed


def test_a_camera_that_cannot_be_started_gives_an_error_of_one_sentence_and_is_closed() -> None:
    camera = Ramp(Ramp.Options(), CONFIG)
    camera.start = lambda: 1 / 0
    loop = CameraLoop(camera, Listener(FakeClock()).service("camera"))
    with pytest.raises(ConfigurationError, match=r"cannot be started: ZeroDivisionError: .* \(test_drivers.py, line"):
        loop.run()
    assert camera.closed


def test_a_camera_finishes_before_its_last_health_and_is_closed_after_it() -> None:
    camera, calls = Ramp(Ramp.Options(), CONFIG), list[str]()
    for name in ("finish", "close"):
        setattr(camera, name, partial(calls.append, name))
    camera.fill = lambda _: calls.append("fill")
    CameraLoop(camera, Listener(FakeClock()).service("camera"), frames=3).run()
    assert calls[-3:] == ["finish", "fill", "close"]
    assert calls.count("finish") == 1


def test_a_fault_in_an_optional_method_is_counted_and_reported_and_does_not_stop_the_camera() -> None:
    camera, listener = Ramp(Ramp.Options(), CONFIG), Listener(FakeClock(), FRAME)
    camera.sent = lambda _: 1 / 0
    camera.fill = lambda _: {}["temperature"]
    loop = CameraLoop(camera, listener.service("camera"), frames=3)
    loop.run()
    assert len(listener.messages(FRAME)) == 3
    assert loop.watch.failures > 3
    assert {"DRIVER_FAILED"} < set(listener.events())
    assert camera.closed


def test_lockstep_refuses_a_camera_in_the_controllers_process() -> None:
    controller = Listener(FakeClock()).service("controller")
    beside = camera_beside(Ramp(Ramp.Options(), CONFIG), load(None, {"lockstep": True}), controller)
    with pytest.raises(ConfigurationError, match="leave out --camera, or lockstep"), beside:
        pass


class RampWithExtras(Ramp, CameraExtras):
    """The ramp with the default of every optional method."""


@pytest.mark.parametrize("kind", [Ramp, RampWithExtras])
def test_lockstep_refuses_a_camera_that_does_not_wait_for_the_mirror(kind: type[Ramp]) -> None:
    camera = kind(Ramp.Options(), CONFIG)
    with pytest.raises(ConfigurationError, match="in lockstep a camera waits for the mirror"):
        run_camera(camera, load(None, {"lockstep": True}), "none")
    assert camera.closed


def test_options_in_a_section_named_after_the_class_are_refused() -> None:
    config = load(None, {"drivers.Ramp.level": 3})
    with pytest.raises(ConfigurationError, match=rf"are in \[drivers.{__name__}\], got \[drivers.Ramp\]"):
        plugins.opened("camera", f"{__name__}:Ramp", config)


def test_times_of_the_cameras_clock_are_converted_within_0_3_ms() -> None:
    """The camera's clock is slow by 30 ppm, and the camera pauses for an hour.

    A transfer takes 0.2 ms, which the converter cannot know, plus an exponential delay of mean 0.5 ms.
    """
    clock, rng = CameraClock(), np.random.default_rng(1)
    errors_ns = []
    minute = np.arange(10**15, 10**15 + 60 * 10**9, 10**7)
    for end_ns in [*minute.tolist(), *(minute + 3600 * 10**9).tolist()]:
        stamp_ns = round((end_ns - 10**15) * (1 - 30e-6)) + 77
        received_ns = end_ns + 200_000 + int(rng.exponential(500_000))
        errors_ns.append(clock.monotonic_ns(stamp_ns, received_ns) - end_ns)
    for settled_errors_ns in (errors_ns[100:6000], errors_ns[6100:]):
        assert max(map(abs, settled_errors_ns)) < 300_000
    assert min(errors_ns[6000:]) > -300_000, "the offsets before the pause are not used after it"
    assert clock.monotonic_ns(MS_NS, end_ns + 10**9) == end_ns + 10**9, "the camera's clock restarted"
