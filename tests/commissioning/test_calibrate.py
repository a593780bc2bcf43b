"""Calibration of a complete loop in one process: accuracy, interruptions and errors."""

import contextlib
import io
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.client import Answer, mirror_watch
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError, CalibrationError, DataFileError, RequestRefusedError
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import EVENT, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.response_fit import Initial, Sums, cross_talk
from lowfc.programs.commissioning.calibrate import pokes, recording
from lowfc.programs.commissioning.calibrate.pokes import CalibrationRequest
from lowfc.programs.commissioning.calibrate.result import measured_calibration
from lowfc.programs.commissioning.calibrate.run import CalibrationData, Calibrator, partial_path, resumed, store
from tests.support.in_process_loop import BRIGHT, InProcessLoop, configuration

OUT = Path("night.fits")
configured = partial(configuration, BRIGHT)
FEW = {"sensor.modes": 3}
"""Few modes give short cycles, for tests that do not depend on the number of modes."""
NOISELESS = FEW | {"camera.noise": False}
"""For tests that do not depend on noise: without noise, computing a frame takes half the time."""


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pokes, "DELAY_FRAMES", 240)
    monkeypatch.setattr(pokes, "HOLD", 2)


Action = Callable[[Any], object]


def ignore(*_: object) -> None:
    pass


def calibrator_of(
    loop: InProcessLoop, method: str, *, report: Callable[[str], None] = ignore, **options: Any
) -> Calibrator:
    request = CalibrationRequest(method, **{"out": OUT, "snr": 50.0, "cycles": 4, **options})
    return Calibrator(loop, request, report, ignore, loop.calibration())


def measure(loop: InProcessLoop, method: str, **options: Any) -> tuple[Calibrator, CalibrationData]:
    calibrator = calibrator_of(loop, method, **options)
    with calibrator.required_mode():
        return calibrator, calibrator.run()


def mode_of(loop: InProcessLoop) -> int:
    return loop.status().state.mode


def calibrated(loop: InProcessLoop, method: str) -> tuple[Calibration, CalibrationData]:
    calibrator, data = measure(loop, method)
    return measured_calibration(loop.config, calibrator.in_use, data.measured, calibrator.request)[0], data


@pytest.mark.parametrize(
    ("method", "delay_frames", "modes", "frames_lost"),
    [
        pytest.param("hadamard", 1.0, 14, False, marks=pytest.mark.slow),
        ("hadamard", 1.5, 3, True),
        ("poke", 1.5, 3, False),
        pytest.param("in-loop", 2.0, 6, False, marks=pytest.mark.slow),
    ],
)
def test_a_measured_calibration_reads_the_true_modes(
    monkeypatch: pytest.MonkeyPatch, method: str, delay_frames: float, modes: int, frames_lost: bool
) -> None:
    """The calibration is right for each method and delay; lost frames do not bias it."""
    monkeypatch.setattr(pokes, "HOLD", 4)
    config = configured(camera__delay_frames=delay_frames, sensor__modes=modes)
    loop = InProcessLoop(config, lose=lambda index: frames_lost and index > 300 and index % 41 == 0)
    if method == "in-loop":
        loop.close_loop()
        loop.run(30)
    before = loop.calibration()
    calibration, data = calibrated(loop, method)
    assert abs(data.delay.delay_frames - delay_frames) < 0.05
    assert data.measured.error.max() < 0.02
    talk = np.abs(cross_talk(calibration.reconstructor, before.response))
    assert (talk - 4 * data.measured.error[:, None]).max() < 0.02
    assert np.allclose(
        calibration.actuators_to_modes @ calibration.modes_to_actuators, np.eye(len(calibration.noll)), atol=1e-4
    )
    difference = calibration.actuators_to_modes - before.actuators_to_modes
    assert np.linalg.norm(difference) < 0.1 * np.linalg.norm(before.actuators_to_modes)
    for factor in (0.5, -2.0):  # the mirror moves half as far as its model, or twice as far and the other way
        scaled_response = data.measured._replace(response=factor * data.measured.response)
        scaled, _ = measured_calibration(loop.config, before, scaled_response, CalibrationRequest(method, OUT, 50.0))
        assert np.allclose(scaled.actuators_to_modes, calibration.actuators_to_modes, atol=1e-3)
    assert calibration.id != before.id
    assert calibration.estimator == f"weighted+{method}"
    # The fit may start from the provisional R of a commissioning; its result is not provisional.
    initial = data.measured.initial._replace(estimator=f"weighted+{method}+first")
    from_provisional = data.measured._replace(initial=initial)
    result, _ = measured_calibration(config, before, from_provisional, CalibrationRequest(method, OUT, 50.0))
    assert not result.provisional


