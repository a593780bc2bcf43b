"""Feed damaged inputs to readers; find crashes, hangs and memory growth: python -m tests.support.fuzzing --help."""

import argparse
import json
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from tests.support.targets import Target, targets

HANG_S = 10.0
"""Time after which an input counts as a hang."""
MAX_GROWTH_BYTES = 200_000_000
"""Largest permitted growth of the process's peak memory by one target's inputs."""


class HungError(BaseException):
    """An input took longer than `HANG_S`; no reader catches it as an `Exception`."""


def fuzz(target: Target, numbers: range) -> dict[str, Any]:
    """Feed a target the inputs with these numbers.

    Returns:
        name, inputs, refused (inputs with a permitted error), crashes (number, error), hangs (number), grown_bytes.
    """
    refused, crashes, hangs = 0, [], []
    before = _peak_bytes()
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for number in numbers:
            data = target.input(number)
            try:
                with _time_limit():
                    target.read(data)
            except target.errors:
                refused += 1
            except HungError:
                hangs.append(number)
            except Exception as error:
                crashes.append((number, f"{type(error).__name__}: {error}"[:300]))
    return {
        "name": target.name,
        "inputs": len(numbers),
        "refused": refused,
        "crashes": crashes,
        "hangs": hangs,
        "grown_bytes": _peak_bytes() - before,
    }


def inputs_by_target(all_targets: list[Target], inputs: int) -> dict[str, int]:
    """Number of inputs of each target: fewer for slower targets."""
    weights = {target.name: target.cost**-0.75 for target in all_targets}
    total = sum(weights.values())
    return {name: max(1, round(inputs * weight / total)) for name, weight in weights.items()}


@contextmanager
def _time_limit() -> Iterator[None]:
    def hung(number: int, frame: FrameType | None) -> None:
        raise HungError

    before = signal.signal(signal.SIGALRM, hung)
    signal.setitimer(signal.ITIMER_REAL, HANG_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=1_000_000, help="number of inputs, all targets together")
    parser.add_argument("--first", type=int, default=0, help="number of the first input of each target")
    parser.add_argument("--only", help="feed only the targets whose name contains this")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        all_targets = [one for one in targets(Path(folder)) if not options.only or options.only in one.name]
        if not all_targets:
            parser.error(f"no target's name contains {options.only!r}")
        counts = inputs_by_target(all_targets, options.inputs)
        results = []
        for target in all_targets:
            found = fuzz(target, range(options.first, options.first + counts[target.name]))
            results.append(found)
            sys.stderr.write(
                f"{found['name']:20} {found['inputs']:8} inputs, {found['refused']:8} refused, "
                f"{len(found['crashes'])} crashes, {len(found['hangs'])} hangs, {found['grown_bytes'] / 1e6:.0f} MB\n"
            )
    if options.json:
        sys.stdout.write(json.dumps({"targets": results, "seconds": round(time.monotonic() - begun_s, 1)}) + "\n")
    for found in results:
        for number, error in found["crashes"][:3]:
            sys.stderr.write(f"{found['name']} {number}: {error}\n")
    return int(any(found["crashes"] or found["hangs"] for found in results))


if __name__ == "__main__":
    sys.exit(main())
