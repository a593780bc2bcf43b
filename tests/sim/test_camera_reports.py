"""Reports of the simulated camera: statistics of the wavefront, habitually late commands, and the readout region."""

from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from lowfc.contract.configuration import Configuration, load
from lowfc.contract.envelope import Envelope
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import MIRROR_STATE, TRUTH, wire
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener
from sim_camera.driver import SimulatedCamera
from sim_camera.lateness import WINDOW, Lateness
from sim_camera.scene import Truth, Wavefront
from sim_camera.wavefront_statistics import MAX_BLOCKS, WavefrontAccumulator

NOLL = (2, 3, 4)
PIXELS = np.arange(80 * 80, dtype=np.uint16).reshape(80, 80)


def camera_of(config: Configuration, **options: int | str) -> SimulatedCamera:
    """A camera whose optics always give the same image."""
    scene = SimpleNamespace(shape=PIXELS.shape, instants=(), expose=lambda index, shape: PIXELS)
    return SimulatedCamera(SimulatedCamera.Options(**options), config, scene)


def truth(residual_nm: float, noll: tuple[int, ...] = NOLL) -> Truth:
    """A frame with this residual in every mode and over the pupil, and a disturbance twice as large."""
    modes = np.full(len(noll), residual_nm, np.float32)
    sampled = Wavefront(2 * modes, modes, 2 * residual_nm, residual_nm)
    return Truth(sampled, None, modes, np.array([[2 * modes], [modes]]), np.zeros(0), np.zeros(0))


def statistics(
    *residuals_nm: float, nm_per_mas: float = 1.0, recent: int = 1, noll: tuple[int, ...] = NOLL
) -> WavefrontAccumulator:
    accumulator = WavefrontAccumulator(noll, nm_per_mas, recent)
    for residual_nm in residuals_nm:
        accumulator.add(truth(residual_nm, noll), 0.0, np.zeros(len(noll)))
    return accumulator


@pytest.mark.parametrize("frames", [2, 3, 750, MAX_BLOCKS, MAX_BLOCKS + 1, 3 * MAX_BLOCKS - 1, 9 * MAX_BLOCKS + 5])
def test_statistics_cover_the_second_half_of_a_run_of_any_length(frames: int) -> None:
    half = frames // 2
    run = statistics(*[5.0] * half, *[3.0] * (frames - half))
    found = run.wavefront()
    exact = frames <= MAX_BLOCKS
    expected = pytest.approx((3.0, 6.0), rel=1e-12 if exact else 0.003)
    assert (found["residual_rms_nm"], found["tilt_disturbance_mas"]) == expected
    assert len(run._blocks) == MAX_BLOCKS


def test_statistics_are_rms_over_frames_and_tilts_are_per_axis() -> None:
    assert statistics().wavefront() == {}
    found = statistics(*[3.0, 5.0] * 250, nm_per_mas=2.0).wavefront()
    rms_nm = np.sqrt((3**2 + 5**2) / 2)
    assert [*found.values()][:4] == pytest.approx(np.array((2, 1, 1, 0.5)) * rms_nm), "tilts per axis"
    assert not any([*found.values()][4:])


def test_tilt_per_axis_counts_only_the_axes_among_the_modes() -> None:
    found = statistics(3.0, nm_per_mas=2.0, noll=(2,)).wavefront()
    assert (found["tilt_disturbance_mas"], found["tilt_residual_mas"]) == pytest.approx((3.0, 1.5))


def test_the_modes_that_add_most_contrast_are_named_even_if_the_disturbance_adds_no_contrast() -> None:
    run = statistics()
    run.add(truth(1.0), 0.0, np.arange(3))
    assert [*run.wavefront().values()][-2:] == ["focus", pytest.approx(2 / 3)]


def test_recent_statistics_cover_only_recent_frames() -> None:
    assert statistics(recent=100).recent() == {}
    run = statistics(*[50.0] * 500, *[2.0] * 100, recent=100)
    found, overall = run.recent(), run.wavefront()
    assert (found["residual_rms_nm"], found["tilt_disturbance_mas"]) == pytest.approx((2.0, 4.0))
    assert overall["residual_rms_nm"] > 40.0, "includes the frames before"


@pytest.mark.parametrize("before", [0, 1, WINDOW, 3 * WINDOW + 7])
def test_lateness_becomes_habitual_at_a_quarter_of_the_window_and_ends_at_an_eighth(before: int) -> None:
    lateness = Lateness()
    assert not any(lateness.add(False) for _ in range(before))
    changes = [lateness.add(True) for _ in range(WINDOW)]
    assert changes.index(True) == WINDOW // 4
    assert sum(changes) == 1
    assert lateness.percent == 100
    changes = [lateness.add(False) for _ in range(WINDOW)]
    assert changes.index(True) == WINDOW - WINDOW // 8 - 1
    assert (sum(changes), lateness.habitual, lateness.percent, lateness.total) == (1, False, 0, WINDOW)


