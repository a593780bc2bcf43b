"""The messages of a camera under test: frames and settings."""

import zlib
from collections.abc import Callable
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.arrays import Pixels
from lowfc.contract.messages import CAMERA_STATE, FRAME, RawImage, Role, from_timestamp, wire
from lowfc.programs.commissioning.conformance.connection import NS_PER_S, CollectedMessages, Connection, Received
from lowfc.programs.commissioning.conformance.publisher import LATE_NS

POLL_S = 0.02
STORED_IMAGES = 50
"""Number of frames whose pixels are stored."""


class FrameRecord(NamedTuple):
    """A frame without pixels; `publish_time_ns` is 0 without a valid envelope, `highest_dn` None if sizes misfit."""

    receive_time_ns: int
    publish_time_ns: int
    image: RawImage
    data_bytes: int
    checksum: int
    highest_dn: int | None

    @property
    def time_ns(self) -> int:
        """End of the exposure, ns, as stated by the camera."""
        return from_timestamp(self.image.timestamp)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.image.height, self.image.width


class Camera(CollectedMessages):
    """Messages of a camera.

    Attributes:
        frames: every frame, without its pixels.
        unreadable: number of payloads that are not a RawImage.
        pixels: pixels (rows, columns) of the first `STORED_IMAGES` frames, decoded as little-endian.
        states: the camera's settings in order of arrival; None for one that could not be decoded.
        answers: replies to a query for the settings.
    """

    def __init__(self, connection: Connection) -> None:
        super().__init__(connection, FRAME.key, Role.CAMERA)
        self.frames: list[FrameRecord] = []
        self.unreadable = 0
        self.pixels: list[Pixels] = []
        self.states: list[wire.CameraState | None] = []
        self.answers: list[Received] = []

    def store(self, message: Received) -> None:
        """Store a message for the checks, frames without their pixels."""
        if message.key == FRAME.key:
            try:
                self._store_frame(message, RawImage.FromString(message.payload))
            except DecodeError:
                self.unreadable += 1
            message = message._replace(payload=b"")
        elif message.key == CAMERA_STATE.key:
            try:
                self.states.append(wire.CameraState.FromString(message.payload))
            except DecodeError:
                self.states.append(None)
        super().store(message)

    def _store_frame(self, message: Received, image: RawImage) -> None:
        data, envelope, highest_dn = image.data, message.envelope, None
        if image.step == 2 * image.width and len(data) == image.step * image.height > 0:
            pixels = np.frombuffer(data, "<u2").reshape(image.height, image.width)
            highest_dn = int(pixels.max())
            if len(self.pixels) < STORED_IMAGES:
                self.pixels.append(pixels)
        image.ClearField("data")
        publish_time_ns, checksum = 0 if envelope is None else envelope.publish_time_ns, zlib.crc32(data)
        frame = FrameRecord(message.receive_time_ns, publish_time_ns, image, len(data), checksum, highest_dn)
        self.frames.append(frame)

    @property
    def settings(self) -> wire.CameraState | None:
        """The last settings that could be decoded."""
        return next((state for state in reversed(self.states) if state is not None), None)

    @cached_property
    def shapes(self) -> list[tuple[int, int]]:
        """The different sizes (rows, columns) of the frames; normally one."""
        return sorted({frame.shape for frame in self.frames})

    @cached_property
    def brightest_dn(self) -> int:
        """The brightest pixel of all frames, DN."""
        return max((frame.highest_dn or 0 for frame in self.frames), default=0)

    @cached_property
    def publish_times_ns(self) -> list[int]:
        """Publish times of the frames, or their arrival times if any publish time is implausible."""
        times = [frame.publish_time_ns for frame in self.frames]
        arrivals = [frame.receive_time_ns for frame in self.frames]
        near = all(abs(arrival - time) <= LATE_NS for time, arrival in zip(times, arrivals, strict=True))
        return times if near and all(later > earlier for earlier, later in pairwise(times)) else arrivals


def watch(connection: Connection, seconds: float, progress: Callable[[float], None]) -> Camera:
    """Observe a camera for `seconds`; `progress` receives the elapsed time, s."""
    camera, begun_ns = Camera(connection), connection.now_ns()
    while (elapsed_s := (connection.now_ns() - begun_ns) / NS_PER_S) < seconds:
        progress(elapsed_s)
        camera.collect(min(POLL_S, seconds - elapsed_s))
    camera.seconds = seconds
    camera.answers = connection.ask(CAMERA_STATE.key)
    return camera
