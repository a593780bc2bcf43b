"""The fused step compared with the numpy step on random frames; both steps start from the same random state."""

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import ANY, Mock

import numpy as np
import pytest

from benchmarks.sizes import Size, configuration, random_calibration
from lowfc.adapters.process import compiled
from lowfc.adapters.process.latch import Latch
from lowfc.arrays import Pixels, Single
from lowfc.contract.configuration import load
from lowfc.control.calibration.calibration import normalise_flux, reconstructor
from lowfc.control.kernel import functions, stepping
from lowfc.control.kernel.tables import FUSED, Tables
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.pi_notch import pi_notch
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Frame, Load, Outputs, Request
from lowfc.control.loop.requests import prepared
from lowfc.control.loop.safety import Limit, Limits, Rejection
from lowfc.control.loop.state import State
from lowfc.programs.core.start_up import settings_at_start
from tests.support import toy

RATE_HZ = 1000.0
SAME_NM = 2e-4
"""Allowed difference. The order of sums depends on the processor: up to 1.5e-4 nm in 10^6 frames with AVX-512."""
LIMITED_NM = 5e-4
"""Allowed difference if the neighbour limit acts, which divides by small differences: up to 2.4e-4 nm on AMD EPYC."""
ROUNDINGS = 10
"""Allowed difference in float32 roundings of a step's largest number: up to 500 nm if no pixel counts as saturated."""
COMMAND_ARRAYS = 2
"""Number of arrays, the first of `_numbers`, that are commands."""
BAD_IMAGES = ("dark", "faint", "saturated pixel", "saturated pixels", "frozen", "aberrated")
pytestmark = pytest.mark.skipif(not compiled.available(), reason="needs the extra `fast`")


