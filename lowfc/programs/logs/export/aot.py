"""Export to Adaptive Optics Telemetry (AOT), the exchange format of the field, written and checked by `aotpy`.

AOT describes a telescope with a Shack-Hartmann or pyramid sensor. A log is mapped to it as follows:

    AOSystem            the run; versions, camera and star in its metadata, the configuration as JSON in its config
    MainTelescope       the open circular aperture
    NaturalGuideStar    the star, observed by both coronagraph and sensor
    Pyramid             the sensor; AOT has no other class whose measurements are pixels. Each good pixel
                        is a subaperture with one signal; n_sides is 1 because there is one image
      measurements        not in the file; they are (frame - dark) / flux - reference over the good pixels
      ref_measurements    I0, fraction of the flux
    Detector            the camera: dark, bad pixels, exposure, and the frames if requested
    DeformableMirror    the mirror; actuator positions in m across the pupil, row by row; stroke to each side of flat, m
    ControlLoop         one row for each step, in the log's order
      time                end of the exposure, and frame count
      modal_coefficients  measured modal error, nm rms of wavefront; NaN if the frame was refused
      commands            surface at each actuator in the frame's first command, m; NaN if the log has none
      modes               Zernike polynomials of the calibration's modes, over the unit circle
      measurements_to_modes, modes_to_measurements, modes_to_commands: R (in use at the end of the log, with the
                          prior set by automatic gains), H and MODES2ACT
      time_filter_num, _den: the integrator g / (z - (1 - leak)) of each mode, at the end of the log
      delay               from mid-exposure to the middle of the command's period, in frames: delay_frames +
                          (1 - exposure / period) / 2
      closed              whether the loop was closed for more than half of the steps

AOT has no fields for flux, reasons, durations and truth; the other formats contain them.
"""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import aotpy
import numpy as np
from aotpy.io.fits import AOTFITSErrorLevel, AOTFITSReader, AOTFITSWriter
from astropy.io import fits
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import name_in
from lowfc.adapters.files.fits_file import header_text
from lowfc.adapters.logs.columns import exposure_fraction
from lowfc.adapters.logs.history import History
from lowfc.arrays import Single
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.codecs.state_codec import calibration_in_use
from lowfc.contract.envelope import count_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import COMMAND, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.safety import LoopMode
from lowfc.optics.chain.zernike import zernikes
from lowfc.programs.logs.export.columns import step_columns
from lowfc.programs.logs.export.cubes import copy_frames_to_fits, fits_cube

_COMMANDS, _FRAMES = "COMMANDS", "FRAMES"  # names of the images that are copied from the log
_MODES_PIXELS = 64  # rows and columns of a mode's image
_NM = 1e-9


def write_aot(files: list[Path], history: History, *, with_frames: bool) -> None:
    """Write a run as AOT; `aotpy` checks the file before commands and frames replace the empty images in it."""
    step_columns(history)  # raises DataFileError if the log has no steps
    path = files[0]
    if history.calibration is None:
        raise DataFileError(f"{history.log.path} has no calibration, which AOT requires")
    system = _System(history, history.calibration, with_frames=with_frames).system
    hdus = AOTFITSWriter(system).get_hdulist()
    hdus.writeto(path, overwrite=True)
    AOTFITSReader(path, exception_level=AOTFITSErrorLevel.WARNING)
    empty_images = {hdu.name: hdu for hdu in hdus if hdu.name in (_COMMANDS, _FRAMES)}
    fits.HDUList([hdu for hdu in hdus if hdu.name not in empty_images]).writeto(path, overwrite=True)
    if _COMMANDS in empty_images:
        _copy_commands(path, empty_images[_COMMANDS], history, history.calibration)
    if _FRAMES in empty_images:
        copy_frames_to_fits(path, empty_images[_FRAMES], history)


