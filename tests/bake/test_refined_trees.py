"""The laws of trees hold for those that `--refine` has fitted, in every format."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import Baked, BakeSettings
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cli import run
from sparklod_cli.codecs import spark_nodes
from sparklod_cli.codecs.formats import WRITABLE
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.fitting import fit, pictures
from sparklod_cli.fitting.settings import SHARES, FitSettings
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import same_rows
from sparklod_cli.system.output import write_file
from sparklod_cli.viewers.cut import Forest, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from tests.conftest import FIXTURES
from tests.lod.trees import check_tree, sorted_rows

#: Values that are written exactly, or nearly.
FLOATS = WriteOptions(rad=RadOptions("f32", "f32", "f32", "f32", "f32", "f32"))
SETTINGS = BakeSettings(method="quality", suffix=".rad", options=FLOATS)
REFINE = FitSettings(steps=100, seed=1)

#: Splats of the scene.
COUNT = 2_000


@pytest.fixture(scope="module", autouse=True)
def small_pictures() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "SIZE", (160, 90))
        patch.setattr(fit, "HELD_OUT", 4)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, small_pictures: None) -> Path:
    """A part of the demo scene, and its tree, in floats."""
    folder = tmp_path_factory.mktemp("refined")
    splats = read_scene(FIXTURES / "demo.ply").splats
    near = np.argsort(np.linalg.norm(splats.center - np.median(splats.center, axis=0), axis=1), kind="stable")
    scene = Scene(splats.take(np.sort(near[:COUNT])))
    write_file(folder / "scene.ply", WRITABLE[".ply"].codec().encode(scene), overwrite=False)
    bake(folder / "scene.ply", folder / "tree.rad", SETTINGS)
    return folder


@pytest.fixture(scope="module")
def baked(folder: Path) -> Baked:
    return bake(folder / "tree.rad", folder / "fitted.rad", dataclasses.replace(SETTINGS, refine=REFINE))


@pytest.fixture(scope="module")
def fitted(folder: Path, baked: Baked) -> Scene:
    return read_scene(folder / "fitted.rad")


def test_it_is_a_tree_of_the_same_leaves_and_most_merged_splats_are_new(folder: Path, fitted: Scene) -> None:
    before, plain = read_scene(folder / "tree.rad"), read_scene(folder / "scene.ply").splats
    assert fitted.tree is not None
    assert before.tree is not None
    leaves = fitted.splats.take(fitted.tree.is_leaf)
    check_tree(leaves, fitted.splats, fitted.tree)
    np.testing.assert_allclose(sorted_rows(leaves)[:, :3], sorted_rows(plain)[:, :3], atol=1e-6)
    assert np.array_equal(fitted.tree.child_start, before.tree.child_start)
    same = same_rows(fitted.splats, before.splats)
    assert same[before.tree.is_leaf].all()
    assert same[~before.tree.is_leaf].mean() < 0.5


def test_the_report_tells_of_no_budget_that_lost(baked: Baked) -> None:
    assert baked.refine is not None
    assert REFINE.steps is not None
    assert REFINE.steps / 2 < baked.refine.steps <= REFINE.steps
    assert baked.refine.is_complete
    assert [*baked.refine.psnr_before] == [*baked.refine.psnr_after] == [*SHARES]
    assert all(baked.refine.psnr_after[share] >= before for share, before in baked.refine.psnr_before.items())
    assert 0 < baked.refine.kept <= 1


@pytest.mark.parametrize("name", ["fitted.spz", "fitted-2.spz", "plain.rad"])
def test_every_format_holds_it_and_a_check_finds_no_fault(folder: Path, fitted: Scene, name: str) -> None:
    options = WriteOptions(spz_version=2) if "2" in name else WriteOptions()
    write_file(folder / name, WRITABLE[Path(name).suffix].codec().encode(fitted, options), overwrite=False)
    found = read_scene(folder / name)
    assert fitted.tree is not None
    assert found.tree is not None
    assert np.array_equal(found.tree.child_count, fitted.tree.child_count)
    low = math.exp(-10)  # of SPZ
    small = (fitted.splats.scale > low).all(axis=1)
    np.testing.assert_allclose(np.log(found.splats.scale[small]), np.log(fitted.splats.scale[small]), atol=0.1)
    np.testing.assert_allclose(found.splats.center, fitted.splats.center, atol=2e-3)
    assert run(["inspect", str(folder / name), "--check", "-q"]) == 0


@pytest.mark.parametrize("share", SHARES)
def test_cuts_spend_their_budget(fitted: Scene, share: float) -> None:
    assert fitted.tree is not None
    traversal = SparkViewer(
        Forest([spark_nodes.unpack(spark_nodes.pack(fitted.splats, fitted.tree, threads=1))]), [TreeInstance()]
    )
    budget = int(share * COUNT)
    for eye in ((0.0, 0.0, -6.0), (3.0, -1.0, 2.0)):
        cut = traversal.cut(Camera.look_at(eye, (0, 0, 0)), budget=budget)
        drawn = sum(map(len, cut.indices()))
        assert budget - int(fitted.tree.child_count.max()) < drawn <= budget


def test_levels_can_be_cut_of_it(folder: Path, baked: Baked) -> None:
    settings = BakeSettings(method="quality", detail=DetailSettings(levels=(0.5, 0.2)), suffix=".json", converts=True)
    bake(folder / "fitted.rad", folder / "web" / "lod-meta.json", settings)
    levels = read_parts(folder / "web" / "lod-meta.json")
    assert len(levels.counts[0]) == 3
    assert levels.splats.opacity.max() <= 1


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(folder: Path, baked: Baked) -> None:
    bake(folder / "tree.rad", folder / "again.rad", dataclasses.replace(SETTINGS, refine=REFINE), threads=2)
    assert (folder / "again.rad").read_bytes() == (folder / "fitted.rad").read_bytes()