@dataclass
class Bench:
    """A random sensor, mirror and controller, with random frames and requests."""

    rng: np.random.Generator
    counts: Counter[str] = field(default_factory=Counter)
    largest_nm: float = 0.0
    repeats: int = 0

    def __post_init__(self) -> None:
        rng = self.rng
        rows, columns, modes = rng.integers(8, 20), rng.integers(8, 20), int(rng.integers(1, 12))
        self.shape, pixels = (int(rows), int(columns)), int(rows * columns)
        grid = tuple(map(int, rng.integers(2, 9, 2)))
        self.noll = tuple(range(2, 2 + modes))
        good = (rng.random(pixels) > rng.choice([0.0, 0.1])).astype(float)
        I0, self.H = normalise_flux(rng.uniform(0.5, 1.5, pixels), rng.normal(0, 2e-3, (pixels, modes)), good)
        self.I0, self.flux_dn = I0, 2000.0 * pixels
        R = reconstructor(I0, self.H, good, self.flux_dn, 3.0)
        self.dark = rng.uniform(90, 110, pixels)
        shapes = rng.normal(0, 1, (grid[0] * grid[1], modes)) / modes**0.5
        single = {"reference": I0, "response": self.H, "reconstructor": R, "good": good, "dark": self.dark}
        self.calibration = replace(
            toy.calibration(),
            noll=self.noll,
            **{name: array.astype(np.float32) for name, array in single.items()},
            modes_to_actuators=shapes.astype(np.float32),
            shape=self.shape,
            grid=grid,
            flux_dn=self.flux_dn,
            saturation_dn=float(rng.choice([60_000, np.inf])),
        )
        tight = rng.random() < 0.5
        self.settings = toy.settings(
            limits=Limits(60.0, 20.0, 50.0) if tight else Limits(700.0, 300.0, 600.0),
            limit_nm=(40.0, 15.0) if tight else (500.0, 300.0),
            delay_frames=float(rng.choice([1.0, 1.5, 2.0, 2.75])),
            max_saturated_pixels=int(rng.choice([0, 4])),
            max_identical_frames=2,
            min_flux_fraction=float(rng.choice([0.0, 0.2])),
            gain=(0.4, 0.2),
            leak=(0.01, 0.02),
            guard=bool(rng.random() < 0.5),
            rate_hz=RATE_HZ,
            kernel=compiled.kernel(FUSED),
        )
        self.state, _ = advance(self.settings, State(), Load(0, self.calibration, "random"))
        self.reference_state, self.count, self.last_image = self.state, 0, np.zeros(self.shape, np.uint16)

    def law(self) -> LinearLaw:
        """A law that is stable in the loop."""
        modes, delay = len(self.noll), self.settings.delay_frames
        if self.rng.random() < 0.5:
            return integrator([0.2] * modes, [0.02] * modes, self.noll, delay, RATE_HZ)
        zeros = np.zeros(modes)
        return pi_notch(self.noll, zeros + 0.1, zeros + 0.05, zeros + 0.02, [()] * modes, delay, RATE_HZ)

    def request(self) -> Request:
        """A random request of an operator."""
        rng, modes, actuators = self.rng, len(self.noll), int(np.prod(self.calibration.grid))
        values = tuple(map(float, rng.uniform(0.05, 0.4, modes).astype(np.float32)))
        shape = rng.normal(0, 5, actuators).astype(np.float32)
        return [
            Request(0, "gain", self.noll, values),
            Request(0, "offset", self.noll, values),
            Request(0, "channel", text="dark-hole", actuators_nm=shape * (rng.random() < 0.7)),
            Request(0, "channel", text="flat", actuators_nm=shape),
            Request(0, "play", text="mirror", actuators_nm=shape, table=rng.normal(0, 1, (5, 1)).astype(np.float32)),
            Request(0, "play", text="offset", table=rng.normal(0, 1, (5, modes)).astype(np.float32)),
            Request(0, "law", law=self.law()),
            Request(0, "law"),
            Request(0, str(rng.choice(["open", "safe", "reset", "stop"]))),
        ][rng.integers(9)]

    def pixels(self) -> Pixels:
        """An image; 4 % of the new images are bad in one of the ways of `BAD_IMAGES`; "frozen" repeats the last one."""
        rng = self.rng
        kind = str(rng.choice(BAD_IMAGES)) if rng.random() < 0.04 else "usual"
        self.repeats = max(self.repeats - 1, 4 * (kind == "frozen"))
        if self.repeats:
            return self.last_image
        wave_nm = rng.normal(0, 40 if kind == "aberrated" else 4, len(self.noll))
        image_dn = self.flux_dn * rng.uniform(0.8, 1.2) * (self.I0 + self.H @ wave_nm)
        image_dn *= {"dark": 0.0, "faint": rng.uniform(0.15, 0.25)}.get(kind, 1.0)
        image = np.clip(np.rint(self.dark + image_dn + rng.normal(0, 3, image_dn.size)), 0, 65535).astype(np.uint16)
        if kind.startswith("saturated"):
            image[rng.integers(0, image.size, 1 if kind == "saturated pixel" else 6)] = 65535
        self.last_image = image.reshape(self.shape)
        return self.last_image

    def run(self, frames: int) -> None:
        """Process frames, each by both implementations from the same state."""
        for _ in range(frames):
            if self.rng.random() < 0.01:
                # The request and `close`; in half of the cases with `clear` between them.
                for request in (self.request(), Request(0, "clear"), Request(0, "close"))[:: self.rng.choice([1, 2])]:
                    self.state, _ = advance(self.settings, self.state, prepared(self.settings, request))
            self.count += 1 + int(self.rng.random() < 0.01)
            age_ns = 10**9 if self.rng.random() < 0.002 else 0
            self.frame(Frame(toy.frame_sequence(self.count), self.count * 1_000_000, age_ns, self.pixels()))

    def frame(self, frame: Frame) -> None:
        """Process a frame with both implementations, and compare the results."""
        loop, reference_state = self.state.loop, self.reference_state
        same_state = self.state._replace(
            loop=loop._replace(estimator=loop.estimator._replace(tables=None)),
            estimate=reference_state.estimate,
            identical_frames=reference_state.identical_frames,
        )
        self.reference_state, expected = advance(self.settings, same_state, frame)
        self.state, outputs = advance(self.settings, self.state, frame)
        self.compare(outputs, expected)
        assert self.state.identical_frames == self.reference_state.identical_frames
        for name in ("mode", "returning_to_zero"):
            assert getattr(self.state, name) == getattr(self.reference_state, name)

    def amplification(self) -> float:
        """Factor by which the projection onto modes, after a limit acted, amplifies rounding of the actuators."""
        return max(1.0, float(np.abs(self.state.loop.inverse).sum(axis=1).max()))

    def compare(self, outputs: Outputs, expected: Outputs) -> None:
        """Compare decisions and events exactly, and numbers up to rounding."""
        step, reference_step = outputs.step, expected.step
        assert (step.mode, step.saturated_pixels) == (reference_step.mode, reference_step.saturated_pixels)
        assert step.flux_dn == pytest.approx(reference_step.flux_dn, rel=1e-6)
        if step.reasons == reference_step.reasons:
            assert outputs.events == expected.events
        else:
            assert {*step.reasons} ^ {*reference_step.reasons} <= {*Limit}
            self.counts["limits in one of the two steps only"] += 1
        self.counts.update(reason.name for reason in step.reasons)
        self.counts["frames"] += 1
        assert (outputs.command is None) is (expected.command is None)
        numbers = list(zip(_numbers(outputs), _numbers(expected), strict=True))
        largest_nm = max(np.abs(reference).max(initial=0) for _, reference in numbers)
        allowed_nm = max(LIMITED_NM if Limit.NEIGHBOUR in step.reasons else SAME_NM, ROUNDINGS * np.spacing(largest_nm))
        for index, (fused, reference) in enumerate(numbers):
            assert np.isfinite(fused).all()
            difference_nm = float(np.abs(fused - reference).max(initial=0))
            assert difference_nm < allowed_nm * (self.amplification() if index == 0 and step.reasons else 1)
            if index < COMMAND_ARRAYS:
                self.largest_nm = max(self.largest_nm, difference_nm)


