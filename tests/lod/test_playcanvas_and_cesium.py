"""What PlayCanvas draws of regions, beside laws; and CesiumJS of tiles, beside a plain walk down the tiles.

tests/interop compares the choice of levels with PlayCanvas's own modules.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quality
from sparklod_cli.lod.parts import make_tiles
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.instances import TileScene
from sparklod_cli.model.scene import Scene
from sparklod_cli.viewers import cesium
from sparklod_cli.viewers.cesium import CesiumViewer, LoadedTiles
from sparklod_cli.viewers.loaded_scene import Forest, TreeInstance
from sparklod_cli.viewers.playcanvas import (
    ANOTHER_LEVEL,
    ENVIRONMENT,
    NEXT,
    NOTHING_DRAWN,
    Chains,
    DetailChoice,
    DetailFiles,
    Distant,
    RegionBounds,
    choose,
    loading,
)
from sparklod_cli.viewers.viewer_settings import DetailRule, pixel_limit
from tests.conftest import FIXTURES
from tests.lod.trees import CutView, random_regions, random_view, view_from

RULES = (DetailRule(), DetailRule(mode="limit"), DetailRule(finest=1, coarsest=2), DetailRule(multiplier=1.2))

# PlayCanvas: the choice of levels


def distant(seed: int, *, gaps: float = 0.0, several: int = 1, rule: DetailRule) -> list[Distant]:
    """Instances of random regions as a random camera sees them."""
    random = np.random.default_rng(seed)
    view = random_view(random)
    found = []
    for _ in range(several):
        regions = random_regions(random, int(random.integers(1, 60)), int(random.integers(1, 6)), gaps=gaps)
        distances = RegionBounds(regions.bounds).squared_distances(view, np.eye(4), rule)
        found.append(Distant(Chains.of(regions.counts, rule), distances, rule.base_distance))
    return found


def places(choice: DetailChoice, instances: Sequence[Distant]) -> list[np.ndarray]:
    """(R,) for each instance, the place of each level in its chain."""
    return [
        np.argmax(each.chains.level == levels[:, None], axis=1)
        for each, levels in zip(instances, choice.levels, strict=True)
    ]


def splats_of(instances: Sequence[Distant], place: int) -> int:
    """Splats of all regions at one place of their chains."""
    return int(sum(each.chains.count[:, place].sum() for each in instances))


@given(st.integers(0, 10_000), st.sampled_from(RULES), st.floats(0, 1.2), st.sampled_from([0.0, 0.4]))
def test_the_budget_holds_unless_the_coarsest_levels_are_more(
    seed: int, rule: DetailRule, share: float, gaps: float
) -> None:
    instances = distant(seed, gaps=gaps, several=1 + seed % 2, rule=rule)
    budget = max(1, int(share * splats_of(instances, 0)))
    choice = choose(instances, budget, rule)
    assert choice.splats <= max(budget, splats_of(instances, -1))
    assert choice.splats == sum(
        each.chains.count[np.arange(len(at)), at].sum()
        for each, at in zip(instances, places(choice, instances), strict=True)
    )


@given(st.integers(0, 10_000), st.sampled_from(RULES))
def test_a_larger_budget_makes_no_region_coarser(seed: int, rule: DetailRule) -> None:
    """Where the counts of every region fall from level to level."""
    instances = distant(seed, several=2, rule=rule)
    finest, before = splats_of(instances, 0), None
    for share in (0.0, 0.1, 0.3, 0.31, 0.6, 0.99, 1.0, 1.5):
        now = np.concatenate(places(choose(instances, max(1, int(share * finest)), rule), instances))
        assert before is None or (now <= before).all()
        before = now


@given(st.integers(0, 10_000), st.sampled_from(RULES), st.floats(0.01, 1))
def test_nearer_regions_are_never_coarser(seed: int, rule: DetailRule, share: float) -> None:
    """Whatever their counts, for the threshold is the same for all regions of an instance."""
    (instance,) = distant(seed, rule=rule)
    budget = max(1, int(share * splats_of([instance], 0)))
    (place,) = places(choose([instance], budget, rule), [instance])
    assert (np.diff(place[np.argsort(instance.squared_distance, kind="stable")]) >= 0).all()


@pytest.mark.parametrize("rule", RULES)
def test_a_budget_for_all_shows_the_finest_levels_and_one_splat_the_coarsest(rule: DetailRule) -> None:
    (instance,) = distant(5, rule=rule)
    most, least = (choose([instance], budget, rule) for budget in (1 << 40, 1))
    if rule.mode != "limit":
        assert most.reason == "exhausted" and (most.levels[0] == instance.chains.level[:, 0]).all()
    assert least.reason == "budget" and (least.levels[0] == instance.chains.level[:, -1]).all()


def test_a_limit_shows_the_levels_that_are_due_at_their_distances() -> None:
    """Level 1 from the base distance on, and each further one at the multiple of that distance."""
    rule = DetailRule(mode="limit", base_distance=5.0, multiplier=3.0)
    edges = np.array([0.1, 4.7, 5.3, 14.3, 15.7, 43.0, 47.0, 1e6])
    for some, levels, reason in ((8, [0, 0, 1, 1, 2, 2, 3, 3], "distance"), (2, [0, 0], "exhausted")):
        chains = Chains.of(np.tile([800, 400, 200, 100], (some, 1)), rule)
        choice = choose([Distant(chains, edges[:some] ** 2, rule.base_distance)], 1 << 30, rule)
        assert choice.levels[0].tolist() == levels and choice.reason == reason


def test_a_region_without_a_level_shows_a_finer_one_and_beyond_its_last_nothing() -> None:
    counts = np.array([[9, 0, 4, 0, 0], [0, 7, 0, 3, 1], [0, 0, 0, 0, 0], [5, 0, 0, 0, 0]])
    chains = Chains.of(counts, DetailRule())
    assert chains.level.tolist() == [[0, 0, 2, 3, 3], [1, 1, 1, 3, 4], [-1] * 5, [0, 1, 1, 1, 1]]
    assert chains.count.tolist() == [[9, 9, 4, 0, 0], [7, 7, 7, 3, 1], [0] * 5, [5, 0, 0, 0, 0]]


@pytest.mark.parametrize(
    ("fov", "penalty", "expected"),
    [
        (np.pi / 4, 2.0, [9.0, 18.0]),  # what is behind is farther
        (np.pi / 4, 1.0, [9.0, 9.0]),
        (np.pi / 2, 1.0, [9.0 / np.tan(np.pi / 8)] * 2),  # through a wide lens all is
    ],
)
def test_distances_grow_behind_and_in_a_wide_lens(fov: float, penalty: float, expected: list[float]) -> None:
    bounds = np.array([[[-1.0, -1, -11], [1, 1, -9]], [[-1.0, -1, 9], [1, 1, 11]]])  # before the camera, and behind it
    rule, view = DetailRule(behind_penalty=penalty), CutView(np.eye(4), fov, fov)
    found = RegionBounds(bounds).squared_distances(view, np.eye(4), rule)
    assert np.sqrt(found).tolist() == pytest.approx(expected)


@pytest.mark.parametrize(("shrink", "high"), [(0.0, 5.0), (1.0, 1.0), (0.5, 3.0)])
def test_distances_go_to_bounds_that_shrink_by_what_they_exceed_the_median(shrink: float, high: float) -> None:
    half = np.array([1.0, 1.0, 5.0])
    low, center = -half[:, None] * [0, 1, 1], 20.0 * np.arange(3)[:, None] * [1, 0, 0]
    bounds = np.stack([center + low, center + low + 2 * half[:, None]], axis=1)
    view = dataclasses.replace(view_from(45.0, 105.0, 0.0), fov_x=np.pi / 4, fov_y=np.pi / 4)
    found = RegionBounds(bounds).squared_distances(view, np.eye(4), DetailRule(behind_penalty=1.0, shrink=shrink))
    assert np.sqrt(found[2]) == pytest.approx(105.0 - high)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"mode": "most"}, "there is no budget mode 'most'; give one of target, limit"),
        ({"base_distance": 0.0}, "base_distance is 0.0; give 0.1 or more"),
        ({"multiplier": 1.0}, "multiplier is 1.0; give 1.2 or more"),
        ({"behind_penalty": float("nan")}, "behind_penalty is nan; give 1 or more"),
        ({"shrink": 1.5}, "shrink is 1.5; give 0 to 1"),
        ({"finest": 2, "coarsest": 1}, "levels 2 to 1 are no range; give 0 <= finest <= coarsest"),
    ],
)
def test_rules_out_of_range_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DetailRule(**wrong)


# PlayCanvas: loading

#: Three regions at three levels; the last has no level 1. Each level is a file, and the environment the fourth.
COUNTS = np.array([[40, 20, 10], [40, 20, 10], [40, 0, 10]])


def state(
    chosen: list[int],
    there: list[int],
    before: list[int] | None = None,
    underfill: int = 0,
    counts: np.ndarray = COUNTS,
) -> tuple[list[int], np.ndarray]:
    """Levels drawn of each region, and priorities of files, where some files are resident."""
    files = DetailFiles(np.where(counts > 0, [0, 1, 2], -1), [(400,), (200,), (100,), (50,)], 3, 9)
    past = None if before is None else np.array(before)
    distances, resident = np.array([1.0, 4.0, 9.0])[: len(counts)], np.isin(np.arange(4), there)
    chains = Chains.of(counts, DetailRule())
    levels, priority = loading(chains, files, np.array(chosen), distances, resident, past, underfill)
    return levels.tolist(), priority


def order(priority: np.ndarray) -> list[int]:
    """Files that are wanted, the most important first."""
    wanted = np.flatnonzero(priority > 0)
    return wanted[np.argsort(-priority[wanted], kind="stable")].tolist()


def test_nothing_is_drawn_before_files_come_and_coarse_levels_are_wanted_first() -> None:
    levels, priority = state([0, 1, 2], [])
    assert levels == [-1, -1, -1]
    assert order(priority) == [3, 2, 1, 0]
    assert priority[3] == ENVIRONMENT and (np.floor(priority[:3]) == NOTHING_DRAWN).all()


@pytest.mark.parametrize(
    ("chosen", "there", "expected"),
    [
        ([0, 1, 2], [1], [-1, 1, -1]),
        ([0, 1, 2], [0, 1, 2], [0, 1, 2]),
        ([0, 0, 2], [1], [-1, -1, -1]),  # another level of a region is no reason to draw it
    ],
)
def test_a_region_is_drawn_when_the_file_of_its_level_is_there(
    chosen: list[int], there: list[int], expected: list[int]
) -> None:
    assert state(chosen, there)[0] == expected


def test_a_region_stays_as_it_was_until_its_level_is_there() -> None:
    levels, priority = state([0, 2, 0], [1], before=[1, 1, -1])
    assert levels == [1, 1, -1]
    assert np.floor(priority[:3]).tolist() == [NOTHING_DRAWN, NOTHING_DRAWN, ANOTHER_LEVEL]


def test_underfill_draws_the_finest_level_that_is_there_and_wants_the_next() -> None:
    assert order(state([0, 0, 0], [], underfill=9)[1])[:2] == [3, 2]  # the coarsest comes first
    levels, priority = state([0, 0, 0], [2], underfill=9)
    assert levels == [2, 2, 2]
    assert np.floor(priority[:2]).tolist() == [NEXT, NEXT]  # of the last region level 0, for it has no level 1
    assert state([0, 0, 0], [1, 2], underfill=9)[0] == [1, 1, 2]
    assert state([0, 0, 0], [2], underfill=1)[0] == [-1, -1, 2]  # one step of a chain at most


def test_a_region_without_splats_at_its_level_needs_no_file() -> None:
    levels, priority = state([1, 2], [], counts=np.array([[40, 0, 0], [40, 20, 10]]))
    assert levels == [1, -1] and priority[0] == 0


# CesiumJS

Mask = NDArray[np.bool_]


@pytest.fixture(scope="module")
def scene() -> TileScene:
    """The demo scene in tiles of three levels."""
    tree = quality.build(read_scene(FIXTURES / "demo.ply").splats, 1.4)
    return make_tiles(*tree, TileSettings(tile_splats=3000))


def camera(seed: int, away: float) -> Camera:
    eye = np.random.default_rng(seed).normal(size=3)
    eye *= away / np.linalg.norm(eye)
    return Camera.look_at(eye.tolist(), [0, 0, 0], up=[0.1, -1, 0.2], fov_y=50, size=(320, 180))


def walk(scene: TileScene, view: Camera, pixel: float, there: Mask) -> tuple[set[int], set[int]]:
    """Tiles that are drawn and wanted, one tile after the other, as CesiumJS goes down them."""
    eye, to_camera = view.camera_to_world[:3, 3], np.linalg.inv(view.camera_to_world)
    drawn, wanted = set(), set()

    def visible(tile: int) -> bool:
        low, high = scene.bounds[tile]
        corners = [np.where([k & 1, k & 2, k & 4], high, low) for k in range(8)]
        points = [to_camera[:3, :3] @ corner + to_camera[:3, 3] for corner in corners]
        wide, tall = math.tan(view.fov_x / 2), math.tan(view.fov_y / 2)
        sides = (
            [z > 0 for _, _, z in points],
            *([sign * x > -z * wide for x, _, z in points] for sign in (1, -1)),
            *([sign * y > -z * tall for _, y, z in points] for sign in (1, -1)),
        )
        return not any(map(all, sides))

    def visit(tile: int) -> None:
        if not visible(tile):
            return
        distance = math.dist(eye, np.clip(eye, *scene.bounds[tile]))
        # Pixels that the error has on the screen; without a pixel, everything is refined.
        pixels = math.inf if distance == 0 or pixel == 0 else scene.errors[tile] / distance / pixel
        below = np.flatnonzero(scene.parent == tile).tolist()
        if below and pixels > 16:
            wanted.update(below)
            if there[below].all():
                for child in below:
                    visit(child)
                return
        drawn.add(tile)

    if visible(0):
        wanted.add(0)
        visit(0)
    return drawn, wanted


@given(st.integers(0, 1000), st.floats(0.1, 60), st.floats(0, 8), st.floats(0, 1), st.booleans())
def test_tiles_drawn_and_wanted_are_those_of_a_walk_down_the_tiles(
    scene: TileScene, seed: int, away: float, scale: float, missing: float, turned: bool
) -> None:
    view = camera(seed, away)
    if turned:  # looks away from the middle
        pose = view.camera_to_world.copy()
        pose[:3, [0, 2]] *= -1
        view = dataclasses.replace(view, camera_to_world=pose)
    there = np.random.default_rng(seed).random(scene.tiles) >= missing
    pixel = pixel_limit(view.fov_y, view.height, scale)
    found = cesium.choose(scene, view, np.eye(4), 16 * pixel, there)
    drawn, wanted = walk(scene, view, pixel, there)
    assert set(np.flatnonzero(found.drawn).tolist()) == drawn
    assert set(np.flatnonzero(found.wanted).tolist()) == wanted


def viewer_of(scene: TileScene, instance: TreeInstance | None = None) -> CesiumViewer:
    forest = Forest([LoadedTiles(None, 0, Scene(scene.splats), scene.splats, 0, tiles=scene)])
    return CesiumViewer(forest, [instance or TreeInstance()])


def test_cuts_go_from_the_root_tile_to_full_detail(scene: TileScene) -> None:
    viewer, cuts = viewer_of(scene), []
    for away in (200.0, 60.0, 20.0, 8.0):
        at = camera(3, away)
        cuts.append(viewer.cut(at, budget=1, smallest=pixel_limit(at.fov_y, at.height)))
    counts = [len(cut) for cut in cuts]
    assert not any(cut.missing for cut in cuts)
    assert counts == sorted(counts) and counts[0] == scene.counts[0] and counts[-1] > 2 * counts[0], counts
    assert cuts[0].reason == "distance"
    every = viewer.cut(camera(3, 8.0), budget=1)
    assert len(every) == scene.counts[scene.is_leaf].sum() and every.reason == "exhausted"


def test_nothing_is_drawn_of_a_tile_that_is_missing(scene: TileScene) -> None:
    viewer, view, there = viewer_of(scene), camera(3, 4.0), np.zeros(scene.tiles, np.bool_)
    nothing = viewer.cut(view, budget=1, resident=there)
    assert not len(nothing) and nothing.reason == "missing" and nothing.wanted()[0] == 0
    there[0] = True
    root = viewer.cut(view, budget=1, resident=there)
    assert len(root) == scene.counts[0] == root.missing and root.reason == "missing"
    below = np.flatnonzero(scene.parent == 0)
    assert sorted(root.wanted()) == [0, *below]
    there[below[:-1]] = True  # all but one of them
    assert len(viewer.cut(view, budget=1, resident=there)) == scene.counts[0]


def test_a_scene_that_is_twice_as_large_and_as_far_away_has_the_same_cut(scene: TileScene) -> None:
    at = camera(5, 6.0)
    pose = at.camera_to_world.copy()
    pose[:3, 3] *= 2
    far, limit = dataclasses.replace(at, camera_to_world=pose), pixel_limit(at.fov_y, at.height)
    large = TreeInstance(object_to_world=np.diag([2.0, 2.0, 2.0, 1.0]))
    one = viewer_of(scene).cut(at, budget=1, smallest=limit)
    two = viewer_of(scene, large).cut(far, budget=1, smallest=limit)
    assert np.array_equal(one.node, two.node)
