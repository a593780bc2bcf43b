"""Typed result of a command: the source of both the `--json` object and the text.

`result_field` declares a field with label, unit and format. The text has a line for each labelled field, then a table
for each list of nested results; fields declared as columns have the same length and share one table.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel, Field
from pydantic.fields import FieldInfo

from lowfc.programs.cli import output

_LABEL_WIDTH = 18


def result_field(label: str = "", unit: str = "", form: str = "", *, column: bool = False, **field: Any) -> Any:
    """A field of a result.

    Without a label it appears only in the JSON. `form` is a format specification, or a format string such as "Z{}". A
    `column` is a list and appears in the result's own table.
    """
    return Field(description=label or None, json_schema_extra={"unit": unit, "form": form, "column": column}, **field)


class Result(BaseModel):
    """A typed result, or a part of one."""

    def json_object(self) -> dict[str, Any]:
        """Object for `--json`; fields that were not set are omitted."""
        return self.model_dump(exclude_unset=True)

    def text(self) -> str:
        """Text for a person."""
        return "\n".join([*self.head(), *self._labelled(), *self._tables(), *self.remarks()])

    def head(self) -> Sequence[str]:
        """Lines before the fields."""
        return ()

    def remarks(self) -> Sequence[str]:
        """Lines after the fields: conclusions and advice."""
        return ()

    def _labelled(self) -> Iterator[str]:
        for name, info in type(self).model_fields.items():
            value = getattr(self, name, None)
            if info.description and value is not None and not _is_table(info, value):
                yield f"{info.description:{_LABEL_WIDTH}} {formatted(info, value, with_unit=True)}"

    def _tables(self) -> Iterator[str]:
        fields = type(self).model_fields
        columns = [(info, getattr(self, name, None) or []) for name, info in fields.items() if _setting(info, "column")]
        columns = [(info, values) for info, values in columns if values]
        if columns:
            cells = [[formatted(info, value) for value in values] for info, values in columns]
            yield from table([_heading(info) for info, _ in columns], zip(*cells, strict=True))
        for name in fields:
            parts = getattr(self, name, None)
            if isinstance(parts, list) and parts and isinstance(parts[0], Result):
                yield from parts_table(parts)


def parts_table(parts: Sequence[Result]) -> list[str]:
    """Table with a row for each part and a column for each labelled field; a part's remarks follow its row."""
    shown = [(name, info) for name, info in type(parts[0]).model_fields.items() if info.description]
    rows = [[formatted(info, getattr(part, name)) for name, info in shown] for part in parts]
    lines = table([_heading(info) for _, info in shown], rows)
    return [lines[0], *("   ".join([line, *part.remarks()]) for line, part in zip(lines[1:], parts, strict=True))]


def table(headings: Sequence[str], rows: Any) -> list[str]:
    """Lines of a table (heading, then rows); first column left-aligned, the others right-aligned."""
    cells = [list(headings), *(list(row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    first, *others = widths
    return [
        "  ".join([f"{row[0]:{first}}", *(f"{cell:>{width}}" for cell, width in zip(row[1:], others, strict=True))])
        for row in cells
    ]


def formatted(info: FieldInfo, value: Any, *, with_unit: bool = False) -> str:
    """The value of a field as text; a dash for None."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return " ".join(formatted(info, each) for each in value) or "none"
    form, unit = _setting(info, "form"), _setting(info, "unit")
    text = form.format(value) if "{" in form else f"{value:{form}}"
    return f"{text} {unit}" if with_unit and unit else text


def print_result(result: Result, *, as_json: bool) -> None:
    """Print a result: one JSON object, or its text with control characters escaped."""
    output.print_result(result.json_object(), result.text(), as_json=as_json)


def _heading(info: FieldInfo) -> str:
    unit = _setting(info, "unit")
    return f"{info.description}, {unit}" if unit else info.description or ""


def _is_table(info: FieldInfo, value: Any) -> bool:
    return bool(_setting(info, "column")) or (isinstance(value, list) and bool(value) and isinstance(value[0], Result))


def _setting(info: FieldInfo, name: str) -> Any:
    extra = info.json_schema_extra
    return extra.get(name, "") if isinstance(extra, dict) else ""