def test_occasional_late_commands_are_not_habitual() -> None:
    lateness = Lateness()
    assert not any(lateness.add(number % 5 == 0) for number in range(10 * WINDOW))
    assert lateness.percent == 20


def test_camera_reports_each_change_of_habitual_lateness() -> None:
    clock, config = FakeClock(), Configuration()
    listener = Listener(clock)
    camera = camera_of(config)
    camera.join(listener.service("camera"))
    states = listener.bus.publisher(MIRROR_STATE, config.mirror.name)
    shape = np.zeros((config.mirror.rows, config.mirror.columns), np.float32)

    def put(sequence: int) -> None:
        state = wire.MirrorState(frame_sequence=sequence, rows=shape.shape[0], columns=shape.shape[1])
        state.actuators = shape.tobytes()
        states.put(state.SerializeToString())
        camera._drain()

    camera._last_frame = 1 << 32
    for sequence in range(1, 2 * WINDOW):
        put(sequence)  # without frames of these sequences, as in the conformance test of a mirror
    assert (camera._lateness.total, listener.events()) == (0, ["STARTED"])
    camera._newest_state = sequence = 0
    for late in (False, True, False, True):
        for _ in range(2 * WINDOW):
            sequence += 1
            camera._last_frame = sequence + late
            camera._published_ns[sequence % len(camera._published_ns)] = sequence, 0
            put(sequence)
    states.put(wire.MirrorState(frame_sequence=sequence + 1).SerializeToString())  # after a fault of the driver
    camera._drain()
    camera._service.beat()
    assert listener.events()[1:] == ["COMMANDS_LATE", "COMMANDS_IN_TIME", "COMMANDS_LATE"]
    assert camera._lateness.total == 4 * WINDOW


def test_expose_of_a_slow_camera_waits_half_a_second_at_most() -> None:
    camera = camera_of(load(None, {"camera.rate_hz": 0.5}))
    camera.join(Listener(FakeClock()).service("camera"))
    camera.start()
    assert [camera.expose() is None for _ in range(5)] == [False, True, True, True, False]


@pytest.mark.parametrize(("lockstep", "truths_per_block"), [(True, 1), (False, 10)])
def test_the_truth_of_every_frame_is_published_in_order_and_in_lockstep_at_once(
    monkeypatch: pytest.MonkeyPatch, lockstep: bool, truths_per_block: int
) -> None:
    """At 1 kHz the truths of ten frames are computed together; the end of the run publishes the rest."""
    config = load(None, {"camera.rate_hz": 1000.0, "lockstep": lockstep})
    camera, listener = SimulatedCamera(SimulatedCamera.Options(), config), Listener(FakeClock())
    sequences = list[int]()
    listener.bus.subscribe(TRUTH, lambda sample: sequences.append(wire.Truth.FromString(sample.payload).frame_sequence))
    camera.join(listener.service("camera"))
    camera.finish()
    assert sequences == [], "a run without a frame"
    camera.start()
    blocks = Mock(wraps=camera._scene._sampler._block)
    monkeypatch.setattr(camera._scene._sampler, "_block", blocks)
    for sequence in range(1, 26):
        assert camera.expose() is not None
        camera.sent(Envelope(sequence, 0))
        assert len(sequences) == (sequence - 1) // truths_per_block * truths_per_block
    camera.finish()
    assert sequences == list(range(1, 26))
    assert blocks.call_count == 4, "no disturbance is computed twice"


def test_region_is_read_at_the_centre_of_the_sensor() -> None:
    camera = camera_of(Configuration(), rows=64, columns=50)
    settings = camera.settings()
    region = settings.region_row, settings.rows, settings.region_column, settings.columns
    assert region == (8, 64, 15, 50)
    camera.join(Listener(FakeClock()).service("camera"))
    camera.start()
    exposure = camera.expose()
    assert np.array_equal(exposure.pixels, PIXELS[8:72, 15:65])
    with pytest.raises(ConfigurationError, match="rows is 81, the sensor has only 80"):
        camera_of(Configuration(), rows=81)


def test_the_path_of_a_fault_may_begin_with_a_tilde(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "fault.json").write_text('{"kind": "dark", "first": 1, "frames": 1}')
    camera_of(load(None), fault="~/fault.json")
    with pytest.raises(ConfigurationError, match="no-fault"):
        camera_of(load(None), fault="~/no-fault.json")
