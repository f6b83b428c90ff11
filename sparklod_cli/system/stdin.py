"""Standard input as a seekable file that can be read more than once."""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import Any, BinaryIO

from .errors import UnreadableError

#: The path that means standard input or output.
DASH = Path("-")


def name_of(path: object) -> str:
    """Return the name of an input, a path or what has one as its text, in messages."""
    return "standard input" if path == DASH else str(path)


def spooled() -> BinaryIO:
    """Return standard input as a temporary file, not to be closed; `UnreadableError` if it is closed or a terminal."""
    if sys.stdin is None:
        raise UnreadableError("standard input is closed")
    if sys.stdin.isatty():
        raise UnreadableError("standard input is a terminal; pipe a file into it, or give a path")
    file = _copy_of(sys.stdin)
    file.seek(0)
    return file


@functools.lru_cache(maxsize=1)
def _copy_of(stream: Any) -> BinaryIO:
    import shutil  # which take milliseconds, and every command loads this module
    import tempfile

    file: BinaryIO = tempfile.TemporaryFile(prefix="sparklod-")  # noqa: SIM115
    shutil.copyfileobj(stream.buffer, file, 1 << 20)
    return file
