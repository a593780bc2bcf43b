"""The steps from a running camera and mirror to a calibration in use and, on request, a closed loop."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lowfc.adapters.files import calibration_file
from lowfc.adapters.logs.columns import Steps, steps_as_columns
from lowfc.adapters.process.progress import ProgressCallback
from lowfc.arrays import Single
from lowfc.client import Client
from lowfc.contract.codecs.law_codec import driving, integrator_of
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError, LowfcError, raised_as
from lowfc.contract.messages import wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.delay_fit import Delay
from lowfc.control.laws import margins
from lowfc.control.laws.stability import delay_weights, settling_frames
from lowfc.control.laws.what_if import (
    Controller,
    controller_of,
    counterfactual,
    limited_integrator,
    missing_before,
    rms,
)
from lowfc.control.loop.inputs import Step
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.programs.commissioning.calibrate.pokes import MIN_SNR, CalibrationRequest, Pokes
from lowfc.programs.commissioning.calibrate.recording import LEASE_CHECK_FRAMES, Player, Report, next_frames
from lowfc.programs.commissioning.calibrate.result import finish_calibration
from lowfc.programs.commissioning.calibrate.run import Calibrator, partial_path, stored_cycles
from lowfc.programs.commissioning.calibrate.tasks import images
from lowfc.programs.commissioning.commission import first_calibration
from lowfc.programs.commissioning.commission.first_light import (
    Sensor,
    calibration_with_reference,
    checked_camera,
    with_measured_dark,
)

METHOD = "hadamard"
DEFAULT_SNR = 50.0
"""Signal-to-noise ratio required in the noisiest mode, unless the number of cycles is given."""
CAMERA_FRAMES = 32
"""Frames from which size, rate and brightness are determined."""
CHECK_GAIN = 0.1
"""Gain of the closed-loop check in place of automatic gains, which are 0 before they are measured.

