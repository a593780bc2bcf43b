"""Marks on a rerun stream, all on one timeline: curves in columns, pictures, captions."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import rerun as rr
from rerun.components import AggregationPolicy, ImageBufferBatch, ImageFormat

from lowfc.programs.view.colours import WHITE, Colour, Rgb

TIMELINE = "time"


def at(stream: rr.RecordingStream, time_ns: int) -> None:
    """What is logged next belongs to this time."""
    stream.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"))


def name_curves(
    stream: rr.RecordingStream, path: str, names: Sequence[str], colours: Sequence[Colour], width: float = 1.2
) -> None:
    """Names and colours of the curves at `path`, for all times."""
    style = rr.SeriesLines(
        names=list(names),
        colors=list(colours),
        widths=[width] * len(names),
        aggregation_policy=AggregationPolicy.MinMax,  # where a pixel holds many rows: peaks stay
    )
    stream.log(path, style, static=True)


def curves(
    stream: rr.RecordingStream, path: str, times_ns: npt.NDArray[np.int64], values: npt.NDArray[np.floating]
) -> None:
    """Add (rows,) or (rows, curves) values in one message; of rows that are not finite one is left, as a gap."""
    if not len(times_ns):
        return
    columns = values.reshape(len(times_ns), -1)
    whole = np.isfinite(columns).all(axis=1)
    kept = whole | np.concatenate([[True], whole[:-1]])
    times, columns = times_ns[kept], columns[kept]
    scalars = rr.Scalars.columns(scalars=columns.astype(np.float64).ravel())
    stream.send_columns(
        path,
        indexes=[rr.TimeColumn(TIMELINE, timestamp=times.view("datetime64[ns]"))],
        columns=scalars.partition([columns.shape[1]] * len(times)),
    )


class Pictures:
    """Pictures at one path; their format is sent when it changes, which takes two thirds off the cost of each."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._shape: tuple[int, ...] = ()

    def show(self, stream: rr.RecordingStream, time_ns: int, colours: Rgb) -> None:
        """Show colours (rows, columns, 3)."""
        at(stream, time_ns)
        if colours.shape != self._shape:
            self._shape = colours.shape
            rows, columns, _ = colours.shape
            image_format = ImageFormat(width=columns, height=rows, color_model="RGB", channel_datatype="U8")
            stream.log(self.path, rr.Image.from_fields(format=image_format))
        buffer = rr.DescribedComponentBatch(ImageBufferBatch(colours.tobytes()), rr.Image.descriptor_buffer())
        stream.log(self.path, [buffer])  # the same as Image.from_fields() makes, for two thirds of its time


def words(places: npt.ArrayLike, texts: Sequence[str], colours: Sequence[Colour] = (WHITE,)) -> rr.Points2D:
    """Words at places (words, 2), by which the viewer sets them a little below."""
    return rr.Points2D(places, radii=0.0, colors=colours, labels=texts, show_labels=True)


def caption(stream: rr.RecordingStream, path: str, text: str, shape: tuple[int, ...]) -> None:
    """Write a line into the lower edge of the picture (rows, columns) at `path`."""
    rows, columns = shape
    stream.log(f"{path}/caption", words([(columns / 2, rows * 0.86)], [text]))
