"""Targets for latency and memory of the fused step and of its loop, and whether the measurements reach them."""

from collections.abc import Callable, Iterator, Sequence
from statistics import median

from benchmarks.peers.comparison import pairs
from lowfc.control.kernel.tables import KERNELS
from tools.shared import Results, markdown

NUMPY = f"lowfc, {KERNELS[0]}"
HEAD = ("quantity", "target", "reached", "met", "lower bound", "what takes the time or memory")
Row = tuple[str, ...]
"""A row of the table, with the columns of `HEAD`."""
OBJECTS = "decoding and encoding by protobuf, new Python objects for the state, calls of compiled code"


def render(measured: Callable[[str], Results]) -> str:
    """The table; `measured` gives the results of a measurement by its name."""
    rows = [*_steps(measured("kernels")), *_comparison(measured("peers")), *_stalls(measured("stalls"))]
    return markdown(HEAD, rows)


def _row(quantity: str, limit: float, values: Sequence[float], form: str, bound: str, excess: str) -> Row:
    """Row of a quantity with one value for each turn; `bound`: least value possible; `excess`: what takes the rest."""
    reached, shown = median(values), form.format
    spread = f" ({shown(min(values))} to {shown(max(values))})" if len(values) > 1 else ""
    met = "yes" if reached <= limit else "no"
    exact = shown(reached) if met == "yes" or shown(reached) != shown(limit) else f"{reached:.5g}"
    return quantity, f"at most {shown(limit)}", exact + spread, met, bound, excess


def _steps(results: Results) -> Iterator[Row]:
    for size, (other, limit) in zip(
        results["sizes"], (("product", 2.4), ("memory", 1.4), ("memory", 1.3)), strict=True
    ):
        side = round(size["pixels"] ** 0.5)
        unit = "product R x" if other == "product" else "read of the step's bytes"
        excess = OBJECTS if other == "product" else "two copies of the frame's bytes by protobuf; " + OBJECTS
        ratios = size["ratios"][f"fused over {other}"]
        yield _row(f"fused step, {side} x {side}: time / time of one {unit}", limit, ratios, "{:.2f}", "1", excess)


def _comparison(results: Results) -> Iterator[Row]:
    runs = results["runs"]
    shared = "the parts common to both: transport of the frame, wake-up, transport of the command"
    for at, limit in (("p50", 0.72), ("p99", 0.75)):
        ratios = [fused[at] / numpy[at] for fused, numpy in pairs(runs, NUMPY)]
        yield _row(f"frame to command, ratio fused / numpy, {at}", limit, ratios, "{:.2f}", shared, OBJECTS)
    sockets = "sockets wake two Python processes"
    links = f"{sockets}; the C chain waits on semaphores in shared memory"
    for other, targets in (("C chain", {"p50": 40.0, "p99": 80.0}), ("pyrtcao, fused", {"p50": 0.0, "p99": 0.0})):
        for at, limit in targets.items():
            differences = [fused[at] - compared[at] for fused, compared in pairs(runs, other)]
            quantity = f"frame to command, lowfc's fused step minus {other}, {at}, us"
            excess = links if other == "C chain" else f"{sockets}; also checks, limits and messages that pyrtcao lacks"
            yield _row(quantity, limit, differences, "{:+.0f}", "0 for the same work in C", excess)


def _stalls(results: Results) -> Iterator[Row]:
    stalls = results["stalls"]
    bare = ", ".join(f"{loop['stalled']} next to the {loop['beside']}" for loop in stalls["bare"])
    yield _row(
        f"frames without a command, of {stalls['frames']}",
        0,
        [float(results["frames_without_command"])],
        "{:.0f}",
        f"wake-ups of bare loops that are more than a period late: {bare}",
        f"the host caused {stalls['of_host']} of the {stalls['stalled']} stalls",
    )
    for name, mb in results["memory_mb"].items():
        process = "source of frames" if name == "camera" else name
        excess = "Python, numpy, zenoh, protobuf" + ("; numba and LLVM" if name == "controller" else "")
        yield _row(f"memory of the {process}, locked, MB", 200, [mb], "{:.0f}", "", excess)
