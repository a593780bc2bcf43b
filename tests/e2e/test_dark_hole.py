"""A dark hole is dug while the loop runs: the loop does not undo it, and a replay is identical."""

import numpy as np
import pytest

from lowfc.arrays import Array
from lowfc.contract.codecs.calibration_codec import decode_calibration
from lowfc.contract.messages import CALIBRATION, COMMAND, OFFLOAD, STEP, wire
from lowfc.programs.paper.dark_hole import PLAIN, SHIFTED, STEPS, DarkHoleRun, dark_hole
from tests.support.loops import json_of, payloads

pytestmark = pytest.mark.slow

GRID = (34, 34)
DEAD = (352, 561, 595, 757)  # indices of actuators, row by row
STEP_RMS_NM = 2.0


def flat_nm() -> Array:
    """Flat map (rows, columns), nm of surface: small, because the simulated mirror is flat without one."""
    rows, columns = np.indices(GRID)
    return np.asarray(np.sin(rows / 2) * np.cos(columns / 3))


@pytest.fixture(scope="module")
def dark_hole_run(tmp_path_factory: pytest.TempPathFactory) -> DarkHoleRun:
    """Dark-hole steps on a channel that shifts the zero point, then on one that does not.

    The mirror has a flat map and dead actuators.
    """
    folder = tmp_path_factory.mktemp("dark_hole")
    active = np.ones(GRID)
    active.flat[list(DEAD)] = 0
    np.save(folder / "flat.npy", flat_nm())
    np.save(folder / "active.npy", active)
    toml = f'[mirror]\nflat = "flat.npy"\nactive = "active.npy"\ndead = {list(DEAD)}\n'
    return dark_hole(folder, STEP_RMS_NM, toml, flat_nm() * active)


@pytest.fixture(scope="module")
def logged(dark_hole_run: DarkHoleRun) -> dict[str, list[bytes]]:
    return payloads(dark_hole_run.log)


def test_the_loop_does_not_undo_the_steps(dark_hole_run: DarkHoleRun) -> None:
    channel = dark_hole_run.channels[SHIFTED]
    assert len(channel.channel_nm) == STEPS + 1
    assert np.linalg.norm(channel.channel_nm[-1]) > 15, "nm of wavefront that a loop without the shift would undo"
    undone_fraction, error = channel.undone()
    assert abs(undone_fraction) < 0.01
    assert error < 0.005


def test_without_the_shift_the_loop_undoes_the_steps(dark_hole_run: DarkHoleRun) -> None:
    undone_fraction, _ = dark_hole_run.channels[PLAIN].undone()
    assert undone_fraction == pytest.approx(1, abs=0.1)


def test_the_residual_grows_by_less_than_a_fifth(dark_hole_run: DarkHoleRun) -> None:
    before_nm, after_nm = dark_hole_run.channels[SHIFTED].residual_nm
    assert before_nm < 3
    assert after_nm < 1.2 * before_nm


def test_commands_contain_the_flat_map_and_leave_dead_actuators_at_zero(logged: dict[str, list[bytes]]) -> None:
    calibration = decode_calibration(wire.Calibration.FromString(logged[f"/{CALIBRATION.key}"][0]))
    expected = flat_nm().reshape(-1)
    expected[list(DEAD)] = 0
    messages = [wire.MirrorCommand.FromString(body) for body in logged[f"/{COMMAND.at('dm')}"][:300]]
    assert len(messages) == 300
    for message in messages:
        other_channels_nm = (
            np.frombuffer(message.actuators, "<f4") - calibration.modes_to_actuators @ message.command_nm
        )
        assert not np.frombuffer(message.actuators, "<f4")[list(DEAD)].any()
        np.testing.assert_allclose(other_channels_nm, expected, atol=1e-3)


def test_the_mean_command_is_published_once_a_second(logged: dict[str, list[bytes]]) -> None:
    """Every 1000 frames at 1 kHz, so that another adaptive-optics system can take over the mean command."""
    steps = [wire.ControlStep.FromString(body) for body in logged[f"/{STEP.key}"]]
    offloads = [wire.ModalOffload.FromString(body) for body in logged[f"/{OFFLOAD.key}"]]
    assert len(offloads) == len(steps) // 1000 > 2
    commands = {step.frame_sequence: step.command_nm for step in steps}
    for offload in offloads:
        assert offload.frames == 1000
        assert list(offload.noll) == list(range(2, 16))
        last = offload.frame_sequence
        expected = np.mean([commands[sequence] for sequence in range(last - 999, last + 1)], axis=0)
        np.testing.assert_allclose(offload.command_nm, expected, atol=1e-4)
    times_ns = [offload.timestamp.ToNanoseconds() for offload in offloads]
    assert np.diff(times_ns) == pytest.approx(1e9)


def test_the_run_is_replayed_to_the_bit(dark_hole_run: DarkHoleRun) -> None:
    results = json_of("replay", dark_hole_run.log)
    assert results["identical"]
    assert results["largest_difference_nm"] == 0
    assert results["requests"] > STEPS
