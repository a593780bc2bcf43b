"""Parse untrusted TOML in bounded time, or refuse it with a one-sentence error."""

import re
import tomllib
from typing import Any

MAX_BYTES = 1 << 20
"""Largest size of a configuration; one with every key and its description has 16 kB."""

_MAX_DOTS = 100  # in a line: the time to parse a dotted key grows with the square of the number of its parts
_NUMBER = re.compile(r"[0-9]\.[0-9_]++(?:[eE][+-]?[0-9_]++)?(?![\w.-])")
"""A number with a fraction; its dot is not counted. In a dotted key of digits, at least half of the dots are."""


def parsed(content: bytes) -> dict[str, Any]:
    """Tables of a TOML file; ValueError, with a short text, if it is invalid, too large or slow to parse."""
    if len(content) > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES} bytes")
    text = content.decode("utf-8-sig")
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") > _MAX_DOTS and len(re.findall(r"\.+", _NUMBER.sub("0", line))) > _MAX_DOTS:
            raise ValueError(f"line {number} has more than {_MAX_DOTS} dots")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(str(error)[:200]) from None
    except RecursionError:
        raise ValueError("its arrays or tables are nested too deeply") from None
    except ValueError:
        raise ValueError("a number in it has too many digits") from None
