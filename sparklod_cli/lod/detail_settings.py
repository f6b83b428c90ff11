"""`DetailSettings`, how a scene is divided into regions and detail levels."""

from __future__ import annotations

from dataclasses import dataclass

from ..support import defaults


@dataclass(frozen=True)
class DetailSettings:
    """How regions and detail levels are made.

    Attributes:
        levels: splats of each level after full detail, as a share of it, descending, above 0 and below 1; None for
            levels that suit the scene.
        chunk_splats: a chunk file is closed at about this many splats, and a region has no more of all levels together.
        extent: longest side, in world units, beyond which a region is divided.
        min_splats: a region of fewer splats is not divided for its extent.
    """

    levels: tuple[float, ...] | None = None
    chunk_splats: int = defaults.DETAIL_CHUNK_SPLATS
    extent: float = defaults.DETAIL_EXTENT
    min_splats: int = defaults.DETAIL_MIN_SPLATS
