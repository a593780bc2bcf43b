"""Atomic writing of files: complete or absent, also after a power failure."""

import contextlib
import errno
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from lowfc.contract.errors import ConfigurationError, DataFileError, raised_as

_NAME_LENGTH = 50  # most characters that the temporary name takes from the final one: file systems limit its length


@contextlib.contextmanager
def being_written(path: Path, source: Path | None = None, mode: int = 0o666) -> Iterator[Path]:
    """As `draft`, but for a block that only writes the file: its OSErrors become DataFileErrors, too."""
    with _os_errors_as_data_file_errors(path), draft(path, source, mode) as part:
        yield part


@contextlib.contextmanager
def draft(path: Path, source: Path | None = None, mode: int = 0o666) -> Iterator[Path]:
    """Yield a temporary file that is renamed to `path` on success and removed on failure.

    A log, a directory, device or pipe at `path` is not replaced. The permissions are `mode` without the umask's bits,
    and at most those of `source`, the file that the content comes from.

    Raises:
        DataFileError: the file cannot be written, or is a log. Errors of the block are raised unchanged.
    """
    with _os_errors_as_data_file_errors(path):
        _require_replaceable(path, source)
        permitted = source.stat().st_mode & mode if source is not None and source.exists() else mode
        part = path.with_name(f".{path.name[:_NAME_LENGTH]}.{secrets.token_hex(4)}")
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, permitted)
        mode = stat.S_IMODE(os.fstat(descriptor).st_mode)
        os.close(descriptor)
    try:
        yield part
        with _os_errors_as_data_file_errors(path):
            part.chmod(mode)  # the writer may have replaced the temporary file
            with part.open("rb") as written:
                os.fsync(written.fileno())  # otherwise the file may be empty after a power failure
            part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def _os_errors_as_data_file_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DataFileError(f"{path} cannot be written: {error.strerror or f'is the disk full? {error}'}") from error


def write_whole(path: Path, content: bytes, source: Path | None = None, mode: int = 0o666) -> None:
    """Write a temporary file, then rename it, so that no process ever reads a partial file; see `being_written`.

    Raises:
        DataFileError: The file cannot be written, or is a log.
    """
    with being_written(path, source, mode) as part:
        part.write_bytes(content)


def require_folder(*files: Path | None) -> None:
    """Check that files can be written later with `being_written`; None is skipped.

    Raises:
        DataFileError: A file's folder does not exist or cannot be written, or the file cannot be replaced.
        ConfigurationError: Two files are the same.
    """
    written = [file for file in files if file is not None]
    for file in written:
        with raised_as(DataFileError, OSError, f"{file} cannot be written"):
            if not file.parent.is_dir():
                raise DataFileError(f"{file} cannot be written: there is no directory {file.parent}")
            _require_replaceable(file)
            with tempfile.TemporaryFile(dir=file.parent):
                pass
    if len({os.path.realpath(file) for file in written}) < len(written):  # Path.resolve fails on a loop of links
        raise ConfigurationError(f"these must be different files: {', '.join(map(str, written))}")


def _require_replaceable(path: Path, source: Path | None = None) -> None:
    """Refuse to replace `source`, a log of any name, or anything but a regular file."""
    if path.name and not path.exists():
        return
    if not path.is_file():
        raise OSError(errno.EINVAL, "not a regular file")
    from mcap.writer import MCAP0_MAGIC  # slow

    with (
        raised_as(DataFileError, OSError, f"{path} is not overwritten: cannot determine whether it is a log"),
        path.open("rb") as file,
    ):
        is_log = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
    if is_log or (source is not None and source.exists() and path.samefile(source)):
        raise DataFileError(f"{path} is a log, which is never overwritten; choose another name")
