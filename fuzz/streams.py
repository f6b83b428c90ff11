"""Standard output and error of a process that runs cases: kept in files, so that libraries in C cannot slip past."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator


class Streams:
    """What was written to file descriptors 1 and 2 since it was last taken."""

    def __init__(self) -> None:
        self._files: dict[int, int] = {}

    def redirect(self) -> None:
        """From now on they are files; standard input is empty."""
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number in (1, 2):
            with tempfile.TemporaryFile() as file:
                self._files[number] = os.dup(file.fileno())
        self.begin()

    def begin(self) -> None:
        """Forgets what was written."""
        for number, descriptor in self._files.items():
            self._flush()
            os.dup2(descriptor, number)  # a command may have pointed it elsewhere
            os.ftruncate(descriptor, 0)
            os.lseek(descriptor, 0, os.SEEK_SET)

    def take(self) -> tuple[bytes, bytes]:
        """What was written, which is forgotten."""
        self._flush()
        out, err = (os.pread(descriptor, 1 << 26, 0) for descriptor in (self._files.get(1, -1), self._files.get(2, -1)))
        self.begin()
        return out, err

    def unasked(self) -> Iterator[str]:
        """What was written and never taken."""
        if self._files:
            for data in self.take():
                if data:
                    yield data[:2000].decode("utf-8", "replace")

    @staticmethod
    def _flush() -> None:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()


#: Those of this process.
STREAMS = Streams()
