"""How a benchmark begins and ends, whoever ends it, and what it prints."""

import argparse
import json
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

from benchmarks.host import host
from lowfc.adapters.terminal import INTERRUPTED
from lowfc.contract.errors import LowfcError

Result = dict[str, Any]


def occasion(program: str) -> Result:
    """Where, when and by which command something is measured; to be asked for before."""
    return {
        "host": host(),
        "load_before": round(os.getloadavg()[0], 2),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "command": shlex.join([*program.split(), *sys.argv[1:]]),
    }


def add_forms(parser: argparse.ArgumentParser, tables: str = "the table") -> None:
    """Options for what `say` looks at."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--markdown", action="store_true", help=f"print {tables} in Markdown")


def say(
    result: Result, asked: argparse.Namespace, text: Callable[[Result], str], markdown: Callable[[Result], str]
) -> None:
    """Print a result in the form that was asked for."""
    form = json.dumps if asked.json else markdown if asked.markdown else text
    sys.stdout.write(form(result) + "\n")


def run_main(main: Callable[[], int]) -> None:
    """End with its status; told to end, stop what runs first."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except LowfcError as error:
        sys.exit(f"error: {error}")
