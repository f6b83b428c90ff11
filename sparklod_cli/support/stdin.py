"""Standard input as a file that can be read from any place, and more than once."""

from __future__ import annotations

import functools
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, BinaryIO

from .errors import UnreadableError

#: Standard input or output, where a path can be one of them.
DASH = Path("-")


def name_of(path: Path) -> str:
    """What people call an input."""
    return "standard input" if path == DASH else str(path)


def spooled() -> BinaryIO:
    """All of standard input, at its beginning; it is read the first time, into a temporary file. Not to be closed.

    Raises:
        UnreadableError: it is closed, or a terminal.
    """
    if sys.stdin is None:
        raise UnreadableError("standard input is closed")
    if sys.stdin.isatty():
        raise UnreadableError("standard input is a terminal; pipe a file into it, or name one")
    file = _copy_of(sys.stdin)
    file.seek(0)
    return file


@functools.lru_cache(maxsize=1)
def _copy_of(stream: Any) -> BinaryIO:
    file: BinaryIO = tempfile.TemporaryFile(prefix="sparklod-")  # noqa: SIM115
    shutil.copyfileobj(stream.buffer, file, 1 << 20)
    return file
