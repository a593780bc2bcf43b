"""A stream that keeps what is logged on it, for tests of what is drawn."""

from collections import defaultdict
from typing import Any

import numpy as np
import numpy.typing as npt


class Tape:
    """In place of a RecordingStream.

    Attributes:
        now_ns: time of what is logged next.
        logged: (time in ns, archetypes) by entity path; the time is None for what holds for ever.
        rows: (times in ns, values (rows, series)) of columns of scalars, by entity path.
    """

    def __init__(self) -> None:
        self.now_ns: int | None = None
        self.logged: dict[str, list[tuple[int | None, tuple[Any, ...]]]] = defaultdict(list)
        self.rows: dict[str, list[tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]]] = defaultdict(list)

    def set_time(self, timeline: str, *, timestamp: np.datetime64) -> None:
        assert timeline == "time"
        self.now_ns = int(timestamp.astype("datetime64[ns]").astype(np.int64))

    def log(self, path: str, *archetypes: Any, static: bool = False) -> None:
        self.logged[path].append((None if static else self.now_ns, archetypes))

    def send_columns(self, path: str, indexes: list[Any], columns: Any) -> None:
        (index,) = indexes
        assert index.timeline_name() == "time"
        times_ns = np.array(index.as_arrow_array().cast("int64"))
        self.rows[path].append((times_ns, np.array(values_of(next(iter(columns))), float)))

    def disconnect(self) -> None:
        pass

    @property
    def paths(self) -> set[str]:
        """Where something was drawn that is not style alone."""
        moving = {path for path, found in self.logged.items() if any(at is not None for at, _ in found)}
        return moving | set(self.rows)

    def column(self, path: str) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """All rows of a path."""
        times, values = zip(*self.rows[path], strict=True)
        return np.concatenate(times), np.concatenate(values)

    def names(self, path: str) -> list[str]:
        """Names of the curves at a path, as they were given last."""
        return values_of(self.last(path).names)

    def texts(self, path: str) -> list[str]:
        """Lines of a log at a path."""
        return [values_of(line.text)[0] for _, (line,) in list(self.logged[path])]

    def last(self, path: str) -> Any:
        """What was logged last at a path."""
        return self.logged[path][-1][1][0]


def values_of(component: Any) -> list[Any]:
    return list(component.as_arrow_array().to_pylist())


def pixels(tape: Tape, path: str) -> npt.NDArray[np.uint8]:
    """Colours (rows, columns, 3) of the last picture at a path; its format may have come before it."""

    def last(component: str) -> Any:
        logged = [batches for _, (batches, *_) in tape.logged[path]]
        parts = [part for one in logged for part in (one if isinstance(one, list) else one.as_component_batches())]
        named = [part for part in parts if part.component_descriptor().component == f"Image:{component}"]
        return values_of(named[-1])[0]

    shape = last("format")
    return np.array(last("buffer"), np.uint8).reshape(shape["height"], shape["width"], -1)