class _System:
    """A run in AOT's classes; commands and frames, which are copied from the log later, are empty images."""

    def __init__(self, history: History, calibration: Calibration, *, with_frames: bool) -> None:
        self._history = history
        self._calibration = calibration
        self._good = calibration.good > 0
        first_ns, last_ns = (int(history.steps.time_ns[row]) for row in (0, -1))
        config = history.configuration
        telescope = aotpy.MainTelescope(uid="telescope")
        if config is not None:
            telescope.enclosing_diameter = telescope.inscribed_diameter = config.star.diameter_m
        source = aotpy.NaturalGuideStar(uid="star")
        sensor = self._sensor(source, self._detector(with_frames=with_frames))
        mirror = self._mirror(telescope)
        self.system = aotpy.AOSystem(
            ao_mode="SCAO",
            name="lowfc",
            date_beginning=_date(first_ns),
            date_end=_date(last_ns),
            config=json.dumps(config.model_dump(), default=str) if config is not None else None,
            main_telescope=telescope,
            sources=[source],
            wavefront_sensors=[sensor],
            wavefront_correctors=[mirror],
            loops=[self._loop(sensor, mirror)],
            metadata=self._metadata(),
        )

    def _detector(self, *, with_frames: bool) -> aotpy.Detector:
        shape, camera = self._calibration.shape, self._history.camera
        detector = aotpy.Detector(
            uid="camera",
            dark=aotpy.Image("DARK", self._calibration.dark.reshape(shape), "adu"),
            bad_pixel_map=aotpy.Image("BAD PIXELS", (~self._good).astype(np.uint8).reshape(shape)),
            frame_rate=self._history.rate_hz,
            integration_time=camera.exposure_ns * 1e-9 if camera is not None else None,
        )
        if with_frames:
            sequences = self._history.frame_sequence
            clock = aotpy.Time(uid="frames", frame_numbers=[float(count_of(int(each))) for each in sequences])
            detector.pixel_intensities = aotpy.Image(_FRAMES, np.zeros((1, 1, 1), np.float32), "adu", time=clock)
        return detector

    def _sensor(self, source: aotpy.Source, detector: aotpy.Detector) -> aotpy.Pyramid:
        good, shape = self._good, self._calibration.shape
        indices = np.where(good, np.cumsum(good) - 1, -1).astype(np.int32).reshape(shape)
        return aotpy.Pyramid(
            uid="sensor",
            source=source,
            dimensions=1,
            n_sides=1,
            n_valid_subapertures=int(good.sum()),
            ref_measurements=aotpy.Image("REFERENCE", self._calibration.reference[None, good]),
            subaperture_mask=aotpy.Image("SUBAPERTURES", indices),
            mask_offsets=[aotpy.Coordinates(0.0, 0.0)],
            subaperture_size=1.0,
            wavelength=self._calibration.wavelength_nm * _NM,
            detector=detector,
        )

    def _mirror(self, telescope: aotpy.MainTelescope) -> aotpy.DeformableMirror:
        rows, columns = self._calibration.grid
        config = self._history.configuration
        keys = [key for key in self._history.counts if COMMAND.matches(key)]
        mirror = aotpy.DeformableMirror(
            uid=name_in(COMMAND, keys[0]) if keys else "dm", telescope=telescope, n_valid_actuators=rows * columns
        )
        if config is not None:
            pitch_m = config.star.diameter_m / config.mirror.pitches_per_pupil
            x, y = ((np.arange(count) - (count - 1) / 2) * pitch_m for count in (columns, rows))
            mirror.actuator_coordinates = [aotpy.Coordinates(float(at_x), float(at_y)) for at_y in y for at_x in x]
            mirror.stroke = config.mirror.stroke_nm / 2 * _NM
        return mirror

    def _loop(self, sensor: aotpy.Pyramid, mirror: aotpy.DeformableMirror) -> aotpy.ControlLoop:
        steps, calibration, state = self._history.steps, self._calibration, self._history.controller
        clock = aotpy.Time(
            uid="steps",
            timestamps=(steps.time_ns / 1e9).tolist(),
            frame_numbers=[float(count_of(int(sequence))) for sequence in steps.sequence],
        )
        good, in_use = self._good, calibration if state is None else calibration_in_use(state, calibration)
        loop = aotpy.ControlLoop(
            uid="loop",
            input_sensor=sensor,
            commanded_corrector=mirror,
            time=clock,
            closed=bool(np.mean(steps.mode == LoopMode.CLOSED) > 0.5),
            framerate=self._history.rate_hz,
            modes=aotpy.Image("MODES", _mode_images(calibration.noll)),
            modal_coefficients=aotpy.Image("MODAL ERROR", steps.error_nm, "nm", time=clock),
            measurements_to_modes=aotpy.Image("R", in_use.reconstructor[:, None, good], "nm"),
            modes_to_measurements=aotpy.Image("H", calibration.response[good][:, None, :], "nm-1"),
            modes_to_commands=aotpy.Image("MODES2ACT", calibration.modes_to_actuators * np.float32(_NM), "m nm-1"),
        )
        if any(COMMAND.matches(key) for key in self._history.counts):
            loop.commands = aotpy.Image(_COMMANDS, np.zeros((1, 1), np.float32), "m", time=clock)
        if state is not None and len(state.gain) == len(calibration.noll):
            exposure = exposure_fraction(self._history.camera)
            loop.delay = state.delay_frames + (0.0 if exposure is None else (1 - exposure) / 2)
            if not state.HasField("law"):  # a linear law cannot be given as one filter for each mode
                gain, leak = np.array(state.gain, np.float32), np.array(state.leak, np.float32)
                loop.time_filter_num = aotpy.Image("TIME FILTER NUM", gain[:, None])
                loop.time_filter_den = aotpy.Image("TIME FILTER DEN", np.stack([leak - 1, np.ones_like(leak)], axis=1))
        return loop

    def _metadata(self) -> list[aotpy.Metadatum]:
        history, calibration = self._history, self._calibration
        closed = float(np.mean(history.steps.mode == LoopMode.CLOSED))
        recorded = history.log.metadata.get("lowfc", {})
        cards: dict[str, tuple[Any, str | None]] = {
            "LOG": (history.log.path.name, None),  # no comment beside a long text: a card has 80 characters
            "RUN": (recorded.get("run", ""), None),
            "CALID": (calibration.id, None),
            "NOLL": (" ".join(map(str, calibration.noll)), None),
            "VERSION": (recorded.get("lowfc", ""), "lowfc version that recorded the log"),
            "FLUX": (calibration.flux_dn, "[adu] expected sum of the good pixels"),
            "CLOSED": (closed, "fraction of the steps with the loop closed"),
            "GAINSETS": (
                sum(one.accepted and one.name in ("gain", "leak") for one in history.requests),
                "number of accepted gain and leak requests",
            ),
        }
        if history.camera is not None:
            cards |= {
                "EPERADU": (history.camera.gain_e_per_dn, "[electron/adu] conversion gain"),
                "RDNOISE": (history.camera.read_noise_e, "[electron] read noise of a pixel and frame"),
                "BIAS": (history.camera.bias_dn, "[adu] level without light"),
                "EMGAIN": (history.camera.em_gain, "electron-multiplying gain"),
            }
        if history.configuration is not None:
            cards["STARMAG"] = (history.configuration.star.magnitude, "V magnitude of the star")
            cards["SENSOR"] = (history.configuration.sensor.kind, "kind of wavefront sensor (not a pyramid)")
        return [
            aotpy.Metadatum(key, header_text(value) if isinstance(value, str) else value, comment)
            for key, (value, comment) in cards.items()
        ]


