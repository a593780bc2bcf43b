"""What an operator is told of a run, in words, levels and a picture: of real runs, and of each state by itself."""

import io
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import rerun as rr
from PIL import Image
from toy import FLUX_DN, NOLL, START, TOY, calibration

from lowfc.adapters import instrument
from lowfc.adapters.bus import Sample
from lowfc.adapters.clock import SimulatedClock
from lowfc.adapters.latch import Latch
from lowfc.adapters.service import Service
from lowfc.contract.calibration_codec import encode_calibration, identified
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.envelope import sequence_of
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    HEALTH,
    MIRROR_STATE,
    STEP,
    TIMING,
    TRUTH,
    Message,
    Topic,
    image,
    timestamp,
    topic_of,
    wire,
)
from lowfc.control.safety import LoopMode, Reason
from lowfc.optics.photometry import tilt_nm_per_mas
from lowfc.programs.controller import Controller
from lowfc.programs.view.moment import SHOWN, Gatherer
from lowfc.programs.view.tile import Level, Tile
from lowfc.programs.view.tiles import (
    FILL,
    GROUND,
    HEADLINE,
    HEIGHT,
    TILES,
    WIDTH,
    Tiles,
    picture,
    places,
    png,
)
from lowfc.programs.view.verdict import Verdict, judge
from lowfc.programs.view.watcher import Watcher
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from sim_camera.process import CameraProcess, bench
from sim_dm.process import MirrorProcess

HOLLOW = (Level.NEUTRAL, Level.GOOD)
MAS = tilt_nm_per_mas(2.0)


def tile(verdict: Verdict, title: str) -> Tile:
    return next(one for one in verdict.tiles if one.title == title)


def levels(verdict: Verdict) -> dict[str, Level]:
    return {one.title: one.level for one in verdict.tiles}


# The loop's real processes, as threads on the bus in memory, in lockstep.


def spoken(config: Configuration, camera: Configuration, latch: Path, frames: int = 260) -> list[Sample]:
    """All that is said in a run whose camera sees another sky or detector than the one that was calibrated."""
    hub, heard = MemoryHub(), []
    observer = MemoryBus(hub, "viewer", SimulatedClock())
    for topic in SHOWN:
        observer.subscribe(topic, heard.append)
    services = [
        Service(name, "run", clock, MemoryBus(hub, name, clock))
        for name, clock in ((name, SimulatedClock()) for name in ("controller", "mirror-dm", "camera"))
    ]
    optics = instrument.twin(config, None, print)
    calibrated = instrument.analytic_calibration(config, optics, instrument.mirror_on_twin(config, optics, print))
    controller = Controller(config, services[0], calibrated, "a test", Latch([latch]))
    services[0].fill = controller.fill
    mirror = MirrorProcess(config, services[1])
    eye = CameraProcess(camera, services[2], bench(camera), frames)
    services[2].fill = eye.fill
    threads = [threading.Thread(target=run) for run in (controller.run, mirror.run)]
    for thread in threads:
        thread.start()
    eye.run(("controller", "mirror-dm"))
    for service in services:
        service.stop("done")
    for thread in threads:
        thread.join()
    return heard


def judged(heard: list[Sample]) -> Verdict:
    """The verdict on a run at its last step before a process said that it ends, ten moments a second."""
    gatherer, watcher, due_ns = Gatherer(), Watcher(), 0
    ends = (topic_of(one.key) is HEALTH and wire.Health.FromString(one.payload).state == "stopped" for one in heard)
    end = next((place for place, ended in enumerate(ends) if ended), len(heard))
    last = max(place for place, sample in enumerate(heard[:end]) if topic_of(sample.key) is STEP)
    for sample in heard[: last + 1]:
        gatherer.take(topic_of(sample.key), sample.key, sample.payload, sample.publish_time_ns)
        if sample.publish_time_ns >= due_ns:
            due_ns = sample.publish_time_ns + 100_000_000
            watcher.feed(gatherer.moment(sample.publish_time_ns))
    watcher.feed(gatherer.moment(heard[last].publish_time_ns))
    assert not gatherer.unreadable
    return judge(watcher, MAS)


def configured(**overrides: object) -> Configuration:
    usual = {"lockstep": True, "control.start_mode": "closed"}
    return load(None, usual | {key.replace("__", "."): value for key, value in overrides.items()})


