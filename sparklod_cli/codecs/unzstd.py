"""Reading of zstd frames on one thread, which buffers little more than a piece of a file and what is asked for."""

from __future__ import annotations

from typing import Any, BinaryIO

import zstandard

from ..system.errors import ChecksumError, FormatError, TooLongError
from .inflate import PIECE


class _Window:
    """The next `size` bytes of a file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int) -> bytes:
        data = self._file.read(min(size, self._left))
        self._left -= len(data)
        return data


class Unzstd:
    """Reader of a zstd frame, the next `packed` bytes of a file, that buffers little more than requested."""

    def __init__(self, file: BinaryIO, packed: int, name: str) -> None:
        self._name = name
        window: Any = _Window(file, packed)
        self._reader = zstandard.ZstdDecompressor().stream_reader(window, read_size=PIECE)

    def read(self, size: int) -> bytes:
        """Return the next `size` bytes, or fewer where the data ends; raises `FormatError` where they are corrupt."""
        try:
            piece: bytes = self._reader.read(size)
        except zstandard.ZstdError as error:
            kind = ChecksumError if "checksum" in str(error) else FormatError
            raise kind(f"corrupt zstd data in stream {self._name}: {error}") from None
        return piece

    def finish(self) -> None:
        """Raise `FormatError` unless the stream ends here."""
        if self.read(1):
            raise TooLongError(f"stream {self._name} is longer than its table announces")
