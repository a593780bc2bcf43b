"""Checks of the actuator limits, hand-chosen cases for them, and the simulated mirror behind its protection."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration
from lowfc.control.loop.safety import Limited, Limits, Reason
from lowfc.device import DriverOptions
from lowfc.device.mirror_loop import protection_of
from lowfc.device.mirror_protection import Command, Status, apply_command, tick
from sim_dm.driver import SimulatedMirror

LIMITS = Limits(stroke_nm=700.0, slew_nm=100.0, neighbour_nm=400.0)


@dataclass(frozen=True)
class Case:
    """A shape commanded `steps` times from a previous shape; the result is `expected_nm` to 0.01 nm, if given.

    `reasons` are those of the last step.
    """

    name: str
    previous_nm: Single
    commanded_nm: Single
    reasons: tuple[str, ...]
    expected_nm: Single | None = None
    steps: int = 1


def rows(*values: float) -> Single:
    """Shape of three columns with these heights of its rows."""
    return np.repeat(np.array(values, np.float32)[:, None], 3, axis=1)


def columns(*values: float) -> Single:
    """Shape of three rows with these heights of its columns."""
    return np.ascontiguousarray(rows(*values).T)


CASES = (
    Case("nothing", rows(0, 0, 0), rows(0, 0, 0), (), rows(0, 0, 0)),
    Case("small move", rows(1, 2, 3), rows(50, -40, 30), (), rows(50, -40, 30)),
    Case("stroke up", rows(690, 690, 690), rows(720, 690, 690), ("STROKE",), rows(700, 690, 690)),
    Case("stroke down", rows(-690, -690, -690), rows(-720, -690, -690), ("STROKE",), rows(-700, -690, -690)),
    Case("slew up", rows(0, 0, 0), rows(150, 0, 0), ("SLEW",), rows(100, 0, 0)),
    Case("slew down", rows(0, 0, 0), rows(0, -150, 0), ("SLEW",), rows(0, -100, 0)),
    Case("stroke and slew", rows(0, 0, 0), rows(900, 900, 900), ("STROKE", "SLEW"), rows(100, 100, 100)),
    Case("neighbours in a column", rows(190, -190, -190), rows(230, -230, -230), ("NEIGHBOUR",), rows(200, -200, -200)),
    Case(
        "neighbours in a row",
        columns(190, -190, -190),
        columns(230, -230, -230),
        ("NEIGHBOUR",),
        columns(200, -200, -200),
    ),
    Case(
        "neighbours, signs reversed", rows(-190, 190, 190), rows(-230, 230, 230), ("NEIGHBOUR",), rows(-200, 200, 200)
    ),
    Case("neighbours crossing over", rows(60, -60, 0), rows(-45, 45, 0), ("SLEW",), rows(-40, 40, 0)),
    Case("all actuators together", rows(500, 500, 500), rows(550, 550, 550), (), rows(550, 550, 550)),
    Case(
        "clipped at the neighbour limit",
        rows(0, 0, 0),
        rows(600, -600, -600),
        ("SLEW", "NEIGHBOUR"),
        rows(200, -200, -200),
        40,
    ),
    Case(
        "in the margin of the neighbour limit",
        rows(200, -199.9996, 0),
        rows(250, -250, 0),
        ("NEIGHBOUR",),
        rows(200, -200, 0),
    ),
    Case("from beyond the neighbour limit to flat", rows(600, 0, 0), rows(0, 0, 0), (), rows(0, 0, 0), 20),
    Case(
        "from beyond the neighbour limit further up", rows(600, 0, 0), rows(680, 0, 0), ("NEIGHBOUR",), rows(500, 0, 0)
    ),
    Case("from beyond the stroke to flat", rows(5000, 5000, 5000), rows(0, 0, 0), (), rows(0, 0, 0), 60),
    Case("from beyond the stroke, one step", rows(900, 900, 900), rows(0, 0, 0), ("SLEW",), rows(800, 800, 800)),
    Case("NaN", rows(1, 2, 3), rows(np.nan, 0, 0), ("NOT_FINITE",), rows(1, 2, 3)),
    Case("infinity", rows(1, 2, 3), rows(0, -np.inf, 0), ("NOT_FINITE",), rows(1, 2, 3)),
    Case("huge", rows(0, 0, 0), rows(3e38, 3e38, 3e38), ("STROKE", "SLEW"), rows(100, 100, 100)),
    Case("another grid", rows(1, 2, 3), rows(1, 2), ("WRONG_GRID",), rows(1, 2, 3)),
    Case("at the slew limit", rows(0.3, 0, 0), rows(100.3, 100, 0), ("SLEW",), rows(100.3, 100, 0)),
    Case("at the stroke limit", rows(650, 650, 650), rows(700, 700, 700), ("STROKE",), rows(700, 700, 700)),
    Case("within the slew", rows(3, 3, 3), rows(102.99, 3, 3), (), rows(102.99, 3, 3)),
    Case("beyond the slew", rows(3, 3, 3), rows(103.01, 3, 3), ("SLEW",), rows(103, 3, 3)),
    Case("within the stroke", rows(650, 650, 650), rows(699.99, 650, 650), (), rows(699.99, 650, 650)),
    Case("beyond the stroke down", rows(-650, -650, -650), rows(-700.01, -650, -650), ("STROKE",)),
    Case("within the neighbour limit in a column", rows(170, -170, -170), rows(199.99, -200, -200), ()),
    Case("within the neighbour limit in a row", columns(170, -170, -170), columns(199.99, -200, -200), ()),
    Case("beyond the neighbour limit in a column", rows(170, -170, -170), rows(200.01, -200, -200), ("NEIGHBOUR",)),
    Case("beyond the neighbour limit in a row", columns(170, -170, -170), columns(200.01, -200, -200), ("NEIGHBOUR",)),
    Case("at the neighbour limit", rows(195, -195, 0), rows(200, -200, 0), ("NEIGHBOUR",), rows(200, -200, 0)),
)


def violations(limits: Limits, previous_nm: Single, actuators_nm: Single) -> list[str]:
    """Limits that a command violates, given the previous one; exact, in float64 without tolerance."""
    now, before = actuators_nm.astype(np.float64), previous_nm.astype(np.float64)
    if now.shape != before.shape or not np.isfinite(now).all():
        return ["finite"]
    differences = [np.abs(np.diff(now, axis=axis)).max(initial=0) for axis in (0, 1)]
    results = {
        "stroke": (np.abs(now).max(), limits.stroke_nm),
        "slew": (np.abs(now - before).max(), limits.slew_nm),
        "neighbours in a column": (differences[0], limits.neighbour_nm),
        "neighbours in a row": (differences[1], limits.neighbour_nm),
    }
    return [f"{name}: {value} > {bound}" for name, (value, bound) in results.items() if not value <= bound]


def check_case(limit: Callable[[Limits, Single, Single], Limited], case: Case) -> None:
    """Assert that `limit` gives the expected result of a case."""
    shape = case.previous_nm
    outside = bool(violations(LIMITS, shape, shape))
    for _ in range(case.steps):
        limited = limit(LIMITS, shape, case.commanded_nm)
        after: Single = limited.actuators_nm
        violated = violations(LIMITS, shape, after)
        if outside:
            violated = [one for one in violated if one.startswith(("slew", "finite"))]
        assert violated == [], f"{case.name}: {violated}"
        shape = after
    names = tuple(reason.name for reason in limited.reasons)
    assert names == case.reasons, f"{case.name}: {names}"
    if case.expected_nm is not None:
        error_nm = np.abs(shape - case.expected_nm).max()
        assert error_nm < 0.01, f"{case.name}: {error_nm} nm from the expected shape\n{shape}"


class Simulated:
    """The simulated mirror of a configuration behind its protection; `changes` replace values of the protection.

    Attributes:
        initial: status before the first command.
    """

    def __init__(self, config: Configuration, **changes: object) -> None:
        driver = SimulatedMirror(DriverOptions(), config)
        self.protection = replace(protection_of(driver, config), **changes)
        self._settle, flat = driver.settle, np.zeros(self.protection.grid, np.float32)
        self.initial = Status(flat, driver.settle(flat, np.inf))

    def apply_command(self, status: Status, command: Command, now_ns: int) -> tuple[Status, Reason | None]:
        return apply_command(self.protection, status, command, now_ns, self._settle)

    def tick(self, status: Status, now_ns: int) -> Status:
        return tick(self.protection, status, now_ns, self._settle)
