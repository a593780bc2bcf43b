"""The network section of the configuration, and the base class of all sections."""

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Section(BaseModel):
    """A section: unknown keys are errors, values are immutable, and only integers are converted, to floats."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, use_attribute_docstrings=True, allow_inf_nan=False
    )


class Network(Section):
    """Connection between hosts; without a router, all processes run on this host."""

    router: str = Field("", pattern=r"^(tls/.+:[0-9]{1,5})?$")
    """Where the router listens, such as "tls/bench.example.org:7447"; empty for none."""
    certificates: str = ""
    """Folder with ca.pem and, for each role on this host, ROLE.pem and ROLE.key, made by `lowfc certs`."""
    listen: str = Field("", pattern=r"^(tls/.+:[0-9]{1,5})?$")
    """Address on which the router listens, if it differs from `router`."""

    @model_validator(mode="after")
    def _both(self) -> "Network":
        if self.router and not self.certificates:
            raise ValueError("certificates: a folder is needed, because the router requires a certificate of each peer")
        return self

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the router."""
        host, _, port = self.router.partition("/")[2].rpartition(":")
        return host.strip("[]"), int(port)
