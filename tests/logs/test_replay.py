"""Replay confirms identical results, reports differences, and counts the steps that it cannot check."""

import shutil
from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.process import compiled
from lowfc.adapters.process.provenance import provenance
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.calibration_codec import encode_calibration, with_identity
from lowfc.contract.codecs.law_codec import wire_law, wire_play
from lowfc.contract.codecs.state_codec import controller_state
from lowfc.contract.envelope import sequence_of
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    COMMAND,
    CONTROL_INPUT,
    CONTROLLER_STATE,
    FRAME,
    LAW,
    PLAY,
    REQUEST,
    STEP,
    RawImage,
    Topic,
    image,
    timestamp,
    wire,
)
from lowfc.control.laws.linear_law import integrator
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Frame, Input, Load, Request
from lowfc.control.loop.requests import prepared
from lowfc.control.loop.safety import Limit
from lowfc.control.loop.state import Settings, State
from lowfc.programs.logs.replay import frames as frames_of_log
from lowfc.programs.logs.replay import workers
from lowfc.programs.logs.replay.account import Account
from lowfc.programs.logs.replay.controller_replay import PATIENCE_NS, Segment
from lowfc.programs.logs.replay.fold import Replay
from lowfc.programs.logs.replay.former import CHANNEL_RULE, GAIN_RULE, LOAD_RULE, FormerVersion
from lowfc.programs.logs.replay.frames import Frames
from tests.support import controller_inputs, report_log
from tests.support.controller_inputs import TIGHT, inputs
from tests.support.loops import json_of, lowfc
from tests.support.mutated_logs import chunks_of, flipped
from tests.support.toy import NOLL, calibration, frame, settings

START_S = 1_767_225_600
STATE_EVERY = 12  # inputs
STEPS = 600
EXAMPLES = 40
SHAPE = np.full(20, 3, np.float32)
"""Shape of a command channel, nm of surface."""


class Night:
    """Log of a controller and its peers, made from a list of inputs."""

    def __init__(self, loop_settings: Settings) -> None:
        self.messages: list[Sample] = []
        self.loop_settings = loop_settings
        self.start_s = START_S
        self.now_ns = START_S * 10**9
        self._counts: dict[tuple[str, int], int] = {}
        self._start()

    def restart(self) -> None:
        """Let the controller die and restart."""
        self.start_s += 1
        self._start()

    def apply(self, input_: Input, logged: Request | None = None) -> None:
        """Apply an input and log it, or log `logged` instead, as a version with another rule does."""
        self.now_ns += 1_000_000
        if isinstance(input_, Frame):
            message = RawImage(timestamp=timestamp(input_.time_ns))
            if input_.pixels is not None:
                message = image(input_.pixels, input_.time_ns, "sensor")
            payload = message.SerializeToString()
            self.messages.append(Sample(FRAME.key, payload, input_.sequence, self.now_ns, self.now_ns))
        if isinstance(input_, Request):
            input_ = prepared(self.loop_settings, input_)
            if input_.law is not None:
                self.put(LAW, wire_law(input_.law, input_.time_ns).SerializeToString())
            if input_.played is not None:
                self.put(PLAY, wire_play(input_.played, input_.time_ns).SerializeToString())
        self.state, outputs = advance(self.loop_settings, self.state, input_)
        number = self.state.input_number
        if outputs.command is not None:
            self.put(COMMAND, codec.encode_command(outputs.command, 200, "lowfc", number), "dm")
        if outputs.step is not None:
            self.put(STEP, codec.encode_step(outputs.step, number))
        if isinstance(input_, Request):
            assert outputs.reply is not None
            state = (
                controller_state(self.state, self.loop_settings, input_.time_ns) if input_.name == "status" else None
            )
            self.put(REQUEST, codec.encode_request(logged or input_, outputs.reply, number, state))
        elif not isinstance(input_, Frame) and number > self._last_number:
            self.put(CONTROL_INPUT, codec.encode_input(input_, number))
        if outputs.changed or (number > self._last_number and number % STATE_EVERY == 0):
            state = controller_state(self.state, self.loop_settings, self.now_ns)
            self.put(CONTROLLER_STATE, state.SerializeToString())
        self._last_number = number

    def indices(self, topic: Topic) -> list[int]:
        """Indices of the messages of a topic."""
        return [index for index, message in enumerate(self.messages) if topic.matches(message.key)]

    def _start(self) -> None:
        self.state, self._last_number = State(), 0
        self.put(CALIBRATION, encode_calibration(controller_inputs.CALIBRATION, self.now_ns))
        self.apply(Load(self.now_ns, controller_inputs.CALIBRATION, "a test"))

    def put(self, topic: Topic, payload: bytes, name: str = "") -> None:
        key = topic.at(name)
        count = self._counts.get((key, self.start_s), 0)
        self._counts[key, self.start_s] = count + 1
        sequence = sequence_of(self.start_s, count)
        self.messages.append(Sample(key, payload, sequence, self.now_ns, self.now_ns))


