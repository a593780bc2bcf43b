"""Protection of existing logs from being overwritten by the output of a command."""

from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from lowfc.contract.errors import DataFileError


def refuse_log(out: Path, source: Path) -> None:
    """Refuse to overwrite the log that is read or any other log, whatever its name."""
    if not out.is_file():
        return
    try:
        with out.open("rb") as file:
            is_log = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
    except OSError as fault:
        raise DataFileError(f"{out} is not overwritten: cannot read whether it is a log: {fault.strerror}") from fault
    if is_log or (source.exists() and out.samefile(source)):
        raise DataFileError(f"{out} is a log, which is never overwritten; choose another name (--out)")
