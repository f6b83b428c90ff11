"""Draws splats as Spark's shaders do, each over the whole picture, in float64."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import ShadedSplats
from sparklod_cli.render.render_settings import RasterSettings
from tests.references.gaussians import covariance


def spherical_harmonics(direction: np.ndarray, degree: int) -> list[float]:
    """Returns real spherical harmonics from degree 1 at a direction, with the Condon-Shortley sign."""
    x, y, z = direction / np.linalg.norm(direction)
    azimuth, sine = math.atan2(y, x), math.hypot(x, y)
    found = []
    for at in range(1, degree + 1):
        for order in range(-at, at + 1):
            m = abs(order)
            norm = math.sqrt((2 * at + 1) / (4 * math.pi) * math.factorial(at - m) / math.factorial(at + m))
            legendre = (-sine) ** m * np.polynomial.legendre.Legendre.basis(at).deriv(m)(z)
            wave = 1 if not order else math.sqrt(2) * (math.cos if order > 0 else math.sin)(m * azimuth)
            found.append(float(norm * legendre * wave))
    return found


def seen_rgb(splats: Splats, eye: np.ndarray) -> np.ndarray:
    """Returns (N, 3) colours of splats as seen from a point."""
    degree = math.isqrt(splats.sh.shape[1] + 1) - 1
    seen = splats.rgb.astype(np.float64)
    for color, center, sh in zip(seen, splats.center, splats.sh, strict=True):
        color += np.array(spherical_harmonics(center - eye, degree)) @ sh if degree else 0
    return np.maximum(seen, 0)


@dataclass
class Drawn:
    """A picture that `picture` drew.

    Attributes:
        rgba: (height, width, 4) float64, premultiplied by alpha.
        unsure: (height, width) whether a splat ends so near to the pixel that float32 may decide otherwise.
        where: by the index of each splat that is drawn, from far to near, (height, width) whether it is there.
    """

    rgba: np.ndarray
    unsure: np.ndarray
    where: dict[int, np.ndarray]


def picture(splats: ShadedSplats, camera: Camera, settings: RasterSettings, held: Drawn | None = None) -> Drawn:
    """Draws splats from far to near, each over the whole picture.

    Args:
        held: a picture of the same splats before a small change: they are drawn in its order and end where its do.
    """
    to_camera = np.linalg.inv(camera.camera_to_world)
    (fx, fy), (cx, cy), width, height = camera.focal, camera.principal, camera.width, camera.height
    centers = splats.center.astype(np.float64) @ to_camera[:3, :3].T + to_camera[:3, 3]
    turned = to_camera[:3, :3] @ covariance(splats.scale, splats.quat_xyzw) @ to_camera[:3, :3].T
    key = np.linalg.norm(centers, axis=1) if settings.sort == "radial" else -centers[:, 2]
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    rgba, unsure = np.zeros((height, width, 4)), np.zeros((height, width), bool)
    where: dict[int, np.ndarray] = {}
    for i in np.argsort(-key, kind="stable") if held is None else held.where:
        (x, y, z), d = centers[i], min(float(splats.lod_opacity[i]), 5)
        if not settings.near < -z < settings.far or not d >= 0.5 / 255:
            continue
        middle = np.array([cx - fx * x / z, cy + fy * y / z])
        if (abs(middle / (width, height) - 0.5) > 1.4 / 2).any():
            continue
        jacobian = np.array([[-fx / z, 0, fx * x / z**2], [0, fy / z, -fy * y / z**2]])
        flat = jacobian @ turned[i] @ jacobian.T
        blurred = flat + 0.3 * np.eye(2)
        strength = d * math.sqrt(max(np.linalg.det(flat) / np.linalg.det(blurred), 0))
        deviations = 8**0.5 + 0.7 * max(d - 1, 0)
        sizes, axes = np.linalg.eigh(blurred)
        reach = np.minimum(deviations * np.sqrt(sizes), 512)
        z2 = (((pixels - middle) @ axes * (deviations / reach)) ** 2).sum(axis=-1)
        alpha = _falloff(z2, strength, settings.profile)
        inside = z2 <= deviations**2
        unsure |= abs(z2 / deviations**2 - 1) < 2e-4
        unsure |= inside & (min(abs(strength * 255 - 0.5), 1) < 0.01)
        unsure |= inside & (abs(alpha * 255 - 0.5) < 0.01)
        where[i] = inside & (alpha >= 0.5 / 255) & (strength >= 0.5 / 255) if held is None else held.where[i]
        alpha = np.where(where[i], alpha, 0)[..., None]
        rgba = np.minimum(alpha * [*splats.rgb[i].astype(np.float64), 1], 1) + (1 - alpha) * rgba
    return Drawn(rgba, unsure, where)


def _falloff(z2: np.ndarray, d: float, profile: str) -> np.ndarray:
    if d <= 1:
        return d * np.exp(-z2 / 2)
    if profile == "shifted":
        return np.exp(-d / 2 * np.maximum(np.sqrt(z2) - (d - 1), 0) ** 2)
    return 1 - (1 - np.exp(-z2 / 2)) ** math.exp((d * d - 1) / math.e)
