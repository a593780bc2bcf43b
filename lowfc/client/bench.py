"""Values of other devices on the bench, for interlocks."""

import re

import numpy as np

from lowfc.client.arguments import ARGUMENT_ERRORS
from lowfc.contract.codecs.bench_codec import encode_bench_value
from lowfc.contract.errors import BadMessageError, ConfigurationError, brief, raised_as
from lowfc.contract.sections import BENCH_NAME
from lowfc.control.loop.interlocks import Value


def bench_message(name: str, value: Value, time_ns: int) -> bytes:
    """Encode a device's value, measured at `time_ns`, as a BenchValue.

    Raises:
        ConfigurationError: the name or the value is invalid.
    """
    if not isinstance(name, str) or not re.fullmatch(BENCH_NAME, name):
        raise ConfigurationError(
            f"a bench value's name begins with a letter and has up to 64 of A-Z, a-z, 0-9, _ and -, got {brief(name)}"
        )
    with raised_as(ConfigurationError, (BadMessageError, *ARGUMENT_ERRORS), f"bench value {name}"):
        plain = value.item() if isinstance(value, np.generic) else value  # numpy's True becomes Python's, not 1
        return encode_bench_value(plain, time_ns)
