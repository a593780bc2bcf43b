"""How a benchmark ends, whoever ends it."""

import signal
import sys
from collections.abc import Callable

from lowfc.adapters.terminal import INTERRUPTED
from lowfc.contract.errors import LowfcError


def run_main(main: Callable[[], int]) -> None:
    """End with its status; told to end, stop what runs first."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except LowfcError as error:
        sys.exit(f"error: {error}")
