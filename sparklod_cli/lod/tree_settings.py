"""Settings of trees and their outputs: the table of builders, detail levels of Streamed SOG, and tiles of 3D Tiles.

A new builder needs a module and a row of `BUILDERS`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import ClassVar

from ..model.sh import COEFFICIENTS
from ..system.setting_fields import CheckedSettings, Quantity, Range, setting, whole
from ..system.units import parse_count

#: Ratio of the voxel sizes of successive levels in the quick builder.
MIN_BASE, MAX_BASE, DEFAULT_BASE = 1.1, 2.0, 1.5

#: Maximum ratio of nodes to leaves in the quality builder; 2 keeps every node of its binary tree.
MIN_GROWTH, MAX_GROWTH, DEFAULT_GROWTH = 1.05, 2.0, 1.4

#: Growth of the tree from which the detail levels of a Streamed SOG are cut: all nodes, as it is not written itself.
DETAIL_GROWTH = MAX_GROWTH

#: Bytes of a splat at the peak of a bake: without spherical harmonics, and for each coefficient of them. Measured by
#: `benchmarks/bench_memory.py` (VmHWM), with some reserve.
SplatBytes = tuple[int, int]


def bytes_of(each: SplatBytes, splats: int, sh_degree: int) -> int:
    """Return the bytes of splats of an SH degree."""
    fixed, coefficient = each
    return splats * (fixed + coefficient * COEFFICIENTS[sh_degree])


@dataclass(frozen=True)
class Builder:
    """A tree builder.

    Its module has `build(splats, SETTING, *, progress) -> (nodes, tree)`; the module of the same name with `_stages`
    is a `stages.StagedBuilder`.

    Attributes:
        setting: name of its only parameter, a number.
        summary: phrase for help texts.
        in_bands: put the nodes into the order of `band_order` for files that are read whole. This saves 3 to 4 % of a
            file of quality, but only 1 to 2 % of a file of quick, which is not worth the time.
        in_memory: bytes of an input splat in a bake in memory.
        in_block: bytes of a splat of a block out of core.
        in_scratch: bytes of an input splat in the scratch folder out of core; splats of a finished block are removed.
    """

    setting: str
    summary: str
    in_bands: bool
    in_memory: SplatBytes
    in_block: SplatBytes
    in_scratch: SplatBytes


#: Builders by the name of the method and of the module; the first is the default.
BUILDERS = {
    "quick": Builder(
        "base",
        "pairs in cells of a voxel grid, in seconds",
        in_bands=False,
        in_memory=(220, 27),
        in_block=(300, 50),
        in_scratch=(190, 32),
    ),
    "quality": Builder(
        "growth",
        "the pairs that cost least, in all",
        in_bands=True,
        in_memory=(250, 30),
        in_block=(350, 50),
        in_scratch=(200, 34),
    ),
}
METHODS = tuple(BUILDERS)


#: Maximum number of levels after full detail. Chosen: viewers use a handful.
MOST_LEVELS = 15

#: Least determinant of the axes of a transform, as a share of the product of their lengths; below, it is flat. Chosen.
LEAST_VOLUME = 1e-6


def parse_levels(text: str) -> tuple[float, ...] | None:
    """Parse levels such as "50%,25%,12%" into shares of full detail; "auto" into None. Raises `ValueError`."""
    if text.strip() == "auto":
        return None
    from .budget import SHARE  # whose fractions take milliseconds to load

    shares = [SHARE.fullmatch(part.strip()) for part in text.split(",")]
    levels = tuple(float(share[1]) / 100 for share in shares if share is not None)
    if len(levels) < len(shares) or not _are_levels(levels):
        raise ValueError(
            f"{text!r} is neither auto nor shares of full detail such as 50%,25%,12%: at most {MOST_LEVELS}, each"
            " smaller than the one before, above 0% and below 100%"
        )
    return levels


def _are_levels(levels: tuple[float, ...]) -> bool:
    """Return whether the number of levels and their shares are valid."""
    descends = all(a > b for a, b in itertools.pairwise((1.0, *levels, 0.0)))
    return 0 < len(levels) <= MOST_LEVELS and descends


@dataclass(frozen=True)
class DetailSettings(CheckedSettings):
    """Settings of regions and detail levels; the defaults are those of PlayCanvas's own tools.

    A region has, over all levels, at most as many splats as a chunk file.
    """

    HEADING: ClassVar[str] = "Streamed SOG"

    levels: tuple[float, ...] | None = setting(
        "Splats of each detail level after full detail, as shares of it in descending order, such as 50%,25%,12%,6%;"
        " auto suits the scene.  [default: auto]",
        Quantity("SHARES|auto", parse_levels),
    )
    chunk_splats: int = setting(
        "Splats, about, after which a chunk file is closed.", Quantity("N", parse_count, whole(1)), 524_288
    )
    extent: float = setting(
        "Longest side of a region, in world units of the output; regions that are longer are divided.",
        Range(above=0),
        16.0,
        name="region_extent",
    )
    min_splats: int = setting(
        "Splats below which a region is not divided, however long it is.",
        Quantity("N", parse_count, whole(1)),
        8_192,
        name="region_min_splats",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.levels is not None and not _are_levels(self.levels):
            raise ValueError(
                f"levels are {self.levels}; give 1 to {MOST_LEVELS} shares below 1 and above 0, descending"
            )


def parse_matrix(text: str) -> tuple[float, ...]:
    """Parse a matrix such as "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1"; raise `ValueError` as `check_matrix`."""
    try:
        matrix = tuple(map(float, text.replace(",", " ").split()))
    except ValueError:
        matrix = ()
    check_matrix(matrix, repr(text))
    return matrix


def check_matrix(matrix: tuple[float, ...], name: str) -> None:
    """Raise `ValueError` unless numbers are an affine transform, column by column, not flattening and not mirroring."""
    if len(matrix) != 16 or not all(map(math.isfinite, matrix)):
        raise ValueError(f"{name} is not 16 finite numbers, a matrix of 4 rows column by column")
    (a, b, c, p), (d, e, f, q), (g, h, i, r), (*_, s) = (matrix[at : at + 4] for at in (0, 4, 8, 12))
    if (p, q, r, s) != (0, 0, 0, 1):
        raise ValueError(f"{name} has the last row {p:g} {q:g} {r:g} {s:g}, not 0 0 0 1; give it column by column")
    volume = a * (e * i - f * h) - d * (b * i - c * h) + g * (b * f - c * e)
    if not volume > LEAST_VOLUME * math.hypot(a, b, c) * math.hypot(d, e, f) * math.hypot(g, h, i):
        raise ValueError(f"{name} flattens or mirrors; give one that turns, moves and scales")


@dataclass(frozen=True)
class TileSettings(CheckedSettings):
    """Settings of 3D Tiles."""

    HEADING: ClassVar[str] = "3D Tiles"

    tile_splats: int = setting("Most splats of a tile, which is a file.", Quantity("N", parse_count, whole(1)), 100_000)
    lat: float | None = setting(
        "Latitude of the origin of the scene, in degrees, geodetic (WGS 84).", Range(-90, 90, unit="DEG")
    )
    lon: float | None = setting("Longitude of the origin, in degrees.", Range(-180, 180, unit="DEG"))
    height: float | None = setting("Height of the origin above the ellipsoid, in metres.", Range(unit="M"))
    heading: float | None = setting(
        "Direction that the scene's forward axis, -z where y is up, points to on the ground, in degrees clockwise from"
        " north.",
        Range(unit="DEG"),
    )
    transform: tuple[float, ...] | None = setting(
        "Transform of the root tile instead: 16 numbers, column by column, from the axes of the tileset, x right, y"
        " forward, z up, to those of the Earth (ECEF), in metres.",
        Quantity("NUMBERS", parse_matrix),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.lat is None) != (self.lon is None):
            raise ValueError("lat and lon go together; give both")
        if self.lat is None and not (self.height is None and self.heading is None):
            raise ValueError("height and heading are of a place; give lat and lon, too")
        for name in ("height", "heading"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} is {value}; give a finite number")
        if self.transform is not None:
            if self.lat is not None:
                raise ValueError("transform cannot be used with lat and lon")
            check_matrix(self.transform, "transform")

    @property
    def matrix(self) -> tuple[float, ...]:
        """Transform of the root tile, column by column."""
        from ..model.transforms import IDENTITY, earth_matrix  # not needed for other outputs

        if self.lat is None or self.lon is None:
            return self.transform or IDENTITY
        return earth_matrix(self.lat, self.lon, self.height or 0.0, self.heading or 0.0)
