"""Files that note which axis points up are, to the programs of others, the same files as without."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli import write
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.render.render_settings import RasterSettings
from tests.interop.foreign import Foreign
from tests.interop.page import Page
from tests.interop.pictures import cameras_around
from tests.interop.spark import Spark
from tests.scenes import random_splats

pytestmark = pytest.mark.slow


def both(folder: Path, suffix: str, scene: Scene) -> list[Path]:
    """A file without the axis and one with it, which differ."""
    paths = [folder / f"without{suffix}", folder / f"with{suffix}"]
    for path, up in zip(paths, (None, "y"), strict=True):
        write(path, replace(scene, up=up))
        assert read_scene(path).up == up
    return paths


@pytest.fixture(scope="module")
def splats() -> Splats:
    return random_splats(300, sh_degree=1)


@pytest.mark.parametrize("lod", [False, True])
@pytest.mark.parametrize("suffix", [".spz", ".rad", ".ply"])
def test_spark_reads_the_same_words(spark: Spark, splats: Splats, suffix: str, lod: bool, tmp_path: Path) -> None:
    if lod and suffix == ".ply":
        pytest.skip("PLY holds no tree")
    without, noted = both(tmp_path, suffix, Scene(*quick.build(splats)) if lod else Scene(splats))
    expected, found = (spark.load_words("Ext", path) for path in (without, noted))
    assert found.keys() == expected.keys()
    for name, words in expected.items():
        np.testing.assert_array_equal(found[name], words, name)


def test_spark_draws_the_same_picture_in_a_browser(page: Page, splats: Splats, tmp_path: Path) -> None:
    camera, settings = cameras_around(splats.center, 64, 48)[0], RasterSettings()
    pictures = []
    for path in both(tmp_path, ".rad", Scene(*quick.build(splats))):
        page.open(path, camera, settings, pages=4)
        pictures.append(page.draw(camera, settings, budget=1_000).rounded)
    assert pictures[0][..., :3].max() > 0.1
    np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("suffix", [".spz", ".ply", ".sog"])
def test_splat_transform_reads_the_same_splats(foreign: Foreign, splats: Splats, suffix: str, tmp_path: Path) -> None:
    without, noted = (foreign.read(path) for path in both(tmp_path, suffix, Scene(splats)))
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(noted, name), getattr(without, name), name)
