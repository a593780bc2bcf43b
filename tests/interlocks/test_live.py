"""Interlocks with the real processes: a value acts at the next frame, replay is identical, a flood loses no frame."""

import json
import random
import time
from itertools import pairwise
from pathlib import Path

import pytest

from lowfc.adapters.logs.reader import LogReader
from lowfc.client import Client
from lowfc.contract.errors import BusError, RequestRefusedError
from lowfc.contract.messages import BENCH, CONTROL_INPUT, FRAME, STEP, wire
from tests.support.loops import FIXED, interrupt, output_of, started, until

RATE_HZ = 100  # leaves a host with two cores time for the flood: at 500 Hz the flood's publisher waits for a core
FLIPS = 60
MAX_AGE_S = 1
FLOOD_HZ = 2000
FLOOD_S = 1
SECOND_NS = 1_000_000_000
RUN = "flipped"
CONFIG = f"""
[camera]
rate_hz = {RATE_HZ}
{FIXED}
[[interlocks]]
name = "mask"
value = true
action = "hold"
max_age_s = {MAX_AGE_S}
[[interlocks]]
name = "shutter"
test = "different"
value = "open"
action = "open"
when_old = "passes"
"""


@pytest.mark.exclusive
def test_interlocks_act_on_values_within_a_period_and_a_flood_of_values_loses_no_frame(tmp_path: Path) -> None:
    """A value older than its maximum age acts as a missing one."""
    (tmp_path / "night.toml").write_text(CONFIG)
    options = ("--json", "--config", "night.toml", "--run", RUN, "--duration", "600")
    with started(tmp_path, "sim-loop", *options) as process:
        until(lambda: any(tmp_path.glob("logs/*.mcap.part")), 60)  # a replay needs every request since the last state
        _publish()
        out, stderr = interrupt(process)
    assert process.returncode == 0, stderr
    results = json.loads(out)
    assert results["frames_missing"] == results["messages_lost"] == 0
    assert results["frames_skipped"] < FLOOD_S * RATE_HZ / 5, "stalls of the host skip few frames, a flood most"
    log = tmp_path / results["log"]
    replayed = json.loads(output_of(tmp_path, f"lowfc replay --json {log}"))
    assert replayed["identical"]
    assert replayed["unchecked"] == 0
    _steps_follow_the_inputs(log)
    _values_act_at_the_next_frame(log)


def _publish() -> None:
    """Publish values at random times, then a flood of them, then none."""
    rng = random.Random(3)  # noqa: S311
    with Client(RUN) as loop:
        until(lambda: _has_frames(loop), 60)
        loop.bench("shutter", "open")
        for number in range(FLIPS):  # some values fall between the same two frames
            for acts in (True, False):
                time.sleep(rng.uniform(0, 7.5 / RATE_HZ))  # up to seven and a half frame periods
                if number % 5:
                    loop.bench("mask", acts)
                else:
                    loop.bench("mask", False)
                    loop.bench("shutter", "shut" if acts else "open")
                    if not acts:
                        until(lambda: _try_to_close(loop))
        begun_s = time.monotonic()
        for number in range(FLOOD_HZ * FLOOD_S):
            loop.bench("mask", False)
            if number > FLOOD_HZ * (time.monotonic() - begun_s):
                time.sleep(0.005)
        until(lambda: [acting.why[:8] for acting in loop.status().state.interlocks_acting] == ["no value"])


def _has_frames(loop: Client) -> bool:
    """Whether the loop has received frames; before that the controller may not reply."""
    try:
        return bool(loop.status().state.frame_sequence)
    except BusError:
        return False


def _try_to_close(loop: Client) -> bool:
    """Try to close the loop; the request is refused until the values have been received."""
    loop.bench("mask", False)
    try:
        return loop.close_loop().accepted
    except RequestRefusedError:
        return False


def _steps_follow_the_inputs(log: Path) -> None:
    """Every step agrees with the interlock inputs before it; a value acts as missing from its maximum age on."""
    types = {STEP.key: wire.ControlStep, CONTROL_INPUT.key: wire.ControlInput}
    messages = [types[read.key].FromString(read.payload) for read in LogReader(log, topics=[STEP, CONTROL_INPUT])]
    changes = held = opened = age_ns = 0
    mask = shut = False
    for message in sorted(messages, key=lambda message: message.input_number):
        if isinstance(message, wire.ControlStep):
            assert (wire.REASON_HELD in message.reasons) is (mask and message.mode == wire.LOOP_MODE_CLOSED)
            assert not (shut and message.mode == wire.LOOP_MODE_CLOSED)
            held, opened = held + mask, opened + shut
        elif message.WhichOneof("input") == "bench_report":
            changes += 1
            report = message.bench_report
            if report.name == "shutter":
                shut = report.value.text != "open"
            else:
                mask = report.value.truth or not report.HasField("value") or report.age_ns > MAX_AGE_S * SECOND_NS
                age_ns = report.age_ns
    assert changes >= FLIPS
    assert held
    assert opened
    assert 0 < age_ns - MAX_AGE_S * SECOND_NS < SECOND_NS // 10


def _values_act_at_the_next_frame(log: Path) -> None:
    """The first frame published at least a period after a value obeys it; a few values may arrive later."""
    messages = list(LogReader(log, topics=[BENCH, STEP, FRAME]))
    values = [one for one in messages if one.key == BENCH.at("mask")]
    frames_ns = {one.sequence: one.publish_time_ns for one in messages if one.key == FRAME.key}
    steps = [wire.ControlStep.FromString(one.payload) for one in messages if one.key == STEP.key]
    obeyed = []
    for value, next_value in pairwise(values):
        acts = wire.BenchValue.FromString(value.payload).truth
        begun_ns = value.publish_time_ns + SECOND_NS // RATE_HZ
        between = [step for step in steps if begun_ns < frames_ns[step.frame_sequence] < next_value.publish_time_ns]
        obeyed += [
            (wire.REASON_HELD in step.reasons) is (acts and step.mode == wire.LOOP_MODE_CLOSED) for step in between[:1]
        ]
    assert len(obeyed) > FLIPS // 2
    assert obeyed.count(False) <= len(obeyed) // 10, f"{obeyed.count(False)} of {len(obeyed)} values arrived later"
