"""The configuration of a running loop."""

import tomllib
from typing import Protocol

from pydantic import ValidationError

from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError


class Configured(Protocol):
    """What answers as a client does."""

    def configuration(self) -> str:
        """The configuration that the controller was started with, as TOML."""
        ...


def configuration_of(loop: Configured) -> Configuration:
    """The configuration that a loop's controller was started with.

    Raises:
        ConfigurationError: it is one of another version.
    """
    try:
        return Configuration.model_validate(tomllib.loads(loop.configuration()))
    except ValidationError as fault:
        first = fault.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise ConfigurationError(
            f"the controller's configuration is one of another version of lowfc: {key}: {first['msg']}; use the "
            "lowfc that the controller was started with"
        ) from None
