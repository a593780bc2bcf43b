"""Calibration through the bus: the controller plays pokes, and H is fitted to the frames.

Completed cycles are kept beside the output file, as FILE.part.npz, until the calibration is complete.
"""

import contextlib
import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lowfc.adapters.files import factory, fits_file
from lowfc.adapters.files.whole_file import write_whole
from lowfc.adapters.process.progress import ProgressCallback
from lowfc.arrays import Array
from lowfc.client import Client, configuration_of
from lowfc.contract.errors import CalibrationError, DataFileError, LowfcError
from lowfc.contract.messages import wire
from lowfc.control.calibration.calibration import Calibration, same_frames_and_modes
from lowfc.control.calibration.delay_fit import Delay
from lowfc.control.calibration.regularised import pixel_variance
from lowfc.control.calibration.response_fit import (
    Check,
    Initial,
    Measured,
    Sums,
    best_initial,
    check,
    correlation,
    fit_response,
)
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.control.loop.wording import counted
from lowfc.programs.commissioning.calibrate.pokes import CalibrationRequest, Pokes, check_cycles
from lowfc.programs.commissioning.calibrate.recording import Player, Report, check_size, warn_of_added_shapes

_MIN_CORRELATION = 0.3
"""Absolute correlation of the first poke's image with that of the calibration in use below which there is a warning."""


class CalibrationData(NamedTuple):
    """Measured response and delay."""

    measured: Measured
    delay: Delay


