"""Where the camera of a page starts, and how large the scene is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras import framing
from ..cameras.camera import Camera
from ..cameras.defaults import ELEVATION
from ..cameras.frame import DEFAULT_FOV_Y, Settings
from ..cameras.sources import Views, WholeScene
from ..io import examine_scene
from ..model.balls import Balls, balls_of
from ..support.errors import InvalidSplatsError, SparklodError
from ..support.progress import Progress, silent
from .files import ShownFile

#: x, y and z in world units.
Point = tuple[float, float, float]

#: Width and height of the picture that the first look is framed for; the page steps back where its window is narrower.
FRAME = (1280, 720)

#: Vertical field of view where none is given, degrees.
FOV = round(math.degrees(DEFAULT_FOV_Y), 9)


@dataclass(frozen=True)
class Extent:
    """What a file holds.

    Attributes:
        splats: how many, nodes where it is a tree.
        leaves: how many of a tree; None without one.
        balls: what its splats cover; only the coarsest of a large RAD tree.
    """

    splats: int
    leaves: int | None
    balls: Balls


@dataclass(frozen=True)
class Start:
    """The first look at the scene.

    Attributes:
        eye, target: of the camera, world units.
        fov: vertical field of view, degrees.
        center: the middle of the scene, world units.
        radius: of a ball around the middle that most splats are in, world units.
        chosen: the view was chosen for the scene, not given.
    """

    eye: Point
    target: Point
    fov: float
    center: Point
    radius: float
    chosen: bool


def extent_of(shown: ShownFile, *, threads: int = 1, progress: Progress = silent) -> Extent:
    """What a file holds.

    Raises:
        SparklodError: it is broken; the text names it.
    """
    try:
        scene = examine_scene(shown.path, columns=("center", "scale"), threads=threads, progress=progress)
    except SparklodError as error:
        raise type(error)(f"{shown.path}: {error}") from None
    leaves = None if scene.tree is None else np.flatnonzero(scene.tree.is_leaf)
    index = slice(None) if leaves is None else leaves
    return Extent(
        len(scene.splats), None if leaves is None else len(leaves), balls_of(scene.splats, index, np.eye(4))
    )


def start_of(extents: Sequence[Extent], view: tuple[Point, Point] | None, up: Point, fov: float) -> Start:
    """The first look at some files together.

    Args:
        extents: of the files.
        view: eye and target, where they are given; else the whole scene is in view, from its front.
        up: direction that is up.
        fov: vertical field of view, degrees.

    Raises:
        CameraPathError: the camera makes no sense.
    """
    balls = Balls.concat(extent.balls for extent in extents)
    settings = Settings(size=FRAME, fov_y=math.radians(fov), up=up)
    try:
        middle, radius = framing.framing(balls.center)
    except InvalidSplatsError:  # nothing that could be framed
        middle, radius, view = np.zeros(3), 1.0, view or ((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    source = WholeScene(ELEVATION) if view is None else Views((view,))
    (camera,) = source.cameras(settings, lambda: balls).cameras
    target = view[1] if view is not None else _ahead(camera, middle)
    return Start(_point(camera.position), _point(target), fov, _point(middle), radius, view is None)


def _ahead(camera: Camera, middle: framing.Matrix) -> framing.Matrix:
    """The point on the axis of a camera that is nearest to the middle of the scene."""
    away = float((middle - camera.position) @ camera.forward)
    point: framing.Matrix = camera.position + camera.forward * (away if away > 0 else 1.0)
    return point


def _point(values: Sequence[float] | framing.Matrix) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z
