"""Gradients of a picture: how a loss changes with each splat that the rasterizer draws."""

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
    """Derivatives of a loss by the properties of N splats, float32 views of one array; 0 for splats that are not drawn.

    Attributes:
        center: (N, 3) per world unit.
        log_scale: (N, 3) per unit of ln(scale).
        turn: (N, 3) per radian of a rotation vector in the splat's own axes: q becomes q * exp(turn / 2).
        lod_opacity: (N,) per unit of D; 0 above `ellipse.MAX_D`.
        rgb: (N, 3) per unit of colour; where a colour is 0, of raising it.
    """

    center: FloatArray
    log_scale: FloatArray
    turn: FloatArray
    lod_opacity: FloatArray
    rgb: FloatArray


@dataclass(frozen=True)
class Drawing:
    """A picture with the data that `gradients` needs; made by `draw`.

    Attributes:
        image: (height, width, 4) float32, as `rasterizer.draw` returns it.
        splats: their arrays must not have changed before `gradients`.
    """

    image: Image
    splats: ShadedSplats
    camera: Camera
    settings: RasterSettings
    drawn: backward.Drawn

    def gradients(self, by_image: Image) -> SplatGradients:
        """Return derivatives of a loss by each splat, the same for any number of threads.

        Where a splat ends (at a number of standard deviations, at the least alpha, behind opaque ones) is held
        constant, and so is the shape of a splat whose axes are shortened to the largest radius. `by_image` are the
        (height, width, 4) float32 derivatives of the loss by the image's red, green and blue, which are multiplied by
        alpha, and by alpha.
        """
        drawn = self.drawn
        first = backward.first_rows(drawn.boxes)
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
    """Draw the picture of `rasterizer.draw` for its gradients; `ValueError` for the profile `shifted`, without any."""
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
    """Return derivatives by a splat's own colour and its SH, of those by the colour that a camera sees.

    The direction from the camera to a splat is held constant.

    Args:
        center: (N, 3) float32 centres, in the space of the spherical harmonics.
        eye: (3,) position of the camera, in that space.
        coefficients: K, of degree 1 and above: 0, 3, 8 or 15.
        rgb: (N, 3) colours that the camera sees, of `shade`.
        by_rgb: (N, 3) float32 derivatives by these.

    Returns:
        (N, 3) by `Splats.rgb` and (N, K, 3) by `Splats.sh`, float32; 0 where the colour was clamped to 0.
    """
    by_color = np.where(rgb > 0, by_rgb, np.float32(0))
    found = np.empty((len(center), coefficients, 3), np.float32)
    if coefficients:
        sh_gradients(len(center), center, np.asarray(eye, np.float32), by_color, found)
    return by_color, found