The loop is stable with it at any usual delay; with a wrong sign the error grows about tenfold in 25 frames.
"""
MAX_ERROR_RATIO = 1.5
"""Largest accepted ratio of measured to predicted error in the closed loop."""
MIN_RESIDUAL_FRAMES = 1000
"""Smallest number of frames observed, after settling, to predict the residual and to measure it."""
STEPS = (
    *("camera", "dark and bad pixels", "reference image", "delay", "orientation and sign", "poke amplitude"),
    *("response", "verdict", "prediction", "closed loop"),
)


@dataclass(frozen=True, slots=True)
class CommissionOptions:
    """The options of `lowfc commission`."""

    out: Path
    frames: int
    dark: Path | None
    no_dark: bool
    snr: float | None
    cycles: int | None
    resume: bool
    close: bool


def provisional_path(out: Path) -> Path:
    """File of the provisional calibration until the final one is written."""
    return out.with_name(f"{out.name}.first.fits")


class Commissioning:
    """One commissioning of a running loop."""

    def __init__(
        self,
        loop: Client,
        config: Configuration,
        computed: Calibration,
        options: CommissionOptions,
        report: Report,
        progress: ProgressCallback,
        confirm: Callable[[str], None],
    ) -> None:
        """Commission the loop that `loop` is connected to; `computed` is the calibration of the optical model."""
        self._loop, self._config, self._computed, self._options = loop, config, computed, options
        self._report, self._progress, self._confirm = report, progress, confirm
        self._results: dict[str, Any] = {}
        self._provisional_file: Path | None = None  # set once the provisional calibration is about to be loaded
        self._advice = ""  # text printed if an error occurs after the calibration was loaded

    def run(self) -> tuple[dict[str, Any], str]:
        """Carry out all steps; return the results, and the text to print without --json."""
        options, provisional_file = self._options, provisional_path(self._options.out)
        if options.resume and not provisional_file.is_file():
            if options.out.is_file():
                raise CalibrationError(
                    f"nothing to resume: {options.out} is finished; `lowfc ctl load {options.out}` loads it; --force "
                    "in place of --resume starts a new commissioning"
                )
            self._report(f"nothing to resume beside {options.out}: starting from the beginning")
        previous = self._prepare_loop()
        try:
            return self._carry_out(provisional_file)
        except BaseException:
            self._report(self._how_to_continue(previous))
            raise

    def _how_to_continue(self, previous: Calibration | None) -> str:
        """Text after a commissioning that ended early: the calibration in use, and how to continue."""
        if self._advice:
            return self._advice
        if self._provisional_file is None:
            return "no calibration was changed"
        text = f"the completed steps are kept in {self._provisional_file}: the same command with --resume continues"
        with contextlib.suppress(LowfcError):
            if previous is not None:
                self._loop.check_lease()
                self._loop.load(previous)
                return f"{text}; the previous calibration is in use again"
        return (
            f"{text}; until then the provisional calibration of this commissioning is in use, without a verdict: "
            "`lowfc ctl load FILE` loads another one"
        )

    def _carry_out(self, provisional_file: Path) -> tuple[dict[str, Any], str]:
        options, config = self._options, self._config
        resumed = options.resume and provisional_file.is_file()
        if resumed:
            provisional, commands = calibration_file.load(provisional_file), self._computed.modes_to_actuators
            same_modes = provisional.noll == self._computed.noll and provisional.grid == self._computed.grid
            if not (same_modes and np.allclose(provisional.modes_to_actuators, commands, atol=1e-3)):
                raise CalibrationError(
                    f"{provisional_file} has other modes or mirror commands than the configuration: omit --resume"
                )
            camera = self._loop.camera()
            if camera is not None and camera.shape != provisional.shape:
                raise CalibrationError(
                    f"{provisional_file} is for frames of {provisional.shape[0]} x {provisional.shape[1]} pixels, "
                    f"the camera's are {camera.shape[0]} x {camera.shape[1]}: omit --resume"
                )
            self._report(
                f"resuming from {provisional_file} with its dark: --dark, --no-dark and --frames have no effect"
            )
        else:
            provisional, delay = self._measure_provisional()
            calibration_file.save(provisional, provisional_file)
            partial_path(options.out).unlink(missing_ok=True)  # cycles of a former commissioning
        self._provisional_file = provisional_file
        self._loop.load(provisional)
        player = Player(self._loop, provisional, self._report)
        if resumed:
            delay = first_calibration.first_delay(player, config)
        has_cycles = resumed and partial_path(options.out).is_file()
        if has_cycles:
            amplitude_nm = float(stored_cycles(partial_path(options.out))[0]["amplitude_nm"])
        else:
            self._announce("poke amplitude")
            default_nm = Pokes(config, provisional, self._request()).amplitude_nm
            amplitude_nm = first_calibration.linear_amplitude_nm(player, config, delay, default_nm)
        self._announce("response")
        request = self._request(amplitude_nm, resume=has_cycles)
        calibrator = Calibrator(self._loop, request, self._report, self._progress, self._computed)
        data = calibrator.run(delay)
        self._announce("verdict")
        calibration, result = finish_calibration(calibrator, data)
        self._results |= result.json_object()
        if not result.recommended:
            raise CalibrationError(
                f"{result.text()}\nnot loaded: correct this, then repeat the command; --resume keeps these cycles, "
                "for example to add more (--cycles)"
            )
        self._loop.load(calibration)
        self._advice = f"the calibration is good, saved in {options.out} and loaded: `lowfc ctl close` closes the loop"
        for path in (provisional_file, partial_path(options.out)):
            path.unlink(missing_ok=True)
        self._report(result.text())
        return self._results, self._predict_and_close(delay.delay_frames)

    def _request(self, amplitude_nm: float | None = None, *, resume: bool = False) -> CalibrationRequest:
        options = self._options
        snr = options.snr or (DEFAULT_SNR if options.cycles is None else MIN_SNR)
        return CalibrationRequest(METHOD, options.out, snr, options.cycles, amplitude_nm, resume)

    def _announce(self, name: str) -> None:
        self._report(f"[{STEPS.index(name) + 1}/{len(STEPS)}] {name}")

    def _prepare_loop(self) -> Calibration | None:
        """Check mode and mirror, and open a closed loop; return the calibration in use, None without one."""
        state = self._state()
        if state.mode == wire.LOOP_MODE_SAFE:
            raise CalibrationError("the loop is in safe mode: `lowfc ctl clear` first, when it is safe")
        grid = (state.mirror_rows, state.mirror_columns)
        if state.mirror_rows and grid != self._computed.grid:
            raise CalibrationError(
                f"the mirror has {grid[0]} x {grid[1]} actuators, the configuration {self._computed.grid[0]} x "
                f"{self._computed.grid[1]}: set mirror.rows and mirror.columns"
            )
        if state.mode == wire.LOOP_MODE_CLOSED:
            self._report("the loop is opened")
            self._loop.open_loop()
        return self._loop.calibration() if state.calibration_id and state.mode != wire.LOOP_MODE_IDLE else None

    def _state(self) -> wire.ControllerState:
        state = self._loop.status().state
        if state is None:
            raise CalibrationError("the controller did not report its state")
        return state

    def _measure_provisional(self) -> tuple[Calibration, Delay]:
        """Measure dark, reference image, delay and first response; return the provisional calibration and the delay."""
        self._announce("camera")
        frames = list(self._loop.frames(CAMERA_FRAMES))
        camera = checked_camera(self._config, self._loop.camera_state(), frames, self._report)
        self._announce("dark and bad pixels")
        options, pixels = self._options, camera.shape[0] * camera.shape[1]
        sensor = Sensor(camera, np.full(pixels, float(camera.bias_dn)), np.ones(pixels), measured=False)
        if options.dark is not None:
            sensor = with_measured_dark(camera, images(options.dark), self._report)
        elif options.no_dark:
            self._report(f"no dark: the camera's bias of {camera.bias_dn:g} DN for all pixels, and no bad pixels")
        else:
            self._confirm("block the star; is it dark?")
            sensor = with_measured_dark(camera, next_frames(self._loop, options.frames), self._report)
            self._confirm("unblock the star; is it visible?")
        self._announce("reference image")
        without_response = calibration_with_reference(
            sensor, next_frames(self._loop, options.frames), self._computed, self._report
        )
        self._announce("delay")
        player = Player(self._loop, without_response, self._report)
        delay = first_calibration.first_delay(player, self._config)
        self._announce("orientation and sign")
        provisional = first_calibration.aligned_calibration(player, self._config, self._computed, delay, self._results)
        if provisional is None:
            provisional = first_calibration.poked_calibration(player, self._config, delay)
        return provisional, delay

    def _predict_and_close(self, delay_frames: float) -> str:
        """Predict the residual; if requested, close the loop and compare."""
        controller, settling, automatic = self._law_of_check()
        frames = settling + max(MIN_RESIDUAL_FRAMES, settling)
        self._announce("prediction")
        with raised_as(CalibrationError, ValueError, "the residual cannot be predicted"):
            opened = self._observe(frames)
            weights = delay_weights(max(delay_frames, 1.0)).astype(np.float32)
            missing = missing_before(opened.sequence)
            predicted_nm = _rms_nm(counterfactual(controller, weights, opened.pol_nm, missing)[0], settling)
        self._results["predicted_error_nm"] = predicted_nm
        gain = f", at a gain of {CHECK_GAIN:g} in place of automatic gains" if automatic else ""
        prediction = f"predicted error with noise in closed loop{gain}: {predicted_nm:.3g} nm rms"
        text = f"{prediction}, from {frames} open-loop frames"
        if not self._options.close:
            return f"{text}\n`lowfc ctl close` closes the loop"
        self._announce("closed loop")
        with self._fixed_gains(automatic):
            measured_nm = self._measured_nm(frames, settling, predicted_nm)
        ratio = measured_nm / predicted_nm
        return f"{text}\nmeasured in closed loop: {measured_nm:.3g} nm rms, {ratio:.2f} times the prediction"

    def _law_of_check(self) -> tuple[Controller, int, list[int]]:
        """Controller of the closed-loop check, its settling time in frames, and the modes with automatic gains.

        A linear law in force stays in force.
        """
        state, noll = self._state(), self._computed.noll
        integrator, law = integrator_of(state), driving(state, self._loop.laws())
        if law is not None:
            settling = SETTLING_FRAMES + FADING_FRAMES + margins.settling_frames(law, state.delay_frames)
            return controller_of(law, integrator.limit_nm), settling, []
        automatic = np.array(state.automatic or [False] * len(noll), bool)
        integrator = replace(integrator, gain=np.where(automatic, np.float32(CHECK_GAIN), integrator.gain))
        settling = settling_frames(integrator.gain, integrator.leak, self._config.camera.rate_hz)
        return limited_integrator(integrator), settling, np.array(noll)[automatic].tolist()

    @contextlib.contextmanager
    def _fixed_gains(self, modes: list[int]) -> Iterator[None]:
        """Context with the gain `CHECK_GAIN` in these modes; afterwards their gains are automatic again."""
        if not modes:
            yield
            return
        try:
            self._loop.gain(CHECK_GAIN, modes)
            yield
        finally:
            try:
                self._loop.automatic_gain(modes)
            except LowfcError as fault:  # an error in the block is the one that is raised
                self._report(
                    f"warning: {fault}: the gains of the check stay; `lowfc ctl gain auto --modes "
                    f"{','.join(map(str, modes))}` makes them automatic again"
                )

    def _measured_nm(self, frames: int, settling: int, predicted_nm: float) -> float:
        """Close the loop and measure its error, nm rms.

        A failure opens the loop again, unless another operator ended the lease.
        """
        first = self._loop.close_loop().frame_sequence
        try:
            closed = self._observe(frames, LoopMode.CLOSED, first)
            self._advice = (
                f"the calibration is saved in {self._options.out} and loaded, but the closed loop did not behave as "
                "predicted: check the sign of the mirror, the delay and the disturbance before you close it; "
                "`lowfc ctl reset` removes the loop's command from the mirror"
            )
            measured_nm = _rms_nm(closed.error_nm, settling)
            self._results["measured_error_nm"] = measured_nm
            if measured_nm > MAX_ERROR_RATIO * predicted_nm:
                raise CalibrationError(
                    f"the measured error in closed loop is {measured_nm:.3g} nm rms, but {predicted_nm:.3g} was "
                    "predicted: are sign and delay right, did the disturbance change? The loop is opened"
                )
        except BaseException as error:
            with contextlib.suppress(LowfcError):
                self._loop.check_lease()  # raises if another operator ended the lease: the loop is left to them
                self._loop.open_loop()
            if isinstance(error, ValueError):
                raise CalibrationError(f"the residual cannot be measured: {error}") from None
            raise
        return measured_nm

    def _observe(self, frames: int, mode: LoopMode = LoopMode.OPEN, first: int = 0) -> Steps:
        steps: list[Step] = []
        self._report(f"observing {frames} frames, {frames / self._config.camera.rate_hz:.0f} s")
        for step in self._loop.steps():
            if step.frame_sequence < first:  # a step in the previous mode
                continue
            if step.mode is not mode:
                self._loop.check_lease()  # its error names who ended the lease
                raise CalibrationError(f"the loop went from {mode.in_words} to {step.mode.in_words}")
            steps.append(step)
            if len(steps) >= frames:
                break
            if len(steps) % LEASE_CHECK_FRAMES == 0:
                self._loop.check_lease()
        return steps_as_columns(steps, len(self._computed.noll))


def _rms_nm(error_nm: Single, settling: int) -> float:
    """Rms of the measured error of all modes together, noise included, over the frames after settling."""
    used = np.isfinite(error_nm).all(axis=1) & (np.arange(len(error_nm)) >= settling)
    if used.sum() < MIN_RESIDUAL_FRAMES / 2:  # up to half may have been refused, such as late frames
        raise ValueError(f"{int(used.sum())} frames after {settling} of settling are too few for a residual")
    return float(np.linalg.norm(rms(error_nm, used)))
