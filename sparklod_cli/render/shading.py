"""`ShadedSplats`: splats as one camera sees them, which is what backends draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from ..cameras.camera import Camera, Matrix
from ..model.gaussian import lod_opacity, placed
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from .kernels.shade import add_sh


@dataclass(frozen=True)
class ShadedSplats:
    """N splats in the world, in the colours that a camera sees.

    Attributes:
        center: (N, 3) float32 world units.
        scale: (N, 3) float32 standard deviations, world units.
        quat_xyzw: (N, 4) float32 unit quaternions, local to world.
        lod_opacity: (N,) float32, Spark's D.
        rgb: (N, 3) float32, display-referred, at least 0.
    """

    center: FloatArray
    scale: FloatArray
    quat_xyzw: FloatArray
    lod_opacity: FloatArray
    rgb: FloatArray

    def __len__(self) -> int:
        return len(self.center)


def shade(parts: Sequence[tuple[Splats, Matrix]], camera: Camera) -> ShadedSplats:
    """Shade splats with their places, (4, 4) object to world, as a camera sees them.

    Spherical harmonics are those of the direction from the camera to a splat's centre, in the space of its object.
    """
    shaded = [_shade(splats, matrix, camera) for splats, matrix in parts]
    return ShadedSplats(
        **{field.name: np.concatenate([getattr(part, field.name) for part in shaded]) for field in fields(ShadedSplats)}
    )


def _shade(splats: Splats, matrix: Matrix, camera: Camera) -> ShadedSplats:
    rgb = splats.rgb.copy()
    if splats.sh.shape[1]:
        eye = np.linalg.solve(matrix, np.append(camera.position, 1))[:3].astype(np.float32)
        add_sh(len(rgb), splats.center, splats.sh, eye, COEFFICIENTS.index(splats.sh.shape[1]), rgb)
    np.maximum(rgb, 0, out=rgb)
    if not np.array_equal(matrix, np.eye(4)):
        splats = placed(splats, matrix)
    return ShadedSplats(splats.center, splats.scale, splats.quat_xyzw, lod_opacity(splats.opacity), rgb)
