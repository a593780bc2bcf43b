"""The exceptions that a user may see; a few modules add their own subclasses of LowfcError.

    LowfcError               anything that the user can correct; exit status 2 unless its class sets another
    ├── ConfigurationError   a key, a value or a combination of values
    ├── DataFileError        a file that is missing, damaged or of the wrong kind
    ├── CalibrationError     a calibration that does not fit the instrument
    ├── BusError             a port, a socket, or a peer that does not answer
    │   └── BadMessageError  a message from the bus that violates the contract; reported in an event
    └── RequestRefusedError  the controller refused the request, with the reason

Numerical code raises ValueError; the code that calls it raises one of these instead, which names the file or the key.
"""

import re
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches


class LowfcError(Exception):
    """Base of the errors that a user can correct; the text says what is wrong, expected and found, and what to do."""

    exit_status = 2


class ConfigurationError(LowfcError):
    """A configuration key or value is unknown, malformed or out of range."""


class DataFileError(LowfcError):
    """A file is missing, damaged or of the wrong kind."""


class CalibrationError(LowfcError):
    """A calibration does not fit the camera, the mirror or the sensor."""


class BusError(LowfcError):
    """The message bus cannot be opened, or no process answers on it."""


class BadMessageError(BusError):
    """A message from the bus cannot be read; it is reported and ignored, and the process continues."""


class RequestRefusedError(LowfcError):
    """The controller refused an operator's request."""


@contextmanager
def raised_as(
    kind: type[Exception], caught: type[Exception] | tuple[type[Exception], ...], about: object = ""
) -> Iterator[None]:
    """Raise the exceptions `caught` in the block as errors of type `kind`; their text follows `about` and a colon.

    The text of an OSError is its reason alone, without number and path.
    """
    try:
        yield
    except caught as error:
        text = getattr(error, "strerror", None) or error
        raise kind(f"{about}: {text}" if about else str(text)) from None


_BRIEF = reprlib.Repr()
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 100


def reworded(message: str) -> str:
    """Reword a message of pydantic for the user: "must" for "Input should"; no "Value error" and no parser details."""
    message = re.sub("^Value error, |, unable to (?:parse|interpret) .*", "", message)
    return re.sub("^(?:Input|String|List|Tuple) should", "must", message)


def brief(value: object) -> str:
    """Shortened `repr` of a value from a file, so that an error stays one readable line."""
    try:
        return _BRIEF.repr(value)
    except ValueError:  # an integer of more digits than Python converts
        return "a number of too many digits"


def nearest(name: str, known: Iterable[str]) -> str:
    """Suffix of a "no such name" error that suggests the nearest known name; empty if none is near."""
    close = get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
