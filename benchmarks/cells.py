"""Tables of the benchmarks, for a terminal and for a document: the first line is the headings."""

from collections.abc import Sequence

Lines = Sequence[Sequence[str]]


def text(lines: Lines) -> str:
    """Columns side by side: the first one and words to the left, figures to the right."""
    columns = list(zip(*lines, strict=True))
    widths = [max(map(len, column)) for column in columns]
    figures = [any(cell[:1].isdigit() for cell in column[1:]) for column in columns]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if column and figures[column] else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown(lines: Lines) -> str:
    """The same for a document; a bar within a cell becomes a slash."""
    first, *others = (f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)
    return "\n".join([first, "|---" * len(lines[0]) + "|", *others])