def replay(
    messages: Iterable[Sample], tolerance_nm: float = 0.0, former: FormerVersion | None = None, **options: Any
) -> Account:
    """Replay messages; with `former`, as messages of that former version of lowfc."""
    run = Replay(tolerance_nm, **options)
    run.context.former = former
    for message in messages:
        run.add(message)
        if run.done:
            break
    return run.finish()


def night_of(input_list: list[Input], **changes: object) -> Night:
    """Log of a controller that has these changed settings and receives these inputs."""
    night = Night(settings(**(TIGHT | changes)))
    for one in input_list:
        night.apply(one)
    return night


@pytest.mark.skipif(not compiled.available(), reason="needs the extra `fast`")
def test_a_log_of_the_fused_kernel_is_replayed_bit_for_bit_by_that_kernel_but_not_by_numpy() -> None:
    channel = Request(0, "channel", text="dark-hole", actuators_nm=SHAPE)
    law = Request(0, "law", law=integrator([0.3] * 3, [0.0] * 3, NOLL, 2.5, 1000.0))
    input_list = [*frames(60, 1), channel, *frames(100, 61), law, *frames(400, 161)]
    night = night_of(input_list, kernel=compiled.kernel("fused"), delay_frames=2.5, interlocks=())
    logged = [one.payload for one in night.messages if one.key == CONTROLLER_STATE.key][-1]
    assert wire.ControllerState.FromString(logged).settings.kernel == "fused"
    assert replay(night.messages).identical
    other = replay(night.messages, kernel="numpy")
    assert (other.other_kernel, other.identical) == ("numpy", False)
    assert 0 < other.largest_difference_nm < 1e-3
    tolerant = replay(night.messages, 1e-3, kernel="numpy")
    assert (tolerant.frames, tolerant.different, tolerant.identical) == (560, 0, False)


def after_camera_restart(input_list: list[Input]) -> list[Input]:
    """The same inputs after a restart of the camera, so that no two frames share sequence and time."""
    return [
        one._replace(sequence=one.sequence + (1 << 32), time_ns=one.time_ns + 10**9) if isinstance(one, Frame) else one
        for one in input_list
    ]


def frames(count: int, first: int = 0) -> list[Input]:
    """Frames of random wavefronts, numbered from `first`."""
    rng = np.random.default_rng(first)
    return [frame(first + index, rng.normal(0, 4, len(NOLL))) for index in range(count)]


@hypothesis_settings(deadline=None, max_examples=EXAMPLES)
@given(*[inputs()] * 2, *map(st.sampled_from, (["hold", "flat"], [1.0, 2.5], ["numpy", "fused"])))
def test_any_sequence_of_inputs_is_replayed_bit_for_bit(
    before: list[Input], after: list[Input], on_frame_timeout: str, delay_frames: float, kernel: str
) -> None:
    night = night_of(
        before, on_frame_timeout=on_frame_timeout, delay_frames=delay_frames, kernel=compiled.kernel(kernel)
    )
    night.restart()
    for one in after_camera_restart(after):
        night.apply(one)
    account, sent = replay(night.messages), Counter(message.key for message in night.messages)
    assert (account.different, account.largest_difference_nm, account.unchecked_because) == (0, 0.0, {})
    assert account.frames == sent[STEP.key]
    assert account.commands == sent[COMMAND.at("dm")]
    assert account.requests == sent[REQUEST.key]
    assert account.states == sent[CONTROLLER_STATE.key] - 2  # the replay begins with a state at each start


