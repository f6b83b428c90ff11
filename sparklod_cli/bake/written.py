"""What is said of an output."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..codecs.clamps import Clamp


@dataclass(frozen=True)
class WrittenLevel:
    """A detail level.

    Attributes:
        splats: of all regions.
        share: of the splats of level 0.
        worst_error: the largest of the errors of its regions.
    """

    splats: int
    share: float
    worst_error: float


@dataclass(frozen=True)
class WrittenDetail:
    """A scene at several detail levels.

    Attributes:
        levels: full detail first.
        regions: how many there are.
        chunks: chunk files, each of which is a folder.
        environment: splats that are always drawn.
    """

    levels: tuple[WrittenLevel, ...]
    regions: int
    chunks: int
    environment: int


@dataclass(frozen=True, kw_only=True)
class WrittenTree:
    """What was written.

    Attributes:
        output_format: "spz", "rad", "rad-chunked", "streamed-sog", or the name of the encoding of arrays.
        bytes: of the output, all of its files.
        version, fractional_bits: of an SPZ output, else None.
        chunks: of a RAD output, else None.
        encodings: of a RAD output, by the field of `RadOptions`.
        sh_codes: the most entries of the SH palette of a RAD output; None without one.
        arrays: shapes of the arrays of another output, in its order.
        detail: of a Streamed SOG, what was made of the tree; else None.
        clamped: by the column of `Splats`, the number of nodes with a value that the output cannot hold.
        clamps: at which ends, and how far beyond.
    """

    output_format: str
    bytes: int
    version: int | None = None
    fractional_bits: int | None = None
    chunks: int | None = None
    encodings: dict[str, str] = field(default_factory=dict)
    sh_codes: int | None = None
    arrays: dict[str, tuple[int, ...]] = field(default_factory=dict)
    detail: WrittenDetail | None = None
    clamped: dict[str, int] = field(default_factory=dict)
    clamps: tuple[Clamp, ...] = ()
