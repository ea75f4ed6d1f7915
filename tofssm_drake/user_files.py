"""Reads files that a user names: bounded, and never a pipe or a device."""

import json
import os
from pathlib import Path
import stat
from typing import Any

MEGABYTE = 1_000_000


def read_file(path: str | Path, *, most: int) -> bytes:
    """Returns the contents of a file.

    Args:
        path: The file.
        most: Its greatest size, bytes.

    Raises:
        OSError: It cannot be read, is not a regular file (a pipe or a device
            might never end), or is larger; `strerror` says which.
    """
    with open(path, "rb", opener=_open_at_once) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError(0, "it is not a regular file", str(path))
        # Files of the kernel say that they are empty.
        contents = file.read(most + 1)
    if len(contents) > most:
        raise OSError(0, f"it is larger than {most / MEGABYTE:g} MB", str(path))
    return contents


def _open_at_once(path, flags):
    """Opens a file; a pipe is not waited for until somebody writes to it."""
    return os.open(path, flags | os.O_NONBLOCK)


def decode_json(text: str | bytes) -> Any:
    """Returns the value of a JSON text.

    Raises:
        ValueError: It is not JSON, or nested too deep.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deep") from None
