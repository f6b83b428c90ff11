"""Splats, cameras and scenes to draw in tests."""

from __future__ import annotations

import numpy as np

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.viewers.scenes import CutFinder, read_scenes


def balls(*centers: tuple[float, float, float], size: float = 0.3, opacity: float = 1.0, rgb: object = 1.0) -> Splats:
    """Round splats of one size and opacity; `rgb` is of all, or of each."""
    splats = Splats.zeros(len(centers), 0)
    splats.center[:] = centers
    splats.scale[:] = size
    splats.quat_xyzw[:, 3] = 1
    splats.opacity[:] = opacity
    splats.rgb[:] = rgb
    return splats


def camera(width: int = 64, height: int = 48, z: float = 5.0) -> Camera:
    """At (0, 0, z), looking at the origin, with y up."""
    pose = np.eye(4)
    pose[2, 3] = z
    focal = height / (2 * np.tan(np.radians(30)))
    return Camera(pose, width, height, (focal, focal), (width / 2, height / 2))


def plain(*parts: Splats) -> CutFinder:
    """Scenes without trees, in full."""
    instances = [Instance(Scene(part), str(number)) for number, part in enumerate(parts)]
    return CutFinder(read_scenes(instances), None)
