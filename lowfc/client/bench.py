"""Values of other things on the bench, published for the interlocks of a loop."""

import re

from lowfc.adapters.bus.bus import Bus, Publisher
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.codecs.bench_codec import encode_bench_value
from lowfc.contract.errors import BadMessageError, ConfigurationError
from lowfc.contract.messages import BENCH
from lowfc.contract.sections import BENCH_NAME
from lowfc.control.loop.interlocks import Value


class BenchPublisher:
    """Publishes values by name."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._publishers: dict[str, Publisher] = {}

    def put(self, name: str, value: Value) -> None:
        """Publish a value.

        Raises:
            ConfigurationError: the name or the value is none.
        """
        if not re.fullmatch(BENCH_NAME, name):
            raise ConfigurationError(f"a bench value's name has up to 64 of A-Z, a-z, 0-9, _ and -, got {name[:80]!r}")
        try:
            message = encode_bench_value(float(value) if type(value) is int else value, HostClock().now_ns())
        except BadMessageError as fault:
            raise ConfigurationError(f"bench value {name}: {fault}") from None
        if name not in self._publishers:
            self._publishers[name] = self._bus.publisher(BENCH, name)
        self._publishers[name].put(message)