def test_a_healthy_run_has_nothing_yellow_or_red(tmp_path: Path) -> None:
    verdict = judged(spoken(configured(), configured(), tmp_path / "safed"))
    assert {level for level in levels(verdict).values() if level not in HOLLOW} == set(), verdict
    assert verdict.level is Level.GOOD
    assert verdict.headline.startswith("Loop closed, nothing is wrong.")
    assert tile(verdict, "LOOP").value == "CLOSED"
    assert "x better than" in tile(verdict, "WAVEFRONT").detail
    assert "mas per axis; true" in tile(verdict, "WAVEFRONT").detail
    assert tile(verdict, "FRAMES").value == "250 Hz"
    assert "simulated time" in tile(verdict, "FRAMES").detail


def test_an_open_run_is_grey_and_says_how_to_close_it(tmp_path: Path) -> None:
    opened = configured(control__start_mode="open")
    verdict = judged(spoken(opened, opened, tmp_path / "safed", 120))
    assert verdict.level is tile(verdict, "LOOP").level is Level.NEUTRAL
    assert "lowfc ctl close" in verdict.headline
    assert "not corrected" in tile(verdict, "WAVEFRONT").detail
    assert "mirror holds its last shape" in tile(verdict, "LOOP").detail


def test_a_saturated_detector_is_told_from_a_star_that_is_gone(tmp_path: Path) -> None:
    shallow = configured(camera__full_well_e=1500.0)
    bright = configured(camera__full_well_e=1500.0, star__magnitude=-2.0)
    verdict = judged(spoken(shallow, bright, tmp_path / "safed", 120))
    assert "detector saturated" in verdict.headline
    assert (tile(verdict, "STAR").value, tile(verdict, "LOOP").value) == ("SATURATED", "HOLDING")

    verdict = judged(spoken(configured(), configured(star__magnitude=9.0), tmp_path / "safed", 120))
    assert "the star is gone" in verdict.headline
    assert (tile(verdict, "STAR").value, tile(verdict, "STAR").level) == ("GONE", Level.BAD)


def test_a_short_stroke_is_told_as_a_limit(tmp_path: Path) -> None:
    short = configured(safety__stroke_nm=6.0)
    verdict = judged(spoken(short, short, tmp_path / "safed"))
    assert tile(verdict, "MIRROR").value == "AT LIMIT"
    assert "actuator stroke" in verdict.headline
    assert verdict.level >= Level.WARNING


# One state at a time: what each process says, half a second after half a second.


