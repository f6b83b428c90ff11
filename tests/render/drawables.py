"""Splats, cameras and scenes to draw in tests."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import ShadedSplats
from sparklod_cli.viewers.scenes import CutFinder, read_scenes

COLUMNS = [field.name for field in dataclasses.fields(ShadedSplats)]


def balls(*centers: tuple[float, float, float], size: object = 0.3, opacity: object = 1.0, rgb: object = 1.0) -> Splats:
    """Round splats; size, opacity and colour are of all, or of each."""
    splats = Splats.zeros(len(centers), 0)
    splats.center[:] = centers
    splats.scale[:] = size
    splats.quat_xyzw[:, 3] = 1
    splats.opacity[:] = opacity
    splats.rgb[:] = rgb
    return splats


def plain(*parts: Splats) -> CutFinder:
    """Scenes without trees, in full."""
    instances = [Instance(Scene(part), str(number)) for number, part in enumerate(parts)]
    return CutFinder(read_scenes(instances), None)


def shown(
    count: int,
    *,
    seed: int = 0,
    scale: float = 0.08,
    spread: float = 0.7,
    sigma: float = 0.8,
    most: float = 1.0,
    brightest: float = 1.3,
) -> ShadedSplats:
    """Splats around the origin: D up to `most`; a `sigma` of 2, of the logarithms of scales, has needles and discs."""
    rng = np.random.default_rng(seed)
    f32 = np.float32
    return ShadedSplats(
        center=rng.normal(0, spread, (count, 3)).astype(f32),
        scale=(scale * np.exp(rng.normal(0, sigma, (count, 3)))).astype(f32),
        quat_xyzw=normalized_quat(rng.normal(size=(count, 4)).astype(f32)),
        lod_opacity=rng.uniform(0, most, count).astype(f32),
        rgb=rng.uniform(0, brightest, (count, 3)).astype(f32),
    )


def one(center: tuple[float, float, float], scale: float, d: float, rgb: tuple[float, float, float]) -> ShadedSplats:
    columns = [center, (scale, scale, scale), (0, 0, 0, 1), d, rgb]
    return ShadedSplats(*(np.array([column], np.float32) for column in columns))


def joined(*parts: ShadedSplats) -> ShadedSplats:
    return ShadedSplats(*(np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS))


def rows(of: ShadedSplats, index: np.ndarray | slice) -> ShadedSplats:
    return ShadedSplats(*(getattr(of, name)[index].copy() for name in COLUMNS))


def camera(width: int = 64, height: int = 48, z: float = 5.0) -> Camera:
    """At (0, 0, z), looking at the origin, with y up."""
    pose = np.eye(4)
    pose[2, 3] = z
    focal = height / (2 * np.tan(np.radians(30)))
    return Camera(pose, width, height, (focal, focal), (width / 2, height / 2))


def camera_at(
    eye: tuple[float, ...] = (0.3, -0.5, 4.0),
    *,
    size: tuple[int, int] = (57, 41),
    focal: tuple[float, float] = (60.0, 52.0),
    principal: tuple[float, float] | None = None,
    target: tuple[float, ...] = (0, 0, 0),
) -> Camera:
    """Looks at the origin; y is down in the world."""
    return Camera(look_at(eye, target, (0, -1, 0)), *size, focal, principal or (size[0] / 2, size[1] / 2))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    error = float(np.mean((image.astype(np.float64) - reference) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)
