"""Estimate of the disk space that a recording will use, and a check of its folder."""

import os
import shutil
from pathlib import Path

from lowfc.adapters.files.sensors import PUPIL_IMAGE_PIXELS
from lowfc.adapters.logs.selection import Selection, selection
from lowfc.adapters.logs.series import nearest_existing, shortage
from lowfc.contract.codecs.input_file import user_path
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import COMMAND, FRAME, MIRROR_STATE, STEP, SURFACE, TRUTH, Rate, Topic, wire
from lowfc.optics.chain.sensor import Sensor

_FLOAT_BYTES, _PIXEL_BYTES = 4, 2
_SURFACE_SIDE = 64  # pixels of the published image of the mirror's surface
_MESSAGE_BYTES = 110  # times, sequence, flags, record header and index entry of a message
_COMPRESSED_FRACTION = {FRAME: 0.6, COMMAND: 0.9, MIRROR_STATE: 0.55}
"""Relative size of a payload after LZ4, measured in closed loop with the simulated camera at V = 2; other topics: 1."""


def payload_bytes(config: Configuration, camera: wire.CameraState | None = None) -> dict[Topic, int]:
    """Size of the uncompressed arrays of one message, bytes, for each topic with large arrays.

    Without the camera's state, frames are those of the simulated camera.
    """
    rows, columns, _ = _frame_size(config, camera)
    actuators, modes = config.mirror.rows * config.mirror.columns, config.sensor.modes
    return {
        FRAME: rows * columns * _PIXEL_BYTES,
        COMMAND: actuators * _FLOAT_BYTES,
        MIRROR_STATE: actuators * _FLOAT_BYTES,
        SURFACE: _SURFACE_SIDE**2 * _FLOAT_BYTES,
        STEP: 3 * modes * _FLOAT_BYTES,
        TRUTH: (5 if config.camera.instants > 1 else 2) * modes * _FLOAT_BYTES,
    }


def bytes_per_s(config: Configuration, recorded: Selection, camera: wire.CameraState | None = None) -> float:
    """Growth of a log, bytes per second: compressed message size times rate, summed over the large topics."""
    return sum(
        (size * _COMPRESSED_FRACTION.get(topic, 1.0) + _MESSAGE_BYTES) * _rate_hz(topic, config, recorded)
        for topic, size in payload_bytes(config, camera).items()
    )


def configured_selection(config: Configuration) -> Selection:
    """The selection of messages to record, from the configuration."""
    return selection(config.recorder.every, config.recorder.topics)


def estimate(config: Configuration, camera: wire.CameraState | None = None) -> str:
    """Sentence on the disk space that a recording will use, with the assumed rate and frame size."""
    recorded = configured_selection(config)
    folder, min_free_bytes = user_path(config.recorder.folder), config.recorder.min_free_mb * 1e6
    rows, columns, source = _frame_size(config, camera)
    selected = f" ({recorded.description})" if recorded.description else ""
    size = f"{rows} x {columns} pixels{source}{selected}"
    time = " in simulated time" if config.lockstep else ""
    conditions = f" at {config.camera.rate_hz:g} Hz{time} and {size}"
    growth = growth_in_words(bytes_per_s(config, recorded, camera), folder, min_free_bytes, conditions)
    return f"recording into {folder}: {growth}"


def check_folder(config: Configuration) -> None:
    """Raise DataFileError if the recorder's folder can hold no log: no access, no permission or too little space."""
    folder = user_path(config.recorder.folder)
    fault = shortage(folder, round(config.recorder.min_free_mb * 1e6))
    if not fault and not os.access(nearest_existing(folder), os.W_OK):
        fault = f"no log can be recorded in {folder}: it is not writable; name another (recorder.folder)"
    if fault:
        raise DataFileError(fault)


def growth_in_words(growth_bytes_per_s: float, folder: Path, min_free_bytes: float, conditions: str = "") -> str:
    """Growth per hour, `conditions` (" at 250 Hz"), and time until the disk of `folder` has `min_free_bytes` left."""
    free_bytes = shutil.disk_usage(nearest_existing(folder)).free
    lasts_h = max(0.0, free_bytes - min_free_bytes) / growth_bytes_per_s / 3600
    growth = f"about {_size(growth_bytes_per_s * 3600)} an hour{conditions}"
    return f"{growth}; {_size(free_bytes)} free, enough for {lasts_h:.1f} h"


def _frame_size(config: Configuration, camera: wire.CameraState | None) -> tuple[int, int, str]:
    """Rows and columns of a frame; if no camera reports them, the simulated camera's, and a remark that says so."""
    if camera is not None and camera.rows and camera.columns:
        return camera.rows, camera.columns, ""
    side = PUPIL_IMAGE_PIXELS if config.sensor.kind == "zwfs" else Sensor.pixels
    return side, side, " (size of the simulated camera)"


def _rate_hz(topic: Topic, config: Configuration, recorded: Selection) -> float:
    if topic in recorded.excluded:
        return 0.0
    rate_hz = config.camera.rate_hz if topic.rate is Rate.LOOP else float(topic.rate)
    return rate_hz if recorded.records_all(topic) else rate_hz / recorded.interval_frames


def _size(count: float) -> str:
    if count < 1e9:
        return f"{count / 1e6:.0f} MB"
    return f"{count / 1e9:.{0 if count >= 1e10 else 1}f} GB"