class Stage:
    """A run of the toy, whose processes say what they are made to say.

    Attributes:
        silent: processes that say nothing any more; a silent camera sends no frames, and so on.
        states: one word of each process's Health.
        health: more of a process's Health.
        lost: every so manieth frame is not given to the controller.
        reasons: of every step; from the first seven on the frame was refused.
    """

    def __init__(self, *, data_ns: int = START * 10**9) -> None:
        self.host_ns, self.data_ns = START * 10**9, data_ns
        self.gatherer, self.watcher = Gatherer(), Watcher()
        self.panel: Callable[[], None] = lambda: None
        self.silent: set[str] = set()
        self.states = dict.fromkeys(("camera", "controller", "mirror-dm", "recorder"), "running")
        self.health: dict[str, dict[str, object]] = {"recorder": {"recording": wire.Recording(file="logs/a.mcap")}}
        self.mode, self.reasons = LoopMode.CLOSED, ()
        self.truth, self.residual_nm, self.open_nm = True, 5.0, 40.0
        self.flux, self.full = 1.0, 0
        self.stroke_nm, self.latency_us = 100.0, 500
        self.status = wire.MIRROR_STATUS_FOLLOWING
        self.frames, self.start_s = 0, START
        self.behind_s = 0.0
        self.calibrated = True

    def say(self, topic: Topic, message: Message | bytes, name: str = "dm") -> None:
        payload = message if isinstance(message, bytes) else message.SerializeToString()
        self.gatherer.take(topic, topic.at(name), payload, self.host_ns)

    def begin(self) -> None:
        if self.calibrated and "controller" not in self.silent:
            self.say(CALIBRATION, encode_calibration(identified(calibration()), self.data_ns))
        settings = wire.ControllerSettings(stroke_nm=700.0, least_flux=0.2)
        self.say(CONTROLLER_STATE, wire.ControllerState(mode=self.mode.value, settings=settings))
        self.say(CAMERA_STATE, wire.CameraState(period_ns=20_000_000))

    def run(self, seconds: float) -> Verdict:
        """Frames at 50 Hz, Health at 2 Hz, moments at 10 Hz."""
        for _ in range(round(seconds * 50)):
            self.host_ns += 20_000_000
            self.data_ns += 20_000_000
            self._frame()
            if self.frames % 25 == 0:
                for name, state in self.states.items():
                    if name not in self.silent:
                        health = wire.Health(process=name, state=state, pid=7, **self.health.get(name, {}))
                        if name == "controller":
                            health.mode = self.mode.value
                        self.say(HEALTH, health, name)
            if self.frames % 5 == 0:
                self.watcher.feed(self.gatherer.moment(self.host_ns, behind_s=self.behind_s))
                self.panel()
        assert not self.gatherer.unreadable
        return judge(self.watcher, MAS)

    def _talks(self, name: str) -> bool:
        return name not in self.silent and self.states.get(name) == "running"

    def _frame(self) -> None:
        self.frames += 1
        sequence, stamp = sequence_of(self.start_s, self.frames), timestamp(self.data_ns)
        residual_nm, open_nm = ([size, 0.0, 0.0] for size in (self.residual_nm, self.open_nm))
        if self._talks("camera"):
            pixels = TOY.pixels([0.0] * len(NOLL), self.flux * FLUX_DN)
            pixels.flat[: self.full] = 60_000
            self.say(FRAME, image(pixels, self.data_ns, "toy"))
            if self.truth:
                truth = wire.Truth(
                    timestamp=stamp,
                    frame_sequence=sequence,
                    disturbance_nm=open_nm,
                    residual_nm=residual_nm,
                    disturbance_rms_nm=self.open_nm,
                    residual_rms_nm=self.residual_nm,
                )
                self.say(TRUTH, truth)
        if self._talks("mirror-dm"):
            state = wire.MirrorState(
                status=self.status, rows=2, columns=2, actuators=np.full(4, self.stroke_nm, "<f4").tobytes()
            )
            self.say(MIRROR_STATE, state)
        if self._talks("camera") and self._talks("controller"):
            refused = any(reason <= Reason.DARK for reason in self.reasons)
            step = wire.ControlStep(
                timestamp=stamp,
                frame_sequence=sequence,
                mode=self.mode.value,
                error_nm=() if refused else residual_nm,
                pol_nm=() if refused else open_nm,
                command_nm=[0.0] * 3,
                reasons=[reason.value for reason in self.reasons],
            )
            self.say(STEP, step)
            durations = dict.fromkeys(("transport_ns", "wakeup_ns", "compute_ns", "publish_ns"), (1,))
            self.say(
                TIMING,
                wire.ControlTiming(
                    frame_sequence=(sequence,), frame_to_command_ns=(1000 * self.latency_us,), **durations
                ),
            )


def staged(change: Callable[[Stage], object], before_s: float = 3.0, after_s: float = 4.0) -> Verdict:
    """A healthy run for a while, and then something is changed."""
    stage = Stage()
    stage.begin()
    assert stage.run(before_s).level is Level.GOOD
    change(stage)
    return stage.run(after_s)


def silence(*names: str) -> Callable[[Stage], None]:
    return lambda stage: stage.silent.update(names)


def setting(**values: object) -> Callable[[Stage], None]:
    def change(stage: Stage) -> None:
        for name, value in values.items():
            setattr(stage, name, value)

    return change


def saying(name: str, **fields: object) -> Callable[[Stage], None]:
    return lambda stage: stage.health.__setitem__(name, fields)


def counting(**counts: int) -> Callable[[Stage], None]:
    return saying("controller", topics=[wire.TopicCount(topic=FRAME.key, **counts)])


def opened_by_itself(stage: Stage) -> None:
    stage.mode = LoopMode.OPEN
    details = {"before": "closed", "after": "open", "why": "the camera changed"}
    stage.say(EVENT, EVENTS["MODE_CHANGED"].log("controller", stage.data_ns, **details))


