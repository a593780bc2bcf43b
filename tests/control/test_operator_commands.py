"""Whatever comes, and whenever: requests are answered, nothing jumps, no limit is crossed, and the log says it all."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given
from hypothesis import settings as effort
from hypothesis import strategies as st

from lowfc.arrays import Single
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.calibration_codec import encode_calibration, identified
from lowfc.contract.codecs.law_codec import wire_law
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import wire
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import (
    CameraSettings,
    Frame,
    Input,
    Load,
    MirrorReport,
    MirrorShape,
    Outputs,
    Reply,
    Request,
    Tick,
)
from lowfc.control.loop.requests import REQUESTS, prepared
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import Settings, State
from tests.support.safety_checks import violations
from tests.support.theory import integrators, law_of, linear
from tests.support.toy import (
    DARK_DN,
    GRID,
    NOLL,
    SATURATION_DN,
    SHAPE,
    START,
    calibration,
    frame,
    frame_sequence,
    settings,
)

COMMANDS = 40
"""In each example."""
TIGHT: dict[str, object] = {"limit_nm": (40.0, 15.0), "max_saturated_pixels": 0}
CALIBRATION = identified(calibration())
OTHERS = tuple(identified(calibration(noll, scale)) for noll, scale in ((NOLL, 1.1), ((2, 3), 1.0), ((2,), 0.9)))
ELSEWHERE = identified(replace(CALIBRATION, grid=(5, 4)))
KNOWN = {each.id: each for each in (CALIBRATION, *OTHERS, ELSEWHERE)}
LOUD = 3e38
STATIC_NM = (12.0, -8.0, 5.0)
"""Of each mode, on which the rest of the disturbance rides."""


def laws(delay_frames: float, noll: tuple[int, ...]) -> tuple[LinearLaw, ...]:
    """A stable one, one of the pseudo-open-loop modes, one that is not stable, one of other modes."""

    def one(gain: float, modes: tuple[int, ...] = noll) -> LinearLaw:
        return linear(law_of(gain, modes=len(modes)), modes, delay_frames)

    of_pol = replace(integrators([(0.2, 0.01)] * len(noll), "pol", delay_frames), noll=noll)
    return one(0.3), of_pol, one(3.0), one(0.3, (7, 8))


class Script:
    """Requests as they come from the bus, and frames of a sensor that sees what the mirror does."""

    def __init__(self, what: Settings, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.what = what
        self.count, self.start = 0, START

    def number(self) -> float:
        """Mostly sensible; otherwise what a slip of the finger, or a broken program, may send."""
        odd = (np.nan, np.inf, -np.inf, LOUD, -LOUD, 1e-42, -1.0, 1e6)
        return float(self.rng.choice(odd)) if self.rng.random() < 0.15 else float(self.rng.uniform(0, 1.2))

    def modes(self) -> list[int]:
        some: list[list[int]] = [[], [], [2], [3, 4], [2, 3, 4], [4, 2], [2, 2], [9], [0, 2**32 - 1]]
        return some[self.rng.integers(len(some))]

    def shape(self) -> Single:
        """A shape of the mirror that is smooth, rough, too large, not finite, or of another mirror."""
        rows, columns = CALIBRATION.grid
        smooth = np.add.outer(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns))
        match self.rng.integers(8):
            case 0:
                return np.zeros(CALIBRATION.grid, np.float32)
            case 1:
                return np.full(CALIBRATION.grid, self.rng.choice([np.nan, np.inf, LOUD]), np.float32)
            case 2:
                return np.ones(int(self.rng.integers(40)), np.float32)
            case 3:
                return self.rng.normal(0, 300, CALIBRATION.grid).astype(np.float32)
            case _:
                return (smooth * self.rng.normal(0, 120) + self.rng.normal(0, 10, smooth.shape)).astype(np.float32)

    def table(self, columns: int, amplitude: float) -> Single:
        table = self.rng.normal(0, amplitude, (int(self.rng.integers(1, 12)), columns)).astype(np.float32)
        if self.rng.random() < 0.1:
            table.flat[0] = self.rng.choice([np.nan, LOUD, -1e6])
        return table

    def message(self, name: str) -> wire.Request:
        """A request of that name, with what belongs to it, or something else."""
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
                of = laws(self.what.delay_frames, NOLL)
                if (place := int(self.rng.integers(len(of) + 1))) < len(of):
                    message.law.CopyFrom(wire_law(of[place]))
            case "load":
                one = (CALIBRATION, *OTHERS, ELSEWHERE, None)[self.rng.integers(6)]
                if one is not None:
                    message.calibration.MergeFromString(encode_calibration(one, 0))
            case "lease" | "renew" | "release":
                message.text = str(self.rng.choice(["lowfc calibrate"] * 8 + ["", "x" * 400]))
                message.values.append(float(self.rng.choice([10] * 10 + [1e-6, 0, -1, np.nan, 1e9])))
                if self.rng.random() < 0.1:
                    message.lease_id = int(self.rng.choice([0, 2]))
            case "note":
                message.text = str(self.rng.choice(["seeing is better", "", "n" * 20_000]))
        return message

    def frame(self, state: State) -> Frame:
        """What the sensor sees: a disturbance, and the mirror as the last command left it."""
        self.count += 1 + int(self.rng.random() < 0.03) * 3
        disturbance = self.rng.normal(STATIC_NM, 3)
        if state.drive is not None:
            mirror = CALIBRATION.modes_to_actuators
            disturbance = disturbance + np.linalg.lstsq(mirror, state.drive.actuators_nm.ravel(), rcond=None)[0]
        return frame(self.count, disturbance, sequence=frame_sequence(self.count, self.start))

    def happening(self) -> Input:
        """What may come beside good frames and requests."""
        rng, still = self.rng, np.zeros(SHAPE, np.uint16)
        newest = frame_sequence(self.count, self.start)
        pixels = (None, still, still + 65535, rng.integers(0, 65536, SHAPE).astype(np.uint16), still[:3])
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
                shape = np.full(GRID, rng.choice([0.0, 30.0, 650.0, np.nan]), np.float32)
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
    """What was taken, and what was said: as bytes."""

    state: State
    taken: list[Input]
    said: list[bytes]
    counts: Counter[tuple[str, bool]]


def said(taken: Input, outputs: Outputs, state: State, what: Settings) -> bytes:
    """Everything that an input gave rise to, as it goes to the bus."""
    step = codec.encode_step(outputs.step, state.input_number) if outputs.step else b""
    command = codec.encode_command(outputs.command, 1, "c", state.input_number) if outputs.command else b""
    reply = b""
    if isinstance(taken, Request):
        assert outputs.reply is not None
        reply = codec.encode_request(taken, outputs.reply, state.input_number, None)
    events = [EVENTS[one.name].log("controller", 0, **one.details).SerializeToString() for one in outputs.events]
    return b"|".join((step, command, reply, *events))


def taken_one(what: Settings, state: State, taken: Input) -> tuple[State, Outputs]:
    """Take an input, whose arrays are read-only: it is pure, nothing that comes out jumps, refused is as not asked."""
    if isinstance(taken, Frame) and taken.pixels is not None:
        taken.pixels.flags.writeable = False
    before = controller_state(state, what, 0)
    after, outputs = advance(what, state, taken)
    again, repeated = advance(what, state, taken)
    assert said(taken, repeated, again, what) == said(taken, outputs, after, what)
    assert controller_state(again, what, 0) == controller_state(after, what, 0)
    assert controller_state(state, what, 0) == before
    if isinstance(taken, Frame):
        assert outputs.step is not None
        assert (outputs.command is None) == (after.drive is None)
    if isinstance(taken, Request):
        assert outputs.reply.text
        assert outputs.reply.frame_sequence == state.frame_sequence + 1
        assert outputs.command is None, "the next frame moves the mirror, not a request"
        if not outputs.reply.accepted:
            assert all(now is was for now, was in zip(after[:-1], state[:-1], strict=True)), "but `taken`, the last"
        if state.drive is not None and after.drive is not None and after.drive.actuators_nm.size:
            assert np.array_equal(after.drive.actuators_nm, state.drive.actuators_nm)
    if outputs.command is not None and state.drive is not None:
        now = outputs.command.actuators_nm
        assert violations(what.limits, state.drive.actuators_nm, now) == []
        assert np.isfinite(outputs.command.command_nm).all()
    if outputs.step is not None:
        assert np.isfinite(outputs.step.command_nm).all()
    if after.drive is not None and after.drive.following is not None:
        assert np.isfinite(after.drive.following.x).all()
    if state.mode is LoopMode.SAFE and after.mode is not LoopMode.SAFE:
        assert isinstance(taken, Request)
        assert taken.name == "clear"
        assert after.mode is not LoopMode.CLOSED
    return after, outputs


def operated(what: Settings, names: list[str], pauses: list[int], seed: int) -> Run:
    """The run of a loop to which these requests come, each after so many frames."""
    script = Script(what, seed)
    state, _ = advance(what, State(), Load(0, CALIBRATION, "a test"))
    run = Run(state, [], [], Counter())
    for name, pause in zip(names, pauses, strict=True):
        for taken in between(script, name, pause, run):
            run.state, outputs = taken_one(what, run.state, taken)
            run.taken.append(taken)
            run.said.append(said(taken, outputs, run.state, what))
            if outputs.reply is not None:
                run.counts[name, outputs.reply.accepted] += 1
    return run


def between(script: Script, name: str, pause: int, run: Run) -> Iterator[Input]:
    for _ in range(pause):
        yield script.frame(run.state)
    if script.rng.random() < 0.2:
        yield script.happening()
    try:
        yield codec.decode_request(script.message(name).SerializeToString(), name, 7)
    except ValueError:  # the process answers it, before the loop hears of it
        run.counts[name, False] += 1


def replayed(what: Settings, state: State, run: Run, begin: int) -> tuple[State, list[bytes]]:
    """The rest of a run from its log: requests as they were published."""
    heard = []
    for taken in run.taken[begin:]:
        again = taken
        if isinstance(taken, Request):
            logged = wire.Request.FromString(codec.encode_request(taken, Reply(True, "", 0), 1, None))
            again = codec.request(logged, logged.name, 7, KNOWN)
        state, outputs = advance(what, state, again)
        heard.append(said(again, outputs, state, what))
    return state, heard


def check(names: list[str], pauses: list[int], seed: int, delay_frames: float, tight: bool, silence: str) -> Run:
    """Run, and replay: from the beginning, and from a state on the wire in the middle."""
    what = settings(delay_frames=delay_frames, on_frame_timeout=silence, **(TIGHT if tight else {}))
    run = operated(what, names, pauses, seed)
    assert sum(run.counts.values()) == len(names), "every request is answered"
    begun, _ = advance(what, State(), Load(0, CALIBRATION, "a test"))
    end, heard = replayed(what, begun, run, 0)
    assert heard == run.said
    last = controller_state(run.state, what, 9).SerializeToString()
    assert controller_state(end, what, 9).SerializeToString() == last
    middle = len(run.taken) // 2
    state, _ = replayed(what, begun, Run(begun, run.taken[:middle], run.said[:middle], Counter()), 0)
    sent = controller_state(state, what, 8).SerializeToString()
    asked = [prepared(what, one) for one in run.taken[:middle] if isinstance(one, Request)]
    again, resumed = decode_state(
        wire.ControllerState.FromString(sent),
        KNOWN[state.drive.calibration.id],
        {one.law.id: one.law for one in asked if one.law is not None},
        {one.played.id: one.played for one in asked if one.played is not None},
    )
    end, heard = replayed(again, resumed, run, middle)
    assert heard == run.said[middle:]
    assert controller_state(end, again, 9).SerializeToString() == last
    return run


NAMES = [
    *(name for name in REQUESTS if name not in ("safe", "configuration")),
    *("close",) * 4,
    "lease",
    "renew",
    "clear",
    "dance",
]


def test_whatever_comes_in_it_is_pure_finite_and_within_the_limits() -> None:
    """Of every kind of request some are accepted and some are refused: otherwise it would show little."""
    rng = np.random.default_rng(6)
    counts: Counter[tuple[str, bool]] = Counter()
    for seed in range(24):
        some: list[str] = rng.choice([*NAMES, *NAMES, "safe"], COMMANDS).tolist()
        pauses: list[int] = rng.choice([0, 1, 2, 5, 12], COMMANDS).tolist()
        delay_frames, silence = float(rng.choice([1.0, 1.5, 3.0])), str(rng.choice(["hold", "flat"]))
        counts += check(some, pauses, seed, delay_frames, bool(seed % 2), silence).counts
    accepted = {name for name, good in counts if good}
    refused = {name for name, good in counts if not good}
    assert accepted == set(REQUESTS) - {"configuration"}
    assert refused >= {"step", "gain", "leak", "limit", "offset", "channel", "play", "law", "load", "note", "dance"}


@pytest.mark.slow
@effort(max_examples=1000, deadline=None, phases=[Phase.explicit, Phase.generate, Phase.shrink])
@given(
    names=st.lists(st.sampled_from([*NAMES, *NAMES, "safe"]), min_size=COMMANDS, max_size=COMMANDS),
    pauses=st.lists(st.sampled_from([0, 1, 1, 2, 5, 12]), min_size=COMMANDS, max_size=COMMANDS),
    seed=st.integers(0, 2**32 - 1),
    delay_frames=st.sampled_from([1.0, 1.5, 3.0]),
    tight=st.booleans(),
    silence=st.sampled_from(["hold", "flat"]),
)
def test_whatever_comes_in_for_long(**commands: Any) -> None:
    check(**commands)
