"""The configuration of a running loop."""

import tomllib
from typing import TYPE_CHECKING

from pydantic import ValidationError

from lowfc.contract.errors import ConfigurationError

if TYPE_CHECKING:
    from lowfc.client.client import Client
    from lowfc.contract.configuration import Configuration


def configuration_of(loop: "Client") -> "Configuration":
    """Return the configuration that a loop's controller was started with.

    Raises:
        ConfigurationError: it belongs to another version of lowfc.
    """
    from lowfc.contract.configuration import Configuration, explain

    try:
        return Configuration.model_validate(tomllib.loads(loop.configuration()))
    except ValidationError as fault:
        raise ConfigurationError(
            f"the controller's configuration belongs to another version of lowfc: {explain(fault.errors()[0])}; use "
            "the lowfc that the controller was started with"
        ) from None