def test_an_overruled_law_is_replayed_bit_for_bit_even_from_the_middle() -> None:
    night = night_of([], guard=True, rate_hz=1000.0, limit_nm=(150.0, 150.0))
    night.apply(
        Request(night.now_ns, "law", law=integrator((0.05,) * len(NOLL), (0.0,) * len(NOLL), NOLL, 1.0, 1000.0))
    )
    for count in range(860):
        wave_nm = 20 * np.sin(0.04 * count + np.arange(len(NOLL)))
        night.apply(frame(count, wave_nm + night.state.loop.history_nm[0]))
    steps = [message for message in night.messages if message.key == STEP.key]
    # About 100 frames of observation, 100 of cross-fade, and four blocks of 100 in which the law is worse.
    overruled = [Limit.LAW_OVERRULED in wire.ControlStep.FromString(message.payload).reasons for message in steps]
    assert overruled == [False] * 598 + [True] * 262
    account = replay(night.messages)
    assert account.identical
    for first in (300, 640, 800):
        truncated = [message for message in night.messages if message.key in (CALIBRATION.key, LAW.key)]
        truncated += [message for message in night.messages if message.receive_time_ns >= steps[first].receive_time_ns]
        account = replay(truncated)
        assert account.identical
        assert account.frames >= 860 - first - 2 * STATE_EVERY


@hypothesis_settings(deadline=None, max_examples=EXAMPLES)
@given(inputs(), st.randoms(use_true_random=False), st.integers(1, 6))
def test_lost_messages_are_never_a_difference_and_every_step_is_accounted_for(
    input_list: list[Input], random: st.DataObject, losses: int
) -> None:
    night = night_of([*frames(30, 9000), *after_camera_restart([*input_list, *frames(30, 5000)])])
    remaining = list(night.messages)
    for _ in range(losses):
        remaining.pop(random.randrange(len(remaining)))  # type: ignore[attr-defined]
    account = replay(remaining)
    assert (account.different, account.largest_difference_nm) == (0, 0.0)
    assert account.frames + account.unchecked == sum(message.key == STEP.key for message in remaining)


