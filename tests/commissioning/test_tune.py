"""`lowfc tune` on a log computed by the controller's `advance`: results, files and errors; and law files."""

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
from astropy.io import fits

from lowfc.adapters.files import law_file
from lowfc.adapters.files.drawing import png
from lowfc.adapters.logs.reader import LogReader
from lowfc.client import Answer
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.codecs.law_codec import driving
from lowfc.contract.configuration import load
from lowfc.contract.errors import BusError, ConfigurationError, DataFileError, RequestRefusedError
from lowfc.contract.messages import CONTROLLER_STATE, TRUTH, wire
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.margins import check_stable
from lowfc.control.laws.tuning import Gains, Tuned
from lowfc.control.loop.inputs import Step
from lowfc.control.loop.safety import LoopMode
from lowfc.programs.commissioning.tune.command import apply_gains
from lowfc.programs.commissioning.tune.data import Telemetry, telemetry_from_log, telemetry_from_run
from lowfc.programs.commissioning.tune.result import result_of, tuned
from tests.support.in_process_loop import SMALL_MIRROR, InProcessLoop
from tests.support.loops import json_of, lowfc, refusal
from tests.support.report_log import SyntheticLog
from tests.support.theory import LAWS
from tests.support.toy import NOLL, PERIOD_NS, frame_sequence

KEYS = {"sensor.modes": 3, "camera.rate_hz": 1000, "control.tilt_gain": 0.4, "control.gain": 0.2}
CONFIG = load(None, KEYS | SMALL_MIRROR)
TunedAs = Callable[[str], tuple[Tuned, Gains]]


@pytest.fixture(scope="module")
def closed() -> SyntheticLog:
    return SyntheticLog().request("close").frames(3000)


