"""A bake out of core makes the file, the report and the errors of a bake in memory."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import Baked, BakeSettings, Resources
from sparklod_cli.codecs import ply
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.splats import Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import InvalidSplatsError
from tests.bake.out_of_core.plain import Loop
from tests.conftest import FIXTURES, real_scene
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

#: What differs by nature: how long it took, and what was in the scratch folder.
OWN = {"seconds", "blocks", "scratch_bytes_written", "scratch_bytes_read"}

COUNT = 900

SETTINGS: dict[str, dict[str, Any]] = {
    "plain": {},
    "another base": {"base": 1.3},
    "without harmonics": {"max_sh": 0},
    "with fewer harmonics": {"max_sh": 1},
    "in a ball": {"selection": Selection(within=((0.0, 0.0, 0.0), 0.8))},
    "a single one": {"selection": Selection(within=((0.0, 0.0, 0.0), 1e-9))},
    "in a box": {"selection": Selection(min_box=(-1.0, -1.0, -1.0), max_box=(0.5, 0.5, 0.5), min_opacity=0.3)},
    "turned": {"transform": Transform.from_parts(up="z", rotate=(10, 20, 30), scale=3.0, translate=(1, 2, 3))},
}


def file_of(folder: Path, splats: Splats) -> Path:
    path = folder / "scene.ply"
    path.write_bytes(b"".join(ply.encode(Scene(splats))))
    return path


def both(source: Path, folder: Path, how: BakeSettings, block: int) -> tuple[Baked, Baked]:
    """Bakes in memory and out of core; the files are the same."""
    places = [folder / f"{name}{how.suffix}" for name in ("memory", "blocks")]
    found = [
        bake(source, place, how, resources=resources)
        for place, resources in zip(places, (None, Resources(block_splats=block)), strict=True)
    ]
    assert places[0].read_bytes() == places[1].read_bytes()
    plain, blocks = ({key: value for key, value in vars(one).items() if key not in OWN} for one in found)
    assert plain == blocks
    assert sorted(path.name for path in folder.iterdir() if "scratch" in path.name) == []
    return found[0], found[1]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with harmonics, some of whose splats cannot be seen, and one at the origin."""
    splats = random_splats(COUNT, sh_degree=2, seed=5)
    splats.opacity[::7] = 0
    splats.scale[::11] = 0
    splats.center[100] = 0
    return file_of(tmp_path_factory.mktemp("scene"), splats)


@pytest.mark.parametrize("name", SETTINGS)
def test_quick_makes_the_same_file(name: str, scene: Path, tmp_path: Path) -> None:
    suffix = ".rad" if len(name) % 2 else ".spz"
    _, blocks = both(scene, tmp_path, BakeSettings(suffix=suffix, **SETTINGS[name]), 100)
    assert blocks.blocks is not None
    assert (blocks.blocks > 1) == (blocks.splats > 100)


def test_quick_makes_the_same_file_with_colours_of_another(scene: Path, tmp_path: Path) -> None:
    colours = tmp_path / "rgba.bin"
    colours.write_bytes(np.random.default_rng(0).integers(0, 256, (COUNT, 4), np.uint8).tobytes())
    both(scene, tmp_path, BakeSettings(rgba=colours), 100)


@pytest.mark.parametrize("name", ["coincident.ply", "one.ply", "huge.ply", "sh3.ply"])
def test_quick_makes_the_same_file_of_hard_scenes(name: str, tmp_path: Path) -> None:
    source = FIXTURES / name
    both(source, tmp_path, BakeSettings(suffix=".rad"), 1 + len(read_scene(source)) // 8)


@pytest.mark.parametrize("name", ["playbot-125k.ply", "biker.spz"])
def test_quick_makes_the_same_file_of_real_scenes(name: str, tmp_path: Path) -> None:
    both(real_scene(name), tmp_path, BakeSettings(suffix=".rad"), 30_000)


def spoiled(**columns: Any) -> Splats:
    """A scene with a few other values."""
    splats = random_splats(COUNT, seed=6)
    for name, rows in columns.items():
        for row, value in rows.items():
            getattr(splats, name)[row] = value
    return splats


BAD = {
    "not finite": (spoiled(center={700: np.nan, 701: np.inf}), {}),
    "of several kinds": (spoiled(center={350: np.nan}, rgb={777: np.inf}), {}),
    "nothing left": (spoiled(), {"selection": Selection(min_box=(1e6, 1e6, 1e6))}),
    "invisible": (dataclasses.replace(spoiled(), opacity=np.zeros(COUNT, np.float32)), {}),
    "beyond float32": (spoiled(), {"transform": Transform(scale=1e12, translation=(1e12, 0, 0))}),
    "empty": (random_splats(0), {}),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_baked_is_refused_in_the_same_words(name: str, tmp_path: Path) -> None:
    splats, how = BAD[name]
    if name == "beyond float32":
        splats = dataclasses.replace(splats, center=splats.center * np.float32(1e30))
    source, said = file_of(tmp_path, splats), []
    for resources in (None, Resources(block_splats=100)):
        with pytest.raises(InvalidSplatsError) as error:
            bake(source, tmp_path / "out.spz", BakeSettings(**how), resources=resources)
        said.append(str(error.value))
    assert said[0] == said[1]
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_invalid_splats_are_dropped_and_counted(tmp_path: Path) -> None:
    source = file_of(tmp_path, spoiled(center={5: np.nan, 700: np.inf}, opacity={6: 0}))
    both(source, tmp_path, BakeSettings(selection=Selection(drop_invalid=True)), 100)


def test_quality_makes_one_file_whatever_the_order_of_tasks_and_threads(tmp_path: Path) -> None:
    source, found = file_of(tmp_path, random_splats(4 * COUNT, sh_degree=1, seed=7)), set()
    for number, threads in enumerate((1, 2, 3)):
        place = tmp_path / f"{number}.spz"
        engine = Loop(np.random.default_rng(number), threads)
        baked = bake(
            source, place, BakeSettings(method="quality"), resources=Resources(block_splats=COUNT), engine=engine
        )
        assert (baked.blocks, baked.splats) == (4, 4 * COUNT)
        found.add(place.read_bytes())
    assert len(found) == 1