def stop(*names: str) -> Callable[[Stage], None]:
    return lambda stage: stage.states.update(dict.fromkeys(names, "stopped"))


def brightened(full: int) -> str:
    """Light of a frame of which so many pixels are full, as it is told."""
    pixels = TOY.pixels([0.0] * len(NOLL)).ravel() - 100.0
    pixels[:full] = 60_000 - 100
    return f"{100 * pixels.sum() / FLUX_DN:.0f} %"


EVERYBODY = ("camera", "controller", "mirror-dm", "recorder")
STATES: dict[str, tuple[Callable[[Stage], object], str, str, Level, str]] = {
    # name: what changes; the tile that tells it, its value and level; words of the headline
    "healthy": (lambda stage: None, "LOOP", "CLOSED", Level.GOOD, "nothing is wrong"),
    "open": (setting(mode=LoopMode.OPEN), "LOOP", "OPEN", Level.NEUTRAL, "lowfc ctl close"),
    "open, worse than flat": (
        setting(mode=LoopMode.OPEN, residual_nm=60.0),
        "LOOP",
        "OPEN",
        Level.NEUTRAL,
        "worse than a flat mirror: `lowfc ctl safe` flattens it",
    ),
    "camera changed": (opened_by_itself, "LOOP", "OPEN", Level.WARNING, "opened by itself"),
    "safed": (setting(mode=LoopMode.SAFED), "LOOP", "SAFE", Level.BAD, "lowfc ctl clear"),
    "no calibration": (
        setting(mode=LoopMode.IDLE, reasons=(Reason.NO_CALIBRATION,)),
        "FRAMES",
        "REFUSED",
        Level.BAD,
        "no calibration",
    ),
    "controller dead": (silence("controller"), "LOOP", "DEAD", Level.BAD, "Controller silent for 4 s"),
    "camera dead": (silence("camera"), "FRAMES", "NO FRAMES", Level.BAD, "No frame for 4 s, camera silent"),
    "mirror dead": (silence("mirror-dm"), "MIRROR", "DEAD", Level.BAD, "Mirror silent for 4 s"),
    "recorder dead": (silence("recorder"), "RECORDER", "DEAD", Level.BAD, "Recorder silent"),
    "everybody dead": (silence(*EVERYBODY), "LOOP", "NO MESSAGES", Level.BAD, "No message from any process for 4 s"),
    "ended": (stop(*EVERYBODY), "LOOP", "ENDED", Level.NEUTRAL, "The run has ended"),
    "controller stopped": (stop("controller"), "LOOP", "STOPPED", Level.NEUTRAL, "The controller was stopped"),
    "camera stopped": (stop("camera"), "LOOP", "HOLDING", Level.NEUTRAL, "The camera was stopped"),
    "skipped": (counting(skipped=12), "FRAMES", "12 LOST", Level.WARNING, "12 skipped (controller busy)"),
    "missing": (counting(missing=90), "FRAMES", "90 LOST", Level.BAD, "90 never arrived"),
    "late frames": (setting(reasons=(Reason.LATE,)), "FRAMES", "REFUSED", Level.BAD, "too late"),
    "wrong size": (setting(reasons=(Reason.WRONG_SIZE,)), "FRAMES", "REFUSED", Level.BAD, "wrong size"),
    "saturated": (
        setting(reasons=(Reason.SATURATED,), full=20),
        "STAR",
        "SATURATED",
        Level.BAD,
        "Every frame is refused, detector saturated",
    ),
    "nearly saturated": (setting(full=3), "STAR", brightened(3), Level.WARNING, "3 pixels at full well"),
    "star gone": (setting(reasons=(Reason.DARK,), flux=0.01), "STAR", "GONE", Level.BAD, "the star is gone"),
    "dim": (setting(flux=0.4), "STAR", "40 %", Level.WARNING, "The star is dim"),
    "stroke": (setting(reasons=(Reason.STROKE,)), "MIRROR", "AT LIMIT", Level.BAD, "actuator stroke"),
    "modal limit": (setting(reasons=(Reason.MODAL_LIMIT,)), "MIRROR", "AT LIMIT", Level.BAD, "modal limit"),
    "little stroke left": (setting(stroke_nm=650.0), "MIRROR", "93 %", Level.WARNING, "little is left"),
    "expired": (setting(status=wire.MIRROR_STATUS_EXPIRED), "MIRROR", "EXPIRED", Level.BAD, "receives no commands"),
    "harmful": (setting(residual_nm=60.0), "WAVEFRONT", "60.0 nm rms", Level.WARNING, "The loop does harm"),
    "diverging": (setting(residual_nm=400.0), "WAVEFRONT", "400 nm rms", Level.BAD, "40.0 nm with a flat mirror"),
    "late commands": (saying("camera", commands_late=80), "LATENCY", "80 LATE", Level.WARNING, "80 commands, "),
    "slow": (setting(latency_us=30_000), "LATENCY", "30000 us", Level.WARNING, "longer than a frame"),
    "recorder failed": (
        saying("recorder", recording=wire.Recording(failure="no space left")),
        "RECORDER",
        "FAILED",
        Level.BAD,
        "no space left",
    ),
    "recording stopped": (
        saying("recorder", recording=wire.Recording(file="logs/a.mcap", stopped=True)),
        "RECORDER",
        "STOPPED",
        Level.WARNING,
        "the night is not kept",
    ),
    "recorder stopped": (stop("recorder"), "RECORDER", "STOPPED", Level.WARNING, "The recorder was stopped"),
    "recorder losing": (
        saying("recorder", recording=wire.Recording(file="a", lost=5)),
        "RECORDER",
        "LOSING",
        Level.BAD,
        "lost 5 messages",
    ),
    "view behind": (setting(behind_s=3.0), "VIEW", "3 s", Level.WARNING, "This view is 3 s behind"),
}


