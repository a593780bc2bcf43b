"""lowfc: a real-time low-order wavefront control daemon for coronagraphs.

What programs of yours use, imported when it is first named:

- `Client`, `running`: a running loop, and the names of the runs on this host
- `Configuration`, `load_configuration`: the configuration, and the one of a file
- `Calibration`, `load_calibration`: a calibration, and the one of a file
- `LogReader`, `read_history`: a log, and everything that it has of every step, as columns
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lowfc.adapters.files.calibration_file import load as load_calibration
    from lowfc.adapters.logs.history import read_history
    from lowfc.adapters.logs.reader import LogReader
    from lowfc.client import Client, running
    from lowfc.contract.configuration import Configuration
    from lowfc.contract.configuration import load as load_configuration
    from lowfc.control.calibration.calibration import Calibration

__version__ = "0.2.0"
__all__ = [
    "Calibration",
    "Client",
    "Configuration",
    "LogReader",
    "load_calibration",
    "load_configuration",
    "read_history",
    "running",
]

_WHERE = {
    "Calibration": "lowfc.control.calibration.calibration:Calibration",
    "Client": "lowfc.client:Client",
    "Configuration": "lowfc.contract.configuration:Configuration",
    "LogReader": "lowfc.adapters.logs.reader:LogReader",
    "load_calibration": "lowfc.adapters.files.calibration_file:load",
    "load_configuration": "lowfc.contract.configuration:load",
    "read_history": "lowfc.adapters.logs.history:read_history",
    "running": "lowfc.client:running",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _WHERE[name].partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return [*globals(), *_WHERE]
