"""TOML that may be anything: it is parsed in bounded time, or refused with one sentence."""

import re
import tomllib
from typing import Any

LARGEST_BYTES = 1 << 20
"""Size of a configuration, at most; one with every key is 12 kB."""

_MOST_DOTS = 100  # in a line: the time to parse a dotted key grows with the square of its parts


def parsed(content: bytes) -> dict[str, Any]:
    """The tables of a TOML file; ValueError, in short, where it is none, too large, or would take long to parse."""
    if len(content) > LARGEST_BYTES:
        raise ValueError(f"larger than {LARGEST_BYTES} bytes")
    text = content.decode()
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") > _MOST_DOTS and len(re.findall(r"\.+", line)) > _MOST_DOTS:
            raise ValueError(f"line {number} has more than {_MOST_DOTS} dots")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(str(error)[:200]) from None
    except RecursionError:
        raise ValueError("its arrays or tables are nested too deeply") from None
    except ValueError:
        raise ValueError("a number in it has too many digits") from None