@pytest.fixture(scope="module")
def verdicts() -> dict[str, Verdict]:
    return {name: staged(change) for name, (change, *_) in STATES.items()}


@pytest.mark.parametrize("name", STATES)
def test_each_state_has_its_tile_its_level_and_its_words(verdicts: dict[str, Verdict], name: str) -> None:
    _, title, value, level, words = STATES[name]
    verdict = verdicts[name]
    assert (tile(verdict, title).value, tile(verdict, title).level) == (value, level), verdict
    assert words in verdict.headline
    assert all(one.advice for one in verdict.tiles if one.level is verdict.level >= Level.WARNING)
    assert verdict.level is (level if level >= Level.WARNING else tile(verdict, "LOOP").level)


def test_no_two_states_have_the_same_headline(verdicts: dict[str, Verdict]) -> None:
    assert [line for line, count in Counter(one.headline for one in verdicts.values()).items() if count > 1] == []


def test_what_a_dead_controller_leaves_is_not_called_good(verdicts: dict[str, Verdict]) -> None:
    assert tile(verdicts["controller dead"], "WAVEFRONT").level is Level.NEUTRAL
    assert tile(verdicts["camera dead"], "LOOP").value == tile(verdicts["star gone"], "LOOP").value == "HOLDING"


@pytest.mark.parametrize(
    ("name", "compared"),
    [
        ("open", "not corrected; 40.0 nm with a flat mirror"),
        ("safed", "not corrected; 40.0 nm with a flat mirror"),
        ("controller dead", "not corrected; 40.0 nm with a flat mirror"),
        ("star gone", "of 40.0 nm with a flat mirror"),
        ("ended", "of 40.0 nm with a flat mirror"),
    ],
)
def test_only_where_nothing_corrects_it_is_said(verdicts: dict[str, Verdict], name: str, compared: str) -> None:
    found = tile(verdicts[name], "WAVEFRONT")
    assert (found.detail.startswith(compared), found.level) == (True, Level.NEUTRAL), found


@pytest.mark.parametrize("after_s", [0.5, 20.0])
def test_what_is_left_of_an_ended_run_is_called_the_last_of_it_and_is_grey(after_s: float) -> None:
    verdict = staged(stop(*EVERYBODY), after_s=after_s)
    last = [tile(verdict, title).value for title in ("WAVEFRONT", "STAR", "LATENCY")]
    assert last == ["last: 5.0 nm", "last: 100 %", "last: 500 us"]
    assert set(levels(verdict).values()) == {Level.NEUTRAL}


