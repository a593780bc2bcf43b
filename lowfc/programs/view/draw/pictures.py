"""Pictures on a rerun stream, and the scale of their colours."""

from math import floor, log10

import numpy as np
import numpy.typing as npt
import rerun as rr
from rerun.components import ImageBufferBatch, ImageFormat

from lowfc.programs.view.draw.colours import Rgb, diverging
from lowfc.programs.view.draw.plots import at, labels

_STEPS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0)  # round numbers in a decade
_SHRINK_NS = 2_000_000_000  # time of smaller values after which the limit shrinks


class Scale:
    """Largest magnitude shown, a round number: it grows at once, and shrinks after two seconds of smaller values."""

    def __init__(self, min_limit: float) -> None:
        self._min_limit = min_limit
        self.limit = 0.0
        self._needed_ns = 0  # last time at which the limit was needed

    def fit(self, values: npt.NDArray[np.floating], time_ns: int) -> bool:
        """Adapt the limit to the finite values; True if the limit changed."""
        largest = max(self._min_limit, float(np.abs(values[np.isfinite(values)]).max(initial=0.0)))
        decade = 10.0 ** floor(log10(largest))
        fitted = next(step * decade for step in _STEPS if largest <= step * decade * (1 + 1e-9))
        if fitted >= self.limit:
            self._needed_ns = time_ns
        if fitted > self.limit or (fitted < self.limit and time_ns - self._needed_ns > _SHRINK_NS):
            self.limit, self._needed_ns = fitted, time_ns
            return True
        return False


class Picture:
    """Pictures at one path of a stream; the format is sent only when it changes, which saves two thirds of the time."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._shape: tuple[int, ...] = ()
        self._captioned: object = None

    def show(self, stream: rr.RecordingStream, time_ns: int, colours: Rgb, caption: str = "") -> None:
        """Show colours (rows, columns, 3) with a caption at the lower edge."""
        at(stream, time_ns)
        rows, columns, _ = colours.shape
        if colours.shape != self._shape:
            self._shape = colours.shape
            image_format = ImageFormat(width=columns, height=rows, color_model="RGB", channel_datatype="U8")
            stream.log(self.path, rr.Image.from_fields(format=image_format))
        buffer = rr.DescribedComponentBatch(ImageBufferBatch(colours.tobytes()), rr.Image.descriptor_buffer())
        stream.log(self.path, [buffer])  # as Image.from_fields() does, but faster
        if caption and self._captioned != (caption, rows, columns):
            self._captioned = caption, rows, columns
            stream.log(f"{self.path}/caption", labels([(columns / 2, rows * 0.86)], [caption]))


class SignedPicture(Picture):
    """Pictures of signed values: blue below zero, orange above; the caption gives the range."""

    def __init__(self, path: str, unit: str) -> None:
        super().__init__(path)
        self._scale, self._unit = Scale(1.0), unit

    def show_values(self, stream: rr.RecordingStream, time_ns: int, values: npt.NDArray[np.floating]) -> None:
        """Show values (rows, columns)."""
        self._scale.fit(values, time_ns)
        limit = self._scale.limit
        caption = f"blue -{limit:g}, orange +{limit:g} {self._unit}"
        self.show(stream, time_ns, diverging(values / limit), caption)
