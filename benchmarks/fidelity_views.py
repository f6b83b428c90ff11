"""Cameras of `bench_fidelity.py`, and how far pictures of trees and of other splats are from full detail there."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import sparklod_cli as sparklod
from sparklod_cli.api.comparison import PicturePair, measured, rows_by_budget
from sparklod_cli.images.metrics import BACKGROUNDS, edges
from sparklod_cli.tables.columns import Row

#: Width and height, pixels, and the vertical field of view, degrees.
SIZE, FOV_Y = (960, 540), 60.0

#: The ball that cameras go around holds this share of the splats; so many splats are looked at to find it.
SHARE, SAMPLE = 0.9, 1 << 18

#: Cameras of a path that moves: how many, degrees from one to the next around the scene, and how much closer each is.
STEPS, TURN, CLOSER = 30, 0.5, 0.99

#: Budgets at which paths that move are measured.
OF_PATHS = ("5%", "25%")

#: A picture, (height, width, 4).
Image = NDArray[np.float32]


@dataclass(frozen=True)
class Ball:
    """What cameras are placed by.

    Attributes:
        middle: x, y, z of the median of the centres.
        radius: within which `SHARE` of them are, world units.
    """

    middle: tuple[float, float, float]
    radius: float

    @classmethod
    def of(cls, scene: sparklod.Scene) -> Ball:
        """The ball of a scene."""
        center = scene.splats.center[:: max(len(scene) // SAMPLE, 1)].astype(np.float64)
        middle = np.median(center, axis=0)
        x, y, z = middle.tolist()
        return cls((x, y, z), float(np.quantile(np.linalg.norm(center - middle, axis=1), SHARE)))

    def at(self, turn: float, elevation: float, distance: float) -> tuple[float, float, float]:
        """A point, -y being up: radians around and above the middle, and radii away from it."""
        flat = math.cos(elevation)
        away = (flat * math.sin(turn), -math.sin(elevation), -flat * math.cos(turn))
        x, y, z = (at + distance * self.radius * way for at, way in zip(self.middle, away, strict=True))
        return x, y, z


#: A place and what it looks at.
View = tuple[tuple[float, float, float], tuple[float, float, float]]


def _circle(distance: float, degrees: float) -> Callable[[Ball], list[View]]:
    """Six cameras around the middle, so many radii away and degrees above it."""
    elevation = math.radians(degrees)
    return lambda ball: [(ball.at(math.pi * k / 3, elevation, distance), ball.middle) for k in range(6)]


def _around(ball: Ball) -> list[View]:
    return [*_circle(1.6, 15)(ball), *_circle(3.5, 15)(ball)]


def _inside(ball: Ball) -> list[View]:
    """A third of a radius from the middle, looking away from it and past it."""
    views = []
    for k in range(6):
        eye = ball.at(math.pi * k / 3, 0.1, 1 / 3)
        views += [(eye, ball.at(math.pi * k / 3, 0.0, 2)), (eye, ball.at(math.pi * k / 3 + 2.4, 0.0, 1))]
    return views


def _orbit(ball: Ball) -> list[View]:
    return [(ball.at(math.radians(20 + TURN * k), math.radians(15), 1.6), ball.middle) for k in range(STEPS)]


def _dolly(ball: Ball) -> list[View]:
    return [(ball.at(math.radians(20), math.radians(15), 1.9 * CLOSER**k), ball.middle) for k in range(STEPS)]


#: Sets of cameras by name; those of `MOVING` are frames of a movement.
CAMERAS = {
    "around": _around,
    "near": _circle(0.8, 5),
    "inside": _inside,
    "above": _circle(1.6, 60),
    "orbit": _orbit,
    "dolly": _dolly,
}
MOVING = ("orbit", "dolly")


def cameras_of(name: str, scene: sparklod.Scene, size: tuple[int, int] = SIZE) -> list[sparklod.Camera]:
    """Return a set of cameras for a scene whose up is -y, a thirtieth of a second after each other."""
    views = CAMERAS[name](Ball.of(scene))
    return [
        sparklod.Camera.look_at(eye, target, fov_y=FOV_Y, size=size, time=at / 30)
        for at, (eye, target) in enumerate(views)
    ]


def that_see(cameras: Sequence[sparklod.Camera], scene: sparklod.Scene) -> list[sparklod.Camera]:
    """Return the cameras whose pictures are not empty: inside an object that stands alone, some are."""
    return [camera for camera in cameras if sparklod.render(scene, camera)[..., 3].any()]


def count_of(budget: str, leaves: int) -> int:
    """Splats of a budget such as "5%" or "5000"."""
    return max(1, int(float(budget[:-1]) * leaves / 100)) if budget.endswith("%") else int(budget)


def difference(image: Image, full: Image) -> float:
    """PSNR in dB, mean of the backgrounds."""
    return statistics.mean(sparklod.psnr(image, full, background=gray) for gray in BACKGROUNDS.values())


@dataclass(frozen=True)
class Figures:
    """What the pictures of one budget come to.

    Attributes:
        psnr: dB, mean of cameras and backgrounds.
        ssim: mean.
        edge_psnr: dB; None where no picture has edges.
        popping, popping_max: steps of 8 bits, mean and most; None for cameras that do not move.
        psnr_of_cameras: dB, means of the backgrounds.
    """

    psnr: float
    ssim: float
    edge_psnr: float | None
    popping: float | None
    popping_max: float | None
    psnr_of_cameras: list[float]

    @classmethod
    def of(cls, rows: Sequence[Row]) -> Figures:
        """The figures of the rows of a comparison, one for each camera."""

        def of(name: str) -> list[float]:
            return [value for row in rows if isinstance(value := row[name], (int, float))]

        def mean(name: str) -> float | None:
            return statistics.mean(values) if (values := of(name)) else None

        psnr = of("psnr")
        most = max(of("popping"), default=None)
        edge, popping = mean("edge_psnr"), mean("popping")
        return cls(statistics.mean(psnr), statistics.mean(of("ssim")), edge, popping, most, psnr)


def of_tree(
    tree: sparklod.Tree, full: sparklod.Scene, cameras: Sequence[sparklod.Camera], budgets: Sequence[str]
) -> dict[str, Figures]:
    """By budget, how far cuts of a tree are from full detail; nodes have the precision that Spark holds."""
    settings = sparklod.LodSettings(foveation=sparklod.Cones(), pixel_scale_limit=0.0)
    table = sparklod.compare(tree, full, cameras, budgets=budgets, settings=settings, precision="float16")
    groups = rows_by_budget(table.rows, len(budgets))
    return {budget: Figures.of(rows) for budget, rows in zip(budgets, groups, strict=True)}


class FullDetail:
    """Pictures of a scene from some cameras, and how far others are from them.

    Args:
        scene: as it is drawn.
        cameras: that do not move.
    """

    def __init__(self, scene: sparklod.Scene, cameras: Sequence[sparklod.Camera]) -> None:
        self._cameras = cameras
        self._pictures: list[Image] = [sparklod.render(scene, camera) for camera in cameras]
        self._edges = [edges(picture) for picture in self._pictures]

    def of_scene(self, scene: sparklod.Scene) -> Figures:
        """How far pictures of all splats of another scene are from it."""
        rows = []
        for number, (camera, full, where) in enumerate(zip(self._cameras, self._pictures, self._edges, strict=True)):
            known: Row = {"frame": number, "time_s": camera.time, "selected": len(scene)}
            rows.append(measured(PicturePair(known, sparklod.render(scene, camera), full, where, None)))
        return Figures.of(rows)
