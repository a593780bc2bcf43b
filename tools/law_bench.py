"""The simulated loop in one process: sensor images, the live loop's own `advance`, the mirror, true residuals."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lowfc.adapters.files import factory
from lowfc.arrays import Array, Pixels, Single
from lowfc.contract.configuration import FIXED_GAINS, Configuration, load
from lowfc.contract.sections import sensor_keys
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.spectra import TimeSeries
from lowfc.control.laws.stability import delay_weights
from lowfc.control.laws.tuning import Tuned, best_gains, identify_modes, tune_integrator, tune_lqg, tune_pi_notch
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Command as ModalCommand
from lowfc.control.loop.inputs import Frame, Input, Load, Outputs, PendingEvent, Request, Step
from lowfc.control.loop.state import State
from lowfc.device import DriverOptions
from lowfc.device.mirror_loop import protection_of
from lowfc.device.mirror_protection import Command, Status, apply_command
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.core.gain_watch import GainWatch
from sim_camera.disturbance import LINES_HZ, Disturbance
from sim_camera.driver import scene
from sim_camera.path import MirrorPath
from sim_camera.scene import Truth
from sim_dm.driver import SimulatedMirror

RATE_HZ = 1000.0


def configured(
    sensor: str = "sam27d10_bal14", seed: int = 1, delay_frames: float = 1.0, **changed: Any
) -> Configuration:
    """Configuration with a reaction wheel of 14 mas rms per axis, V = 0, 1 kHz; `changed` has further keys."""
    keys: dict[str, Any] = {f"sensor.{key}": value for key, value in sensor_keys(sensor).items()}
    keys |= FIXED_GAINS | {
        "camera.rate_hz": RATE_HZ,
        "camera.delay_frames": delay_frames,
        "star.magnitude": 0.0,
        "seed": seed,
    }
    return load(None, keys | {"disturbance.preset": "reaction-wheel"} | changed)


def calibrated(config: Configuration) -> Calibration:
    """The analytic calibration of a configuration."""
    optics = factory.twin(config, None, lambda _: None)
    return factory.analytic_calibration(config, optics, factory.mirror_on_twin(config, optics, lambda _: None))


def with_lines_moved(disturbance: Disturbance, factor: float) -> Disturbance:
    """The same disturbance with the frequencies of its lines multiplied by `factor`."""
    of_lines = np.isin(disturbance.frequency_hz, LINES_HZ)
    return replace(
        disturbance,
        frequency_hz=np.where(of_lines, factor, 1) * disturbance.frequency_hz,
        lines=tuple(replace(line, frequency_hz=factor * line.frequency_hz) for line in disturbance.lines),
    )


class Bench:
    """A loop in one process that starts with a flat mirror. Its record is the steps and truths since `new_record`.

    Attributes:
        config: configuration of the controller.
        nm_per_mas: nm rms of wavefront per milliarcsecond of tilt.
        frames_refused: number of frames that the controller did not use.
        events: frame number and event of the controller, since the start.
        settings: settings of the controller.
        state: state of the controller.
        watch: comparison of gains and detection of harm; None if there is neither.
    """

    watch: GainWatch | None = None

    def __init__(
        self,
        config: Configuration,
        first: Calibration | Input,
        disturbance: Disturbance | None = None,
        world: Configuration | None = None,
    ) -> None:
        """Build the optics.

        Args:
            config: configuration of the controller.
            first: first input: a calibration, or another input.
            disturbance: replaces the disturbance of the configuration.
            world: configuration of optics, detector and mirror, if it differs from `config`.
        """
        self._begin(config, Load(0, first, "bench") if isinstance(first, Calibration) else first)
        self.watch = GainWatch(self.settings, config.control.on_harm, factory.contrast_of(config).form)
        self.world = config if world is None else world
        self.scene = scene(self.world, disturbance)
        self.start_mirror()
        self._weights = delay_weights(self.world.camera.delay_frames).astype(np.float32)
        self._shapes = [self._status.surface_nm] * len(self._weights)
        self._path = MirrorPath(self._status.surface_nm, timing_of(self.world).applied - 1)

    def _begin(self, config: Configuration, first: Input) -> None:
        self.config, self.frames_refused, self._index = config, 0, 0
        self.nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
        self.events: list[tuple[int, PendingEvent]] = []
        self.settings = factory.settings(config)
        self.state = advance(self.settings, State(), first)[0]
        self.new_record()

    def start_mirror(self) -> None:
        """Replace the mirror by a new, flat one."""
        self._mirror = SimulatedMirror(DriverOptions(), self.world)
        self._protection = protection_of(self._mirror, self.world)
        flat = np.zeros(self._protection.grid, np.float32)
        self._status = Status(flat, self._mirror.apply(flat))

    def new_record(self) -> None:
        """Discard steps and truths, and begin a new record."""
        self.steps: list[Step] = []
        self.truths: list[Truth] = []

    def ask(self, name: str, **fields: Any) -> None:
        """Send an operator's request; ValueError if it is refused."""
        outputs = self.process_input(Request(self._index * self.config.period_ns, name, **fields))
        if outputs.reply is None or not outputs.reply.accepted:
            raise ValueError(f"{name}: {outputs.reply}")

    def settle(self, frames: int) -> None:
        """Close the loop, and begin a new record after this number of frames."""
        self.ask("close")
        self.run(frames, record=False)
        self.new_record()

    def expose(self) -> tuple[Single, Pixels]:
        """Expose a frame; return the mirror's shape (rows, columns) in the exposure, nm of surface, and the pixels."""
        self._shapes = [self._status.surface_nm, *self._shapes[:-1]]
        single = len(self._weights) == 1
        exposed_nm = self._shapes[0] if single else np.tensordot(self._weights, np.array(self._shapes), 1)
        pixels = self.scene.expose(self._index, exposed_nm)
        self._index += 1
        return exposed_nm, pixels

    def process_input(self, input_: Input) -> Outputs:
        """Advance the controller by an input."""
        self.state, outputs = advance(self.settings, self.state, input_)
        return outputs

    def frame(self, pixels: Pixels, start: int = 1 << 32) -> Frame:
        """Frame of the last exposure."""
        return Frame(start + self._index - 1, 10**18 + (self._index - 1) * self.config.period_ns, 0, pixels)

    def move_mirror(self, frame: Frame, command: ModalCommand) -> None:
        """Move the mirror by the command for a frame; ValueError if the mirror refuses it."""
        received = Command("lowfc", frame.sequence, frame.time_ns, 10**9, command.actuators_nm, command.command_nm)
        self._status, refused = apply_command(
            self._protection, self._status, received, frame.time_ns, self._mirror.settle
        )
        if refused is not None:
            raise ValueError(f"the mirror refused a command: {refused.name}")
        self._path.applied(self._index, self._status.surface_nm)

    def run(self, frames: int, *, record: bool = True) -> None:
        """Expose, control, move the mirror. With `record`, keep steps and truths: this takes a quarter of the time."""
        for _ in range(frames):
            index = self._index
            exposed_nm, pixels = self.expose()
            path = self._path.motion(index, self.scene.instants)
            frame = self.frame(pixels)
            outputs = self.process_input(frame)
            if self._record_and_watch(outputs, record):
                self.truths.append(self.scene.truth(index, exposed_nm, path))
            if outputs.command is not None:
                self.move_mirror(frame, outputs.command)

    def _record_and_watch(self, outputs: Outputs, record: bool) -> bool:
        """Record events, and apply the requests of the gain watch as the controller does.

        With `record`, keep the step of a frame that was used; return whether it was kept.
        """
        events = list(outputs.events)
        if outputs.step is not None and self.watch is not None:
            actions = self.watch.observe(outputs.step, self.state)
            events += actions.events
            for request in actions.requests:
                events += self.process_input(request).events
        self.events += [(self._index - 1, event) for event in events]
        if outputs.step is None or outputs.step.pol_nm is None:
            self.frames_refused += 1
            return False
        if record:
            self.steps.append(outputs.step)
        return record

    def pol(self) -> TimeSeries:
        """Pseudo-open-loop modes (frames, modes) of the record."""
        return TimeSeries((np.array([step.pol_nm for step in self.steps], np.float64),), 0)

    def residual_nm(self, *, continuous: bool = True) -> Array:
        """True residual (frames, modes) of the record: rms over each period, or at the start of each exposure."""
        name = "continuous" if continuous else "sampled"
        return np.array([getattr(truth, name).residual_nm for truth in self.truths], np.float64)

    def tilt_mas(self, last: int, *, continuous: bool = True) -> float:
        """True tilt in the last frames, mas rms per axis: in continuous time, or at the starts of the exposures."""
        residual_nm = self.residual_nm(continuous=continuous)[-last:, :2]
        return float(np.sqrt(np.mean(residual_nm**2)) / self.nm_per_mas)


def timing_of(config: Configuration) -> Timing:
    """Times of exposure and mirror motion in the loop of a configuration."""
    exposure = config.camera.exposure_fraction if config.camera.instants > 1 else 0.0
    return Timing.of(config.camera.delay_frames, exposure)


def tuned(
    run: TimeSeries, config: Configuration, kinds: Sequence[str] = ("lqg",), timing: Timing | None = None
) -> dict[str, Tuned]:
    """Laws of these kinds, tuned from pseudo-open-loop modes (frames, modes): all of the loop, or its first few."""
    noll = config.noll[: run.values[0].shape[1]]
    rate_hz, leak = config.camera.rate_hz, np.zeros(len(noll))
    timing = timing_of(config) if timing is None else timing
    gains, models = best_gains(run, rate_hz, timing, leak), identify_modes(run, rate_hz)
    makers: dict[str, Callable[[], Tuned]] = {
        "integrator": lambda: tune_integrator(models, gains, noll, leak, timing),
        "pi-notch": lambda: tune_pi_notch(models, gains, noll, leak, timing),
        "lqg": lambda: tune_lqg(run, models, gains, noll, leak, timing),
    }
    return {kind: makers[kind]() for kind in kinds}