@hypothesis_settings(deadline=None, max_examples=EXAMPLES)
@given(inputs(), st.randoms(use_true_random=False))
def test_the_order_between_publishers_does_not_matter(input_list: list[Input], random: st.DataObject) -> None:
    night = night_of([*input_list, *frames(20, 5000)])
    frames_late_ns, others_late_ns = (random.randrange(PATIENCE_NS // 2) for _ in range(2))  # type: ignore[attr-defined]
    late = []
    for message in night.messages:
        late_ns = frames_late_ns if message.key == FRAME.key else others_late_ns
        late.append(message._replace(receive_time_ns=message.receive_time_ns + late_ns))
    shuffled = sorted(late, key=lambda message: message.receive_time_ns)
    account = replay(shuffled)
    assert account.identical
    assert account.frames == len(night.indices(STEP))


@hypothesis_settings(deadline=None, max_examples=EXAMPLES)
@given(
    inputs(),
    inputs(),
    st.lists(st.floats(0, 1), max_size=4),
    st.lists(st.tuples(st.floats(0, 1), st.integers(1, 60)), max_size=3),
    st.booleans(),
    st.sampled_from([1, 30, 300]),
)
def test_segments_together_give_the_account_of_the_whole_log(
    before: list[Input],
    after: list[Input],
    edge_fractions: list[float],
    gaps: list[tuple[float, int]],
    only_states: bool,
    slowdown: int,
) -> None:
    """Messages or states are missing, singly or for seconds, at different message rates."""
    night = night_of([*before, *frames(60, 9000)])
    night.restart()
    for one in after_camera_restart([*after, *frames(60, 9000)]):
        night.apply(one)
    begun_ns = night.messages[0].receive_time_ns
    messages = [
        message._replace(receive_time_ns=begun_ns + slowdown * (message.receive_time_ns - begun_ns))
        for message in night.messages
    ]
    for fraction, count in gaps:
        first = int(fraction * (len(messages) - 1))
        states = [index for index, message in enumerate(messages) if message.key == CONTROLLER_STATE.key]
        lost = [index for index in (states if only_states else range(len(messages))) if index >= first][:count]
        messages = [message for index, message in enumerate(messages) if index not in lost]
    span_ns = messages[-1].receive_time_ns - messages[0].receive_time_ns if messages else 0
    edges = sorted({begun_ns + 1 + int(fraction * span_ns) for fraction in edge_fractions})
    whole = replay(messages)
    parts = [replay(messages, segment=Segment(begin, end)) for begin, end in pairwise([0, *edges, 1 << 63])]
    steps = sum(message.key == STEP.key for message in messages)
    assert sum(part.steps for part in parts) == whole.steps == steps
    assert whole.frames + whole.unchecked == steps
    for name in ("frames", "commands", "requests", "different", "commands_missing"):
        assert sum(getattr(part, name) for part in parts) == getattr(whole, name), name
    unchecked = sum(part.unchecked for part in parts)
    assert unchecked >= whole.unchecked  # where states are missing, two segments may count the same step
    if not gaps:
        assert unchecked == 0


def test_after_a_gap_the_replay_continues_at_the_next_state_and_reports_unchecked_steps() -> None:
    night = night_of(frames(100))
    steps = night.indices(STEP)
    account = replay([*night.messages[: steps[30]], *night.messages[steps[40] :]])
    assert account.identical
    assert list(account.unchecked_because) == ["after an input that the log does not have"]
    assert account.frames + account.unchecked == 90
    without_a_frame = [one for one in night.messages if one.key != FRAME.key or one.sequence % 100 != 50]
    assert replay(without_a_frame).unchecked_because["after a frame that the log does not have"] >= 1
    head = [message for message in night.messages if message.key == CALIBRATION.key]
    account = replay([*head, *night.messages[len(night.messages) // 2 :]])
    assert account.identical
    assert 0 < account.unchecked_because["recorded before the first complete state of the controller"] <= STATE_EVERY


def test_a_recording_that_begins_in_the_middle_of_a_run_lacks_no_input() -> None:
    """A recorder that starts receives the newest state; earlier inputs since that state are not recorded."""
    messages = night_of(frames(100)).messages
    head = [message for message in messages if message.key == CALIBRATION.key]
    later = messages[len(messages) // 2 :]
    state = [message for message in messages[: len(messages) // 2] if message.key == CONTROLLER_STATE.key][-2]
    account = replay([*head, state._replace(receive_time_ns=later[0].receive_time_ns), *later])
    assert account.identical
    assert list(account.unchecked_because) == ["recorded before the first complete state of the controller"]
    assert account.inputs_missing == 0


OTHER = with_identity(calibration(NOLL, 2.0))


@pytest.mark.parametrize(
    ("rule", "logged", "applied"),
    [
        (GAIN_RULE, Request(0, "gain", values=(0.2,)), Request(0, "gain", values=(0.3,))),
        (GAIN_RULE, Request(0, "leak", values=(0.2,)), Request(0, "leak", values=(0.3,))),
        (CHANNEL_RULE, *(Request(0, "channel", text=name, actuators_nm=SHAPE) for name in "ab")),
        (LOAD_RULE, *(Request(0, "load", calibration=one) for one in (controller_inputs.CALIBRATION, OTHER))),
        (None, Request(0, "gain", values=(0.2,)), Request(0, "gain", values=(9.0,))),  # refused in the log
    ],
)
def test_the_replay_continues_after_an_accepted_input_under_a_former_rule_and_names_the_rule(
    rule: str | None, logged: Request, applied: Request
) -> None:
    night = night_of([Request(0, "open"), *frames(30)], interlocks=())
    night.put(CALIBRATION, encode_calibration(OTHER, night.now_ns))
    night.apply(applied, logged)
    for one in frames(30, 31):
        night.apply(one)
    account = replay(night.messages, former=FormerVersion({}))
    assert (account.frames, account.different, account.rules_changed) == (60, 0, {rule: 1} if rule else {})
    assert replay(night.messages).different  # as a log of this version


def raise_actuator(command: Any, number: int) -> None:
    """Change one actuator of a command by the smallest amount."""
    surface = np.frombuffer(command.actuators, np.float32).copy()
    surface[number] = np.nextafter(surface[number], np.float32(np.inf))
    command.actuators = surface.tobytes()


def replay_tampered(night: Night, topic: Topic, number: int, change: str) -> Account:
    """Change one message of a log, and replay the log."""
    messages = list(night.messages)
    index = night.indices(topic)[number]
    body = topic.message.FromString(messages[index].payload)
    exec(change, {"body": body, "raise_actuator": raise_actuator})  # noqa: S102  # the test's own text
    messages[index] = messages[index]._replace(payload=body.SerializeToString())
    return replay(messages)


@pytest.mark.parametrize(
    ("topic", "change", "expected"),
    [
        (COMMAND, "raise_actuator(body, 7)", "actuators: [7] log"),
        (STEP, "body.error_nm[1] += 1e-6", "error_nm: [1] log"),
        (STEP, "body.mode = 2", "mode: log 2, replay 3"),
        (STEP, "body.command_nm[0] = float('nan')", "command_nm: log [nan"),
        (STEP, "body.timestamp.nanos += 1", "timestamp.nanos: log"),
        (STEP, "body.MergeFromString(bytes([0xA0, 0x06, 1]))", "the bytes differ, but no value"),
        (COMMAND, "body.valid_for_ns = 10**12", "valid_for_ns: log 1000000000000"),
        (CONTROLLER_STATE, "body.command_history_nm[0] += 0.5", "command_history_nm: [0] log"),
        (CONTROLLER_STATE, "body.settings.slew_nm += 1", "settings.slew_nm: [0] log"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_smallest_difference_is_found_and_reported(topic: Topic, change: str, expected: str) -> None:
    account = replay_tampered(night_of(frames(60)), topic, 2, change)
    assert not account.identical
    assert account.first_difference.message == topic.message.DESCRIPTOR.name
    assert any(line.startswith(expected) for line in account.first_difference.fields), account.first_difference.fields
    if change.startswith("raise_actuator"):
        assert 0 < account.largest_difference_nm < 1e-5
        difference = account.first_difference  # input 1 is the calibration, frame 0 is input 2
        assert (account.different, difference.taken, difference.frame_sequence & 0xFF) == (1, 4, 2)


def test_a_second_message_for_one_input_differs() -> None:
    night = night_of(frames(60))
    account = replay([*night.messages, night.messages[night.indices(STEP)[20]]])
    assert account.different == 1
    assert account.first_difference.fields == ["a second message of input 22"]


def test_commands_that_are_not_in_the_log_are_counted() -> None:
    night = night_of(frames(60))
    commands = night.indices(COMMAND)
    account = replay(message for index, message in enumerate(night.messages) if index not in commands[10:13])
    assert (account.identical, account.commands, account.commands_missing) == (True, 57, 3)
    account = replay(message for message in night.messages if not COMMAND.matches(message.key))
    assert (account.different, account.commands, account.commands_missing, account.identical) == (0, 0, 60, False)


def test_a_log_without_input_numbers_is_refused() -> None:
    night = night_of(frames(3))
    with pytest.raises(DataFileError, match="the steps in this log are not numbered"):
        replay_tampered(night, STEP, 0, "body.input_number = 0")
    night.messages.append(Sample(REQUEST.key, wire.Request(name="gain").SerializeToString(), 0, 0, 0))
    assert replay(night.messages).identical


def test_a_log_with_nothing_to_check_is_not_identical() -> None:
    assert not replay([]).identical
    assert replay([]).text() == "nothing could be replayed"
    night = night_of(frames(5))
    assert not replay([message for message in night.messages if message.key != CALIBRATION.key]).identical


def test_frames_are_kept_within_a_limit_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames_of_log, "FRAMES_BYTES", 1000)
    store = Frames()
    pixels = np.arange(100, dtype=np.uint16).reshape(10, 10)
    for sequence in range(50):
        store.add(sequence, image(pixels + sequence, sequence, "sensor").SerializeToString())
    found = [store.frame(sequence, sequence, 0) for sequence in range(50)]
    assert found[49].pixels is not None
    assert np.array_equal(found[49].pixels, pixels + 49)
    assert [kept is not None for kept in found].count(True) == 4
    assert store.frame(49, 48, 0) is None
    assert store.frame(49, 48, 0, any_time=True) is not None


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report_log.SyntheticLog().frames(STEPS).write(tmp_path_factory.mktemp("night") / "night.mcap")


def test_several_processes_give_the_same_account_as_one_process(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chunk_ends_ns = workers._chunk_ends_ns  # unsorted, as after a calibration recorded again with its old time
    monkeypatch.setattr(workers, "_chunk_ends_ns", lambda path: chunk_ends_ns(path)[::-1])
    monkeypatch.setattr(workers, "_MIN_SEGMENT_BYTES", 1)
    by_one, by_two = (workers.replay_files([log], 0.0, jobs, lambda done: None) for jobs in (1, 2))
    assert (by_one.identical, by_one.log_s) == (True, pytest.approx((STEPS - 1) / 1000))
    assert by_one == by_two


def test_logs_in_another_order_than_recorded_are_refused(log: Path, tmp_path: Path) -> None:
    later = report_log.SyntheticLog()
    later.samples[0] = later.samples[0]._replace(receive_time_ns=1)  # a state at the log's start is older than the log
    later.now_ns += 3600 * 10**9
    later.frames(20)
    newer = later.write(tmp_path / "newer.mcap")
    assert workers.replay_files([log, newer], 0.0, 1, lambda done: None).frames == STEPS + 20
    with pytest.raises(ConfigurationError, match=r"night\.mcap begins 3600\.0 s before .*; name the logs"):
        workers.replay_files([newer, log], 0.0, 1, lambda done: None)


@pytest.mark.parametrize("other", ["b", "a"])
def test_two_lockstep_runs_with_the_same_sequences_are_replayed_separately(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: str
) -> None:
    """This also holds for two runs of the same name (`sim-loop --lockstep --run a`)."""
    paths: list[Path] = []
    for run, gain in (("a", 0.1), (other, 0.2)):
        night = report_log.SyntheticLog().request("gain", (gain,)).frames(200)
        hour_ns = len(paths) * 3600 * 10**9
        night.samples = [
            one._replace(publish_time_ns=one.publish_time_ns + hour_ns, receive_time_ns=one.receive_time_ns + hour_ns)
            for one in night.samples
        ]
        part = {"of": f"night-{len(paths)}", "number": "1"}
        monkeypatch.setattr(report_log, "METADATA", {"lowfc": {"run": run}, "part": part})
        paths.append(night.write(tmp_path / f"{len(paths)}.mcap"))
    found = workers.replay_files(paths, 0.0, 1, lambda done: None)
    assert (found.frames, found.unchecked, found.first_difference, found.runs) == (400, 0, None, sorted({"a", other}))


def test_a_damaged_log_is_replayed_except_for_the_damage(log: Path, tmp_path: Path) -> None:
    log = Path(shutil.copy(log, tmp_path))
    chunks = chunks_of(log)
    flipped(log, sum(chunks[len(chunks) // 2]) // 2)
    found = workers.replay_files([log], 0.0, 1, lambda done: None)
    steps = len(list(LogReader(log, topics=[STEP], skip_damaged=True)))
    assert found.identical
    assert len(found.damaged) == 1
    assert found.frames + found.unchecked == steps < STEPS
    assert found.inputs_missing == STEPS - steps
    text = lowfc("replay", log).stdout
    assert "unchecked" in text
    assert "damaged" in text
    assert "damaged            left out: at byte" in lowfc("latency", log).stdout


def test_a_finished_log_with_a_damaged_summary_is_not_called_cut_off(log: Path, tmp_path: Path) -> None:
    log = flipped(Path(shutil.copy(log, tmp_path)), -100)
    found = json_of("replay", log)
    assert (found["identical"], found["frames"]) == (True, STEPS)
    assert (found["complete"], found["no_end"]) == (False, "")


def test_a_forged_command_and_another_host_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    night = report_log.SyntheticLog().frames(STEPS)
    night.change(COMMAND, 400, lambda command: raise_actuator(command, 13))
    features = provenance()["cpu_features"] + " abacus"
    monkeypatch.setattr(report_log, "METADATA", {"lowfc": {"numpy": "1.0", "cpu_features": features}})
    forged = night.write(tmp_path / "forged.mcap")
    done = lowfc("replay", forged)
    assert done.exit_code == 1
    for expected in (
        f"{STEPS} frames, 1 message differs",
        "first difference   MirrorCommand of frame 400 ",
        "actuators: [13] log",
        "numpy              1.0 in the log",
        "cpu_features       abacus in the log, none on this host",
    ):
        assert expected in done.stdout
    assert lowfc("replay", forged, "--tolerance", 0.001).exit_code == 0
