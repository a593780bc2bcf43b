"""The network section of the configuration, and the base class of all sections."""

import ast
import inspect
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator


def _without_nul(text: str) -> str:
    if "\0" in text:
        raise ValueError("must not contain NUL")
    return text


WithoutNul = Annotated[str, AfterValidator(_without_nul)]
"""A path, command or address, in which the operating system accepts no NUL."""


class Section(BaseModel):
    """A section: unknown keys are errors, values are immutable; the only conversion is from integer to float."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @classmethod
    def descriptions(cls) -> dict[str, str]:
        """Description of each key: the docstring below it, empty without source.

        Only help needs them: pydantic's `use_attribute_docstrings` would read the source at every import.
        """
        sections = [base for base in reversed(cls.__mro__) if issubclass(base, Section)]
        texts = {key: text for section in sections for key, text in _docstrings(section)}
        return {key: info.description or texts.get(key, "") for key, info in cls.model_fields.items()}


def _docstrings(section: type[Section]) -> Iterator[tuple[str, str]]:
    """Keys of a class, with the docstrings below them; none for a class that has no source (made at run time)."""
    try:
        source = inspect.getsource(section)
    except (OSError, TypeError):
        return
    # The source of a nested class is indented, which is valid below a condition.
    tree = ast.parse(f"if True:\n{source}" if source[0].isspace() else source)
    declared = next(node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    for statement, below in pairwise(declared.body):
        match statement, below:
            case ast.AnnAssign(target=ast.Name(id=key)), ast.Expr(value=ast.Constant(value=str(text))):
                yield key, inspect.cleandoc(text)


class Network(Section):
    """Connection between hosts; without a router, all processes run on this host."""

    router: str = Field("", pattern=r"^(tls/[^\x00]+:[1-9][0-9]{0,4})?$")
    """Address at which processes reach the router, such as "tls/bench.example.org:7447"; empty for no router."""
    certificates: WithoutNul = ""
    """Folder with ca.pem and, for each role on this host, ROLE.pem and ROLE.key, made by `lowfc certs`."""
    listen: str = Field("", pattern=r"^(tls/[^\x00]+:[1-9][0-9]{0,4})?$")
    """Address on which the router itself listens, if it differs from `router`."""

    @model_validator(mode="after")
    def _valid(self) -> "Network":
        if self.router and not self.certificates:
            raise ValueError("certificates: a folder is needed, because the router requires a certificate of each peer")
        for key, (host, port) in {"router": _address(self.router), "listen": _address(self.listen)}.items():
            if port >= 1 << 16:
                raise ValueError(f"{key}: the highest port is 65535, got {port}")
            try:
                host.encode("idna")
            except UnicodeError:
                raise ValueError(f"{key}: {host!r} is not the name or address of a host") from None
        return self

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the router."""
        return _address(self.router)


def _address(endpoint: str) -> tuple[str, int]:
    """Host and port of an endpoint such as "tls/bench:7447"; "" and 0 if the endpoint is empty."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port or 0)
