"""Captures standard output and error of this process in files, so that the output of C libraries is captured too."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator


class Streams:
    """The output to file descriptors 1 and 2 since it was last taken."""

    def __init__(self) -> None:
        self._files: dict[int, int] = {}

    def redirect(self) -> None:
        """Redirects both descriptors to files, and standard input to an empty one."""
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number in (1, 2):
            with tempfile.TemporaryFile() as file:
                self._files[number] = os.dup(file.fileno())
        self.begin()

    def begin(self) -> None:
        """Discards the output so far."""
        for number, descriptor in self._files.items():
            self._flush()
            os.dup2(descriptor, number)  # a command may have pointed it elsewhere
            os.ftruncate(descriptor, 0)
            os.lseek(descriptor, 0, os.SEEK_SET)

    def take(self) -> tuple[bytes, bytes]:
        """Returns the output so far, of standard output and of standard error, and discards it."""
        self._flush()
        out, err = (os.pread(descriptor, 1 << 26, 0) for descriptor in (self._files.get(1, -1), self._files.get(2, -1)))
        self.begin()
        return out, err

    def untaken(self) -> Iterator[str]:
        """Yields the output that was never taken, as texts of up to 2,000 bytes."""
        if self._files:
            for data in self.take():
                if data:
                    yield data[:2000].decode("utf-8", "replace")

    @staticmethod
    def _flush() -> None:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()


#: The streams of this process.
STREAMS = Streams()
