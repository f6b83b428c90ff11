"""Paths of cameras to make figures of, and the pixels of pictures."""

from __future__ import annotations

import io
import math

import numpy as np
from PIL import Image

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.figures.charts import PathScene, plot
from sparklod_cli.simulation.results import Extremes, add_extremes, moments_of
from sparklod_cli.tables.columns import Row, totals
from tests.scenes import random_splats

SIZE = (400, 250)


def looking(position: tuple[float, float, float], up: tuple[float, float, float] = (0, -1, 0)) -> Camera:
    """A camera that looks at the origin."""
    forward = -np.array(position) / np.linalg.norm(position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(right, forward), -forward], 1)
    pose[:3, 3] = position
    focal = 450 / math.tan(math.radians(25))
    return Camera(pose, 1600, 900, (focal, focal), (800, 450))


def circle(count: int = 20, radius: float = 6) -> list[Camera]:
    angles = np.linspace(0, 4, count)
    return [looking((radius * math.cos(angle), -2, radius * math.sin(angle))) for angle in angles]


def path_scene(frame: int | None = 3) -> PathScene:
    splats = random_splats(500)
    return PathScene(circle(), splats, np.arange(500) // 100, frame)


def marked(rows: list[Row]) -> dict[str, int]:
    """The frames worth a look, as `traverse --plot` marks them."""
    most: Extremes = {}
    for number, row in enumerate(totals(rows)):
        add_extremes(most, row, is_first=number == 0)
    return {moment.criterion: moment.frame for moment in moments_of(most)}


def plotted(rows: list[Row], title: str = "scene.spz", path_scene: PathScene | None = None) -> tuple[bytes, str | None]:
    """The plot of `traverse --plot`."""
    return plot(rows, marked(rows), title, path_scene)


def pixels(png: bytes) -> np.ndarray:
    image = Image.open(io.BytesIO(png))
    assert image.format == "PNG"
    return np.asarray(image.convert("RGB")).astype(int)


def count_of(image: np.ndarray, color: str, within: int = 12) -> int:
    """How many pixels are of a colour."""
    wanted = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
    return int((np.abs(image - wanted).max(axis=2) <= within).sum())
