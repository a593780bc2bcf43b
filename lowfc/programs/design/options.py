"""Command-line options from the fields of a dataclass, with their help from the attributes in its docstring."""

import functools
import inspect
import re
import shlex
from collections.abc import Callable
from dataclasses import asdict, fields
from math import isfinite, nan
from typing import Annotated, Any, get_type_hints

import typer

from lowfc.contract.errors import ConfigurationError, raised_as


def flag(name: str) -> str:
    """The option of a field, such as --half-angle for half_angle_deg."""
    return f"--{name.removesuffix('_deg').replace('_', '-')}"


def command_line(command: str, request: Any) -> str:
    """The command line that repeats a request, without options that are None."""
    options = {flag(name): value for name, value in asdict(request).items() if value is not None}
    return shlex.join([*command.split(), *(str(word) for option in options.items() for word in option)])


def span(option: str, text: str) -> tuple[float, float]:
    """Parse LOW:HIGH, or one value for both; ValueError if it is neither, or not finite."""
    low, colon, high = text.partition(":")
    try:
        limits = float(low), float(high if colon else low)
    except ValueError:
        limits = nan, nan
    if not all(map(isfinite, limits)):
        raise ValueError(f"{option} must be a number or LOW:HIGH, got {text!r}")
    return limits


def with_options_of(kind: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Replace a command's first parameter by options for the fields of a dataclass; the command receives the instance.

    The command raises ConfigurationError if the dataclass refuses its values.
    """
    types, helps = get_type_hints(kind), _attributes(kind)
    options = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=field.default,
            annotation=Annotated[types[field.name], typer.Option(flag(field.name), help=helps[field.name])],
        )
        for field in fields(kind)
    ]

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**values: Any) -> None:
            with raised_as(ConfigurationError, ValueError):
                request = kind(**{option.name: values.pop(option.name) for option in options})
            command(request, **values)

        _, *others = inspect.signature(command, eval_str=True).parameters.values()
        own_options = [other.replace(kind=inspect.Parameter.KEYWORD_ONLY) for other in others]
        run.__signature__ = inspect.Signature([*options, *own_options])  # type: ignore[attr-defined]
        return run

    return decorated


def _attributes(kind: type[Any]) -> dict[str, str]:
    """Descriptions of the attributes in the docstrings of a class and its bases, each on one line."""
    descriptions: dict[str, str] = {}
    for class_ in kind.__mro__[-2::-1]:
        _, _, text = inspect.cleandoc(class_.__doc__ or "").partition("Attributes:\n")
        descriptions |= dict(re.findall(r"^    (\w+): ((?:.|\n {5,})+)", text, re.M))
    return {name: " ".join(help_.split()) for name, help_ in descriptions.items()}
