"""lowfc: a real-time low-order wavefront control daemon for coronagraphs.

Names for your own programs, each imported on first use:

- `Client`: connection to a running loop; `running`: names of the user's runs on this host
- `Configuration`: all settings; `load_configuration`: read them from a file
- `Calibration`: matrices of a calibration; `load_calibration`: read them from a file
- `LogReader`: reader of a log's messages; `read_history`: read all steps of a log as columns
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

_SOURCES = {
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
    if name not in _SOURCES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _SOURCES[name].partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return [*globals(), *_SOURCES]