class Calibrator:
    """One calibration of a running loop; afterwards the mirror returns to its former shape.

    Attributes:
        request: the requested calibration.
        computed: calibration computed with the optical model.
        config: configuration of the loop.
        in_use: calibration in use.
        pokes: the probe sequences.
        completed: number of completed cycles stored for --resume.
    """

    def __init__(
        self,
        loop: Client,
        request: CalibrationRequest,
        report: Report,
        progress: ProgressCallback,
        computed: Calibration,
    ) -> None:
        """Get the controller's calibration; with --resume, read the completed cycles.

        Args:
            loop: A connection to the controller.
            request: The requested calibration.
            report: Receives messages for the user.
            progress: Receives the current step as text, and the number of frames done and in total.
            computed: Calibration of the optical model; if its frame size and modes are the loop's, R may start the fit.
        """
        self._loop = loop
        self.request = request
        self._report = report
        self.config = configuration_of(loop)
        self.in_use = replace(loop.calibration(), camera=loop.camera())
        if self.in_use.camera is not None:
            check_size(self.in_use.camera.shape, self.in_use)
        self.computed = computed
        self._closed = request.method == "in-loop"
        if not self._closed:  # the in-loop method keeps the reference image
            warn_of_added_shapes(loop, report)
        self.pokes = Pokes(self.config, self.in_use, request)
        self._progress = progress
        self._player = Player(loop, self.in_use, report, self._closed)
        self._conditions: dict[str, Any] = {
            "method": request.method,
            "amplitude_nm": self.pokes.amplitude_nm,
            "calibration": self.in_use.id,
        }
        self._resumed = resumed(partial_path(request.out), self._conditions) if request.resume else None
        self.completed = self._resumed.cycles if self._resumed else 0

    @contextlib.contextmanager
    def required_mode(self) -> Iterator[None]:
        """Context with the loop in the mode that the method requires; restores the mode at the end."""
        mode = self._mode()
        if mode not in (wire.LOOP_MODE_OPEN, wire.LOOP_MODE_CLOSED):
            raise CalibrationError("the loop must be open or closed: `lowfc ctl clear` leaves safe mode")
        if self._closed and mode != wire.LOOP_MODE_CLOSED:
            raise CalibrationError(
                "--method in-loop requires a closed loop, but the loop is open: `lowfc ctl close` first"
            )
        with contextlib.nullcontext() if self._closed else self.opened("for the calibration"):
            yield

    @contextlib.contextmanager
    def opened(self, purpose: str) -> Iterator[None]:
        """Context with the loop open; a closed loop is closed again at the end."""
        if self._mode() != wire.LOOP_MODE_CLOSED:
            yield
            return
        self._report(f"the loop is opened {purpose} and closed again afterwards")
        self._loop.open_loop()
        try:
            yield
        except BaseException:
            try:
                self._loop.check_lease()  # raises if another operator ended the lease: the loop is left to them
                self._loop.close_loop()
            except LowfcError as fault:  # the first fault is the one that is raised
                self._report(f"warning: the loop was not closed again: {fault}")
            raise
        self._loop.close_loop()

    def _mode(self) -> int:
        state = self._loop.status().state
        return state.mode if state is not None else wire.LOOP_MODE_OPEN

    def run(self, delay: Delay | None = None) -> CalibrationData:
        """Measure the delay, unless it is given, then the response. The delay also shows that pokes are detected."""
        delay = self.delay() if delay is None else delay
        return CalibrationData(self._cycles(delay), delay)

    def check(self, calibration: Calibration, data: CalibrationData) -> Check:
        """Measure the cross-talk of a new calibration, with cycles that it was not computed from."""
        R = calibration.reconstructor.astype(np.float64)
        cycles = data.measured.cycles
        count = check_cycles(cycles)
        products = []
        for number in range(count):
            self._show(f"check {number + 1} of {count}", cycles, cycles + number)
            plan = self.pokes.cycle(cycles + number)
            products.append(R @ self._player.cycle(plan, data.delay.delay_frames).response)
        return check(np.array(products), R @ data.measured.response, data.measured.error * np.sqrt(cycles))

    @property
    def _quietest_mode(self) -> int:
        """Index of the mode with the lowest noise; tip and tilt, the most disturbed, only if there is no other mode."""
        tilt = np.isin(self.in_use.noll, TIP_TILT)
        return int(np.where(tilt & ~tilt.all(), np.inf, self.pokes.noise_nm).argmin())

    def delay(self) -> Delay:
        """Measure the delay from a poke of the quietest mode to its image; warn if the image is unexpected."""
        mode = self._quietest_mode
        plan = self.pokes.delay_plan(mode)
        self._show("detecting pokes", max(self.pokes.cycles(), self.completed), self.completed)
        delay = self._player.first_poke(mode, plan)
        self._compare_response(delay.response, mode)
        self._report(
            f"pokes of Z{self.in_use.noll[mode]} are detected after {delay.delay_frames:.3f} +- "
            f"{delay.error_frames:.3f} frames, {delay.delay_frames * self.config.period_ns * 1e-6:.3g} ms (from the "
            "end of an exposure to the end of the exposure that sees the resulting command)"
        )
        return delay

    def _compare_response(self, response: Array, mode: int) -> None:
        expected = self.in_use.response[:, mode].astype(np.float64)
        image_correlation = correlation(response, expected)
        if abs(image_correlation) < _MIN_CORRELATION:
            self._report(
                f"warning: the image of Z{self.in_use.noll[mode]} differs from that of the calibration in use "
                f"(correlation {image_correlation:.2f}): is the sensor aligned (`lowfc calibrate align`)?"
            )
        elif image_correlation < 0:
            self._report(
                f"warning: Z{self.in_use.noll[mode]} has the opposite sign of the calibration in use: the mirror or "
                "the camera is reflected or rotated; do not close the loop with that calibration"
            )

    def _cycles(self, delay: Delay) -> Measured:
        pokes, request = self.pokes, self.request
        path = partial_path(request.out)
        if self._resumed is None:
            sums = Sums.none(self._initial(delay))
        else:
            sums = self._resumed
            self._report(f"continuing after {counted(sums.cycles, 'cycle')}")
        needed = max(pokes.cycles(), sums.cycles)
        self._report(
            f"{needed} cycles of {len(pokes.cycle(0))} frames and {check_cycles(needed)} check cycles; "
            + self._remaining_time(needed, sums.cycles)
        )
        while True:
            while sums.cycles < needed:
                done = sums.cycles
                self._show(f"{request.method} cycle {done + 1} of {needed}", needed, done)
                sums = sums.plus(self._player.cycle(pokes.cycle(done), delay.delay_frames))
                store(path, sums, self._conditions)
                self.completed = sums.cycles
            measured = fit_response(sums)
            required = pokes.required_cycles(needed, float(measured.error.max()))
            if required <= needed:
                return measured
            self._report(
                f"the cycles scatter more than photon and read noise: {required} cycles instead of {needed}; "
                + self._remaining_time(required, needed)
            )
            needed = required

    def _show(self, doing: str, needed: int, done: int) -> None:
        total = self.pokes.frames(needed)
        self._progress(doing, total - self.pokes.frames(needed, done), total)

    def _remaining_time(self, needed: int, done: int) -> str:
        return f"about {self.pokes.frames(needed, done) / self.config.camera.rate_hz:.0f} s to go"

    def _initial(self, delay: Delay) -> Initial:
        """The initial R of the fit: the computed R, unless the R in use measures the poke with less noise."""
        in_use = self.in_use
        usable = [each for each in (self.computed, in_use) if same_frames_and_modes(each, in_use)]
        candidates = [Initial(each.reconstructor.astype(np.float64) * in_use.good, each.estimator) for each in usable]
        full_rank = [each for each in candidates if np.linalg.matrix_rank(each.matrix) == len(in_use.noll)]
        if not full_rank:
            raise CalibrationError(
                "neither the optical model nor the calibration in use distinguishes all modes on these pixels, as R "
                "requires: `lowfc calibrate align` computes a calibration for this sensor"
            )
        camera = factory.detector(self.config)
        variance = pixel_variance(
            in_use.reference.astype(np.float64),
            in_use.flux_dn * camera.gain_e_per_dn / camera.em_gain,
            factory.equivalent_read_noise_e(camera),
        )
        return best_initial(full_rank, delay.response, self._quietest_mode, variance)


