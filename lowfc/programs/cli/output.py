"""Printing the result of a command, as JSON or text."""

import json
import sys
from collections.abc import Mapping
from typing import Any

from lowfc.contract.printable import LINES, printable


def print_result(result: Mapping[str, Any], text: str, *, as_json: bool) -> None:
    """Print a result as one JSON object, or print its text; control characters in the text are escaped."""
    sys.stdout.write((json.dumps(result) if as_json else printable(text, keep=LINES)) + "\n")