def closed_residual_nm(config: Configuration, calibration: Calibration, world: Configuration) -> np.ndarray:
    """Mean true residual (modes,), nm, in the last 100 of 200 frames of a closed loop in the simulated `world`."""
    loop = InProcessLoop(config, calibration, world)
    loop.close_loop()
    loop.run(200)
    return loop.residual_nm(100).mean(axis=0)


def test_a_loop_whose_mirror_has_dead_actuators_and_misregistration_is_calibrated_and_closed() -> None:
    dead = [40, 53, 66, 91, 104]
    active = np.ones(12 * 12)
    active[dead] = 0
    np.save("active.npy", active.reshape(12, 12))
    config = configured(**NOISELESS, mirror__active="active.npy")
    true = {"mirror__dead": dead, "mirror__magnification": 1.01, "mirror__shift_pitches": 0.1}
    loop = InProcessLoop(config, world=configured(**NOISELESS, **true))
    calibration, data = calibrated(loop, "hadamard")
    assert calibrator_of(loop, "hadamard").pokes.amplitude_nm <= 3
    assert not calibration.modes_to_actuators[dead].any()
    assert not calibration.actuators_to_modes[:, dead].any()
    computed_talk = cross_talk(loop.calibration().reconstructor, data.measured.response)
    assert np.abs(computed_talk).max() > 0.02  # the computed calibration does not include the mirror's errors
    disturbed = configured(**NOISELESS, **true, disturbance__static_nm={"2": 10.0, "4": -6.0})
    assert np.abs(closed_residual_nm(config, calibration, disturbed)).max() < 0.5


def test_the_loop_holds_a_zero_point_that_is_not_flat() -> None:
    zero_point_nm = {"3": -10.0, "4": 15.0}
    config = configured(**NOISELESS)
    loop = InProcessLoop(config, world=configured(**NOISELESS, disturbance__static_nm=zero_point_nm))
    calibration, _ = calibrated(loop, "hadamard")
    zero_nm = loop.residual_nm(0, 1)[0]
    moved = configured(**NOISELESS, disturbance__static_nm={"2": 20.0, "3": -10.0, "4": 35.0})  # Z2, Z4: +20 nm
    difference_nm = closed_residual_nm(config, calibration, moved) - zero_nm
    assert np.abs(difference_nm).max() < 0.02 * 20.0


def test_a_closed_loop_is_opened_for_pokes_and_closed_afterwards() -> None:
    loop = InProcessLoop(configured(**FEW))
    with pytest.raises(CalibrationError, match="the loop is open: `lowfc ctl close` first"):
        measure(loop, "in-loop")
    loop.close_loop()
    calibrator = calibrator_of(loop, "poke")
    with calibrator.required_mode():
        assert mode_of(loop) == wire.LOOP_MODE_OPEN
    assert mode_of(loop) == wire.LOOP_MODE_CLOSED
    with pytest.raises(CalibrationError, match="failed"), calibrator.required_mode():
        raise CalibrationError("failed")
    assert mode_of(loop) == wire.LOOP_MODE_CLOSED
    loop.limit(0.1)
    with pytest.raises(CalibrationError, match=r"pokes \(MODAL_LIMIT\), .* `lowfc calibrate --amplitude`"):
        measure(loop, "in-loop")
    loop.ask("safe")
    with pytest.raises(CalibrationError, match="must be open or closed"), calibrator.required_mode():
        pass


