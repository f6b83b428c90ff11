"""Cuts of scenes at several detail levels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.lod.budget import Budget, parse_budget
from sparklod_cli.model.foveation import Cones
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.scene import DetailScene, Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.color_scales import numbers_of, scale_of_splats
from sparklod_cli.viewers.playcanvas import LoadedDetail
from sparklod_cli.viewers.scenes import CutFinder, Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import PLAYCANVAS_BUDGET, DetailRule, LodSettings
from tests.conftest import FIXTURES
from tests.lod.details import row_of_regions
from tests.part_files import write_streamed
from tests.scenes import random_splats

#: Six regions along z, seen from before the first one: 64, 32 and 16 splats each.
AT = Camera.look_at([0, 0, -6], [0, 0, 0], size=(64, 48))


@pytest.fixture(scope="module")
def row() -> DetailScene:
    return row_of_regions(environment=5)


def scenes_of(*instances: Instance | Scene | DetailScene) -> Scenes:
    return read_scenes(
        [each if isinstance(each, Instance) else Instance(each, f"{at}") for at, each in enumerate(instances)]
    )


def levels_of(scene: DetailScene, index: np.ndarray) -> list[int]:
    """The level of each region in a cut, all of whose splats must be there; -1 where nothing is drawn."""
    drawn, left = [], set(index.tolist())
    for region in range(scene.regions):
        runs = [set(range(*scene.run(region, level).indices(len(scene.splats)))) for level in range(scene.levels)]
        found = [level for level, run in enumerate(runs) if run and run <= left]
        assert len(found) <= 1
        drawn.append(found[0] if found else -1)
        left -= runs[found[0]] if found else set()
    around = 0 if scene.environment is None else len(scene.environment)
    assert left == set(range(len(scene.splats), len(scene.splats) + around))
    return drawn


@pytest.mark.parametrize("budget", [1, 96, 130, 200, 300, 383, 384, 10_000])
def test_a_cut_is_one_level_of_each_region_and_the_environment(row: DetailScene, budget: int) -> None:
    cut = CutFinder(scenes_of(row), LodSettings(budget)).cut(AT)
    (index,) = cut.nodes
    levels = levels_of(row, index)
    assert levels == sorted(levels), "farther regions are as coarse or coarser"
    assert len(cut) - 5 <= max(budget, 6 * 16)
    assert cut.reason == ("exhausted" if budget >= 384 else "budget") and cut.pixel_scale is None
    every = row.splats if row.environment is None else Splats.concat([row.splats, row.environment])
    np.testing.assert_array_equal(cut.splats.center, every.take(index).center)


def test_full_detail_is_level_0_and_the_environment(row: DetailScene) -> None:
    scenes = scenes_of(row)
    np.testing.assert_array_equal(scenes.full().splats.center, row.scene().splats.center)
    assert len(CutFinder(scenes, None).cut(AT)) == scenes.leaves == 6 * 64 + 5
    assert len(CutFinder(scenes, LodSettings()).candidates()) == 6 * 112 + 5


def test_budgets_are_shares_of_full_detail_or_the_default_of_playcanvas(row: DetailScene) -> None:
    scenes = scenes_of(row)
    assert scenes.splats_of(parse_budget("50%")) == (6 * 64 + 5) // 2
    default = replace(Budget.of_count(7), by_default=True)
    assert scenes.splats_of(default) == PLAYCANVAS_BUDGET
    assert scenes.splats_of(replace(default, scale=0.5)) == PLAYCANVAS_BUDGET // 2
    assert scenes_of(Scene(row.splats)).splats_of(default) == 7


def test_a_camera_at_the_other_end_sees_that_end_in_detail(row: DetailScene) -> None:
    finder = CutFinder(scenes_of(row), LodSettings(200))
    (near,), (far,) = (
        finder.cut(camera).nodes for camera in (AT, Camera.look_at([0, 0, 16], [0, 0, 0], size=(64, 48)))
    )
    assert levels_of(row, near) == levels_of(row, far)[::-1]


def test_instances_share_a_budget_by_where_they_stand_and_by_their_lod_scale(row: DetailScene) -> None:
    away = np.eye(4)
    away[:3, 3] = [0, 0, 30]

    def sizes(*, lod_scale: float = 1.0) -> list[int]:
        scenes = scenes_of(Instance(row, "near"), Instance(row, "far", away, lod_scale=lod_scale))
        cut = CutFinder(scenes, LodSettings(500)).cut(AT)
        assert len(scenes.loaded) == 1
        return [len(part.index) for part in cut.parts]

    near, far = sizes()
    assert near > far and near + far <= 500 + 10
    assert sizes(lod_scale=100.0)[0] < sizes(lod_scale=100.0)[1]


def test_splats_of_plain_scenes_count_against_the_budget(row: DetailScene) -> None:
    plain = Scene(random_splats(100))
    with_plain = CutFinder(scenes_of(row, plain), LodSettings(300)).cut(AT)
    alone = CutFinder(scenes_of(row), LodSettings(200)).cut(AT)
    assert with_plain.nodes[0].tolist() == alone.nodes[0].tolist() and len(with_plain.nodes[1]) == 100


def test_a_limit_keeps_to_distances(row: DetailScene) -> None:
    rule = DetailRule(mode="limit", base_distance=8.0, multiplier=1.5, shrink=0.0)
    camera = Camera.look_at([0, 0, -6], [0, 0, 0], fov_y=45, size=(64, 64))
    cut = CutFinder(scenes_of(row), LodSettings(10_000, detail=rule)).cut(camera)
    distances = 5 + 2 * np.arange(6)  # to the front of each region
    assert levels_of(row, cut.nodes[0]) == [0 if near < 8 else 1 if near < 12 else 2 for near in distances]
    assert cut.reason == "distance"


def test_trees_and_detail_levels_do_not_go_together_but_in_full(row: DetailScene) -> None:
    scenes = scenes_of(row, Instance(FIXTURES / "golden" / "hand-tree-v3.spz", "tree"))
    with pytest.raises(ValueError, match=r"hand-tree-v3\.spz is a Level-of-Detail tree and scene is Streamed SOG"):
        CutFinder(scenes, LodSettings())
    assert len(CutFinder(scenes, None).cut(AT)) > 6 * 64 + 5


def test_settings_and_foveation_of_trees_are_refused(row: DetailScene) -> None:
    with pytest.raises(ValueError, match="scene is Streamed SOG; continuous cuts are of trees alone"):
        CutFinder(scenes_of(row), LodSettings(continuous=1.25))
    with pytest.raises(ValueError, match="row is Streamed SOG, and has a foveation, which is for trees alone"):
        CutFinder(scenes_of(Instance(row, "row", foveation=Cones())), LodSettings())


def test_colours_are_of_detail_levels_and_chunk_files(row: DetailScene, tmp_path: Path) -> None:
    scenes = read_scenes([Instance(write_streamed(tmp_path, row), "row")])
    finder = CutFinder(scenes, LodSettings(250))
    (part,) = finder.cut(AT).parts
    levels = numbers_of("level", part.scene, part.index)
    assert set(levels[:-5].tolist()) == {0, 1} and (levels[-5:] == 0).all()
    assert scale_of_splats("level", finder, [AT]).title == "detail level"
    chunks = numbers_of("chunk", part.scene, part.index)
    assert chunks[-1] == 9 and (chunks[:-5] // 3 == levels[:-5]).all()


def test_files_are_read_with_the_bytes_of_their_chunks(row: DetailScene, tmp_path: Path) -> None:
    manifest = write_streamed(tmp_path / "web", row)
    for path in (manifest, manifest.parent):
        (loaded,) = read_scenes([Instance(path, "row")]).loaded
        assert isinstance(loaded, LoadedDetail)
        assert loaded.files.of_run.tolist() == [[at // 2 + 3 * level for level in range(3)] for at in range(6)]
        assert loaded.files.environment == 9 and loaded.files.manifest == manifest.stat().st_size
        folders = [*(f"{level}_{number}" for level in range(3) for number in range(3)), "env"]
        sizes = [sum(each.stat().st_size for each in (manifest.parent / name).iterdir()) for name in folders]
        assert [sum(each) for each in loaded.requests] == sizes and loaded.bytes == sum(sizes) + manifest.stat().st_size
        np.testing.assert_array_equal(loaded.detail.counts, row.counts)


def test_a_manifest_that_names_a_missing_file_is_refused_by_its_name(row: DetailScene, tmp_path: Path) -> None:
    manifest = write_streamed(tmp_path, row)
    (tmp_path / "1_0" / "meta.json").unlink()
    error: Any
    with pytest.raises(Exception, match=r"lod-meta\.json: .*1_0/meta\.json") as error:
        read_scenes([Instance(manifest, "row")])
    assert error.type.__name__ == "FormatError"
