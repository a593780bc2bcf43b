"""The exceptions a user may see.

    LowfcError              anything the user can put right; one line, exit status 2
    ├── ConfigurationError  a key, a value or a combination of values
    ├── DataFileError       a file that is missing, damaged or of another kind
    ├── CalibrationError    a calibration that does not fit the instrument
    ├── BusError            a port, a socket, or a peer that does not answer
    │   └── BadMessageError     a message from the bus that breaks the contract
    └── RequestRefusedError    the controller answered no, and says why

The numerics raise ValueError; the adapters above them name the file or the key and re-raise one of these.
"""

import reprlib
from collections.abc import Iterable
from difflib import get_close_matches


class LowfcError(Exception):
    """Base of the errors that a user can put right; the text says what was wrong, expected, got and to do."""

    exit_status = 2


class ConfigurationError(LowfcError):
    """A configuration key or value is unknown, malformed or out of range."""


class DataFileError(LowfcError):
    """A file is missing, damaged or holds something else."""


class CalibrationError(LowfcError):
    """A calibration does not fit the camera, the mirror or the sensor."""


class BusError(LowfcError):
    """The message bus cannot be opened, or nobody answers on it."""


class BadMessageError(BusError):
    """A message from the bus cannot be read; it is counted and left out, and the process goes on."""


class RequestRefusedError(LowfcError):
    """The controller refused an operator's request."""


_BRIEF = reprlib.Repr()
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 100


def brief(value: object) -> str:
    """`repr` of a value from a file, shortened: an error stays one readable line whatever the file holds."""
    try:
        return _BRIEF.repr(value)
    except ValueError:  # an integer of more digits than Python converts
        return "a number of too many digits"


def nearest(wanted: str, known: Iterable[str]) -> str:
    """What to add to "no such name": the name that was probably meant, or nothing."""
    close = get_close_matches(wanted, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
