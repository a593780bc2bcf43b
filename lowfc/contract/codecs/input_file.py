"""Find and open files that a user names: only regular files of a bounded size, no device, pipe or directory."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

UNBOUNDED = (1 << 63) - 1
"""Value of `largest_bytes` without a limit, for a file that is read piece by piece."""


def user_path(text: str) -> Path:
    """Path that a user wrote, with "~" and "~name" replaced by a home directory; unchanged if there is no such user."""
    return Path(os.path.expanduser(text))  # noqa: PTH111  # Path.expanduser raises RuntimeError


def opened(path: Path, largest_bytes: int) -> BinaryIO:
    """Open a regular file of at most `largest_bytes`, or a symbolic link to one, for reading.

    OSError if it is something else or cannot be opened; its `strerror` is a phrase for the user.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # else a pipe without a writer would block
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        if status.st_size > largest_bytes:
            raise _too_large(path, largest_bytes)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_whole(path: Path, largest_bytes: int) -> bytes:
    """Content of a regular file of at most `largest_bytes`; OSError as for `opened`."""
    with opened(path, largest_bytes) as stream:
        content = stream.read(largest_bytes + 1)
    if len(content) > largest_bytes:  # its size was unknown: a file of /proc, or a growing one
        raise _too_large(path, largest_bytes)
    return content


def _too_large(path: Path, largest_bytes: int) -> OSError:
    return OSError(errno.EFBIG, f"larger than {largest_bytes} bytes, the most for such a file", str(path))
