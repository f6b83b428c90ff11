"""Draws what a camera sees of a scenery: `Renderer`."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..scenery import Piece, Scenery
from . import color_by, styles
from .color_by import Scale
from .rasterizer import Image
from .settings import RasterSettings
from .shading import ShadedSplats, show

#: Held while kernels run on all threads: they do not share them, and not every layer of threads survives their trying.
_KERNELS = threading.Lock()


@dataclass(frozen=True)
class RenderSettings:
    """How pictures are drawn.

    Attributes:
        look: how splats become pixels.
        style: one of `defaults.STYLES`.
        backend: one of `defaults.BACKENDS`.
        color_by: one of `defaults.COLOR_BY`; None for the colours of the splats.
        supersample: each pixel is the mean of so many, squared.
        options: of the backend.
    """

    look: RasterSettings = field(default_factory=RasterSettings)
    style: str = "splats"
    backend: str = "numba"
    color_by: str | None = None
    supersample: int = 1
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Drawn:
    """A picture.

    Attributes:
        image: (H, W, 4) float32: red, green and blue, multiplied by alpha, and alpha.
        values: (H, W) float32, the numbers behind the colours where these are of pixels; NaN where there is none.
        splats: how many were handed to the backend.
    """

    image: Image
    values: NDArray[np.float32] | None
    splats: int


class Renderer:
    """Draws pictures of a scenery, all in one manner, from several threads if they want to.

    Args:
        scenery: what is drawn.
        manner: how.
        cameras: that it will be seen by; colours mean the same in the pictures of all.

    Attributes:
        scale: what the colours mean; None where they are those of the splats.

    Raises:
        SparklodError: there is nothing to colour by.
    """

    def __init__(self, scenery: Scenery, manner: RenderSettings, cameras: Sequence[Camera]) -> None:
        self.scenery, self.manner = scenery, manner
        self.scale = self._scale(cameras)

    def _scale(self, cameras: Sequence[Camera]) -> Scale | None:
        by = self.manner.color_by
        if by is None:
            return None
        if by == "depth":
            return color_by.scale_of_depth(self.scenery, cameras, self.manner.look)
        if by == "overdraw":
            some = {number: cameras[number] for number in (0, len(cameras) // 2, len(cameras) - 1)}
            return color_by.scale_of_overdraw([self._overdraw(self.scenery.pieces(at), at) for at in some.values()])
        return color_by.scale_of_splats(by, self.scenery, cameras)

    def draw(self, camera: Camera) -> Drawn:
        """The picture of a camera.

        Raises:
            BackendError: the backend cannot draw here.
        """
        pieces = self.scenery.pieces(camera)
        count = sum(len(piece.index) for piece in pieces)
        by = self.manner.color_by
        if by == "overdraw":
            values = self._overdraw(pieces, camera)
            return Drawn(self._colored(values, (values > 0).astype(np.float32)), values, count)
        if by == "depth":
            values, alpha = self._depth(pieces, camera)
            return Drawn(self._colored(values, alpha), values, count)
        fine = finer(camera, self.manner.supersample)
        with _KERNELS:
            shown = self._show(pieces, fine)
            if self.scale is not None and by is not None:
                rgb = [self.scale.rgb(color_by.values_of(by, piece)) for piece in pieces]
                shown = dataclasses.replace(shown, rgb=np.concatenate(rgb))
            image = self._image(shown, fine)
        return Drawn(averaged(image, self.manner.supersample), None, count)

    def _show(self, pieces: Sequence[Piece], camera: Camera) -> ShadedSplats:
        """Colours that are not the splats' own are not lit either."""
        degree = 3 if self.manner.color_by is None else 0
        return show([(piece.splats.with_max_sh(degree), piece.object_to_world) for piece in pieces], camera)

    def _image(self, shown: ShadedSplats, camera: Camera) -> Image:
        look = self._look
        return styles.draw(self.manner.style, self.manner.backend, shown, camera, look, self.manner.options)

    @property
    def _look(self) -> RasterSettings:
        """That of finer pictures: the largest radius counts in pixels of those that are shown."""
        look = self.manner.look
        return dataclasses.replace(look, max_radius=look.max_radius * self.manner.supersample)

    def _overdraw(self, pieces: Sequence[Piece], camera: Camera) -> NDArray[np.float32]:
        fine = finer(camera, self.manner.supersample)
        with _KERNELS:
            counts = styles.overdraw(self._show(pieces, fine), fine, self._look)
        return averaged(counts[..., None], self.manner.supersample)[..., 0]

    def _depth(self, pieces: Sequence[Piece], camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(H, W) the mean depth of what is seen, world units, NaN where that is nothing; and alpha."""
        look, fine = self.manner.look, finer(camera, self.manner.supersample)
        with _KERNELS:
            shown = self._show(pieces, fine)
            depth = (shown.center - camera.position.astype(np.float32)) @ camera.forward.astype(np.float32)
            drawn = (depth > look.near) & (depth < look.far)
            # Backends draw colours of 0..1.
            top = float(depth[drawn].max(initial=look.near))
            rgb = np.clip(np.nan_to_num(depth) / np.float32(top), 0, 1)
            image = self._image(
                dataclasses.replace(shown, rgb=np.repeat(rgb[:, None], 3, axis=1).astype(np.float32)), fine
            )
        image = averaged(image, self.manner.supersample)
        alpha = image[..., 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(alpha > 0, image[..., 0] / alpha * np.float32(top), np.float32(np.nan))
        return mean.astype(np.float32), alpha

    def _colored(self, values: NDArray[np.float32], alpha: NDArray[np.float32]) -> Image:
        assert self.scale is not None
        return np.concatenate([self.scale.rgb(values) * alpha[..., None], alpha[..., None]], axis=2)


def finer(camera: Camera, times: int) -> Camera:
    """The same camera with so many pixels a pixel along each side."""
    if times == 1:
        return camera
    return dataclasses.replace(
        camera,
        width=camera.width * times,
        height=camera.height * times,
        focal=(camera.focal[0] * times, camera.focal[1] * times),
        principal=(camera.principal[0] * times, camera.principal[1] * times),
    )


def averaged(image: Image, times: int) -> Image:
    """(H, W, C) the means of squares of so many pixels a side."""
    if times == 1:
        return image
    height, width = image.shape[0] // times, image.shape[1] // times
    fine = image.reshape(height, times, width, times, image.shape[2])
    return fine.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
