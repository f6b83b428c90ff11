"""Spark shows trees with other merged splats, as `--refine` writes them, as sparklod's rasterizer does."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.render.render_settings import RasterSettings
from tests.fittings import StandIn
from tests.fittings import stand_in as stand_in
from tests.interop.page import Page
from tests.interop.pictures import cameras_around, compare
from tests.interop.test_pictures import LEAST_SH, check, demo, written
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

SIZE = 240, 136


def built(folder: Path, name: str, source: Path, *options: str) -> Path:
    assert run(["build-lod", str(source), "--quiet", "-o", str(folder / name), *options]) == 0
    return folder / name


def test_spark_draws_cuts_of_a_refined_tree_as_we_do(page: Page, tmp_path: Path, stand_in: StandIn) -> None:
    """Of a cut of 300 nodes most are merged splats."""
    refined = built(tmp_path, "refined.rad", written(tmp_path, Scene(demo())), "--method", "quality", "--refine")
    assert len(stand_in.calls) == 1
    cameras = cameras_around(read_scene(refined).splats.center, *SIZE)
    check(compare(page, refined, cameras[1:2], RasterSettings(), 300))
    check(compare(page, refined, cameras[3:4], RasterSettings(), 2_000))


def test_spark_draws_a_refined_lod_file_as_we_do(page: Page, tmp_path: Path, stand_in: StandIn) -> None:
    """A tree of SH degree 3, which is refined as it stands in its file."""
    tree = Scene(*quick.build(random_splats(2_000, sh_degree=3)))
    refined = built(tmp_path, "refined.spz", written(tmp_path, tree), "--refine")
    splats = read_scene(refined).splats
    assert len(stand_in.calls) == 1 and splats.sh.shape[1] == 15
    found = compare(page, refined, cameras_around(splats.center, *SIZE)[1:2], RasterSettings(), 1_000)
    check(found, **LEAST_SH)
