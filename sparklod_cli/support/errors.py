"""The errors that sparklod raises on purpose. The command line turns each into one line and an exit code."""

from __future__ import annotations

import contextlib
import errno
import math
from collections.abc import Iterator
from typing import Any


class SparklodError(Exception):
    """Base of every error that tells the user something; its text is one line that says what to do."""


class FormatError(SparklodError):
    """A file is not what its format says, or beyond the format's limits. Its subclasses tell a validator more."""

    code = "container.corrupt"


class UnreadableError(FormatError):
    """A file cannot be opened, or is empty."""

    code = "file.unreadable"


class UnknownFormatError(FormatError):
    """A file is of no known format."""

    code = "file.format"


class NotSplatsError(FormatError):
    """A file is of a known format, but holds something else than splats."""

    code = "file.not-splats"


class TruncatedError(FormatError):
    """A file ends before what it promises."""

    code = "container.cut-short"


class PromiseError(FormatError):
    """A header promises more than a file of its size can hold."""

    code = "container.promise"


class VersionError(FormatError):
    """A version, level or degree that the format does not have."""

    code = "container.version"


class ChecksumError(FormatError):
    """A checksum does not match."""

    code = "container.checksum"


class MembersError(FormatError):
    """Compressed data go on in a second gzip member, which not every reader looks at."""

    code = "container.members"


class TooLongError(FormatError):
    """A stream is longer than the header promises."""

    code = "container.too-long"


class InvalidSplatsError(SparklodError):
    """The splats themselves cannot be used: none is left, or some are invalid."""


class TreeError(SparklodError):
    """A Level-of-Detail tree breaks one of its invariants."""


class OutputError(SparklodError):
    """An output cannot be written: it exists already, or the file system refused it."""


class StdoutError(OutputError):
    """Standard output is closed, or cannot be written; not the fault of the file that is being worked on."""


class CameraPathError(SparklodError):
    """A camera path cannot be read or made: its file is broken or of no known format, or a camera makes no sense."""


class TooManyCamerasError(CameraPathError):
    """A path has more cameras than are made, or taken."""


class OutOfMemoryError(SparklodError):
    """What was asked for does not fit into memory."""


@contextlib.contextmanager
def memory_told() -> Iterator[None]:
    """Makes an `OutOfMemoryError`, which says what did not fit, of every way in which memory runs out inside."""
    try:
        yield
    except Exception as error:
        reason = out_of_memory(error)
        if reason is None:
            raise
        raise OutOfMemoryError(reason) from None


def out_of_memory(error: BaseException) -> str | None:
    """What did not fit into memory, for people; None where the error is about something else."""
    text = str(error).lower()
    starved = (
        isinstance(error, MemoryError)
        or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
        or (isinstance(error, ImportError) and ("cannot allocate memory" in text or "failed to map segment" in text))
        or (isinstance(error, RuntimeError) and "can't start new thread" in text)  # there is no room for its stack
    )
    if not starved:
        return None
    return f"it does not fit into memory{_array_of(error)}; free some, or ask for less at a time"


def _array_of(error: Any) -> str:
    """The array that numpy had no room for, as its `MemoryError` has it; empty for others."""
    shape, dtype = getattr(error, "shape", None), getattr(error, "dtype", None)
    if not shape or dtype is None:
        return ""
    size = math.prod(shape) * dtype.itemsize
    amount = f"{size / 1e9:,.1f} GB" if size >= 1e9 else f"{size / 1e6:,.1f} MB"
    return f": {' x '.join(f'{side:,}' for side in shape)} numbers ({dtype}) take {amount}"
