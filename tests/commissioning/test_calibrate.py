"""Calibration of a whole loop in one process: what is measured, what befalls it, and what it promises."""

import contextlib
import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.client import Answer, mirror_watch
from lowfc.contract.configuration import FIXED_GAINS, Configuration, load
from lowfc.contract.errors import BusError, CalibrationError, DataFileError
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import EVENT, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.response_fit import Initial, Sums, cross_talk
from lowfc.programs.commissioning.calibrate import pokes, recording
from lowfc.programs.commissioning.calibrate.pokes import CalibrationRequest
from lowfc.programs.commissioning.calibrate.result import measured_calibration
from lowfc.programs.commissioning.calibrate.run import CalibrationData, Calibrator, go_on, keep, partial_of
from tests.support.folded_loop import SMALL_MIRROR, FoldedLoop

OUT = Path("night.fits")
BRIGHT = (
    FIXED_GAINS
    | SMALL_MIRROR
    | {
        "sensor.sam": "sam27d10_bal14",
        "star.magnitude": 0.0,
        "disturbance.preset": "quiet",
        "camera.instants": 1,  # of a quiet wavefront one image is as good as the mean of two
    }
)


def configured(**changes: object) -> Configuration:
    return load(None, BRIGHT | {key.replace("__", "."): value for key, value in changes.items()})


FEW = {"sensor.modes": 3}
"""Modes, for what does not hang on their number: a cycle is short."""
STILL = FEW | {"camera.noise": False}
"""For what does not hang on noise either: a frame takes half the time."""


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pokes, "DELAY_FRAMES", 240)


def ignore(*told: object) -> None:
    pass


Strike = Callable[[Any], object]


def of(
    loop: FoldedLoop, method: str, cycles: int = 4, *, report: Callable[[str], None] = ignore, **more: Any
) -> Calibrator:
    wanted = CalibrationRequest(method, **{"out": OUT, "snr": 50.0, "cycles": cycles, **more})
    return Calibrator(loop, wanted, report, ignore)


def taken_of(loop: FoldedLoop, method: str, cycles: int = 4, **wanted: Any) -> tuple[Calibrator, CalibrationData]:
    calibrator = of(loop, method, cycles, **wanted)
    with calibrator.holding():
        return calibrator, calibrator.run()


def mode_of(loop: FoldedLoop) -> int:
    state = loop.status().state
    return state.mode


def calibrated(loop: FoldedLoop, method: str, cycles: int) -> tuple[Calibration, CalibrationData]:
    calibrator, taken = taken_of(loop, method, cycles)
    made, _ = measured_calibration(
        loop.config, calibrator.before, taken.measured, CalibrationRequest(method, OUT, 50.0)
    )
    return made, taken


@pytest.mark.parametrize(
    ("method", "delay", "modes", "lost"),
    [
        pytest.param("hadamard", 1.0, 14, False, marks=pytest.mark.slow),
        ("hadamard", 1.5, 3, True),
        ("poke", 1.5, 3, False),
        pytest.param("in-loop", 2.0, 6, False, marks=pytest.mark.slow),
    ],
)
def test_what_is_measured_reads_the_true_modes(method: str, delay: float, modes: int, lost: bool) -> None:
    """Lost frames cost only themselves."""
    config = configured(camera__delay_frames=delay, sensor__modes=modes)
    loop = FoldedLoop(config, lose=lambda index: lost and index > 300 and index % 41 == 0)
    if method == "in-loop":
        loop.close_loop()
        loop.run(30)
    before = loop.calibration()
    made, taken = calibrated(loop, method, 4)
    assert abs(taken.delay.delay_frames - delay) < 0.05
    assert taken.measured.error.max() < 0.02
    talk = np.abs(cross_talk(made.reconstructor, before.response))
    assert (talk - 4 * taken.measured.error[:, None]).max() < 0.02
    assert np.allclose(made.actuators_to_modes @ made.modes_to_actuators, np.eye(len(made.noll)), atol=1e-4)
    close = made.actuators_to_modes - before.actuators_to_modes
    assert np.linalg.norm(close) < 0.1 * np.linalg.norm(before.actuators_to_modes)
    assert made.id != before.id
    assert made.estimator == f"weighted+{method}"


