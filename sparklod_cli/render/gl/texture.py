"""The data texture: the splats as the vertex shader reads them, in texels of four 32-bit words."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...codecs.gpu import data_texture
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ..kernels.project import MAX_COLOR
from ..rasterizer import ShadedSplats

#: Precision of the stored splats: float32, or that of antimatter15's viewer.
PRECISIONS = ("float", "half")

#: Columns of `ShadedSplats` that do not change when the camera moves; colours do if there are spherical harmonics.
GEOMETRY = ("center", "scale", "quat_xyzw", "lod_opacity")

Words = NDArray[np.uint32]


class DataTexture(ABC):
    """The texels of the last splats, cached so that unchanged parts are not computed or uploaded again.

    `texture` is (height, splats_a_row * texels_a_splat, 4) uint32, row by row from splat 0; unused texels are 0.
    `splats_a_row` is a power of two.
    """

    texels_a_splat: int
    splats_a_row: int

    def __init__(self) -> None:
        self.texture: Words = np.zeros((0, self.splats_a_row * self.texels_a_splat, 4), np.uint32)
        self._last: ShadedSplats | None = None

    def update(self, shaded: ShadedSplats) -> tuple[bool, bool]:
        """Update the texture; return whether it has changed, and whether anything but colours has.

        Compares values, not array identity: every frame has new arrays, mostly with the same values.
        """
        before, self._last = self._last, shaded
        moved = before is None or not _same(before, shaded, GEOMETRY)
        if moved:
            height = max(1, -(-len(shaded) // self.splats_a_row))
            if len(self.texture) != height:
                self.texture = np.zeros((height, *self.texture.shape[1:]), np.uint32)
            self._geometry(shaded)
        recolored = moved or before is None or not _same(before, shaded, ("rgb",))
        if recolored:
            self._colors(shaded)
        return recolored, moved

    def _rows(self, kind: np.dtype[Any], count: int) -> NDArray[Any]:
        return self.texture.reshape(-1, 4 * self.texels_a_splat).view(kind)[:count, 0]

    @abstractmethod
    def _geometry(self, shaded: ShadedSplats) -> None:
        """Write all but the colours."""

    @abstractmethod
    def _colors(self, shaded: ShadedSplats) -> None:
        """Write the colours."""


class Floats(DataTexture):
    """Four texels per splat, in float32.

    Stores rotation and scale instead of the covariance, in which float32 would lose the short axis of a thin splat. In
    whole texels this takes no more space than the six elements of the covariance.
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

    def _geometry(self, shaded: ShadedSplats) -> None:
        rows = self._rows(self.RECORD, len(shaded))
        for name in GEOMETRY:
            rows[name] = getattr(shaded, name)

    def _colors(self, shaded: ShadedSplats) -> None:
        self._rows(self.RECORD, len(shaded))["rgb"] = _clamped_colors(shaded)


class Halves(DataTexture):
    """Two texels per splat, in the layout of antimatter15's viewer: `codecs.gpu.data_texture`.

    A byte cannot store the opacity of a merged splat, nor a colour above 1. So the word that the viewer leaves unused
    holds two float16: D, and a factor for the colour bytes, usually 1.
    """

    texels_a_splat, splats_a_row = 2, data_texture.SPLATS_A_ROW

    def _geometry(self, shaded: ShadedSplats) -> None:
        colorless = np.zeros_like(shaded.rgb)
        sh = np.zeros((len(shaded), COEFFICIENTS[0], 3), np.float32)
        opacity = np.minimum(shaded.lod_opacity, 1)
        splats = Splats(shaded.center, shaded.scale, shaded.quat_xyzw, opacity, colorless, sh)
        self.texture = data_texture.pack(splats)["texture"]
        self._extra(shaded)[:, 0] = shaded.lod_opacity

    def _colors(self, shaded: ShadedSplats) -> None:
        rgb = _clamped_colors(shaded)
        gain = np.maximum(rgb.max(axis=1, initial=0), 1).astype(np.float16)
        # float16 may round the factor down, and a byte must not overflow.
        bright = np.minimum(rgb / gain[:, None].astype(np.float32), 1)
        self._rows(data_texture.SPLAT, len(shaded))["rgba"][:, :3] = np.rint(bright * 255)
        self._extra(shaded)[:, 1] = gain

    def _extra(self, shaded: ShadedSplats) -> NDArray[np.float16]:
        """Return (N, 2) the two halves of the word that the viewer leaves unused."""
        words: NDArray[np.float16] = self.texture.reshape(-1, 8).view(np.float16)[: len(shaded), 6:8]
        return words


def data_texture_of(precision: str) -> DataTexture:
    """Return an empty data texture of one of `PRECISIONS`."""
    return {"float": Floats, "half": Halves}[precision]()


def _clamped_colors(shaded: ShadedSplats) -> FloatArray:
    """Return (N, 3) colours clamped to the range of the rasterizer; NaN becomes 0."""
    rgb: FloatArray = np.where(shaded.rgb > 0, np.minimum(shaded.rgb, MAX_COLOR), np.float32(0))
    return rgb


def _same(one: ShadedSplats, other: ShadedSplats, columns: tuple[str, ...]) -> bool:
    return all(
        (mine := getattr(one, name)) is (theirs := getattr(other, name)) or np.array_equal(mine, theirs)
        for name in columns
    )