def _copy_commands(path: Path, image: fits.ImageHDU, history: History, calibration: Calibration) -> None:
    sequence = history.steps.sequence
    shape = (len(sequence), calibration.grid[0] * calibration.grid[1])
    row_of = {int(one): row for row, one in reversed(list(enumerate(sequence)))}  # row of the first step of each frame
    rows = fits_cube(path, image, shape)
    rows[:] = np.nan
    for message in history.reader(COMMAND):
        try:
            command = wire.MirrorCommand.FromString(message.payload)
        except DecodeError:
            continue
        surface_nm = actuators(command)
        if surface_nm is not None and surface_nm.size == shape[1]:  # another size is another mirror's
            row = row_of.pop(command.frame_sequence, None)  # later ones repeat it, or step to flat without frames
            if row is not None:
                rows[row] = surface_nm.ravel() * np.float32(_NM)


def _mode_images(noll: tuple[int, ...]) -> Single:
    """Zernike polynomials (modes, rows, columns) over the unit circle, 0 outside."""
    axis = (np.arange(_MODES_PIXELS) + 0.5) / (_MODES_PIXELS / 2) - 1
    x, y = np.meshgrid(axis, axis)
    return np.asarray(zernikes(noll, x, y) * (np.hypot(x, y) <= 1), np.float32)


def _date(time_ns: int) -> datetime:
    return datetime.fromtimestamp(time_ns / 1e9, UTC)
