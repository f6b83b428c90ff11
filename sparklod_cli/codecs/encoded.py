"""What a codec is given to write a file, and what it gives back: the contract of every `encode`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from ..support.defaults import DEFAULT_COMPRESSION, SPZ_VERSIONS
from .clamps import Clamps


@dataclass(frozen=True)
class EncodeOptions:
    """How to write a file. A format takes of it what it has; its row in `formats.FORMATS` says what that is.

    Attributes:
        version: of SPZ, 2 (rotations in 3 bytes) or 3 (in 4, ten times as exact); None is `DEFAULT_SPZ_VERSION`.
        fractional_bits: of SPZ's positions, 0 to 24; None takes what suits the scene.
        compression_level: 1 (fast) to 9 (small).
        encoding: of an array file, one of `gpu.encodings.ENCODINGS`.
        raw: write the words of an array file alone, rather than as .npz.
        threads: to encode and compress with.
    """

    version: int | None = None
    fractional_bits: int | None = None
    compression_level: int = DEFAULT_COMPRESSION
    encoding: str | None = None
    raw: bool = False
    threads: int = 1

    def like(self, header: Mapping[str, int]) -> EncodeOptions:
        """These options, in which what is None is as in the file of a header, if that can be written."""
        version = header.get("version")
        return dataclasses.replace(
            self,
            version=version if self.version is None and version in SPZ_VERSIONS else self.version,
            fractional_bits=header.get("fractional_bits") if self.fractional_bits is None else self.fractional_bits,
        )


#: How files are written where nobody says anything.
DEFAULTS = EncodeOptions()


@dataclass(frozen=True)
class Encoded:
    """A file that is about to be written. Iterating over it encodes it, once, and gives its bytes piece by piece.

    Attributes:
        pieces: the bytes.
        header: numbers of the file's header, as `Scene.header` has them after reading.
        arrays: shapes of the arrays of an array file, in its order.
        clamps: looks for values that the file cannot hold.
    """

    pieces: Iterator[bytes]
    header: Mapping[str, int] = field(default_factory=dict)
    arrays: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    clamps: Callable[[], Clamps] = Clamps

    def __iter__(self) -> Iterator[bytes]:
        return self.pieces