def partial_path(out: Path) -> Path:
    """File that keeps the completed cycles until the calibration is complete."""
    return out.with_name(out.name + ".part.npz")


def store(path: Path, sums: Sums, conditions: dict[str, Any]) -> None:
    """Write the completed cycles, with their method, amplitude and calibration; DataFileError if that fails."""
    stream = io.BytesIO()
    arrays = sums._asdict() | {"initial": sums.initial.matrix, "estimator": sums.initial.estimator}
    np.savez(stream, what=np.array(json.dumps(conditions, sort_keys=True)), **arrays)
    write_whole(path, stream.getvalue())


def resumed(path: Path, conditions: dict[str, Any]) -> Sums:
    """Read completed cycles; DataFileError without a file, or if it is damaged or was made under other conditions."""
    stored, sums = stored_cycles(path)
    for key, value in conditions.items():
        if stored.get(key) != value:
            raise DataFileError(
                f"{path} belongs to another calibration: {key} is {stored.get(key)} in the file, but {value} now; "
                "remove the file, or omit --resume"
            )
    return sums


def stored_cycles(path: Path) -> tuple[dict[str, Any], Sums]:
    """Read the conditions (method, amplitude, calibration) and cycles; DataFileError if the file is bad or absent."""
    if not path.is_file():
        raise DataFileError(f"nothing to resume: there is no {path}; omit --resume")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            sums = Sums(
                Initial(arrays["initial"], str(arrays["estimator"])),
                arrays["answers"],
                arrays["response"],
                arrays["reference"],
                int(arrays["references"]),
                float(arrays["flux_dn"]),
            )
            return dict(json.loads(str(arrays["what"]))), sums
    except (*fits_file.DAMAGED, zipfile.BadZipFile) as error:
        why = fits_file.one_line(error)
        raise DataFileError(f"{path} is damaged or not from a calibration: {why}; remove it") from None
