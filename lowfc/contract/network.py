"""The network section of the configuration, which every process of a run needs, and what all sections share."""

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Section(BaseModel):
    """A section: unknown keys are errors, no value is converted but an integer to a float, values do not change."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, use_attribute_docstrings=True, allow_inf_nan=False
    )


class Network(Section):
    """The way between machines; without a router all processes are on this one."""

    router: str = Field("", pattern=r"^(tls/.+:[0-9]{1,5})?$")
    """Where the router listens, such as "tls/bench.example.org:7447"; empty for none."""
    certificates: str = ""
    """Folder with ca.pem and, for each role on this machine, ROLE.pem and ROLE.key, as `lowfc certs` makes them."""
    listen: str = Field("", pattern=r"^(tls/.+:[0-9]{1,5})?$")
    """Of the router: where it listens, if that is not what the others connect to."""

    @model_validator(mode="after")
    def _both(self) -> "Network":
        if self.router and not self.certificates:
            raise ValueError("certificates: a folder is needed, for the router takes nobody without one")
        return self

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the router."""
        host, _, port = self.router.partition("/")[2].rpartition(":")
        return host.strip("[]"), int(port)