@pytest.fixture(scope="module")
def log(closed: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return closed.write(tmp_path_factory.mktemp("night") / "night.mcap")


@pytest.fixture(scope="module")
def telemetry(log: Path) -> Telemetry:
    return telemetry_from_log(LogReader(log))


@pytest.fixture(scope="module")
def tuned_as(telemetry: Telemetry) -> TunedAs:
    return cache(partial(tuned, telemetry))


@pytest.mark.parametrize("controller", ["integrator", "pi-notch", "lqg"])
def test_each_law_is_tuned_from_a_closed_loop(telemetry: Telemetry, tuned_as: TunedAs, controller: str) -> None:
    """Tip is a sine of 12 nm at 7 Hz with noise: the line is found, and each law predicts a smaller residual."""
    best, gains = tuned_as(controller)
    result = result_of(telemetry, best, gains, controller)
    tip = result.modes[0]
    assert [line["frequency_hz"] for line in tip.lines] == pytest.approx([7.0], abs=0.05)
    assert tip.lines[0]["rms_nm"] == pytest.approx(12 / np.sqrt(2), rel=0.1)
    assert tip.gain_now == pytest.approx(0.4)
    assert tip.achieved_nm == pytest.approx(tip.predicted_now_nm, rel=0.15)
    assert tip.predicted_nm < tip.achieved_nm
    assert (result.closed, result.achieved_from, best.law.name) == (True, "truth", controller)
    check_stable(best.law, result.delay_frames)
    continuous = replace(telemetry, continuous_rms_nm=np.array(telemetry.noll, float))
    assert all(mode.achieved_nm == mode.noll for mode in result_of(continuous, best, gains, controller).modes)


def test_predictions_contain_the_part_of_a_constant_disturbance_that_a_leak_leaves(telemetry: Telemetry) -> None:
    pol = replace(telemetry.pol, values=tuple(piece + np.array([0, 0, 50]) for piece in telemetry.pol.values))
    run = replace(
        telemetry, pol=pol, integrator=replace(telemetry.integrator, leak=np.full(len(NOLL), 0.01, np.float32))
    )
    best, gains = tuned(run, "integrator")
    focus = result_of(run, best, gains, "integrator").modes[2]
    assert focus.predicted_nm == pytest.approx(gains.predicted_nm[2], rel=0.05)
    assert focus.predicted_now_nm == pytest.approx(50 * 0.01 / (0.01 + 0.2), rel=0.1)


def test_the_true_residual_in_continuous_time_is_read_from_the_log(tmp_path: Path) -> None:
    night = SyntheticLog()
    night.instants = 4  # the residual in continuous time is then twice that at the starts of exposures
    night.request("close").frames(2100)
    del night.samples[night.indices(TRUTH)[1200]]  # as if it were lost
    run = telemetry_from_log(LogReader(night.write(tmp_path / "night.mcap")))
    np.testing.assert_allclose(run.continuous_rms_nm, 2 * np.sqrt(np.diag(run.true_nm2)), rtol=1e-5)


def test_the_command_writes_the_law_and_draws_it_with_the_labels_of_the_page_and_the_power_of_narrow_lines(
    log: Path, telemetry: Telemetry, tuned_as: TunedAs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr("lowfc.adapters.files.drawing.png", lambda figure: drawn.append(figure) or png(figure))
    out, plot = tmp_path / "law.fits", tmp_path / "law.png"
    result = json_of("tune", log, "--controller", "lqg", "--out", out, "--plot", plot)
    assert result["files"] == [str(out), str(plot)]
    assert plot.read_bytes()[:4] == b"\x89PNG"
    best, gains = tuned_as("lqg")
    assert law_file.load(out).id == best.law.id
    page = " ".join((Path(__file__).parents[2] / "docs/howto/tuning.md").read_text().split())
    curves = {line.get_label().split(" (")[0]: line.get_ydata() for line in drawn[0].axes[0].lines}
    assert [label for label in curves if f"the {label}" not in page] == []
    assert drawn[0].axes[0].get_ylabel() < drawn[0].axes[1].get_ylabel(), "modes in the order of their indexes"
    tip = result_of(telemetry, best, gains, "lqg").modes[0]
    spacing_hz = drawn[0].axes[0].lines[0].get_xdata()[0]
    for law, rms_nm in (("present", tip.predicted_now_nm), ("tuned", tip.predicted_nm)):
        variance_nm2 = curves[f"predicted true residual with the {law} law"].sum() * spacing_hz
        assert variance_nm2 == pytest.approx(rms_nm**2, rel=0.05)
    # The model's line is far narrower than the spacing of the drawn frequencies.
    assert curves["model of the pseudo-open-loop"].sum() == pytest.approx(curves["pseudo-open-loop"].sum(), rel=0.2)
    for axes in drawn[0].axes:
        assert axes.get_legend().get_window_extent().y0 >= axes.get_window_extent().y1  # above all lines


def test_the_result_is_printed_although_the_loop_refuses_the_law(
    log: Path, tuned_as: TunedAs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lowfc.programs.commissioning.tune.result.tuned", lambda _, controller: tuned_as(controller))
    monkeypatch.setattr("lowfc.client.the_run", lambda _: "bench")
    monkeypatch.setattr("lowfc.client.Client", Mock(side_effect=RequestRefusedError("another delay")))
    done = lowfc("tune", log, "--controller", "lqg", "--apply", "--json")
    assert str(done.exception) == "another delay"
    assert json.loads(done.stdout)["applied"] is None


@pytest.mark.parametrize(
    ("frames", "extent"), [(3000, "that of the last 2500 frames, theory is"), (1000, "that of all of")]
)
def test_the_residual_achieved_is_that_of_the_last_gains(
    closed: SyntheticLog, tmp_path: Path, frames: int, extent: str
) -> None:
    """Frames with earlier gains give pseudo-open-loop modes, but their errors do not follow the last law's theory."""
    night = closed.copy().request("gain", (0.1,) * 3).frames(frames)
    result = json_of("tune", night.write(tmp_path / "night.mcap"))
    tip = result["modes"][0]
    assert (tip["achieved_nm"] == pytest.approx(tip["predicted_now_nm"], rel=0.1)) is (frames == 3000)
    assert result["frames"] == 3000 - 500 + frames
    (warning,) = result["warnings"]
    assert warning.startswith(f"law or gains changed in these frames: the achieved residual is {extent}")


def test_an_offset_is_not_counted_as_disturbance_when_the_delay_is_measured(tmp_path: Path) -> None:
    """Without the true wavefront, the delay is measured from the mirror's reports: a frame more than assumed."""
    night = SyntheticLog(truth=False).request("close").frames(1500).request("offset", (0.0, 0.0, 20.0)).frames(1500)
    run = telemetry_from_log(LogReader(night.write(tmp_path / "night.mcap")))
    assert run.timing.delay == 2
    assert np.ptp(run.pol.joined()[:, 2]) < 10


def test_an_offset_or_a_channel_in_the_true_residual_is_reported(closed: SyntheticLog, tmp_path: Path) -> None:
    warning = "an offset or channels were in force: the achieved residual contains their shapes, theory does not"
    night = SyntheticLog().request("close").frames(100).request("offset", (0.0, 0.0, 20.0)).frames(2700)
    result = json_of("tune", night.write(tmp_path / "night.mcap"))
    assert result["modes"][2]["achieved_nm"] > 19
    assert result["warnings"] == [warning]
    night = closed.copy()
    night.change(CONTROLLER_STATE, -1, lambda state: state.channels.add(name="dark-hole"))
    assert telemetry_from_log(LogReader(night.write(tmp_path / "dark-hole.mcap"))).warnings == (warning,)


def test_a_loop_closed_for_too_few_frames_is_reported_as_partly_closed(tmp_path: Path) -> None:
    """Its achieved residual is not given, so there is no warning that the residual contains the offset."""
    night = SyntheticLog().request("open").frames(100).request("close").frames(100)
    night.request("offset", (0.0, 0.0, 20.0)).frames(1900)
    run = telemetry_from_log(LogReader(night.write(tmp_path / "night.mcap")))
    result = result_of(run, *tuned(run, "integrator"), "integrator")
    assert not result.closed
    assert "2100 frames at 1000 Hz, loop closed in 2000 of them, delay" in result.text()
    (warning,) = result.warnings
    assert "in closed loop at most 2000 good frames are consecutive, fewer than 2048" in warning


def test_a_loop_that_was_closed_for_just_enough_frames_and_then_opened_is_tuned_as_closed(tmp_path: Path) -> None:
    night = SyntheticLog().request("close").frames(2100).request("open").frames(400)
    result = json_of("tune", night.write(tmp_path / "night.mcap"))
    assert (result["closed"], result["frames"], result["warnings"]) == (True, 2048, [])


def test_a_reconstructor_with_a_prior_for_uncorrected_modes_is_reported_and_a_flat_map_is_not(
    closed: SyntheticLog, tmp_path: Path
) -> None:
    """The prior is the power of a mode without a gain. A gain for Z4 would remove it, and R would have more noise."""
    night = closed.copy()
    night.change(CONTROLLER_STATE, -1, lambda state: state.prior_nm2.extend([0, 0, 4]))
    night.change(CONTROLLER_STATE, -1, lambda state: state.channels.add(name="flat"))
    warnings = json_of("tune", night.write(tmp_path / "night.mcap"))["warnings"]
    assert ["modes that automatic gains do not correct (Z4)" in warning for warning in warnings] == [True]


def test_probe_sequences_affect_neither_the_tuning_nor_the_delay(tmp_path: Path) -> None:
    """During a probe sequence on the mirror, the true wavefront does not follow the loop's commands alone."""
    night = SyntheticLog().request("close").frames(100)
    shape = night.calibration.modes_to_actuators[:, 0]
    table = 20 * np.sin(2 * np.pi * 31 * np.arange(500) * PERIOD_NS * 1e-9).astype(np.float32)[:, None]
    night.request("play", text="mirror", actuators_nm=shape, table=table)
    night.frames(2900)
    result = json_of("tune", night.write(tmp_path / "played.mcap"))
    assert result["delay_frames"] == 1.0
    assert result["warnings"] == []
    assert result["frames"] < 2900
    assert [line["frequency_hz"] for line in result["modes"][0]["lines"]] == pytest.approx([7.0], abs=0.05)


def test_an_open_loop_with_much_tilt_gives_a_warning(tmp_path: Path) -> None:
    run = telemetry_from_log(LogReader(SyntheticLog().request("open").frames(2150).write(tmp_path / "open.mcap")))
    best = tuned(run, "integrator")
    result = result_of(run, *best, "integrator")
    assert not result.closed
    assert result.modes[0].achieved_nm is None
    assert result.warnings == []
    warned = result_of(replace(run, nm_per_mas=run.nm_per_mas / 10), *best, "integrator").text()
    assert "above 10: the optical gain of the sensor is low" in warned


PROBE = wire.Play(first_sequence=frame_sequence(3050), frames=100, id="probe")


class SteppedLoop(InProcessLoop):
    """A loop with these steps, whose mirror reports each command `report_periods` frame periods after the exposure.

    With a `later_gain`, the state at step 3100 is the only one with the probe sequence; it and all later ones have that
    gain.
    """

    lost, offset = 0, None  # number of steps that the client lost, and offset of the clock of the mirror's host

    def __init__(self, steps: list[Step], report_periods: float = 0.2, *, later_gain: float = 0.0) -> None:
        super().__init__(CONFIG)
        self.recorded, self.report_ns, self.later_gain = steps, round(report_periods * PERIOD_NS), later_gain
        self.requested = 0

    def steps(self, count: int | None = None, patience_s: float = 0.0) -> Any:
        stream = MagicMock(lost=self.lost)
        stream.__iter__.return_value = iter(self.recorded)
        return stream

    def status(self) -> Answer:
        answer = super().status()
        self.requested += 1
        if self.later_gain and self.requested == 1 + 31:  # once at the start, and then every 100 steps
            answer.state.play.CopyFrom(PROBE)
        if self.later_gain and self.requested > 31:
            answer.state.gain[:] = [self.later_gain] * 3
        return answer

    def mirror_watch(self) -> Any:
        applied = [(step.frame_sequence, step.time_ns + self.report_ns) for step in self.recorded[-1024:]]
        return SimpleNamespace(applied=applied, read=lambda: None, offset=self.offset)


def noisy_steps() -> list[Step]:
    """Steps with noise, and 20 Hz in tip; one step in a thousand is missing, one frame in a hundred was refused."""
    noise = np.random.default_rng(3).standard_normal((6000, 3)).astype(np.float32)
    noise[:, 0] += (10 * np.sin(2 * np.pi * 20 * np.arange(6000) * PERIOD_NS * 1e-9)).astype(np.float32)
    measured_nm = [None if index % 100 == 99 else row for index, row in enumerate(noise)]
    return [
        Step(frame_sequence(index), index * PERIOD_NS, LoopMode.CLOSED, np.zeros(3, np.float32), (), each, each)
        for index, each in enumerate(measured_nm)
        if index % 1000 != 500
    ]


def test_tuning_uses_the_steps_of_a_running_loop() -> None:
    """Missing and refused frames are interpolated; the first half second after closing is excluded."""
    loop = SteppedLoop(noisy_steps())
    loop.lost = 4
    loop.mirror_watch = Mock(side_effect=BusError("the mirror does not report"))
    run = telemetry_from_run(loop, 60.0)
    assert run.closed
    assert (run.source, run.noll, run.timing) == ("folded", NOLL, Timing.of(1.0, 0.5))
    assert run.rate_hz == pytest.approx(1000)
    assert run.warnings == ("4 steps lost between the controller and this program",)
    assert run.pol.frames == pytest.approx(5500, abs=5)

    result = result_of(run, *tuned(run, "lqg"), "lqg")
    values, text = result.json_object(), result.text()
    assert f"{values['modes'][0]['lines'][0]['frequency_hz']:.2f} Hz (" in text
    assert "tilt per axis, mas rms: open" in text
    assert values["modes"][0]["lines"][0]["frequency_hz"] == pytest.approx(20, abs=0.05)
    assert values["achieved_from"] == "error less noise"
    added = values["added_contrast"]
    assert 0 < added["predicted"] < added["open"]
    assert set(added["by_group"]["predicted"]) == {"tilt", "focus"}
    assert f"closed {added['closed']:+.1e}, predicted {added['predicted']:+.1e}; tilt contributes most (" in text


def test_the_mirrors_reports_give_the_time_at_which_commands_are_applied() -> None:
    """The mirror's clock is 2 frame periods behind the router's clock, and the camera's clock is 9 behind it."""
    loop = SteppedLoop(noisy_steps(), 7.2)
    loop.offset = SimpleNamespace(offset_ns=2 * PERIOD_NS)
    loop.processes = lambda: {"camera": wire.Health(router_offset_ns=9 * PERIOD_NS)}
    run = telemetry_from_run(loop, 60.0)
    assert (run.timing.delay, run.timing.applied) == (1.0, pytest.approx(0.7, abs=1e-3))


def closed_loop(disturbance_nm: np.ndarray, delay_frames: int) -> list[Step]:
    """Steps of a loop with this disturbance (frames, modes): commands are noise; the assumed delay is 1."""
    command_nm = np.random.default_rng(7).standard_normal(disturbance_nm.shape).astype(np.float32)
    error_nm = disturbance_nm + np.concatenate([np.zeros((delay_frames, 3), np.float32), command_nm[:-delay_frames]])
    pol_nm = error_nm - np.concatenate([np.zeros((1, 3), np.float32), command_nm[:-1]])
    return [
        Step(frame_sequence(index), index * PERIOD_NS, LoopMode.CLOSED, command_nm[index], (), error, pol)
        for index, (error, pol) in enumerate(zip(error_nm, pol_nm, strict=True))
    ]


@pytest.mark.parametrize(("report_periods", "delay_frames"), [(0.2, 1), (1.2, 2)])
def test_a_longer_delay_is_measured_on_a_running_loop(report_periods: float, delay_frames: int) -> None:
    disturbance_nm = np.random.default_rng(5).standard_normal((4000, 3)).astype(np.float32)
    run = telemetry_from_run(SteppedLoop(closed_loop(disturbance_nm, delay_frames), report_periods), 60.0)
    assert run.timing.delay == delay_frames
    assert run.pol.joined() == pytest.approx(disturbance_nm[-run.pol.frames :], abs=1e-4)
    warned = "the controller assumed a delay of 1 frame, but measured from the times of frames and mirror it is 2.00"
    assert [warning.startswith(warned) for warning in run.warnings] == [True] * (delay_frames - 1)


@pytest.mark.parametrize(("gain", "settling"), [(0.3, 500), (1 / 160, 800)])  # frames: 0.5 s, or five time constants
def test_probe_sequences_on_a_running_loop_are_excluded(gain: float, settling: int) -> None:
    """The loop settles again after the sequence."""
    disturbance_nm = np.random.default_rng(5).standard_normal((6000, 3)).astype(np.float32)
    disturbance_nm[3050 : 3050 + PROBE.frames] += 100
    run = telemetry_from_run(SteppedLoop(closed_loop(disturbance_nm, 1), later_gain=gain), 60.0)
    assert run.pol.frames == pytest.approx(6000 - settling - PROBE.frames - settling, abs=10)
    assert np.abs(run.pol.joined()).max() < 20
    assert run.integrator.gain == pytest.approx(gain), "the gains are the last ones"


def test_a_closed_loop_with_few_frames_after_half_a_second_is_not_called_open() -> None:
    disturbance_nm = np.random.default_rng(5).standard_normal((2300, 3)).astype(np.float32)
    run = telemetry_from_run(SteppedLoop(closed_loop(disturbance_nm, 1)), 60.0)
    assert (run.closed, run.pol.frames) == (True, 2048)


def test_a_too_short_live_time_is_refused_at_once() -> None:
    with pytest.raises(DataFileError, match=r"2048 consecutive frames, 2.05 s at 1000 Hz, but got 2 s: use --live 3"):
        telemetry_from_run(SteppedLoop([]), 2.0)


class RequestedLoop(InProcessLoop):
    """A loop that records the requests, and does not answer those whose number is in `unanswered`."""

    def __init__(self) -> None:
        self.requests: list[str] = []
        self.unanswered: tuple[int, ...] = ()
        super().__init__(CONFIG)

    def ask(self, name: str, modes: Any = (), values: Any = (), **fields: Any) -> Answer:
        if name != "status":
            self.requests.append(name)
            if len(self.requests) in self.unanswered:
                raise BusError("the controller did not answer")
        return super().ask(name, modes, values, **fields)

    def laws(self) -> dict[str, LinearLaw]:
        return {law.id: law for law in LAWS.values()}

    def law_and_gains(self) -> tuple[str | None, list[float]]:
        state = self.status().state
        law = driving(state, self.laws())
        return (None if law is None else law.name), [round(gain, 6) for gain in state.gain]


def test_tuned_gains_are_applied_whichever_law_is_active() -> None:
    loop = RequestedLoop()
    answer = apply_gains(loop, [0.3, 0.25, 0.1], NOLL)
    assert answer.reply == "gain is now 0.3 0.25 0.1"
    assert loop.requests == ["gain"]
    loop.law(LAWS["pi"])
    apply_gains(loop, [0.2, 0.2, 0.1], NOLL)
    assert loop.law_and_gains() == (None, [0.2, 0.2, 0.1])


def test_the_previous_law_stays_active_if_the_gains_are_refused() -> None:
    loop = RequestedLoop()
    loop.law(LAWS["pi"])
    before = loop.law_and_gains()
    with pytest.raises(RequestRefusedError, match=r"^gain refused: gain must be at least 0 and below"):
        apply_gains(loop, [0.3, 0.3, 9.0], NOLL)
    assert loop.law_and_gains() == before == (LAWS["pi"].name, [0.4, 0.4, 0.2])
    with pytest.raises(RequestRefusedError, match="are not controlled"):
        apply_gains(loop, [0.3, 0.3], (2, 9))
    assert loop.law_and_gains() == before


def test_without_an_answer_the_previous_law_is_restored_or_the_error_says_that_it_is_not() -> None:
    loop = RequestedLoop()
    loop.law(LAWS["pi"])
    before = loop.law_and_gains()
    loop.unanswered = (3,)
    with pytest.raises(BusError, match="did not answer"):
        apply_gains(loop, [0.3, 0.3, 0.3], NOLL)
    assert loop.law_and_gains() == before
    loop.unanswered = (6, 7)
    with pytest.raises(
        RequestRefusedError, match=f"the integrator now drives .* law {before[0]!r} could not be restored"
    ):
        apply_gains(loop, [0.3, 0.3, 0.3], NOLL)
    assert loop.law_and_gains() == (None, before[1])


def test_a_log_that_is_too_short_is_refused(closed: SyntheticLog, tmp_path: Path) -> None:
    night = closed.copy().request("open")
    night.load(with_identity(replace(night.calibration, flux_dn=1.0)))  # frames of the former calibration do not count
    short = night.request("close").frames(700).write(tmp_path / "short.mcap")
    error = refusal("tune", short, kind=DataFileError)
    assert "tuning requires at least 2048 consecutive frames, 2 s; the longest sequence of good" in error


def test_a_log_that_lacks_its_law_is_refused(tmp_path: Path) -> None:
    night = SyntheticLog().request("close").frames(10)
    night.law(0.3, logged=False)
    error = refusal("tune", night.frames(20).write(tmp_path / "night.mcap"), kind=DataFileError)
    assert re.search(r"night.mcap: the law \w+ is missing", error)


def test_tune_never_overwrites_a_log(log: Path) -> None:
    assert "is a log, which is never overwritten" in refusal("tune", log, "--out", log, kind=DataFileError)


def test_a_missing_package_is_reported_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    error = refusal("tune", "none.mcap", "--plot", "law.png", kind=ConfigurationError)
    assert re.search(r"pip install .*matplotlib", error)


def test_tune_needs_either_a_log_or_a_running_loop() -> None:
    assert "give one LOG, or observe a running loop" in refusal("tune", kind=ConfigurationError)
    assert "give one LOG" in refusal("tune", "x.mcap", "--live", 3.0, kind=ConfigurationError)
    assert "--run has no effect" in refusal("tune", "x.mcap", "--run", "bench", kind=ConfigurationError)


@pytest.mark.parametrize("law", [*LAWS.values(), integrator([0.1] * 20, [0.0] * 20, tuple(range(2, 22)), 1.0, 1e3)])
def test_a_law_is_unchanged_after_saving_and_loading(law: LinearLaw, tmp_path: Path) -> None:
    law_file.save(law, tmp_path / "law.fits")
    loaded = law_file.load(tmp_path / "law.fits")
    assert loaded.id == law.id
    assert (loaded.name, loaded.noll, loaded.delay_frames) == (law.name, law.noll, 1.0)


def test_a_damaged_law_file_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "law.fits"
    with pytest.raises(DataFileError, match="there is no such law file: make one with `lowfc tune"):
        law_file.load(path)
    for name in ("é", "ends with a space "):
        with pytest.raises(DataFileError, match="printable ASCII"):
            law_file.save(replace(LAWS["notch"], name=name), path)
    law_file.save(LAWS["notch"], path)
    with fits.open(path, mode="update") as units:
        units["MEASUREMENT_GAIN"].data[0, 0] += 1
    with pytest.raises(DataFileError, match="damaged: the identity of its content"):
        law_file.load(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DataFileError, match=r"law\.fits: not a readable law file"):
        law_file.load(path)
    fits.PrimaryHDU().writeto(path, overwrite=True)
    with pytest.raises(DataFileError, match="KIND in its header must be 'lowfc law 2'"):
        law_file.load(path)
