"""Standard output with errors of its own, so that failures to write it cannot be taken for others."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any

from .errors import StdoutError


class ReaderGoneError(StdoutError):
    """The reader of standard output is gone. Not an `OSError`, which click would handle itself."""


@contextlib.contextmanager
def told() -> Iterator[None]:
    """In this context failures to write standard output, and only those, raise `StdoutError` or `ReaderGoneError`."""
    before = sys.stdout
    sys.stdout = _Told(before)
    try:
        yield
    finally:
        sys.stdout = before


def silence(stream: Any) -> None:
    """Redirects a broken stream to nowhere: the interpreter flushes it at its end, which would fail."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


class _Told:
    """Wraps a stream or its buffer; None for a closed one."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        #: Attributes that writers ask for.
        self.encoding = getattr(stream, "encoding", None) or "utf-8"
        self.errors = "backslashreplace"  # characters that the terminal cannot show are escaped

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def buffer(self) -> _Told:
        return _Told(self._stream and self._stream.buffer)

    def isatty(self) -> bool:
        return self._stream is not None and self._stream.isatty()

    def write(self, data: Any) -> int:
        if self._stream is None:
            raise StdoutError("standard output is closed")
        if data == "":
            return 0  # click probes streams so, and ignores errors
        if isinstance(data, str):
            data = data.encode(self.encoding, self.errors).decode(self.encoding)
        with self._telling():
            return self._stream.write(data)

    def flush(self) -> None:
        if self._stream is not None:
            with self._telling():
                self._stream.flush()

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            silence(self._stream)
            reason = (error.strerror or str(error)).lower()
            if isinstance(error, BrokenPipeError):
                raise ReaderGoneError(f"cannot write standard output: {reason}") from None
            raise StdoutError(f"cannot write standard output: {reason}") from None


def reserve() -> None:
    """Opens whichever of standard input, output and error are closed, so that no file of ours gets their descriptors.

    Such a file would receive what libraries print. For Python they stay closed, as it found them at its start.
    """
    while True:
        descriptor = os.open(os.devnull, os.O_RDWR)
        if descriptor > 2:
            os.close(descriptor)
            return
