"""Files that are whole or not there."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from lowfc.contract.errors import DataFileError


@contextlib.contextmanager
def being_written(path: Path) -> Iterator[Path]:
    """A file to write that gets the name `path` when all went well, and is gone when not.

    Raises:
        DataFileError: it cannot be written.
    """
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as stream:
            part = Path(stream.name)
        try:
            yield part
            part.chmod(0o644)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise DataFileError(f"{path} cannot be written: {error.strerror or error}") from error


def write_whole(path: Path, content: bytes) -> None:
    """Write beside, then rename: neither a reader nor a second writer ever sees half a file.

    Raises:
        DataFileError: The file cannot be written.
    """
    with being_written(path) as part:
        part.write_bytes(content)


def require_folder(*files: Path | None) -> None:
    """Say before the work that a file could not be written after it; None is no file.

    Raises:
        DataFileError: A file's folder is not there.
    """
    for file in files:
        if file is not None and not file.parent.is_dir():
            raise DataFileError(f"{file} cannot be written: there is no directory {file.parent}")
