"""The exceptions that sparklod raises. The command line turns each into a one-line message and an exit code."""

from __future__ import annotations

import contextlib
import errno
import math
from collections.abc import Iterator

#: Exit code of a check or an assertion that does not hold; 1 is a failure, 2 wrong usage.
CHECK_FAILED = 3


class SparklodError(Exception):
    """Base class of all errors meant for the user; the message is one line that says what to do."""


class FormatError(SparklodError):
    """A file violates its format or exceeds the limits of the format. Subclasses name the violation."""

    code = "container.corrupt"


class UnreadableError(FormatError):
    """A file cannot be opened, or is empty."""

    code = "file.unreadable"


class UnknownFormatError(FormatError):
    """The format of a file is unknown."""

    code = "file.format"


class NotSplatsError(FormatError):
    """A file is in a known format, but does not contain splats."""

    code = "file.not-splats"


class TruncatedError(FormatError):
    """A file is shorter than its header declares."""

    code = "container.cut-short"


class PromiseError(FormatError):
    """A header declares more data than a file of this size can contain."""

    code = "container.promise"


class VersionError(FormatError):
    """The format has no such version, level or degree."""

    code = "container.version"


class UnsupportedError(FormatError):
    """A file uses a part of its format that sparklod does not read."""

    code = "container.unsupported"


class ChecksumError(FormatError):
    """A checksum does not match."""

    code = "container.checksum"


class MembersError(FormatError):
    """Compressed data continue in a second gzip member, which some readers ignore."""

    code = "container.members"


class HasTreeError(FormatError):
    """A file is a Level-of-Detail tree where splats without one are needed."""


class TooLongError(FormatError):
    """A stream is longer than the header declares."""

    code = "container.too-long"


class InvalidSplatsError(SparklodError):
    """The splats cannot be used: some are invalid, or none remain."""


class TreeError(SparklodError):
    """A Level-of-Detail tree violates one of its invariants."""


class BackendError(SparklodError):
    """A backend cannot draw here; the text says what is missing and which package brings it."""


class OutputError(SparklodError):
    """An output file already exists, or the file system refused to write it."""


class ScratchError(OutputError):
    """The scratch folder of a bake cannot be used: it is full, damaged, in use, or has the results of another bake."""


class StdoutError(OutputError):
    """Standard output is closed or cannot be written, which has nothing to do with the file being processed."""


class CameraPathError(SparklodError):
    """A camera path cannot be read or created: the file is corrupt or of an unknown format, or a camera is invalid."""


class TooManyCamerasError(CameraPathError):
    """A camera path has more cameras than the limit."""


class OutOfMemoryError(SparklodError):
    """The operation needs more memory than there is."""


class UnfitError(ValueError):
    """Settings that do not fit scenes, such as a budget, or a chunk cache, too small for their roots: a wrong usage."""


def reason_of(error: OSError) -> str:
    """Return the reason of an error of the system, for the end of a message."""
    return (error.strerror or str(error)).lower()


@contextlib.contextmanager
def naming(
    name: object, kinds: type[SparklodError] | tuple[type[SparklodError], ...] = SparklodError
) -> Iterator[None]:
    """Put a name, such as that of a file, before the messages of errors."""
    try:
        yield
    except kinds as error:
        raise type(error)(f"{name}: {error}") from None


@contextlib.contextmanager
def optional_import(
    purpose: str, extra: str = "", error: type[SparklodError] = SparklodError, *, package: str = ""
) -> Iterator[None]:
    """Turn failed imports inside into an error, of the class `error`, that says what to install.

    The import stays a statement, so that type checkers and import-linter see it.

    Args:
        purpose: what needs which package: "--plot needs matplotlib".
        extra: the extra that brings it: "render".
        package: name for pip, where one package of the extra suffices, or no extra brings it.
    """
    try:
        yield
    except ImportError as reason:
        from .machine import install_hint  # as every command loads this module

        raise error(f"{purpose}: {install_hint(extra, package=package)} ({reason})") from None


@contextlib.contextmanager
def memory_errors_translated() -> Iterator[None]:
    """Translate errors that mean that memory ran out into an `OutOfMemoryError` with the shape of the array."""
    try:
        yield
    except Exception as error:
        reason = out_of_memory(error)
        if reason is None:
            raise
        raise OutOfMemoryError(reason) from None


def out_of_memory(error: BaseException) -> str | None:
    """Return the message for an error that means memory ran out; None for any other error."""
    text = str(error).lower()
    is_out_of_memory = (
        isinstance(error, MemoryError)
        or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
        or (isinstance(error, ImportError) and ("cannot allocate memory" in text or "failed to map segment" in text))
        or (isinstance(error, RuntimeError) and "can't start new thread" in text)  # no memory for its stack
    )
    if not is_out_of_memory:
        return None
    array = ""
    shape, dtype = getattr(error, "shape", None), getattr(error, "dtype", None)  # of the array that numpy asked for
    if shape and dtype is not None:
        size = math.prod(shape) * dtype.itemsize
        amount = f"{size / 1e9:,.1f} GB" if size >= 1e9 else f"{size / 1e6:,.1f} MB"
        array = f": {' x '.join(f'{side:,}' for side in shape)} numbers ({dtype}) take {amount}"
    return f"it does not fit into memory{array}; free some memory, or process less at a time"