def closed(config: Configuration, calibration: Calibration, frames: int, world: Configuration) -> np.ndarray:
    """True residual (frames, modes) of the second half of a closed loop."""
    loop = FoldedLoop(config, calibration, world)
    loop.close_loop()
    loop.run(frames)
    return loop.residual_nm(frames // 2)


def test_a_loop_on_the_measured_calibration_is_as_good_as_on_the_computed_one() -> None:
    loop = FoldedLoop(configured(**FEW))
    made, _ = calibrated(loop, "hadamard", 4)
    shaken = configured(**FEW, disturbance__preset="bench")
    of_computed, of_measured = (closed(shaken, each, 300, shaken) for each in (loop.calibration(), made))
    one, other = (np.sqrt((each**2).sum(axis=1).mean()) for each in (of_computed, of_measured))
    assert abs(other / one - 1) < 0.05


def test_a_mirror_with_dead_actuators_and_another_scale_calibrates_and_closes() -> None:
    dead = [40, 53, 66, 91, 104]
    active = np.ones(12 * 12)
    active[dead] = 0
    np.save("active.npy", active.reshape(12, 12))
    config = configured(**STILL, mirror__active="active.npy")
    true = {"mirror__dead": dead, "mirror__magnification": 1.01, "mirror__shift_pitches": 0.1}
    loop = FoldedLoop(config, world=configured(**STILL, **true))
    made, taken = calibrated(loop, "hadamard", 4)
    assert of(loop, "hadamard", 4).pokes.amplitude_nm <= 3
    assert not made.modes_to_actuators[dead].any()
    assert not made.actuators_to_modes[:, dead].any()
    wrong = cross_talk(loop.calibration().reconstructor, taken.measured.response)
    assert np.abs(wrong).max() > 0.02  # the computed calibration does not know of it
    shaken = configured(**STILL, **true, disturbance__static_nm={"2": 10.0, "4": -6.0})
    settled = closed(config, made, 200, shaken).mean(axis=0)
    assert np.abs(settled).max() < 0.5


def test_a_reference_that_is_not_flat_is_held() -> None:
    state = {"3": -10.0, "4": 15.0}
    config = configured(**STILL)
    loop = FoldedLoop(config, world=configured(**STILL, disturbance__static_nm=state))
    made, _ = calibrated(loop, "hadamard", 4)
    zero = loop.residual_nm(0, 1)[0]
    moved = configured(**STILL, disturbance__static_nm={"2": 20.0, "3": -10.0, "4": 35.0})
    off = closed(config, made, 200, moved).mean(axis=0) - zero
    assert np.abs(off).max() < 0.02 * 20.0


def test_a_closed_loop_is_opened_for_pokes_and_closed_again() -> None:
    loop = FoldedLoop(configured(**FEW))
    with pytest.raises(CalibrationError, match="the loop is open: `lowfc ctl close` first"):
        taken_of(loop, "in-loop", 4)
    loop.close_loop()
    calibrator = of(loop, "poke", 4)
    modes = []
    with calibrator.holding():
        modes.append(mode_of(loop))
    assert [*modes, mode_of(loop)] == [wire.LOOP_MODE_OPEN, wire.LOOP_MODE_CLOSED]
    with pytest.raises(CalibrationError, match="failed"), calibrator.holding():
        raise CalibrationError("failed")
    assert mode_of(loop) == wire.LOOP_MODE_CLOSED
    loop.ask("safe")
    with pytest.raises(CalibrationError, match="must be open or closed"), calibrator.holding():
        pass


def test_cycles_that_cannot_be_read_are_a_line() -> None:
    path = partial_of(OUT)
    keep(path, Sums.none(Initial(np.zeros((2, 4)), "weighted")), {"method": "poke"})
    whole = path.read_bytes()
    one = io.BytesIO()
    np.save(one, np.zeros(3))
    for damaged in (b"", whole[: len(whole) // 2], one.getvalue()):
        path.write_bytes(damaged)
        with pytest.raises(DataFileError, match="is damaged or not from a calibration") as caught:
            go_on(path, {"method": "poke"})
        assert "\n" not in str(caught.value)


def test_what_cannot_be_calibrated_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "ATTEMPTS", 2)
    blind = FoldedLoop(configured(**FEW), world=configured(**FEW, mirror__dead=list(range(12 * 12))))
    with pytest.raises(CalibrationError, match="pokes are not seen"):
        taken_of(blind, "hadamard", 4)
    loop = FoldedLoop(configured(**FEW))
    with pytest.raises(CalibrationError, match="at most 3 nm of each"):
        of(loop, "hadamard", 4, amplitude_nm=5.0)
    with pytest.raises(CalibrationError, match="slew limit; at most"):
        of(loop, "poke", 4, amplitude_nm=500.0)
    lossy = FoldedLoop(configured(**FEW), lose=lambda index: index % 50 == 49)
    with pytest.raises(CalibrationError, match="in 2 attempts there were no 240 consecutive frames"):
        taken_of(lossy, "hadamard", 4)


class Struck(FoldedLoop):
    """Something happens to a device in the middle of some of the plays, and something else 20 frames later.

    Attributes:
        begun: frame at which each play began.
    """

    def __init__(
        self, strikes: Mapping[int, tuple[Strike, Strike]], before_the_end: int | None = None, **changes: Any
    ) -> None:
        """What strikes and what heals, by the number of the play; so many frames before its end, or after 50."""
        self.begun: list[int] = []
        self._strikes, self._before_the_end = strikes, before_the_end
        self._due: dict[int, Strike] = {}
        super().__init__(configured(**STILL, **changes))

    def play(self, basis_nm: npt.ArrayLike, table: npt.ArrayLike) -> Answer:
        given = super().play(basis_nm, table)
        self.begun.append(len(self.surfaces_nm))
        if len(self.begun) in self._strikes:
            after = 50 if self._before_the_end is None else len(np.asarray(table)) - self._before_the_end
            for wait, happens in zip((after, after + 20), self._strikes[len(self.begun)], strict=True):
                self._due[self.begun[-1] + wait] = happens
        return given

    def expose(self) -> None:
        super().expose()
        self._due.get(len(self.surfaces_nm), ignore)(self)


def kill_mirror(loop: FoldedLoop) -> None:
    loop.mirror_bus.close()


def expire(loop: FoldedLoop) -> None:
    event = EVENTS["COMMAND_EXPIRED"].log("mirror-dm", 0, command_timeout_ms=200.0, action="relaxing to flat")
    loop.mirror_bus.publisher(EVENT).put(event.SerializeToString())


def restart_camera(loop: FoldedLoop) -> None:
    loop.first += 5 << 32


def test_what_is_played_while_a_device_restarts_is_given_up_at_once_and_played_again() -> None:
    strikes = {1: (kill_mirror, FoldedLoop.start_mirror), 3: (expire, ignore), 5: (restart_camera, ignore)}
    loop, said = Struck(strikes), list[str]()
    calibrator = of(loop, "hadamard", report=said.append)
    with calibrator.holding():
        taken = calibrator.run()
    again = [one for one in said if re.match("once more|a cycle is repeated", one)]
    for one, why in zip(
        again,
        (
            "once more: the mirror 'dm' restarted during the pokes",
            r"repeated: mirror-dm was .* \(COMMAND_EXPIRED .* relaxing to flat\) during the pokes",
            "repeated: the camera restarted during the pokes",
        ),
        strict=True,
    ):
        assert re.search(why, one)
    assert (len(loop.begun), loop.stops) == (1 + 4 + 3, 3)
    for play in strikes:
        assert loop.begun[play] < loop.begun[play - 1] + 80, "it went on to its end"
    assert np.abs(cross_talk(loop.calibration().reconstructor, taken.measured.response)).max() < 0.05


def test_after_ctrl_c_the_mirror_is_where_it_was_and_the_cycles_done_are_kept() -> None:
    def interrupt(_: FoldedLoop) -> None:
        raise KeyboardInterrupt

    loop = Struck({3: (interrupt, ignore)}, disturbance__static_nm={"4": 5.0})
    loop.close_loop()
    loop.run(50)
    loop.open_loop()
    loop.run(5)
    held = loop.surfaces_nm[-1]
    assert np.abs(held).max() > 1
    with pytest.raises(KeyboardInterrupt):
        taken_of(loop, "hadamard", 4)
    assert np.abs(loop.surfaces_nm[-1] - held).max() > 1
    loop.run(5)
    assert np.array_equal(loop.surfaces_nm[-1], held)
    assert loop.stops == 1
    kept = go_on(partial_of(OUT), {"method": "hadamard"})
    assert kept.cycles == 1
    _, taken = taken_of(loop, "hadamard", 4, resume=True)
    assert taken.measured.cycles == 4
    assert np.array_equal(loop.surfaces_nm[-1], held)
    with pytest.raises(DataFileError, match="its method is hadamard, now it is poke"):
        taken_of(loop, "poke", 4, resume=True)
    with pytest.raises(DataFileError, match="nothing to resume"):
        taken_of(loop, "poke", 4, out=Path("other.fits"), resume=True)


@pytest.mark.parametrize(
    ("strike", "why", "mode", "after"),
    [
        (lambda loop: loop.ask("safe"), "the loop went from open to safe", wire.LOOP_MODE_SAFE, "close refused"),
        (lambda loop: loop.ask("open", lease_id=0), "operator asked to open", wire.LOOP_MODE_OPEN, ""),
    ],
    ids=["safe", "open"],
)
def test_what_another_operator_asks_ends_a_calibration_and_has_the_last_word(
    strike: Callable[[FoldedLoop], None], why: str, mode: int, after: str
) -> None:
    loop, said = Struck({1: (strike, ignore)}), list[str]()
    loop.close_loop()
    calibrator = of(loop, "poke", report=said.append)
    reserved = loop.reserved("a test") if mode == wire.LOOP_MODE_OPEN else contextlib.nullcontext()
    with reserved, pytest.raises(CalibrationError, match=why), calibrator.holding():
        calibrator.run()
    assert mode_of(loop) == mode
    assert loop.stops == 1
    assert said[-1].startswith(f"warning: the loop was not closed again: {after}")


@pytest.mark.parametrize("before_the_end", [None, 3])
def test_a_mirror_that_died_ends_the_calibration(monkeypatch: pytest.MonkeyPatch, before_the_end: int | None) -> None:
    monkeypatch.setattr(mirror_watch, "SILENT_S", 0.0)
    loop, said = Struck({3: (kill_mirror, ignore)}, before_the_end), list[str]()
    calibrator = of(loop, "hadamard", report=said.append)
    with pytest.raises(BusError, match=r"no mirror state came .* is the mirror's process running"):
        calibrator.run()
    assert said[-1].startswith("a cycle is repeated: the mirror has not reported an applied command for 101 frames")
    assert go_on(partial_of(OUT), {"method": "hadamard"}).cycles == 1
