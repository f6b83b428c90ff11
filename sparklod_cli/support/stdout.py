"""Standard output that tells by itself what is wrong with it, so that nobody guesses where an error came from."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any

from .errors import StdoutError


class ReaderGoneError(StdoutError):
    """Whoever read standard output has gone. No `OSError`, as click would take one for its own to handle."""


@contextlib.contextmanager
def told() -> Iterator[None]:
    """Meanwhile, failures to write standard output are `StdoutError` or `ReaderGoneError`, and those alone are."""
    before = sys.stdout
    sys.stdout = _Told(before)
    try:
        yield
    finally:
        sys.stdout = before


def silence(stream: Any) -> None:
    """Sends what a broken stream still holds nowhere: the interpreter flushes it at its end, and fails if it cannot."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


class _Told:
    """A stream, or its bytes; None for one that is closed."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        #: What is asked of a stream before it is written to.
        self.encoding = getattr(stream, "encoding", None) or "utf-8"
        self.errors = "backslashreplace"  # a name that this terminal cannot show is no reason to stop

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
            return 0  # click tries streams so, and says nothing of what comes of it
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
    """Opens what is closed of standard input, output and error, so that no file of ours gets one of their numbers.

    It would get what libraries print, too. Python goes by what it found at its start: to it they stay closed.
    """
    while True:
        descriptor = os.open(os.devnull, os.O_RDWR)
        if descriptor > 2:
            os.close(descriptor)
            return