def _numbers(outputs: Outputs) -> list[Single]:
    """Modal command, actuators, error and pseudo-open-loop modes, nm; an array that the step lacks is empty."""
    step, command = outputs.step, outputs.command
    arrays = (step.command_nm, None if command is None else command.actuators_nm, step.error_nm, step.pol_nm)
    return [np.zeros(0, np.float32) if array is None else array for array in arrays]


def compare_random_frames(
    frames: int, frames_per_bench: int, monkeypatch: pytest.MonkeyPatch
) -> tuple[Counter[str], float]:
    """Counts of fused steps, reasons and disagreements in random frames, and the largest difference of commands, nm."""
    counts: Counter[str] = Counter()
    largest_nm, original = 0.0, stepping._fused

    def counting(*arguments: object) -> object:
        result = original(*arguments)
        counts["fused"] += result is not None
        return result

    monkeypatch.setattr(stepping, "_fused", counting)
    for seed in range(frames // frames_per_bench):
        bench = Bench(np.random.default_rng(seed))
        bench.run(frames_per_bench)
        counts.update(bench.counts)
        largest_nm = max(largest_nm, bench.largest_nm)
    return counts, largest_nm


@pytest.mark.parametrize(
    ("installed", "fault", "advice"),
    [
        (True, None, None),
        (False, None, "the fused step needs numba"),
        (True, PermissionError(13, "no executable memory"), "this host forbids compiling"),
        (True, ImportError("it needs NumPy 2.2"), "numba cannot be imported (it needs NumPy 2.2)"),
    ],
)
def test_the_kernel_in_use_is_reported_by_an_event_and_is_numpy_if_the_fused_step_cannot_be_compiled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, installed: bool, fault: Exception | None, advice: str | None
) -> None:
    functions_ = Mock(return_value=[functions.measure, functions.respond, None], side_effect=fault)
    monkeypatch.setattr(compiled, "_compiled", functions_)
    monkeypatch.setattr(compiled, "available", lambda: installed)
    monkeypatch.setattr(compiled, "kernel", compiled.kernel.__wrapped__)
    if isinstance(fault, ImportError):
        monkeypatch.setattr("importlib.import_module", Mock(side_effect=fault))
    event, config = Mock(), load(None, {"realtime.kernel": "fused"})
    kernel = settings_at_start(Latch([tmp_path / "latch"]), config, event).kernel
    if advice is None:
        assert kernel.name == FUSED
        event.assert_called_once_with("KERNEL", kernel=FUSED)
    else:
        assert kernel.name == "numpy"
        event.assert_called_once_with("KERNEL_MISSING", advice=ANY)
        assert event.call_args.kwargs["advice"].startswith(advice)


def test_the_fused_step_gives_the_same_bytes_with_one_and_with_several_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    size = Size(side=100, modes=13, mirror_side=8)
    calibration, frames = random_calibration(size, configuration(size, RATE_HZ))
    reference_nm, pixels = calibration.reconstructor @ calibration.reference, frames[0].ravel()
    alone = Tables.of(compiled.kernel(FUSED), calibration, reference_nm)
    expected = alone.estimate(pixels, 0.0)
    for threads in (2, 3):
        shared = Tables.of(compiled.kernel(FUSED, threads), calibration, reference_nm)
        shared.sums_nm[:] = np.nan
        for shared_bytes in (shared.tiles.nbytes, shared.tiles.nbytes + 1):  # shared by all threads, then left to one
            monkeypatch.setattr(compiled, "SHARED_BYTES", shared_bytes)
            measured = shared.estimate(pixels, 0.0)
            assert (measured[0].tobytes(), measured[1]) == (expected[0].tobytes(), expected[1])
        assert len(compiled.kernel(FUSED, threads).measure.__self__._shares) == threads, "each had a share"


def test_the_fused_step_agrees_on_random_frames_and_states(monkeypatch: pytest.MonkeyPatch) -> None:
    counts, _ = compare_random_frames(4_000, 500, monkeypatch)
    assert counts["fused"] > 1000
    assert counts["limits in one of the two steps only"] <= 2
    for reason in (Rejection.SATURATED, Rejection.DARK, Rejection.STUCK, Limit.SLEW, Limit.MODAL_LIMIT, Limit.STROKE):
        assert counts[reason.name], reason.name


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_fused_step_agrees_on_a_million_random_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    counts, largest_nm = compare_random_frames(1_000_000, 1000, monkeypatch)
    print(dict(counts), f"largest difference {largest_nm:.3g} nm")
    assert counts["fused"] > 200_000
    assert counts["limits in one of the two steps only"] < 200
