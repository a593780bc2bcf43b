"""Run a benchmark by its name: python -m benchmarks NAME, from the root of the repository."""

import argparse
import signal
import sys
from importlib import import_module
from typing import cast

from benchmarks.runner import Benchmark, run
from lowfc.adapters.process.terminal import INTERRUPTED
from lowfc.contract.errors import LowfcError

BENCHMARKS = {
    "step": "benchmarks.step",
    "curves": "benchmarks.curves",
    "kernels": "benchmarks.kernels",
    "streams": "benchmarks.streams",
    "throughput": "benchmarks.throughput",
    "peers": "benchmarks.peers.comparison",
}


def main() -> int:
    """Run the command line; return its exit status."""
    parser = argparse.ArgumentParser("python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=BENCHMARKS, help="NAME --help describes the measurement and its options")
    name = parser.parse_args(sys.argv[1:2]).name
    try:
        return run(name, cast("Benchmark", import_module(BENCHMARKS[name])), sys.argv[2:])
    except LowfcError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that a benchmark stops its processes
    sys.exit(main())
