"""Gradients: derivatives of a loss on a picture of the rasterizer by the properties of the splats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.falloff import MIN_ALPHA
from ..model.splats import FloatArray
from . import rasterizer
from .kernels import backward
from .kernels.backward import CENTER, LOD_OPACITY, LOG_SCALE, RGB, TURN
from .kernels.shade import sh_gradients
from .rasterizer import Image, ShadedSplats
from .render_settings import RasterSettings


@dataclass(frozen=True)
class SplatGradients:
    """Derivatives of a loss by properties of N splats, views of one float32 array; 0 for splats that are not drawn."""

    center: FloatArray  # (N, 3) per world unit
    log_scale: FloatArray  # (N, 3) per unit of ln(scale)
    turn: FloatArray  # (N, 3) per radian of a rotation vector in the splat's axes: q becomes q * exp(turn / 2)
    lod_opacity: FloatArray  # (N,) per unit of D; 0 above `ellipse.MAX_D`
    rgb: FloatArray  # (N, 3) per unit of colour; at 0, the derivative from above


@dataclass(frozen=True)
class Drawing:
    """A picture of `draw` with what its gradients need; the arrays of `splats` must not change before."""

    image: Image
    splats: ShadedSplats
    camera: Camera
    settings: RasterSettings
    drawn: backward.Drawn

    def gradients(self, by_image: Image) -> SplatGradients:
        """Return derivatives of a loss by each splat, which do not depend on the number of threads.

        Held constant are the ends of a splat (at a number of standard deviations, at the least alpha, behind opaque
        splats), and the shape of a splat whose axes are shortened to the largest radius.

        Args:
            by_image: (height, width, 4) float32 derivatives of the loss by premultiplied red, green, blue and by alpha.
        """
        drawn = self.drawn
        first = np.empty(len(drawn.boxes) + 1, np.int64)
        backward.fill_first_rows(drawn.boxes, first)
        sums = np.empty((first[-1], backward.SUMS), np.float32)
        by_image = np.ascontiguousarray(by_image, np.float32)
        backward.weigh_tiles(len(drawn.stop), drawn, first, np.float32(MIN_ALPHA), self.image, by_image, sums)
        found = np.zeros((len(self.splats), backward.GRADIENT_COLUMNS), np.float32)
        arguments = rasterizer.arguments(self.splats, self.camera, self.settings)
        backward.carry_back(len(drawn.screen), *arguments, backward.Rows(drawn.screen, first, sums), found)
        return SplatGradients(
            center=found[:, CENTER : CENTER + 3],
            log_scale=found[:, LOG_SCALE : LOG_SCALE + 3],
            turn=found[:, TURN : TURN + 3],
            lod_opacity=found[:, LOD_OPACITY],
            rgb=found[:, RGB : RGB + 3],
        )


def draw(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> Drawing:
    """Draw the picture of `rasterizer.draw` for its gradients; `ValueError` for the profile `shifted`."""
    if settings.profile == "shifted":
        raise ValueError("gradients of the profile shifted are not implemented; use the profile spark")
    screen, boxes, keys = rasterizer.project_splats(splats, camera, settings)
    screen, boxes = screen.copy(), boxes.copy()  # the next picture overwrites these buffers
    image, start, order, stop = rasterizer.draw_projected(screen, boxes, keys, camera, settings)
    across, _ = rasterizer.tiles_across(camera)
    drawn = backward.Drawn(screen, boxes, start, order, stop, across)
    return Drawing(image, splats, camera, settings, drawn)


def by_sh(
    center: FloatArray, eye: NDArray[np.float64], coefficients: int, rgb: FloatArray, by_rgb: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Convert derivatives by the colours that a camera sees to derivatives by colours and SH coefficients.

    The direction from the camera to a splat is held constant.

    Args:
        center: (N, 3) float32 centres, in the space of the spherical harmonics.
        eye: (3,) position of the camera in that space.
        coefficients: K, 0, 3, 8 or 15.
        rgb: (N, 3) colours of `shade`.
        by_rgb: (N, 3) float32 derivatives by `rgb`.

    Returns:
        (N, 3) by `Splats.rgb` and (N, K, 3) by `Splats.sh`, float32; 0 where the colour was clamped to 0.
    """
    by_color = np.where(rgb > 0, by_rgb, np.float32(0))
    found = np.empty((len(center), coefficients, 3), np.float32)
    if coefficients:
        sh_gradients(len(center), center, np.asarray(eye, np.float32), by_color, found)
    return by_color, found
