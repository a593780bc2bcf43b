"""Histories of logs with values that the loop never sends, with lost messages and with restarts."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.logs.history import History, read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.envelope import sequence_of
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    EVENT,
    HEALTH,
    MIRROR_STATE,
    STEP,
    TIMING,
    TRUTH,
    Log,
    Topic,
    timestamp,
    wire,
)
from tests.support.report_log import TOY_CALIBRATION, SyntheticLog
from tests.support.toy import NOLL, PERIOD_NS, START, calibration

STEPS = 20


def history_of(night: SyntheticLog, path: Path) -> History:
    return read_history(LogReader(night.write(path)))


def test_late_commands_after_a_restart_of_the_camera_are_counted(tmp_path: Path) -> None:
    night = SyntheticLog()
    for start_s, count, late in ((START, 0, 40), (START, 1, 43), (START + 60, 0, 4), (START + 60, 1, 6)):
        night.put(HEALTH, wire.Health(process="camera", commands_late=late), sequence_of(start_s, count), "camera")
    assert history_of(night, tmp_path / "x.mcap").commands_late == 3 + 6  # the first 40 were late before the log


def test_the_rate_is_that_of_most_steps_and_steps_at_another_rate_are_marked(tmp_path: Path) -> None:
    night = SyntheticLog().frames(STEPS)
    settings = night.messages(CAMERA_STATE)[0]
    for factor, frames in ((2, 5), (1, 5)):
        settings.timestamp.CopyFrom(timestamp(night.now_ns))
        settings.period_ns = factor * PERIOD_NS
        night.put(CAMERA_STATE, settings)
        night.frames(frames)
    history = history_of(night, tmp_path / "x.mcap")
    assert history.rate_hz == 1e9 / PERIOD_NS
    assert history.under_calibration.tolist() == [True] * STEPS + [False] * 5 + [True] * 5


def test_the_attached_calibration_replaces_a_lost_message(tmp_path: Path) -> None:
    night = SyntheticLog().frames(STEPS)
    complete = history_of(night, tmp_path / "complete.mcap")
    history = read_history(LogReader(night.without(CALIBRATION).write(tmp_path / "x.mcap", attached=TOY_CALIBRATION)))
    assert complete.calibration is not None
    assert history.calibration is not None
    assert history.calibration.id == complete.calibration.id
    np.testing.assert_equal(history.steps.error_nm, complete.steps.error_nm)
    assert history.remarks == [f"{history.log.path}: the message of its calibration is lost; the attached one is used"]
    other = with_identity(calibration(NOLL, 2.0))  # no controller reported using it
    for name, attached in (("none", None), ("other", other)):
        history = read_history(LogReader(night.write(tmp_path / f"{name}.mcap", attached=attached)))
        assert history.calibration is None
        assert (len(history.steps.sequence), history.excluded_messages) == (0, STEPS)
        assert not history.remarks


def test_a_repeated_reason_sets_one_bit(tmp_path: Path) -> None:
    night = SyntheticLog().frames(STEPS)
    night.change(STEP, -10, lambda step: step.reasons.extend([62, 62, 5]))
    history = history_of(night, tmp_path / "x.mcap")
    assert history.excluded_messages == 0
    assert history.steps.reasons.max() == 1 << 62 | 1 << 5


@pytest.mark.parametrize(
    ("topic", "change"),
    [
        (STEP, lambda step: setattr(step, "mode", 300)),
        (STEP, lambda step: setattr(step, "mode", -1)),
        (STEP, lambda step: step.reasons.append(70)),
        (STEP, lambda step: step.reasons.append(-1)),
        (STEP, lambda step: setattr(step.timestamp, "seconds", 10**12)),
        (STEP, lambda step: setattr(step.timestamp, "seconds", -(10**12))),
        (STEP, lambda step: step.error_nm.append(1.0)),
        (STEP, lambda step: step.pol_nm.pop()),
        (STEP, lambda step: setattr(step, "flux_dn", np.inf)),
        (MIRROR_STATE, lambda state: state.limits_hit.append(70)),
        (MIRROR_STATE, lambda state: state.limits_hit.append(-3)),
        (MIRROR_STATE, lambda state: setattr(state, "actuators", b"\0\0\xc0\x7f" * (state.rows * state.columns))),
        (TRUTH, lambda truth: truth.residual_nm.append(1.0)),
        (TRUTH, lambda truth: truth.residual_nm.__setitem__(1, -np.inf)),
        (TIMING, lambda timing: timing.compute_ns.append(1)),
        (TIMING, lambda timing: timing.ClearField("frame_sequence")),
    ],
)
def test_an_invalid_message_is_left_out_of_every_column(
    tmp_path: Path, topic: Topic, change: Callable[[Any], object]
) -> None:
    night = SyntheticLog().frames(STEPS)
    night.change(topic, -10, change)
    history = history_of(night, tmp_path / "x.mcap")
    for kind, columns in ((STEP, history.steps), (MIRROR_STATE, history.mirror), (TRUTH, history.truths)):
        extremes = ("highest_nm", "lowest_nm")
        lengths = {len(getattr(columns, column)) for column in columns.__slots__ if column not in extremes}
        assert lengths == {STEPS - (kind is topic)}
    assert np.isfinite(history.steps.error_nm).all()
    assert np.isfinite(history.mirror.highest_nm - history.mirror.lowest_nm).all()
    assert {len(stage) for stage in history.stages_ns.values()} == {len(history.timed_sequence)}
    assert len(history.timed_sequence) == STEPS - (topic is TIMING)
    assert len(history.stepped_sequence) == STEPS
    assert history.excluded_messages == 1 or topic is not STEP


def test_a_message_with_an_impossible_time_is_left_out(tmp_path: Path) -> None:
    night = SyntheticLog().frames(STEPS)
    night.put(EVENT, Log(), late_ns=(1 << 63) - night.now_ns)
    history = history_of(night, tmp_path / "x.mcap")
    assert history.excluded_messages == 1
    assert history.span_ns[1] < 1 << 62


def test_the_span_of_a_log_does_not_include_an_older_state_at_its_beginning(tmp_path: Path) -> None:
    night = SyntheticLog()
    state = night.samples[night.indices(CAMERA_STATE)[0]]
    night.samples = []
    night.frames(STEPS)
    first_ns, last_ns = night.samples[0].receive_time_ns, max(sample.receive_time_ns for sample in night.samples)
    night.samples.insert(0, state._replace(receive_time_ns=first_ns - 3600 * 10**9))
    assert history_of(night, tmp_path / "x.mcap").span_ns == (first_ns, last_ns)
