"""Splats, cameras and sceneries to draw in tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.splats import Splats
from sparklod_cli.scenery import Scenery, Source
from sparklod_cli.world import Placement


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


def plain(*parts: Splats) -> Scenery:
    """Splats of files that have no tree."""
    sources, chunks = [], 0
    for part in parts:
        sources.append(Source(part, None, np.arange(len(part)), chunks))
        chunks += sources[-1].chunks
    return Scenery([Placement(Path(f"{number}.ply"), str(number)) for number in range(len(parts))], sources, None)
