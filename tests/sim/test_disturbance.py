"""Disturbances and faults of the simulated camera: their statistics, and reproducibility from the seed."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.codecs.codec import decode_frame
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import FRAME, image
from lowfc.contract.sections import Preset
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from sim_camera.disturbance import (
    BLOCK,
    LINES_HZ,
    DampedLine,
    Disturbance,
    Sampler,
    _DampedLines,
    preset_disturbance,
    screen,
    variances_nm2,
)
from sim_camera.faults import LOST_SHARE, MAX_FRAMES_LATE, TRACK_PIXELS, Fault, Kind
from sim_camera.faulty import EARLIER_S, FaultyFrames, read_fault
from tests.support.theory import modes_nm

NOLL = tuple(range(2, 16))
NM_PER_MAS = 2.424
WHEEL = "reaction-wheel"
IDEAL = "reaction-wheel-ideal"
RATE_HZ = 1000.0
PRESETS = get_args(Preset)


def preset(name: str, seed: int = 1, **more: object) -> Disturbance:
    return preset_disturbance(name, NOLL, seed, NM_PER_MAS, 550.0, **more)


def rms_nm(disturbance: Disturbance) -> np.ndarray:
    """Rms of each mode over all time, from the amplitudes of its sine waves."""
    return np.sqrt(np.sum(np.abs(disturbance.amplitude_nm) ** 2, axis=0) / 2)


def check_order_and_block(name: str, first: int, count: int, cut: int) -> None:
    """Check that frames are the same if computed from `first`, from `first + cut`, alone, or by a second object."""
    disturbance = preset(name, static_nm={4: 3.0})
    expected = modes_nm(disturbance, first, count, RATE_HZ)
    cut = min(cut, count - 1)
    assert expected.shape == (count, len(NOLL))
    assert np.array_equal(modes_nm(disturbance, first + cut, count - cut, RATE_HZ), expected[cut:])
    assert np.array_equal(modes_nm(disturbance, first + cut, 1, RATE_HZ)[0], expected[cut])
    assert np.array_equal(modes_nm(preset(name, static_nm={4: 3.0}), first, count, RATE_HZ), expected)


@pytest.mark.parametrize("name", [name for name in PRESETS if name != WHEEL])
@settings(max_examples=6, deadline=None, derandomize=True)
@given(first=st.integers(0, 10**9), count=st.integers(1, 80), cut=st.integers(0, 80))
def test_modes_do_not_depend_on_order_or_block(name: str, first: int, count: int, cut: int) -> None:
    check_order_and_block(name, first, count, cut)


@pytest.mark.parametrize(
    ("first", "count", "cut"),
    [
        *[(0, 1, 0), (245, 32, 31), (2_186, 74, 1), (5_881, 56, 48), (16_380, 19, 10)],
        pytest.param(43_881, 19, 10, marks=pytest.mark.slow),
        pytest.param(85_596, 65, 6, marks=pytest.mark.slow),
    ],
)
def test_damped_lines_do_not_depend_on_order_or_block(first: int, count: int, cut: int) -> None:
    """Chosen frames, not random ones as above: damped lines need all frames before the first, and 10^7 take minutes."""
    check_order_and_block(WHEEL, first, count, cut)


@pytest.mark.parametrize("name", ["bench", "thermal", WHEEL])
def test_another_seed_gives_another_disturbance_with_the_same_rms(name: str) -> None:
    one, other = preset(name, 1), preset(name, 2)
    assert np.abs(modes_nm(one, 0, 50, RATE_HZ) - modes_nm(other, 0, 50, RATE_HZ)).max() > 0.5
    assert rms_nm(one) == pytest.approx(rms_nm(other), rel=1e-9)


@pytest.mark.parametrize("name", PRESETS)
def test_scale_multiplies_the_disturbance(name: str) -> None:
    one, thrice = preset(name), preset(name, scale=3.0)
    assert np.allclose(modes_nm(thrice, 5, 7, RATE_HZ), 3 * modes_nm(one, 5, 7, RATE_HZ), atol=1e-4)
    assert thrice.screen_nm == pytest.approx(3 * one.screen_nm)


def test_ideal_reaction_wheel_has_14_mas_per_axis_in_five_lines() -> None:
    disturbance = preset(IDEAL)
    per_axis_mas = rms_nm(disturbance)[:2] / NM_PER_MAS
    assert np.abs(per_axis_mas / 14 - 1).max() < 0.05
    assert LINES_HZ == (6.0, 18.0, 37.0, 71.0, 117.0)
    for axis in (0, 1):
        power = np.abs(disturbance.amplitude_nm[:, axis]) ** 2
        lines = np.isin(disturbance.frequency_hz, LINES_HZ)
        assert lines.sum() == 5
        assert power[lines].sum() > 0.9 * power.sum()
        assert disturbance.frequency_hz[~lines].max() < 6
        assert (np.diff(power[lines]) < 0).all()


@pytest.mark.parametrize("width", [0.005, 0.02])
def test_damped_lines_have_the_configured_power_and_coherence(width: float) -> None:
    """Variance, and autocorrelation exp(-pi width t), over 400 seeds of one line on two axes."""
    line, rate_hz = DampedLine(37.0, 37.0 * width, np.array([2.0, 3.0])), 200.0
    lag = round(rate_hz / (np.pi * line.width_hz))
    quiet = preset("quiet")
    realisations = [replace(quiet, noll=(2, 3), lines=(line,), seed=seed) for seed in range(400)]
    found = np.array([_DampedLines(one, rate_hz).at(0, lag + 1)[[0, lag]] for one in realisations])[:, :, 0]
    assert found.real.std(axis=(0, 1)) == pytest.approx(line.rms_nm, rel=0.1)
    correlation = np.mean(found[:, 1] * found[:, 0].conj(), axis=0) / np.mean(np.abs(found[:, 0]) ** 2, axis=0)
    phase = np.exp(2j * np.pi * line.frequency_hz * lag / rate_hz)
    assert np.abs(correlation / phase - np.exp(-1)).max() < 0.15


def test_reaction_wheel_and_ideal_preset_have_the_same_power() -> None:
    for per_line in (1, 401):
        both = [variances_nm2(preset(name), per_line)[1].sum(axis=0) for name in (WHEEL, IDEAL)]
        np.testing.assert_allclose(*both)


@pytest.mark.parametrize("name", PRESETS)
def test_modes_at_the_instants_of_a_sampler_are_sums_of_the_waves(name: str) -> None:
    """Sums of waves, square wave and constant at two instants of a period, also at the end of a block."""
    disturbance = replace(preset(name, static_nm={4: 3.0}), lines=())
    sampler = Sampler(disturbance, np.array([0.0, 0.5]), RATE_HZ)
    for index in (0, BLOCK - 1, 5, 12_345 * BLOCK + 1):
        time_s = (index + np.array([0.0, 0.5])) / RATE_HZ
        waves = np.exp(2j * np.pi * np.outer(time_s, disturbance.frequency_hz)) @ disturbance.amplitude_nm
        square = np.where(time_s % 4 < 2, -1, 1)[:, None]
        expected = waves.real + square * disturbance.step_nm + disturbance.static_nm
        np.testing.assert_allclose(sampler.at(index), expected, atol=2e-4)


def test_damped_line_rotates_between_frames() -> None:
    disturbance = replace(preset("quiet"), noll=(2, 3), step_nm=np.zeros(2), static_nm=np.zeros(2))
    disturbance = replace(disturbance, amplitude_nm=np.zeros((0, 2)), lines=(DampedLine(71.0, 0.1, np.ones(2)),))
    instants = np.array([0.0, 0.25, 0.75])
    sampler, vectors = Sampler(disturbance, instants, RATE_HZ), _DampedLines(disturbance, RATE_HZ).at(0, 40)[:, 0]
    for index in (0, 1, BLOCK - 1, BLOCK, 30):
        turned = np.exp(2j * np.pi * 0.071 * instants)[:, None]
        ends = vectors[index], vectors[index + 1] * np.exp(-2j * np.pi * 0.071)
        expected = turned * (np.outer(1 - instants, ends[0]) + np.outer(instants, ends[1]))
        np.testing.assert_allclose(sampler.at(index), expected.real, atol=1e-4)


def test_damped_lines_are_finite_at_the_lowest_frame_rate() -> None:
    assert np.isfinite(Sampler(preset(WHEEL), np.array([0.0, 0.5]), 0.001).at(0)).all()


def test_previous_frame_is_available_after_a_new_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """The truth is computed after the next exposure: damped lines must not be drawn again from the first frame on."""
    sampler = Sampler(preset(WHEEL), np.zeros(1), RATE_HZ)
    monkeypatch.delattr(_DampedLines, "_restart")
    for index in range(1, 4 * BLOCK):
        before = sampler.at(index - 1)
        sampler.at(index)
        np.testing.assert_array_equal(sampler.at(index - 1), before)


def test_phases_of_the_lines_differ_between_the_axes() -> None:
    disturbance = preset(IDEAL)
    tilts = disturbance.amplitude_nm[np.isin(disturbance.frequency_hz, LINES_HZ), :2]
    assert np.abs(np.angle(tilts[:, 0] / tilts[:, 1])).max() > 0.5


def test_bench_preset_has_slow_drift_and_tilt_jitter() -> None:
    disturbance = preset("bench")
    jitter = np.isin(disturbance.frequency_hz, (0.7, 1.9, 4.3, 9.1))
    assert jitter.sum() == 4
    jitter_nm = np.sqrt(np.sum(np.abs(disturbance.amplitude_nm[jitter]) ** 2, axis=0) / 2)
    assert jitter_nm[:2] == pytest.approx(1.5 * NM_PER_MAS)
    assert not jitter_nm[2:].any()
    assert disturbance.frequency_hz[~jitter].max() <= 0.53


def test_the_thermal_drift_is_slow_and_falls_with_radial_degree() -> None:
    disturbance = preset("thermal")
    assert disturbance.frequency_hz.max() <= 0.53
    assert rms_nm(disturbance) == pytest.approx([4, 4, 5, 5, 5, 2.5, 2.5, 2.5, 2.5, 1.5, 1.5, 1.5, 1.5, 1.5])


def test_the_step_is_a_square_wave_of_5_mas() -> None:
    tilt = modes_nm(preset("step"), 0, 8000, RATE_HZ)
    assert set(np.unique(tilt[:, 0] / NM_PER_MAS).round(6)) == {-5.0, 5.0}
    assert np.flatnonzero(np.diff(tilt[:, 0])).tolist() == [1999, 3999, 5999]
    assert not tilt[:, 2:].any()


def test_quiet_preset_contains_only_the_static_modes() -> None:
    modes = modes_nm(preset("quiet", static_nm={2: 4.0, 11: -7.0}), 10**6, 3, RATE_HZ)
    assert (modes == modes[0]).all()
    assert modes[0][[NOLL.index(2), NOLL.index(11)]].tolist() == [4, -7]
    assert np.count_nonzero(modes[0]) == 2


def test_screen_has_a_kolmogorov_spectrum_and_depends_on_the_seed() -> None:
    """Power averaged over seeds falls as frequency to the power -11/3 between 1 and 5 cycles per diameter."""
    power = np.zeros((64, 64))
    for seed in range(30):
        power += np.abs(np.fft.fft2(screen(seed, 64, 4 / 64))) ** 2  # the samples cover one period of the screen
    radius = np.hypot(*np.meshgrid(np.fft.fftfreq(64, 4 / 64), np.fft.fftfreq(64, 4 / 64)))
    bands = [(radius > low) & (radius <= 1.3 * low) for low in (1.0, 2.0, 4.0)]
    slope = np.polyfit(np.log([radius[b].mean() for b in bands]), np.log([power[b].mean() for b in bands]), 1)[0]
    assert slope == pytest.approx(-11 / 3, abs=0.25)
    assert np.array_equal(screen(3, 20, 0.05), screen(3, 20, 0.05))
    assert not np.allclose(screen(3, 20, 0.05), screen(4, 20, 0.05))


def test_unknown_presets_are_refused() -> None:
    with pytest.raises(ValueError, match="'earthquake'"):
        preset("earthquake")


FIRST, FRAMES = 100, 400
END = FIRST + FRAMES + MAX_FRAMES_LATE + 1
IMAGE = np.arange(400, dtype=np.uint16).reshape(20, 20)
DARK, HIGHEST = 100, 60_000


def fault(kind: Kind, seed: int = 5) -> Fault:
    return Fault(kind, FIRST, FRAMES, seed)


def published(kind: Kind, seed: int = 5) -> list[int]:
    return [frame for index in range(END) for frame in fault(kind, seed).frames_due(index)]


def faulty_frame(kind: Kind, index: int) -> np.ndarray:
    return fault(kind).pixels(index, IMAGE, IMAGE[::-1], DARK, HIGHEST)


@pytest.mark.parametrize("kind", Kind)
def test_fault_changes_no_frame_outside_its_range(kind: Kind) -> None:
    for index in (1, FIRST - 1, END):
        assert fault(kind).frames_due(index) == (index,)
        assert faulty_frame(kind, index) is IMAGE
        assert fault(kind).payload(index, b"whole", 5) == b"whole"


def test_lost_frames_are_a_tenth_chosen_by_the_seed() -> None:
    lost = set(range(END)) - set(published(Kind.LOST))
    assert lost <= set(range(FIRST, FIRST + FRAMES))
    assert len(lost) == pytest.approx(LOST_SHARE * FRAMES, rel=0.5)
    assert published(Kind.LOST) == published(Kind.LOST) != published(Kind.LOST, seed=6)


def test_reordered_frames_are_swapped_in_pairs() -> None:
    found = published(Kind.REORDERED)
    assert sorted(found) == list(range(END))
    assert found[FIRST : FIRST + 4] == [FIRST + 1, FIRST, FIRST + 3, FIRST + 2]


def test_late_frames_are_all_published_within_fifty_frames() -> None:
    when = {frame: index for index in range(END) for frame in fault(Kind.LATE).frames_due(index)}
    assert set(when) == set(range(END))
    late = [when[frame] - frame for frame in range(FIRST, FIRST + FRAMES)]
    assert (min(late), max(late)) == (1, MAX_FRAMES_LATE)


def test_detector_faults_change_the_pixels() -> None:
    assert (faulty_frame(Kind.SATURATED, FIRST) == HIGHEST).all()
    dark = faulty_frame(Kind.DARK, FIRST)
    assert abs(dark.astype(int) - DARK).max() <= 2
    np.testing.assert_array_equal(faulty_frame(Kind.STUCK, FIRST), IMAGE[::-1])
    assert 0 < (faulty_frame(Kind.HOT_PIXELS, FIRST) == HIGHEST).sum() < IMAGE.size / 4
    tracks = [(faulty_frame(Kind.COSMIC_RAYS, index) == HIGHEST).sum() for index in range(FIRST, FIRST + FRAMES)]
    assert 0 < np.count_nonzero(tracks) < FRAMES / 2
    assert max(tracks) <= TRACK_PIXELS
    assert IMAGE.max() == 399, "the input is not modified"


def test_message_faults_change_the_payload() -> None:
    good = image(IMAGE, 0, "sensor")
    message = good.SerializeToString()
    end = message.index(good.data) + len(good.data)
    assert faulty_frame(Kind.WRONG_SIZE, FIRST).shape == (19, 19)
    truncating = Fault(Kind.TRUNCATED, FIRST, 5000, 5)
    truncated = [truncating.payload(index, message, end) for index in range(FIRST, FIRST + 5000)]
    assert all(message.startswith(one) and decode_frame(one, 1, 0).pixels is None for one in truncated)
    assert len({fault(Kind.RANDOM).payload(index, message, end) for index in range(FIRST, FIRST + 50)}) == 50


@pytest.mark.parametrize("kind", [Kind.DUPLICATED, Kind.REORDERED, Kind.LATE, Kind.OLD_SEQUENCE, Kind.TRUNCATED])
def test_faulty_publisher_sends_the_configured_frames(kind: Kind) -> None:
    hub, clock = MemoryHub(), FakeClock(EARLIER_S * 10**10)  # so that the start minus EARLIER_S is above 0
    camera, reader = MemoryBus(hub, "camera", clock), MemoryBus(hub, "controller", clock)
    received: list[Sample] = []
    reader.subscribe(FRAME, received.append)
    faulty = FaultyFrames(Fault(kind, 10, 10), camera.publisher(FRAME), DARK, HIGHEST, clock.host_ns)
    for index in range(90):
        envelope = faulty.put(image(IMAGE + np.uint16(index), index, "camera").SerializeToString())
        assert count_of(envelope.sequence) == index
    start_s = start_of(received[0].sequence)
    for sample in received:
        index = count_of(sample.sequence)
        faulty_range = 10 <= index < 20
        earlier_s = EARLIER_S if kind is Kind.OLD_SEQUENCE and faulty_range else 0
        assert start_of(sample.sequence) == start_s - earlier_s
        frame = decode_frame(sample.payload, sample.sequence, 0)
        if kind is Kind.TRUNCATED and faulty_range:
            assert frame.pixels is None
        else:
            np.testing.assert_array_equal(frame.pixels, IMAGE + np.uint16(index))
    counts = Counter(count_of(sample.sequence) for sample in received)
    assert set(counts) == set(range(90))
    assert sum(counts.values()) == (100 if kind is Kind.DUPLICATED else 90)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[1]",
        '{"kind": "lost"}',
        '{"kind": "bent", "first": 1, "frames": 1}',
        '{"kind": "lost", "first": 0, "frames": 1}',
        '{"kind": "lost", "first": 1, "frames": 1, "seed": -1}',
        '{"kind": "lost", "first": 1, "frames": 1, "seed": 1.5}',
    ],
)
def test_invalid_fault_file_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "fault.json").write_text(content)
    with pytest.raises(ConfigurationError, match="not a fault"):
        read_fault(tmp_path / "fault.json")


def test_fault_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "fault.json").write_text(json.dumps({"kind": "dark", "first": 3, "frames": 4, "seed": 5}))
    assert read_fault(tmp_path / "fault.json") == Fault(Kind.DARK, 3, 4, 5)
