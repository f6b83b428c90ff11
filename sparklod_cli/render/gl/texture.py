"""The data texture: all that the vertex shader knows of the splats, in texels of four 32 bit words."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...codecs.gpu import data_texture
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ..kernels.project import MAX_COLOR
from ..shading import ShadedSplats

#: How exactly splats are held: as they are, or as antimatter15's viewer holds them.
PRECISIONS = ("float", "half")

#: Columns of `ShadedSplats` that stay as they are while a camera moves; colours do not, where there are spherical
#: harmonics.
GEOMETRY = ("center", "scale", "quat_xyzw", "lod_opacity")

Words = NDArray[np.uint32]


class DataTexture(ABC):
    """The texels of the splats last given, kept so that what has not changed is not computed or uploaded again.

    Attributes:
        texels_a_splat: how many follow each other in a row.
        splats_a_row: a power of two.
        texture: (height, splats_a_row * texels_a_splat, 4) uint32, row by row from splat 0 on; what is left over is 0.
    """

    texels_a_splat: int
    splats_a_row: int

    def __init__(self) -> None:
        self.texture: Words = np.zeros((0, self.splats_a_row * self.texels_a_splat, 4), np.uint32)
        self._shown: ShadedSplats | None = None

    def update(self, shown: ShadedSplats) -> tuple[bool, bool]:
        """Takes splats in.

        Compares what they are, not where they lie: every frame has new arrays, mostly of the same numbers.

        Returns:
            whether the texture has changed, and whether the splats moved, came or went.
        """
        before, self._shown = self._shown, shown
        moved = before is None or not _same(before, shown, GEOMETRY)
        if moved:
            height = max(1, -(-len(shown) // self.splats_a_row))
            if len(self.texture) != height:
                self.texture = np.zeros((height, *self.texture.shape[1:]), np.uint32)
            self._geometry(shown)
        recolored = moved or before is None or not _same(before, shown, ("rgb",))
        if recolored:
            self._colors(shown)
        return recolored, moved

    def _rows(self, kind: np.dtype[Any], count: int) -> NDArray[Any]:
        """(count,) records of the texture."""
        return self.texture.reshape(-1, 4 * self.texels_a_splat).view(kind)[:count, 0]

    @abstractmethod
    def _geometry(self, shown: ShadedSplats) -> None:
        """Writes all but the colours."""

    @abstractmethod
    def _colors(self, shown: ShadedSplats) -> None:
        """Writes the colours."""


class Floats(DataTexture):
    """Four texels a splat, in float32.

    Instead of the covariance there is its root, rotation and scale: of the covariance of a thin splat, float32 would
    lose the thin side. It takes no more room than the six elements, filled up to whole texels.
    """

    RECORD = np.dtype(
        [
            ("center", "<f4", 3),  # 0: world units
            ("lod_opacity", "<f4"),  # 12: D
            ("quat_xyzw", "<f4", 4),  # 16: local to world
            ("scale", "<f4", 3),  # 32: world units
            ("unused_a", "<u4"),  # 44: 0
            ("rgb", "<f4", 3),  # 48
            ("unused_b", "<u4"),  # 60: 0
        ]
    )
    assert RECORD.itemsize == 64

    texels_a_splat, splats_a_row = 4, 2048

    def _geometry(self, shown: ShadedSplats) -> None:
        rows = self._rows(self.RECORD, len(shown))
        for name in GEOMETRY:
            rows[name] = getattr(shown, name)

    def _colors(self, shown: ShadedSplats) -> None:
        self._rows(self.RECORD, len(shown))["rgb"] = _shown_colors(shown)


class Halves(DataTexture):
    """Two texels a splat, those of antimatter15's viewer: `codecs.data_texture`.

    A byte of opacity cannot tell a merged splat, nor a byte of colour one that is brighter than 1. So the word that the
    viewer leaves unused has two float16: D, and what the bytes of colour are multiplied by, 1 for most.
    """

    texels_a_splat, splats_a_row = 2, data_texture.SPLATS_A_ROW

    def _geometry(self, shown: ShadedSplats) -> None:
        colorless = np.zeros_like(shown.rgb)
        sh = np.zeros((len(shown), COEFFICIENTS[0], 3), np.float32)
        opacity = np.minimum(shown.lod_opacity, 1)
        splats = Splats(shown.center, shown.scale, shown.quat_xyzw, opacity, colorless, sh)
        self.texture = data_texture.pack(splats)["texture"]
        self._extra(shown)[:, 0] = shown.lod_opacity

    def _colors(self, shown: ShadedSplats) -> None:
        rgb = _shown_colors(shown)
        gain = np.maximum(rgb.max(axis=1, initial=0), 1).astype(np.float16)
        # float16 rounds down, too, and a byte must not wrap around.
        bright = np.minimum(rgb / gain[:, None].astype(np.float32), 1)
        self._rows(data_texture.SPLAT, len(shown))["rgba"][:, :3] = np.rint(bright * 255)
        self._extra(shown)[:, 1] = gain

    def _extra(self, shown: ShadedSplats) -> NDArray[np.float16]:
        """(N, 2) of the unused word."""
        words: NDArray[np.float16] = self.texture.reshape(-1, 8).view(np.float16)[: len(shown), 6:8]
        return words


def data_texture_of(precision: str) -> DataTexture:
    """An empty one of `PRECISIONS`."""
    return {"float": Floats, "half": Halves}[precision]()


def _shown_colors(shown: ShadedSplats) -> FloatArray:
    """(N, 3) colours in the range that the rasterizer draws; 0 for what is no number."""
    rgb: FloatArray = np.where(shown.rgb > 0, np.minimum(shown.rgb, MAX_COLOR), np.float32(0))
    return rgb


def _same(one: ShadedSplats, other: ShadedSplats, columns: tuple[str, ...]) -> bool:
    return all(
        (mine := getattr(one, name)) is (theirs := getattr(other, name)) or np.array_equal(mine, theirs)
        for name in columns
    )
