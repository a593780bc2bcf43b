"""Targets of the fused step and of the loop around it, and the measured results."""

from collections.abc import Callable, Iterator
from statistics import median
from typing import NamedTuple

from benchmarks.peers.implementations import FUSED
from lowfc.control.kernel.tables import KERNELS
from tools.shared import Results, markdown

NUMPY = f"lowfc, {KERNELS[0]}"
HEAD = ("quantity", "target", "reached", "met", "lower bound", "what takes the time")


class Target(NamedTuple):
    """A target for one quantity.

    Attributes:
        quantity: name of the measured quantity.
        limit: largest value that meets the target.
        values: measured, one for each turn.
        form: format of a value.
        bound: lower bound for any program of this kind, in words.
        excess: what takes the time above that bound.
    """

    quantity: str
    limit: float
    values: list[float]
    form: str
    bound: str
    excess: str

    def row(self) -> list[str]:
        """The row of the table."""
        reached = median(self.values)
        spread = f" ({self.form.format(min(self.values))} to {self.form.format(max(self.values))})"
        return [
            self.quantity,
            f"at most {self.form.format(self.limit)}",
            self.form.format(reached) + (spread if len(self.values) > 1 else ""),
            "yes" if reached <= self.limit else "no",
            self.bound,
            self.excess,
        ]


OBJECTS = "decoding and encoding by protobuf, new Python objects for the state, calls of compiled code"


def render(measured: Callable[[str], Results]) -> str:
    """The table; `measured` gives the results of a measurement by its name."""
    targets = [*_steps(measured("kernels")), *_comparison(measured("peers")), *_stalls(measured("stalls"))]
    return markdown(HEAD, [target.row() for target in targets])


def _steps(results: Results) -> Iterator[Target]:
    for size, (other, limit) in zip(
        results["sizes"], (("product", 2.4), ("memory", 1.4), ("memory", 1.3)), strict=True
    ):
        side = round(size["pixels"] ** 0.5)
        unit = "products R x" if other == "product" else "reads of its bytes"
        excess = OBJECTS if other == "product" else "two copies of the frame's bytes by protobuf; " + OBJECTS
        ratios = size["ratios"][f"fused over {other}"]
        yield Target(f"step, fused, {side} x {side}, in {unit}", limit, ratios, "{:.2f}", "1", excess)


def _comparison(results: Results) -> Iterator[Target]:
    runs = results["runs"]

    def pairs(other: str, at: str) -> list[tuple[float, float]]:
        both = zip(runs[FUSED], runs[other], strict=True)
        return [(mine["frame_to_command"][at], its["frame_to_command"][at]) for mine, its in both if mine and its]

    shared = "the parts common to both: transport of the frame, wake-up, transport of the command"
    for at, limit in (("p50", 0.72), ("p99", 0.75)):
        ratios = [mine / its for mine, its in pairs(NUMPY, at)]
        yield Target(f"frame to command, fused over numpy, {at}", limit, ratios, "{:.2f}", shared, OBJECTS)
    sockets = "sockets wake two Python processes"
    ways = f"{sockets}; the C chain waits on semaphores in shared memory"
    for other, targets in (("C chain", {"p50": 40.0, "p99": 80.0}), ("pyrtcao, fused", {"p50": 0.0, "p99": 0.0})):
        for at, limit in targets.items():
            differences = [mine - its for mine, its in pairs(other, at)]
            quantity = f"frame to command, fused minus {other}, {at}, us"
            excess = ways if other == "C chain" else f"{sockets}; also checks, limits and messages that pyrtcao lacks"
            yield Target(quantity, limit, differences, "{:+.0f}", "0 for the same work in C", excess)


def _stalls(results: Results) -> Iterator[Target]:
    stalls = results["stalls"]
    bare = ", ".join(f"{loop['stalled']} next to the {loop['beside']}" for loop in stalls["bare"])
    yield Target(
        f"frames without a command, of {stalls['frames']}",
        0,
        [float(results["frames_without_command"])],
        "{:.0f}",
        f"{bare}: wake-ups of the bare loops more than a period late",
        f"the host caused {stalls['of_host']} of the {stalls['stalled']} stalls",
    )
    for name, mb in results["memory_mb"].items():
        process = "source of frames" if name == "camera" else name
        excess = "Python, numpy, zenoh, protobuf" + ("; numba and LLVM" if name == "controller" else "")
        yield Target(f"memory of the {process}, locked, MB", 200, [mb], "{:.0f}", "", excess)
