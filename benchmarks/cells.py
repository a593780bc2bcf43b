"""Tables of the benchmarks, for a terminal and for a document: the first line is the headings."""

from collections.abc import Sequence

Lines = Sequence[Sequence[str]]


def text(lines: Lines) -> str:
    """Columns side by side; the first one to the left, figures to the right."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if column else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown(lines: Lines) -> str:
    """The same for a document."""
    first, *others = (f"| {' | '.join(cells)} |" for cells in lines)
    return "\n".join([first, "|---" * len(lines[0]) + "|", *others])
