"""The network section of the configuration, and the base class of all sections."""

import ast
import inspect
from itertools import pairwise
from textwrap import dedent

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Section(BaseModel):
    """A section: unknown keys are errors, values are immutable, and only integers are converted, to floats."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @classmethod
    def descriptions(cls) -> dict[str, str]:
        """Description of each key: the docstring below it. Only help asks; pydantic would read the source at import."""
        found = {}
        for section in reversed([one for one in cls.__mro__ if issubclass(one, Section)]):
            for statement, below in pairwise(ast.parse(dedent(inspect.getsource(section))).body[0].body):  # type: ignore[attr-defined]
                match statement, below:
                    case ast.AnnAssign(target=ast.Name(id=key)), ast.Expr(value=ast.Constant(value=str(text))):
                        found[key] = inspect.cleandoc(text)
        return {key: info.description or found.get(key, "") for key, info in cls.model_fields.items()}


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