def test_an_unreadable_file_of_cycles_gives_an_error_of_one_line() -> None:
    path = partial_path(OUT)
    store(path, Sums.none(Initial(np.zeros((2, 4)), "weighted")), {"method": "poke"})
    intact = path.read_bytes()
    other_array = io.BytesIO()
    np.save(other_array, np.zeros(3))
    for damaged in (b"", intact[: len(intact) // 2], other_array.getvalue()):
        path.write_bytes(damaged)
        with pytest.raises(DataFileError, match="is damaged or not from a calibration") as caught:
            resumed(path, {"method": "poke"})
        assert "\n" not in str(caught.value)


def test_errors_say_why_a_calibration_is_impossible(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "ATTEMPTS", 2)
    dead_mirror = InProcessLoop(configured(**FEW), world=configured(**FEW, mirror__dead=list(range(12 * 12))))
    with pytest.raises(CalibrationError, match="pokes are not seen"):
        measure(dead_mirror, "hadamard")
    loop = InProcessLoop(configured(**FEW))
    with pytest.raises(CalibrationError, match="at most 3 nm of each"):
        calibrator_of(loop, "hadamard", amplitude_nm=5.0)
    with pytest.raises(CalibrationError, match="slew limit; give at most"):
        calibrator_of(loop, "poke", amplitude_nm=500.0)
    lossy = InProcessLoop(configured(**NOISELESS), lose=lambda index: index % 50 == 49)
    with pytest.raises(CalibrationError, match="in 2 attempts there were no 240 consecutive frames"):
        measure(lossy, "hadamard")


class FaultyLoop(InProcessLoop):
    """A loop in which a device fails during some of the probe sequences, and recovers 20 frames later.

    Attributes:
        begun: frame at which each probe sequence began.
    """

    def __init__(
        self, faults: Mapping[int, tuple[Action, Action]], frames_before_end: int | None = None, **changes: Any
    ) -> None:
        """Inject `faults`: number of a probe sequence -> (fault, recovery).

        A fault occurs 50 frames after the start of the sequence, or `frames_before_end` frames before its end.
        """
        self.begun: list[int] = []
        self._faults, self._frames_before_end = faults, frames_before_end
        self._due: dict[int, Action] = {}
        super().__init__(configured(**NOISELESS, **changes))

    def play(self, basis_nm: npt.ArrayLike, table: npt.ArrayLike) -> Answer:
        answer = super().play(basis_nm, table)
        self.begun.append(len(self.surfaces_nm))
        if len(self.begun) in self._faults:
            after = 50 if self._frames_before_end is None else len(np.asarray(table)) - self._frames_before_end
            for wait, action in zip((after, after + 20), self._faults[len(self.begun)], strict=True):
                self._due[self.begun[-1] + wait] = action
        return answer

    def expose(self) -> None:
        super().expose()
        self._due.get(len(self.surfaces_nm), ignore)(self)


def kill_mirror(loop: InProcessLoop) -> None:
    loop.mirror_bus.close()


def expire_command(loop: InProcessLoop) -> None:
    event = EVENTS["COMMAND_EXPIRED"].log("mirror-dm", 0, command_timeout_ms=200.0, action="relaxing to flat")
    loop.mirror_bus.publisher(EVENT).put(event.SerializeToString())


def restart_camera(loop: InProcessLoop) -> None:
    loop.first += 5 << 32


def test_a_probe_sequence_during_a_device_restart_is_stopped_at_once_and_repeated() -> None:
    faults = {
        1: (kill_mirror, InProcessLoop.start_mirror),
        3: (expire_command, ignore),
        5: (restart_camera, ignore),
        7: (InProcessLoop.silence_camera, ignore),
    }
    loop, reports = FaultyLoop(faults), list[str]()
    calibrator = calibrator_of(loop, "hadamard", report=reports.append)
    with calibrator.required_mode():
        data = calibrator.run()
    repeated = [report for report in reports if re.match("the delay is measured again|a cycle is repeated", report)]
    for report, why in zip(
        repeated,
        (
            "again: the mirror 'dm' restarted during the pokes",
            r"repeated: mirror-dm was .* \(COMMAND_EXPIRED .* relaxing to flat\) during the pokes",
            "repeated: the camera restarted during the pokes",
            r"repeated: controller was without frames .* \(NO_FRAMES .* 60 ms; holding the command\) during the pokes",
        ),
        strict=True,
    ):
        assert re.search(why, report)
    assert (len(loop.begun), loop.stops) == (1 + 4 + 4, 4)  # 1 delay measurement, 4 cycles, 4 repetitions
    for number in faults:
        assert loop.begun[number] < loop.begun[number - 1] + 80, "a sequence ends soon after the fault in its frame 50"
    assert np.abs(cross_talk(loop.calibration().reconstructor, data.measured.response)).max() < 0.05


def lose_mirror(loop: InProcessLoop) -> None:
    kill_mirror(loop)
    loop.report_mirror("does not answer")


def test_a_probe_sequence_waits_until_the_controller_notices_that_a_restarted_mirror_follows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The mirror's state arrives before the controller reads the mirror's Health; until then `play` is refused."""
    loop, waited_s = FaultyLoop({1: (lose_mirror, InProcessLoop.start_mirror)}), list[float]()

    def wait(seconds: float) -> None:
        waited_s.append(seconds)
        if len(waited_s) == 2:
            loop.report_mirror("")

    monkeypatch.setattr(recording, "sleep", wait)
    _, data = measure(loop, "hadamard")
    assert len(waited_s) == 2
    assert data.measured.cycles == 4
    loop.report_mirror("refuses commands: STUCK")
    monkeypatch.setattr(recording, "FAULT_S", 0.0)
    with pytest.raises(RequestRefusedError, match="refuses commands: STUCK"):
        measure(loop, "hadamard")


def test_ctrl_c_restores_the_mirror_and_keeps_the_completed_cycles() -> None:
    loop = FaultyLoop({3: (Mock(side_effect=KeyboardInterrupt), ignore)}, disturbance__static_nm={"4": 5.0})
    loop.close_loop()
    loop.run(50)
    loop.open_loop()
    loop.run(5)
    before_nm = loop.surfaces_nm[-1]
    assert np.abs(before_nm).max() > 1
    with pytest.raises(KeyboardInterrupt):
        measure(loop, "hadamard")
    assert np.abs(loop.surfaces_nm[-1] - before_nm).max() > 1
    loop.run(5)
    assert np.array_equal(loop.surfaces_nm[-1], before_nm)
    assert loop.stops == 1
    kept = resumed(partial_path(OUT), {"method": "hadamard"})
    assert kept.cycles == 1
    _, data = measure(loop, "hadamard", resume=True)
    assert data.measured.cycles == 4
    assert np.array_equal(loop.surfaces_nm[-1], before_nm)
    with pytest.raises(DataFileError, match="method is hadamard in the file, but poke now"):
        measure(loop, "poke", resume=True)
    with pytest.raises(DataFileError, match="nothing to resume"):
        measure(loop, "poke", out=Path("other.fits"), resume=True)


@pytest.mark.parametrize(
    ("action", "why", "mode", "cause"),
    [
        (lambda loop: loop.ask("safe"), "the loop went from open to safe", wire.LOOP_MODE_SAFE, "close refused"),
        (lambda loop: loop.ask("open", lease_id=0), "operator asked to open", wire.LOOP_MODE_OPEN, ""),
    ],
    ids=["safe", "open"],
)
def test_another_operators_request_ends_a_calibration_and_stays_in_force(
    action: Callable[[InProcessLoop], None], why: str, mode: int, cause: str
) -> None:
    loop, reports = FaultyLoop({1: (action, ignore)}), list[str]()
    loop.close_loop()
    calibrator = calibrator_of(loop, "poke", report=reports.append)
    reserved = loop.reserved("a test") if mode == wire.LOOP_MODE_OPEN else contextlib.nullcontext()
    with reserved, pytest.raises(CalibrationError, match=why), calibrator.required_mode():
        calibrator.run()
    assert mode_of(loop) == mode
    assert loop.stops == 1
    assert reports[-1].startswith(f"warning: the loop was not closed again: {cause}")


@pytest.mark.parametrize("frames_before_end", [None, 3])
def test_a_dead_mirror_ends_the_calibration(monkeypatch: pytest.MonkeyPatch, frames_before_end: int | None) -> None:
    monkeypatch.setattr(mirror_watch, "DEFAULT_TIMEOUT_S", 0.0)
    loop, reports = FaultyLoop({3: (kill_mirror, ignore)}, frames_before_end), list[str]()
    calibrator = calibrator_of(loop, "hadamard", report=reports.append)
    with pytest.raises(BusError, match=r"no mirror state came .* is the mirror's process running"):
        calibrator.run()
    assert reports[-1].startswith("a cycle is repeated: the mirror has not reported an applied command for 101 frames")
    assert resumed(partial_path(OUT), {"method": "hadamard"}).cycles == 1
