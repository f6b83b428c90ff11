"""`Renderer`: draws what a camera sees of scenes, in one of several styles."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.falloff import MIN_ALPHA
from ..model.gaussian import size_factor
from ..system.progress import Progress, silent
from ..viewers.scenes import Cut, CutFinder
from . import rasterizer
from .kernels.raster import count_fragments, draw_discs
from .rasterizer import Image, ShadedSplats, shade
from .render_settings import CLIP, RasterSettings, RenderSettings, uses_card

if TYPE_CHECKING:
    from .color_scales import Coloring

#: Modules of the backends, of which "cuda" is the backend numba on a card; each has a function `draw`.
MODULES = {"numba": ".rasterizer", "cuda": ".cuda.card_rasterizer", "osmesa": ".osmesa", "open3d": ".open3d_backend"}

#: Held while kernels run, since some threading layers of numba crash when called concurrently.
_KERNELS = threading.Lock()


@dataclass(frozen=True)
class DrawnPicture:
    """A picture of a camera.

    Attributes:
        image: (H, W, 4) float32: premultiplied red, green and blue, and alpha.
        values: (H, W) float32 numbers behind the colours of pixels, NaN where empty; None if splats have the colours.
        splats: number of splats passed to the backend.
    """

    image: Image
    values: NDArray[np.float32] | None
    splats: int


class Renderer:
    """Draws pictures with the same settings, on any number of threads.

    Attributes:
        scale: the colour scale that the pictures of all `cameras` share; None if splats have their own colours.

    Raises:
        SparklodError: the scenes lack the quantity to colour by.
        BackendError: the device is a card, and none is usable.
    """

    def __init__(
        self, source: CutFinder, settings: RenderSettings, cameras: Sequence[Camera], *, progress: Progress = silent
    ) -> None:
        self.source, self.settings = source, settings
        if settings.device == "cuda" and settings.backend != "numba":
            raise ValueError(f"device is 'cuda'; the backend numba draws on cards, not {settings.backend}")
        on_card = settings.backend == "numba" and settings.device != "cpu" and uses_card(settings.device)
        self._backend = "cuda" if on_card else settings.backend
        # In pixels of the finer picture, which is the one that is shaded.
        self._raster = replace(settings.raster, max_radius=settings.raster.max_radius * settings.supersample)
        self.scale: Coloring | None = None
        by = settings.color_by
        if by is not None:
            from . import color_scales

            if by == "depth":
                self.scale = color_scales.scale_of_depth(source, cameras, settings.raster)
            elif by == "overdraw":
                some = {number: cameras[number] for number in (0, len(cameras) // 2, len(cameras) - 1)}.values()
                self.scale = color_scales.scale_of_overdraw([self._overdraw(source.cut(at), at) for at in some])
            else:
                self.scale = color_scales.scale_of_splats(by, source, cameras, progress)

    def draw(self, camera: Camera) -> DrawnPicture:
        """Draw the picture of a camera; raise `BackendError` if the backend cannot draw here."""
        cut = self.source.cut(camera)
        by, times, top = self.settings.color_by, self.settings.supersample, 1.0
        if by == "overdraw":
            values = self._overdraw(cut, camera)
            return DrawnPicture(self._colored(values, (values > 0).astype(np.float32)), values, len(cut))
        fine = finer(camera, times)
        with _KERNELS:
            shaded = _shaded(cut, fine, self.settings.max_sh if by is None else 0)
            if by == "depth":
                shaded, top = colored_by_depth(shaded, fine, self.settings.raster)
            elif self.scale is not None and by is not None:
                from .color_scales import values_of

                values = np.concatenate([values_of(by, part) for part in cut.parts])
                shaded = replace(shaded, rgb=self.scale.rgb(values) / np.float32(255))
            style, options = self.settings.style, self.settings.options
            image = averaged(draw_styled(style, self._backend, shaded, fine, self._raster, options), times)
        if by != "depth":
            return DrawnPicture(image, None, len(cut))
        alpha = image[..., 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(alpha > 0, image[..., 0] / alpha * np.float32(top), np.float32(np.nan))
        depth = mean.astype(np.float32)
        return DrawnPicture(self._colored(depth, alpha), depth, len(cut))

    def _overdraw(self, cut: Cut, camera: Camera) -> NDArray[np.float32]:
        """Return (H, W) number of splats of the backend numba blended into each pixel, including hidden ones."""
        fine = finer(camera, self.settings.supersample)
        counts = np.zeros((fine.height, fine.width), np.int32)
        with _KERNELS:
            shaded = _shaded(cut, fine, 0)
            if len(shaded):
                screen, _, keys = rasterizer.project_splats(shaded, fine, self._raster)
                is_design, least = self._raster.profile == "shifted", np.float32(MIN_ALPHA)
                count_fragments(len(counts), screen, keys, is_design, least, counts)
        return averaged(counts.astype(np.float32)[..., None], self.settings.supersample)[..., 0]

    def _colored(self, values: NDArray[np.float32], alpha: NDArray[np.float32]) -> Image:
        assert self.scale is not None
        rgb = self.scale.rgb(values) / np.float32(255)
        return np.concatenate([rgb * alpha[..., None], alpha[..., None]], axis=2)


def _shaded(cut: Cut, camera: Camera, degree: int) -> ShadedSplats:
    return shade([(part.splats.with_max_sh(degree), part.object_to_world) for part in cut.parts], camera)


def colored_by_depth(splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> tuple[ShadedSplats, float]:
    """Color splats with gray levels of depth / largest visible depth; also return the latter, in world units."""
    depth = (splats.center - camera.position.astype(np.float32)) @ camera.forward.astype(np.float32)
    top = float(depth[(depth > raster.near) & (depth < raster.far)].max(initial=raster.near))
    gray = np.clip(np.nan_to_num(depth) / np.float32(top), 0, 1)
    return replace(splats, rgb=np.repeat(gray[:, None], 3, axis=1).astype(np.float32)), top


def finer(camera: Camera, times: int) -> Camera:
    """Return the same camera with `times` as many pixels along each side."""
    if times == 1:
        return camera
    return replace(
        camera,
        width=camera.width * times,
        height=camera.height * times,
        focal=(camera.focal[0] * times, camera.focal[1] * times),
        principal=(camera.principal[0] * times, camera.principal[1] * times),
    )


def averaged(image: Image, times: int) -> Image:
    """Average squares of `times` x `times` pixels."""
    if times == 1:
        return image
    height, width = image.shape[0] // times, image.shape[1] // times
    fine = image.reshape(height, times, width, times, image.shape[2])
    return fine.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


#: Opacity of a billboard.
BILLBOARD_ALPHA = 0.5


def draw_styled(
    style: str,
    backend: str,
    splats: ShadedSplats,
    camera: Camera,
    settings: RasterSettings,
    options: Mapping[str, Any],
) -> Image:
    """Draw what a camera sees, as `rasterizer.draw` does; `BackendError` if the backend cannot draw here.

    Args:
        style: one of `render_settings.STYLES`. "points" are opaque pixels, "billboards" discs of one opacity, as wide
            as the splats, both in the order of the file; "sorted-billboards" are drawn from far to near, as "splats".
        options: of the backend's `draw`, which draws "splats".
    """
    image: Image = np.zeros((camera.height, camera.width, 4), np.float32)
    if not len(splats):  # no chunk has arrived yet
        return image
    if style == "splats":
        drawn: Image = import_module(MODULES[backend], __package__).draw(splats, camera, settings, **options)
        return drawn
    index, x, y, depth, distance = _on_screen(splats, camera, settings)
    if style == "points":
        inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        row, column = y[inside].astype(np.intp), x[inside].astype(np.intp)
        image[row, column, :3] = np.minimum(splats.rgb[index[inside]], 1)  # of several, the last one stays
        image[row, column, 3] = 1
        return image
    order = np.arange(len(index))
    if style == "sorted-billboards":
        order = np.argsort(-(distance if settings.sort == "radial" else depth), kind="stable")
    index, depth = index[order], depth[order]
    width = splats.scale[index].mean(axis=1) * size_factor(splats.lod_opacity[index])
    radius = np.clip(width * np.float32(camera.focal[1]) / depth, 0.5, settings.max_radius).astype(np.float32)
    rgb = np.minimum(splats.rgb[index], 1)
    draw_discs(camera.height, x[order], y[order], radius, rgb, np.float32(BILLBOARD_ALPHA), image)
    return image


def _on_screen(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> tuple[NDArray[Any], ...]:
    """Find the splats between near and far whose centres are in the picture, enlarged by `CLIP`.

    Returns:
        (M,) indices; x and y in pixels from the upper left corner, float32; depths along the axis; distances.
    """
    local = (splats.center - camera.position.astype(np.float32)) @ camera.camera_to_world[:3, :3].astype(np.float32)
    depth = -local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        dx, dy = camera.focal[0] * local[:, 0] / depth, -camera.focal[1] * local[:, 1] / depth
        seen = (depth > settings.near) & (depth < settings.far) & (splats.lod_opacity >= MIN_ALPHA)
        seen &= (abs(dx) <= CLIP * camera.width / 2) & (abs(dy) <= CLIP * camera.height / 2)
    index = np.flatnonzero(seen)
    return (
        index,
        (dx[index] + camera.principal[0]).astype(np.float32),
        (dy[index] + camera.principal[1]).astype(np.float32),
        depth[index],
        np.linalg.norm(local[index], axis=1),
    )
