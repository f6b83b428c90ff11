"""Standard input as a seekable file, and standard output with errors of its own for failed writes."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from .errors import StdoutError, UnreadableError, reason_of


class ReaderGoneError(StdoutError):
    """The reader of standard output has closed it. Not an `OSError`, which click would handle itself."""


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Make failed writes to standard output inside raise `StdoutError` or `ReaderGoneError`."""
    before = sys.stdout
    sys.stdout = _GuardedStream(before)
    try:
        yield
    finally:
        sys.stdout = before


def silence(stream: Any) -> None:
    """Redirect a broken stream to the null device; otherwise its flush when the interpreter exits would fail."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


class _GuardedStream:
    """Standard output or its buffer; the stream is None if it is closed."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.encoding = getattr(stream, "encoding", None) or "utf-8"
        self.errors = "backslashreplace"  # characters that the terminal cannot show are escaped
        self.isatty: Callable[[], bool] = bool if stream is None else stream.isatty

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def buffer(self) -> _GuardedStream:
        return _GuardedStream(self._stream and self._stream.buffer)

    def write(self, data: Any) -> int:
        if self._stream is None:
            raise StdoutError("standard output is closed")
        if data == "":
            return 0  # click tries streams this way, and ignores errors
        if isinstance(data, str):
            data = data.encode(self.encoding, self.errors).decode(self.encoding)
        return self._checked(self._stream.write, data)

    def flush(self) -> None:
        if self._stream is not None:
            self._checked(self._stream.flush)

    def _checked(self, method: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return method(*arguments)
        except OSError as error:
            silence(self._stream)
            kind = ReaderGoneError if isinstance(error, BrokenPipeError) else StdoutError
            raise kind(f"cannot write standard output: {reason_of(error)}") from None


def reserve() -> None:
    """Open placeholders on closed standard descriptors (0, 1, 2), so that files opened later do not get these numbers.

    Otherwise what libraries print would end up in such a file. `sys.stdin`, `sys.stdout` and `sys.stderr` stay None.
    """
    while True:
        descriptor = os.open(os.devnull, os.O_RDWR)
        if descriptor > 2:
            os.close(descriptor)
            return


#: The path that means standard input or output.
DASH = Path("-")


def name_of(path: object) -> str:
    """Return the name of an input in messages."""
    return "standard input" if path == DASH else str(path)


def spooled() -> BinaryIO:
    """Return standard input as a temporary file that must stay open; raise `UnreadableError` if there is no input."""
    if sys.stdin is None:
        raise UnreadableError("standard input is closed")
    if sys.stdin.isatty():
        raise UnreadableError("standard input is a terminal; pipe a file into it, or give a path")
    file = _copy_of(sys.stdin)
    file.seek(0)
    return file


@functools.lru_cache(maxsize=1)
def _copy_of(stream: Any) -> BinaryIO:
    import shutil  # these take milliseconds, and every command loads this module
    import tempfile

    file: BinaryIO = tempfile.TemporaryFile(prefix="sparklod-")  # noqa: SIM115
    shutil.copyfileobj(stream.buffer, file, 1 << 20)
    return file


def write_stdout(pieces: Iterable[bytes], *, may_end: bool = False) -> int:
    """Write to standard output and return the number of bytes; raise `StdoutError` if a write fails.

    With `may_end`, a reader that closes it early, as head does, raises `ReaderGoneError` instead.
    """
    size = 0
    with guarded():
        try:
            for piece in pieces:
                size += sys.stdout.buffer.write(piece)
            sys.stdout.buffer.flush()
        except ReaderGoneError as error:
            if may_end:
                raise
            raise StdoutError(str(error)) from None
    return size