def test_a_few_lost_frames_are_told_and_are_no_alarm() -> None:
    stage = Stage()
    stage.begin()
    stage.run(3)
    counting(skipped=1)(stage)
    verdict = stage.run(1)
    frames = tile(verdict, "FRAMES")
    assert (frames.value, frames.level, verdict.level) == ("50 Hz", Level.GOOD, Level.GOOD)
    assert frames.detail == "1 frame skipped in the last 5 s"
    counting(skipped=2)(stage)  # 2 of 250 are more than 0.5 %
    verdict = stage.run(1)
    assert (tile(verdict, "FRAMES").value, verdict.level) == ("2 LOST", Level.WARNING)
    assert verdict.headline.startswith("2 frames lost in the last 5 s")


def test_a_refused_frame_is_told_and_is_no_alarm() -> None:
    stage = Stage()
    stage.begin()
    stage.run(3)
    stage.reasons = (Reason.LATE,)
    stage.run(0.02)
    stage.reasons = ()
    frames = tile(stage.run(0.98), "FRAMES")
    assert (frames.level, frames.detail) == (Level.GOOD, "1 frame refused in the last 5 s")


def test_a_camera_that_restarts_is_never_called_unused() -> None:
    stage = Stage()
    stage.begin()
    stage.run(3)
    stage.start_s += 100
    values = [tile(stage.run(0.1), "FRAMES").value for _ in range(15)]
    assert set(values) == {"50 Hz"}


def test_a_dead_mirror_is_not_hidden_by_one_that_was_stopped_or_runs() -> None:
    stage = Stage()
    stage.begin()
    stage.states |= {"mirror-dm": "running", "mirror-tt": "running", "mirror-old": "stopped"}
    stage.run(1)
    stage.silent = {"mirror-old"}
    assert tile(stage.run(3), "MIRROR").level is Level.GOOD
    stage.silent.add("mirror-tt")
    assert (tile(stage.run(3), "MIRROR").value, tile(stage.run(3), "LOOP").level) == ("DEAD", Level.WARNING)


def test_losses_stay_for_five_seconds_and_then_go() -> None:
    stage = Stage()
    stage.begin()
    stage.run(3)
    counting(missing=4)(stage)
    assert tile(stage.run(4.5), "FRAMES").value == "4 LOST"
    assert levels(stage.run(2))["FRAMES"] is Level.GOOD


def test_without_truth_the_measured_wavefront_is_told_as_such() -> None:
    stage = Stage()
    stage.truth = False
    stage.begin()
    found = tile(stage.run(3), "WAVEFRONT")
    tilt = f"tilt {5 / np.sqrt(2) / MAS:.1f} of {40 / np.sqrt(2) / MAS:.1f} mas per axis"
    assert (found.value, found.detail) == (
        "5.0 nm rms",
        f"8.0 x better than 40.0 nm with a flat mirror; {tilt}; measured, with noise",
    )


def test_simulated_time_is_neither_silence_nor_latency() -> None:
    stage = Stage(data_ns=10**18)
    stage.latency_us = 30_000
    stage.begin()
    verdict = stage.run(5)
    assert verdict.level is Level.GOOD
    assert set(levels(verdict).values()) == set(HOLLOW)


def test_a_run_that_starts_is_waited_for_and_missed_only_later() -> None:
    watcher = Watcher()
    watcher.feed(Gatherer().moment(START * 10**9))
    nothing = judge(watcher)
    assert (nothing.level, nothing.headline) == (Level.NEUTRAL, "Waiting for the run to start.")
    stage = Stage()
    stage.silent = {"camera", "mirror-dm", "recorder"}
    stage.states = {"controller": "ready"}
    stage.begin()
    assert stage.run(5).level is Level.NEUTRAL
    late = stage.run(10)
    assert (tile(late, "FRAMES").value, tile(late, "MIRROR").value) == ("NO CAMERA", "NO MIRROR")
    assert late.level is Level.WARNING


def test_steps_of_a_camera_that_says_nothing_of_itself_are_judged_too() -> None:
    stage = Stage()
    stage.states = {"controller": "running", "camera": "running"}
    assert tile(stage.run(0.1), "FRAMES").value == "50 Hz"
    assert levels(stage.run(3))["FRAMES"] is Level.GOOD


