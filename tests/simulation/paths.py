"""Cameras and viewers to simulate, and the rows that come of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.simulation.frames import Simulation
from sparklod_cli.tables.columns import Row
from sparklod_cli.viewers.scenes import Scenes
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, StreamingSettings
from tests.conftest import FIXTURES

TOWN, HAND = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
SPARK = Cones(90, 120, 0.4, 0.2)
UP = (0.0, -1.0, 0.0)
#: Cells of which a frame by itself knows nothing.
OF_THE_PAST = {"added", "removed", "churn", "chunks_new", "bytes_new", "chunks_resident", "traverse_ms"}


def camera(
    eye: Sequence[float],
    target: Sequence[float] = (0, 0, 0),
    *,
    fov: float = 60.0,
    size: tuple[int, int] = (640, 360),
    time: float = 0.0,
) -> Camera:
    focal = size[1] / (2 * math.tan(math.radians(fov) / 2))
    return Camera(look_at(eye, target, UP), *size, (focal, focal), (size[0] / 2, size[1] / 2), time)


def path_of(cameras: Sequence[Camera]) -> CameraPath:
    return CameraPath(tuple(cameras), "a test", (), tuple(range(len(cameras))))


def around(count: int, distance: float = 3.0, seconds: float = 1.0) -> CameraPath:
    turns = 2 * math.pi * np.arange(count) / count
    return path_of(
        [
            camera((distance * math.sin(turn), -1, -distance * math.cos(turn)), time=seconds * number / count)
            for number, turn in enumerate(turns)
        ]
    )


def resting(count: int, fps: float = 30.0) -> CameraPath:
    return path_of([camera((1.0, -1.0, -2.0), time=number / fps) for number in range(count)])


def rows_of(
    scenes: Scenes,
    settings: LodSettings,
    path: CameraPath,
    streaming: StreamingSettings | None = None,
    *,
    by_instance: bool = False,
    threads: int = 1,
) -> list[Row]:
    simulation = Simulation(scenes, settings, streaming)
    return [row for frame in simulation.run(path, by_instance=by_instance, threads=threads) for row in frame.rows]


def without(row: Row, names: set[str]) -> Row:
    return {name: cell for name, cell in row.items() if name not in names}


def viewers() -> list[tuple[LodSettings, StreamingSettings]]:
    """What is drawn, and how it gets there."""
    there = StreamingSettings()
    return [
        (LodSettings(20_000, SPARK), there),
        (LodSettings(2_000, Cones()), StreamingSettings(chunk_cache=2)),
        (LodSettings(3, SPARK), there),
        (LodSettings(10**9, SPARK, render_scale=40.0), there),
        (LodSettings(10**9, Frustum(0.2, 0.1), pixel_scale_limit=0.1), there),
        (LodSettings(1_000_000, Cones()), there),
        (LodSettings(20_000, SPARK), StreamingSettings(Network(1e6, 0.03), chunk_cache=3)),
        (LodSettings(20_000, SPARK), StreamingSettings(Network(3e4, 0.1, 1))),
    ]
