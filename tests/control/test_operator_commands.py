"""Random inputs: all requests are answered, the mirror does not jump, limits are kept, and a log can be replayed."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from lowfc.arrays import Single
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.calibration_codec import encode_calibration, with_identity
from lowfc.contract.codecs.law_codec import wire_law
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import wire
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.advance import advance
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.inputs import Frame, Input, Load, MirrorReport, MirrorShape, Outputs, Reply, Request, Tick
from lowfc.control.loop.requests import REQUESTS, prepared
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import Settings, State
from tests.support.safety_checks import violations
from tests.support.theory import integrators, law_of, linear
from tests.support.toy import DARK_DN, NOLL, SATURATION_DN, SHAPE, START, calibration, frame, frame_sequence, settings

REQUEST_COUNT = 40
"""Number of requests in each run."""
TIGHT: dict[str, object] = {"limit_nm": (40.0, 15.0), "max_saturated_pixels": 0}
CALIBRATION = with_identity(calibration())
TO_MODES = np.linalg.pinv(CALIBRATION.modes_to_actuators)
OTHERS = tuple(with_identity(calibration(noll, scale)) for noll, scale in ((NOLL, 1.1), ((2, 3), 1.0), ((2,), 0.9)))
"""Calibrations that replace `CALIBRATION`: another response, and fewer modes."""
OTHER_MIRROR = with_identity(replace(CALIBRATION, grid=(5, 4)))
CALIBRATIONS_BY_ID = {each.id: each for each in (CALIBRATION, *OTHERS, OTHER_MIRROR)}
HUGE = 3e38
STATIC_NM = (12.0, -8.0, 5.0)
"""Static part of the disturbance of each mode."""


def laws(delay_frames: float, noll: tuple[int, ...]) -> tuple[LinearLaw, ...]:
    """A stable law, a law of pseudo-open-loop modes, an unstable law, and a law of other modes."""

    def integrator_of(gain: float, modes: tuple[int, ...] = noll) -> LinearLaw:
        return linear(law_of(gain, modes=len(modes)), modes, delay_frames)

    pol_law = replace(integrators([(0.2, 0.01)] * len(noll), "pol", delay_frames), noll=noll)
    return integrator_of(0.3), pol_law, integrator_of(3.0), integrator_of(0.3, (7, 8))


class Script:
    """Random requests as from the bus, and frames of a sensor that sees the mirror."""

    def __init__(self, setup: Settings, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.setup = setup
        self.count, self.start = 0, START

    def number(self) -> float:
        """A number: mostly sensible, otherwise as after a typing error or from a faulty program."""
        odd = (np.nan, np.inf, -np.inf, HUGE, -HUGE, 1e-42, -1.0, 1e6)
        return float(self.rng.choice(odd)) if self.rng.random() < 0.15 else float(self.rng.uniform(0, 1.2))

    def modes(self) -> list[int]:
        some: list[list[int]] = [[], [], [2], [3, 4], [2, 3, 4], [4, 2], [2, 2], [9], [0, 2**32 - 1]]
        return some[self.rng.integers(len(some))]

    def shape(self) -> Single:
        """A mirror shape that is smooth, rough, too large, not finite, or for another mirror."""
        rows, columns = CALIBRATION.grid
        smooth = np.add.outer(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns))
        match self.rng.integers(8):
            case 0:
                return np.zeros(CALIBRATION.grid, np.float32)
            case 1:
                return np.full(CALIBRATION.grid, self.rng.choice([np.nan, np.inf, HUGE]), np.float32)
            case 2:
                return np.ones(int(self.rng.integers(40)), np.float32)
            case 3:
                return self.rng.normal(0, 300, CALIBRATION.grid).astype(np.float32)
            case _:
                return (smooth * self.rng.normal(0, 120) + self.rng.normal(0, 10, smooth.shape)).astype(np.float32)

    def table(self, columns: int, amplitude: float) -> Single:
        table = self.rng.normal(0, amplitude, (int(self.rng.integers(1, 12)), columns)).astype(np.float32)
        if self.rng.random() < 0.1:
            table.flat[0] = self.rng.choice([np.nan, HUGE, -1e6])
        return table

    def message(self, name: str) -> wire.Request:
        """A request of this name, with valid or invalid fields."""
        message = wire.Request(name=name, lease_id=int(self.rng.choice([0, 1, 1])))
        match name:
            case "gain" | "leak" | "limit":
                message.modes.extend(self.modes())
                message.values.extend(self.number() for _ in range(self.rng.choice([0, 1, 1, 1, 2, 3])))
            case "offset":
                message.modes.extend(self.modes())
                message.values.extend(self.number() * 10 for _ in range(self.rng.choice([0, 1, 1, 2, 3])))
            case "step":
                message.values.append(float(self.rng.choice([1, 2, 5, 0, -3, 2.5, np.nan, 1e30])))
            case "channel":
                message.text = str(self.rng.choice(["dark-hole", "flat", "offset", "a", "Dark", "", "a b", "x" * 40]))
                message.actuators = self.shape().tobytes()
            case "play":
                message.text = str(self.rng.choice(["mirror", "mirror", "offset", "sky"]))
                shapes = 2 if message.text == "mirror" else 0
                message.actuators = b"".join(self.shape().tobytes() for _ in range(shapes))
                table = self.table(shapes or len(NOLL), float(self.rng.choice([0.05, 0.3, 2.0])))
                message.table = table.tobytes()
                message.columns = table.shape[1]
            case "law":
                candidates = laws(self.setup.delay_frames, NOLL)
                if (index := int(self.rng.integers(len(candidates) + 1))) < len(candidates):
                    message.law.CopyFrom(wire_law(candidates[index]))
            case "load":
                loaded = (CALIBRATION, *OTHERS, OTHER_MIRROR, None)[self.rng.integers(6)]
                if loaded is not None:
                    message.calibration.MergeFromString(encode_calibration(loaded, 0))
            case "lease" | "renew" | "release":
                message.text = str(self.rng.choice(["lowfc calibrate"] * 8 + ["", "x" * 400]))
                message.values.append(float(self.rng.choice([10] * 10 + [1e-6, 0, -1, np.nan, 1e9])))
                if self.rng.random() < 0.1:
                    message.lease_id = int(self.rng.choice([0, 2]))
            case "note":
                message.text = str(self.rng.choice(["seeing is better", "", "n" * 20_000]))
        return message

    def frame(self, state: State) -> Frame:
        """A frame with a random disturbance and the shape of the last command."""
        self.count += 1 + int(self.rng.random() < 0.03) * 3
        disturbance = self.rng.normal(STATIC_NM, 3)
        if state.loop is not None:
            disturbance = disturbance + TO_MODES @ state.loop.actuators_nm.ravel()
        return frame(self.count, disturbance, sequence=frame_sequence(self.count, self.start))

    def disruption(self) -> Input:
        """A random input other than a good frame or a request."""
        rng, black = self.rng, np.zeros(SHAPE, np.uint16)
        newest = frame_sequence(self.count, self.start)
        pixels = (None, black, black + 65535, rng.integers(0, 65536, SHAPE).astype(np.uint16), black[:3])
        match rng.integers(9):
            case 0:
                return frame(0, sequence=newest - int(rng.integers(3)))
            case 1:
                self.count += 1
                return frame(0, sequence=newest + 1, age_ns=10**9)
            case 2 | 3:
                self.count += 1
                return frame(0, sequence=newest + 1, pixels=pixels[rng.integers(len(pixels))])
            case 4 if rng.random() < 0.1:
                self.start, self.count = self.start + 9, 0
                return frame(0, sequence=frame_sequence(0, self.start))
            case 4:
                shape = np.full(CALIBRATION.grid, rng.choice([0.0, 30.0, 650.0, np.nan]), np.float32)
                reported = MirrorShape(0, shape, rng.choice([0.0, 20.0, -1e30, np.nan], 3).astype(np.float32))
                fault = rng.choice(["", "", "", "does not answer"])
                return reported if rng.random() < 0.5 else MirrorReport(0, str(fault), reported)
            case 5 | 6:
                bias_dn = rng.choice([DARK_DN] * 14 + [0.0, np.nan])
                return CameraSettings(0, SHAPE, bias_dn, SATURATION_DN, start_s=self.start)
            case 7 if rng.random() < 0.2:
                return Load(0, (CALIBRATION, *OTHERS)[rng.integers(3)], "another")
        return Tick(1, int(rng.choice([0, 20, 80])) * 1_000_000)


@dataclass
class Run:
    """Inputs of a simulated loop, its outputs as bytes, its newest state, and this state as a message."""

    state: State
    message: wire.ControllerState
    inputs: list[Input]
    outputs: list[bytes]
    counts: Counter[tuple[str, bool]]


def serialised(input_: Input, outputs: Outputs, state: State) -> bytes:
    """All outputs of an input, as on the bus."""
    step = codec.encode_step(outputs.step, state.input_number) if outputs.step else b""
    command = codec.encode_command(outputs.command, 1, "c", state.input_number) if outputs.command else b""
    reply = b""
    if isinstance(input_, Request):
        reply = codec.encode_request(input_, outputs.reply, state.input_number, None)
    events = [EVENTS[event.name].log("controller", 0, **event.details).SerializeToString() for event in outputs.events]
    return b"|".join((step, command, reply, *events))


def checked_advance(setup: Settings, run: Run, input_: Input) -> Outputs:
    """Process an input; check that this has no side effects, keeps the limits, and changes nothing if it is refused."""
    if isinstance(input_, Frame) and input_.pixels is not None:
        input_.pixels.flags.writeable = False
    state = run.state
    after, outputs = advance(setup, state, input_)
    again, repeated = advance(setup, state, input_)
    run.outputs.append(serialised(input_, outputs, after))
    assert serialised(input_, repeated, again) == run.outputs[-1]
    run.state, before, run.message = after, run.message, controller_state(after, setup, 0)
    assert controller_state(again, setup, 0) == run.message
    assert controller_state(state, setup, 0) == before
    if isinstance(input_, Frame):
        assert outputs.step is not None
        assert (outputs.command is None) == (after.loop is None or not after.commanded)
        assert after.commanded or after.loop is None or state.conditions.mirror_fault, (
            "only a mirror fault defers the first command"
        )
    if isinstance(input_, Request):
        assert outputs.reply.text
        assert outputs.reply.frame_sequence == state.frame_sequence + 1
        assert outputs.command is None, "the next frame moves the mirror, not a request"
        if not outputs.reply.accepted:
            assert all(new is old for new, old in zip(after[:-1], state[:-1], strict=True)), (
                "a refusal changes nothing but `input_number`, the last field"
            )
        if state.loop is not None and after.loop is not None and after.loop.actuators_nm.size:
            assert np.array_equal(after.loop.actuators_nm, state.loop.actuators_nm)
    if outputs.command is not None and state.loop is not None:
        now = outputs.command.actuators_nm
        assert violations(setup.limits, state.loop.actuators_nm, now) == []
        assert np.isfinite(outputs.command.command_nm).all()
    if outputs.step is not None:
        assert np.isfinite(outputs.step.command_nm).all()
    if after.loop is not None and after.loop.law_runner is not None:
        assert np.isfinite(after.loop.law_runner.x).all()
    if state.mode is LoopMode.SAFE and after.mode is not LoopMode.SAFE:
        assert isinstance(input_, Request)
        assert input_.name == "clear"
        assert after.mode is not LoopMode.CLOSED
    return outputs


def random_run(setup: Settings, names: list[str], pauses: list[int], seed: int) -> Run:
    """Run of a loop with these requests, each after a number of frames."""
    script = Script(setup, seed)
    state, _ = advance(setup, State(), Load(0, CALIBRATION, "a test"))
    run = Run(state, controller_state(state, setup, 0), [], [], Counter())
    for name, pause in zip(names, pauses, strict=True):
        for input_ in inputs_up_to(script, name, pause, run):
            outputs = checked_advance(setup, run, input_)
            run.inputs.append(input_)
            if outputs.reply is not None:
                run.counts[name, outputs.reply.accepted] += 1
    return run


def inputs_up_to(script: Script, name: str, pause: int, run: Run) -> Iterator[Input]:
    """Frames of a pause, sometimes a disruption, and the request."""
    for _ in range(pause):
        yield script.frame(run.state)
    if script.rng.random() < 0.2:
        yield script.disruption()
    try:
        yield codec.decode_request(script.message(name).SerializeToString(), name, 7)
    except ValueError:  # the process refuses it before it reaches the loop
        run.counts[name, False] += 1


def replayed(setup: Settings, state: State, inputs: list[Input]) -> tuple[State, list[bytes]]:
    """Replay these inputs, with requests as published in the log."""
    sent = []
    for input_ in inputs:
        resent = input_
        if isinstance(input_, Request):
            logged = wire.Request.FromString(codec.encode_request(input_, Reply(True, "", 0), 1, None))
            resent = codec.request(logged, logged.name, 7, CALIBRATIONS_BY_ID)
        state, outputs = advance(setup, state, resent)
        sent.append(serialised(resent, outputs, state))
    return state, sent


def check(setup: Settings, names: list[str], pauses: list[int], seed: int) -> Run:
    """Simulate a loop, then replay its inputs: from the beginning, and from a decoded state in the middle."""
    run = random_run(setup, names, pauses, seed)
    assert sum(run.counts.values()) == len(names), "every request is answered"
    start_state, _ = advance(setup, State(), Load(0, CALIBRATION, "a test"))
    middle = len(run.inputs) // 2
    state, sent = replayed(setup, start_state, run.inputs[:middle])
    assert sent == run.outputs[:middle]
    end, sent = replayed(setup, state, run.inputs[middle:])
    assert sent == run.outputs[middle:]
    last = controller_state(run.state, setup, 9).SerializeToString()
    assert controller_state(end, setup, 9).SerializeToString() == last
    message = controller_state(state, setup, 8).SerializeToString()
    requests = [prepared(setup, input_) for input_ in run.inputs[:middle] if isinstance(input_, Request)]
    decoded, resumed = decode_state(
        wire.ControllerState.FromString(message),
        CALIBRATIONS_BY_ID[state.loop.calibration.id],
        {request.law.id: request.law for request in requests if request.law is not None},
        {request.played.id: request.played for request in requests if request.played is not None},
    )
    end, sent = replayed(decoded, resumed, run.inputs[middle:])
    assert sent == run.outputs[middle:]
    assert controller_state(end, decoded, 9).SerializeToString() == last
    return run


NAMES = [
    *(name for name in REQUESTS if name not in ("safe", "configuration")),
    *("close",) * 4,
    "lease",
    "renew",
    "clear",
    "dance",
]


@pytest.mark.parametrize("seeds", [24, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_inputs_are_handled_without_side_effects_and_within_the_limits(seeds: int) -> None:
    """Each request but `configuration`, which the process answers, is accepted at least once; most are also refused."""
    rng = np.random.default_rng(6)
    counts: Counter[tuple[str, bool]] = Counter()
    for seed in range(seeds):
        requests: list[str] = rng.choice([*NAMES, *NAMES, "safe"], REQUEST_COUNT).tolist()
        pauses: list[int] = rng.choice([0, 1, 2, 5, 12], REQUEST_COUNT).tolist()
        delay_frames, on_frame_timeout = float(rng.choice([1.0, 1.5, 3.0])), str(rng.choice(["hold", "flat"]))
        tight = TIGHT if seed % 2 else {}
        setup = settings(delay_frames=delay_frames, on_frame_timeout=on_frame_timeout, **tight)
        counts += check(setup, requests, pauses, seed).counts
    accepted = {name for name, good in counts if good}
    refused = {name for name, good in counts if not good}
    assert accepted == set(REQUESTS) - {"configuration"}
    assert refused >= {"step", "gain", "leak", "limit", "offset", "channel", "play", "law", "load", "note", "dance"}
