"""Cameras, viewers and scenes of simulations, and the rows of their frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.model.instances import Instance
from sparklod_cli.simulation.frames import Simulation
from sparklod_cli.tables.columns import Row
from sparklod_cli.viewers.loaded_scene import TRAVERSED
from sparklod_cli.viewers.scenes import Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, StreamingSettings
from tests.conftest import FIXTURES
from tests.lod.trees import row_of_regions, transform
from tests.part_files import write_streamed

TOWN, HAND = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
SPARK = Cones(90, 120, 0.4, 0.2)
UP = (0.0, -1.0, 0.0)
#: Cells that depend on earlier frames.
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


def flight(frames: int = 12, seconds: float = 6.0) -> CameraPath:
    """Along the row of regions, from its beginning to its end."""
    steps = zip(np.linspace(-6, 16, frames), np.linspace(0, seconds, frames), strict=True)
    return path_of([Camera.look_at([0, 0, z], [0, 0, 40], size=(64, 48), time=time) for z, time in steps])


def rows_of(
    scenes: Scenes,
    settings: LodSettings,
    path: CameraPath,
    streaming: StreamingSettings | None = None,
    *,
    by_instance: bool = False,
    threads: int = 1,
) -> list[Any]:
    simulation = Simulation(scenes, settings, streaming)
    return [row for frame in simulation.run(path, by_instance=by_instance, threads=threads) for row in frame.rows]


def without(row: Row, names: set[str]) -> Row:
    return {name: cell for name, cell in row.items() if name not in names}


#: Cuts of viewers, and the networks and caches of their chunks.
VIEWERS = [
    (LodSettings(20_000, SPARK), StreamingSettings()),
    (LodSettings(2_000, Cones()), StreamingSettings(chunk_cache=2)),
    (LodSettings(3, SPARK), StreamingSettings()),
    (LodSettings(10**9, SPARK, render_scale=40.0), StreamingSettings()),
    (LodSettings(10**9, Frustum(0.2, 0.1), pixel_scale_limit=0.1), StreamingSettings()),
    (LodSettings(1_000_000, Cones()), StreamingSettings()),
    (LodSettings(20_000, SPARK), StreamingSettings(Network(1e6, 0.03), chunk_cache=3)),
    (LodSettings(20_000, SPARK), StreamingSettings(Network(3e4, 0.1, 1))),
]


@pytest.fixture(scope="package")
def town() -> Scenes:
    """165,205 nodes in three chunks."""
    return read_scenes([Instance(TOWN, "town")], columns=TRAVERSED, trees_only=True)


@pytest.fixture(scope="package")
def rad_town(tmp_path_factory: pytest.TempPathFactory) -> Scenes:
    """The town as RAD."""
    path = tmp_path_factory.mktemp("rad") / "town.rad"
    path.write_bytes(b"".join(rad.encode(read_scene(TOWN))))
    return read_scenes([Instance(path, "town")], columns=TRAVERSED, trees_only=True)


@pytest.fixture(scope="package")
def three() -> Scenes:
    """The town twice, once turned and larger, and a small tree."""
    return read_scenes(
        [
            Instance(TOWN, "here"),
            Instance(TOWN, "there", transform(np.random.default_rng(1), scale=1.5, spread=3), 0.5, Frustum(0.3, 0.1)),
            Instance(HAND, "hand"),
        ],
        columns=TRAVERSED,
        trees_only=True,
    )


@pytest.fixture(scope="package")
def regions(tmp_path_factory: pytest.TempPathFactory) -> Scenes:
    """Six regions along z at three levels; two of them share a chunk file."""
    manifest = write_streamed(tmp_path_factory.mktemp("row"), row_of_regions(environment=5))
    return read_scenes([Instance(manifest, "row")])