def test_a_view_that_is_behind_does_not_take_the_run_for_dead() -> None:
    stage = Stage()
    stage.begin()
    stage.run(3)
    stage.behind_s = 30.0
    stage.silent = set(EVERYBODY)  # nothing newer has got here yet
    verdict = stage.run(20)
    assert [one.title for one in verdict.tiles if one.level >= Level.WARNING] == ["VIEW"]


# The picture.


NOON_NS = 43_200 * 10**9


def pixels(verdict: Verdict, time_ns: int = NOON_NS) -> npt.NDArray[np.uint8]:
    with Image.open(io.BytesIO(png(picture(verdict, time_ns)))) as shown:
        return np.asarray(shown.convert("RGB"))


LONG = "neighbouring/actuators/in/a/very/long/path/without/any/blank " + "and more words than a tile has room for " * 3


@pytest.mark.parametrize("tiles", [7, 8])
@pytest.mark.parametrize("level", Level)
def test_all_words_are_within_their_tile_and_nothing_is_on_its_border(level: Level, tiles: int) -> None:
    verdict = Verdict(LONG, level, tuple(Tile("RECORDER", "NOTHING HEARD OF IT", LONG, level) for _ in range(tiles)))
    shown = pixels(verdict)
    assert shown.shape == (HEIGHT, WIDTH, 3)
    rest = np.ones((HEIGHT, WIDTH), bool)
    for x0, y0, x1, y1 in places(tiles):
        inside = shown[y0:y1, x0:x1]
        border = np.ones(inside.shape[:2], bool)
        border[2:-2, 2:-2] = False
        assert (inside[border] == FILL[level]).all()
        assert (inside != FILL[level]).any(axis=2).mean() > 0.03  # there are words
        rest[y0:y1, x0:x1] = False
    assert (shown[rest] == GROUND).all()


def test_longer_words_are_smaller_words_not_fewer() -> None:
    """A letter more changes the picture, at the end of a text too."""
    whole = [Verdict("x", Level.BAD, (Tile("A", "B", LONG + end, Level.BAD),) * 7) for end in ("a", "ab")]
    assert (pixels(whole[0]) != pixels(whole[1])).any()


def test_the_time_of_day_is_at_the_right_end_of_the_headline_and_nowhere_else() -> None:
    verdict = Verdict(LONG, Level.GOOD, (Tile("A", "B", LONG, Level.GOOD),) * 7)
    noon, next_second, next_day = (pixels(verdict, NOON_NS + 10**9 * later) for later in (0, 1, 86_400))
    differs = np.argwhere((noon != next_second).any(axis=2))
    (top, left), (bottom, right) = differs.min(axis=0), differs.max(axis=0)
    assert 0 < top < bottom < places(7)[0][3]
    assert WIDTH - 190 < left < right < WIDTH
    assert (noon == next_day).all()


def test_levels_differ_in_lightness_too() -> None:
    light = sorted(float(np.dot(FILL[level], (0.2126, 0.7152, 0.0722))) for level in Level)
    assert min(np.diff(light)) > 8
    assert len({picture(Verdict("", level, ()), NOON_NS).tobytes() for level in Level}) == len(Level)


class Noting(rr.RecordingStream):
    """A stream that keeps what is logged."""

    logged: list[tuple[str, object]]

    def log(self, path: str, what: object, **more: object) -> None:  # type: ignore[override]
        self.logged.append((path, what))


def test_the_panel_draws_the_clock_each_second_and_speaks_when_something_changes() -> None:
    stream = Noting("test")
    logged = stream.logged = []
    panel, stage = Tiles(MAS), Stage()

    def draw() -> None:
        assert stage.watcher.moment is not None
        panel.draw(stream, stage.watcher.moment)

    stage.panel = draw
    panel.begin(stream)
    stage.begin()
    stage.run(3)
    said = [path for path, _ in logged]
    assert 1 <= said.count(TILES) <= 4 * 3
    assert 1 <= said.count(HEADLINE) <= said.count(TILES)
    logged.clear()
    stage.run(3)
    assert [path for path, _ in logged] == [TILES] * 3
    logged.clear()
    stage.mode = LoopMode.SAFED
    stage.run(0.5)
    assert [path for path, _ in logged][:2] == [TILES, HEADLINE]
    assert "Loop in safe mode" in str(logged[1][1])
