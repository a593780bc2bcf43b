"""What a command writes is never a log that is there already."""

from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from lowfc.contract.errors import DataFileError


def refuse_log(out: Path, source: Path) -> None:
    """Refuse to write over the log that is read, or over another one, whatever its name."""
    if not out.is_file():
        return
    try:
        with out.open("rb") as file:
            is_log = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
    except OSError as fault:
        raise DataFileError(
            f"{out} cannot be replaced: whether it is a log cannot be read: {fault.strerror}"
        ) from fault
    if is_log or (source.exists() and out.samefile(source)):
        raise DataFileError(f"{out} is a log, which is never overwritten; choose another name (--out)")
