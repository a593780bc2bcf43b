"""Whatever an operator asks, and whenever: answered, no jump, no limit crossed, and the log says it all."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import Phase, given
from hypothesis import settings as effort
from hypothesis import strategies as st
from safety_checks import violations
from toy import NOLL, calibration, frame, settings

from lowfc.contract import codec
from lowfc.contract.calibration_codec import encode_calibration, identified
from lowfc.contract.events import EVENTS
from lowfc.contract.law_codec import wire_law
from lowfc.contract.messages import wire
from lowfc.contract.state_codec import controller_state, decode_state
from lowfc.control.inputs import Frame, Input, Load, Outputs, Reply, Request, Tick
from lowfc.control.law import Law
from lowfc.control.linear_law import LinearLaw, integrator, integrator_block, of_blocks
from lowfc.control.loop import advance
from lowfc.control.requests import REQUESTS, prepared
from lowfc.control.safety import LoopMode
from lowfc.control.state import Settings, State

Single = npt.NDArray[np.float32]

COMMANDS = 40
"""In each example."""
TIGHT: dict[str, object] = {"limit_nm": (40.0, 15.0), "most_saturated": 0}
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
        each = np.full(len(modes), gain, np.float32)
        return integrator(Law(each, each * 0, each + 1), modes, delay_frames, 1000.0)

    of_pol = of_blocks(
        [integrator_block(0.2, 0.01, "pol", delay_frames)] * len(noll), "pol", "leaky", noll, delay_frames, 1000.0
    )
    return one(0.3), of_pol, one(3.0), one(0.3, (7, 8))


class Script:
    """Requests as they come from the bus, and frames of a sensor that sees what the mirror does."""

    def __init__(self, what: Settings, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.what = what
        self.count = 0

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

    def payload(self, name: str) -> bytes:
        """The message's bytes, sometimes damaged."""
        whole = self.message(name).SerializeToString()
        match self.rng.integers(20):
            case 0:
                return self.rng.bytes(12)
            case 1:
                return whole[: len(whole) // 2]
        return whole

    def frame(self, state: State) -> Frame:
        """What the sensor sees: a disturbance, and the mirror as the last command left it."""
        self.count += 1 + int(self.rng.random() < 0.03) * 3
        disturbance = self.rng.normal(STATIC_NM, 3)
        if state.drive is not None:
            mirror = CALIBRATION.modes_to_actuators
            disturbance = disturbance + np.linalg.lstsq(mirror, state.drive.actuators_nm.ravel(), rcond=None)[0]
        odd: dict[str, object] = {"pixels": None} if self.rng.random() < 0.04 else {}
        return frame(self.count, disturbance, **odd)


@dataclass
class Run:
    """What was taken, and what was said: as bytes."""

    state: State
    taken: list[Input]
    said: list[bytes]
    counts: Counter[tuple[str, bool]]


def said(taken: Input, outputs: Outputs, state: State, what: Settings) -> bytes:
    """Everything that an input gave rise to, as it goes to the bus."""
    step = codec.encode_step(outputs.step, state.taken) if outputs.step else b""
    command = codec.encode_command(outputs.command, 1, "c", state.taken) if outputs.command else b""
    reply = b""
    if isinstance(taken, Request):
        assert outputs.reply is not None
        reply = codec.encode_request(taken, outputs.reply, state.taken, None)
    events = [EVENTS[one.name].log("controller", 0, **one.details).SerializeToString() for one in outputs.events]
    return b"|".join((step, command, reply, *events))


def taken_one(what: Settings, state: State, taken: Input) -> tuple[State, Outputs]:
    """Take an input; nothing that comes out jumps, and what is refused changes nothing."""
    after, outputs = advance(what, state, taken)
    if isinstance(taken, Request):
        assert outputs.reply is not None
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
    if state.mode is LoopMode.SAFED and after.mode is not LoopMode.SAFED:
        assert isinstance(taken, Request)
        assert taken.name == "clear"
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
    if pause == 0 and script.rng.random() < 0.2:
        yield Tick(1, int(script.rng.choice([20, 80])) * 1_000_000)
    try:
        yield codec.decode_request(script.payload(name), name, 7)
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


def check(names: list[str], pauses: list[int], seed: int, delay_frames: float, tight: bool) -> Run:
    """Run, and replay: from the beginning, and from a state on the wire in the middle."""
    what = settings(delay_frames=delay_frames, **(TIGHT if tight else {}))
    run = operated(what, names, pauses, seed)
    assert sum(run.counts.values()) == len(names), "every request is answered"
    begun, _ = advance(what, State(), Load(0, CALIBRATION, "a test"))
    end, heard = replayed(what, begun, run, 0)
    assert heard == run.said
    last = controller_state(run.state, what, 9).SerializeToString()
    assert controller_state(end, what, 9).SerializeToString() == last
    middle = len(run.taken) // 2
    state, _ = replayed(what, begun, Run(begun, run.taken[:middle], run.said[:middle], Counter()), 0)
    assert state.drive is not None
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
names = st.lists(st.sampled_from([*NAMES, *NAMES, "safe"]), min_size=COMMANDS, max_size=COMMANDS)
pauses = st.lists(st.sampled_from([0, 1, 1, 2, 5, 12]), min_size=COMMANDS, max_size=COMMANDS)
random_commands = given(names, pauses, st.integers(0, 2**32 - 1), st.sampled_from([1.0, 1.5, 2.0]), st.booleans())
quick = effort(max_examples=25, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
thorough = effort(max_examples=1000, deadline=None, phases=[Phase.explicit, Phase.generate, Phase.shrink])


@quick
@random_commands
def test_a_thousand_random_commands(
    names: list[str], pauses: list[int], seed: int, delay_frames: float, tight: bool
) -> None:
    check(names, pauses, seed, delay_frames, tight)


@pytest.mark.slow
@thorough
@random_commands
def test_forty_thousand_random_commands(
    names: list[str], pauses: list[int], seed: int, delay_frames: float, tight: bool
) -> None:
    check(names, pauses, seed, delay_frames, tight)


def test_the_random_commands_are_what_they_should_be() -> None:
    """Of every kind some are accepted and some are refused: otherwise the tests above would show little."""
    rng = np.random.default_rng(5)
    counts: Counter[tuple[str, bool]] = Counter()
    for seed in range(12):
        some: list[str] = rng.choice([*NAMES, *NAMES, "safe"], COMMANDS).tolist()
        counts += check(some, rng.choice([0, 1, 2, 5, 12], COMMANDS).tolist(), seed, 1.0, False).counts
    accepted = {name for name, good in counts if good}
    refused = {name for name, good in counts if not good}
    assert accepted == set(REQUESTS) - {"configuration"}
    assert refused >= {"step", "gain", "leak", "limit", "offset", "channel", "play", "law", "load", "note", "dance"}
