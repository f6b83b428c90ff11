"""Laws of the builders quick and quality, in memory and in stages."""

from __future__ import annotations

import dataclasses
import itertools
import math
import pickle
import random
import statistics
from importlib import import_module

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.cameras.camera import Camera, Settings
from sparklod_cli.cameras.framing import balls_of, framing
from sparklod_cli.cameras.sources import orbit
from sparklod_cli.codecs import layouts
from sparklod_cli.codecs.reader import check_valid, is_valid_and_visible
from sparklod_cli.images.metrics import on_background, psnr
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quality, quality_stages, quick, quick_stages
from sparklod_cli.lod.bounds import check
from sparklod_cli.lod.kernels.cell_pairs import ROUNDS
from sparklod_cli.lod.kernels.prune import MOST_CHILDREN, STEPS
from sparklod_cli.lod.stages import Region, joined
from sparklod_cli.lod.tree_settings import BUILDERS, METHODS
from sparklod_cli.model import selection
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.render.rasterizer import Image, draw, shade
from sparklod_cli.render.render_settings import RasterSettings
from sparklod_cli.system.errors import InvalidSplatsError
from sparklod_cli.system.progress import silent
from sparklod_cli.viewers.loaded_scene import Forest, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from tests.conftest import real_scene
from tests.lod.trees import (
    EVERYWHERE,
    WHOLE,
    Division,
    build_in_stages,
    check_colours,
    check_threads,
    check_tree,
    children,
    coincident,
    grid,
    hard_cases,
    parents,
    random_division,
    same,
)
from tests.scenes import random_splats, single_layer

CASES = [("quick", 1.1), ("quick", 1.5), ("quick", 2.0), ("quality", 1.05), ("quality", 1.4), ("quality", 2.0)]
GROWTHS = [1.05, 1.4, 2.0]

#: Splats of which several threads make a tree.
MANY = {"quick": 60_000, "quality": 20_000}

#: Two blocks, 27, and 16 with two levels of joins.
SPLITS = [[(2, 1, 1)], [(3, 3, 3)], [(2, 2, 1), (2, 2, 1)]]


def build(method: str, splats: Splats, setting: float) -> tuple[Splats, LodTree]:
    """A tree that keeps the laws of all trees, and those of its builder."""
    nodes, tree = import_module(f"sparklod_cli.lod.{method}").build(splats, setting)
    check_tree(splats, nodes, tree)
    if method == "quality":
        assert len(nodes) <= max(setting * len(splats), len(splats) + 1)
    else:
        low, high = splats.center.min(axis=0), splats.center.max(axis=0)
        assert ((nodes.center >= low) & (nodes.center <= high)).all()
        assert tree.child_count.max() <= 2**ROUNDS
    return nodes, tree


def quality_in_stages(splats: Splats, growth: float, splits: list[tuple[int, int, int]]) -> tuple[Splats, LodTree]:
    nodes, tree, _ = build_in_stages(quality_stages, splats, growth, grid(splats.center, *splits))
    check_tree(splats, nodes, tree)
    assert len(nodes) <= max(growth * len(splats), len(splats) + 1)
    return nodes, tree


# Both


@pytest.mark.parametrize("name", hard_cases())
@pytest.mark.parametrize(("method", "setting"), CASES)
def test_hard_scenes_make_valid_trees(name: str, method: str, setting: float) -> None:
    build(method, hard_cases()[name], setting)


@pytest.mark.parametrize(("method", "setting"), CASES)
def test_one_splat_is_a_tree_of_one_node(method: str, setting: float) -> None:
    assert len(build(method, random_splats(1, sh_degree=2), setting)[1]) == 1


@pytest.mark.parametrize(("method", "setting"), CASES)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_colours_are_means_of_the_leaves_by_what_they_cover(method: str, setting: float, sh_degree: int) -> None:
    splats = random_splats(800, sh_degree=sh_degree, seed=sh_degree)
    check_colours(*build(method, splats, setting))


@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_change_a_bit(method: str) -> None:
    builder, splats = import_module(f"sparklod_cli.lod.{method}"), random_splats(MANY[method], sh_degree=1, seed=3)
    division = grid(splats.center, (2, 1, 1))
    check_threads(lambda: builder.build(splats))
    in_stages = import_module(f"sparklod_cli.lod.{method}_stages")
    check_threads(lambda: build_in_stages(in_stages, splats, 1.4, division)[:2])


@pytest.mark.parametrize("method", METHODS)
def test_invisible_splats_are_an_error(method: str) -> None:
    with pytest.raises(InvalidSplatsError, match="no splat"):
        build(method, random_splats(0), 1.5)
    for name in ("opacity", "scale"):
        splats = random_splats(10)
        getattr(splats, name)[3] = 0
        with pytest.raises(InvalidSplatsError, match="without opacity or scale"):
            build(method, splats, 1.5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [1.0, 2.01, math.nan])
def test_a_setting_out_of_range_is_an_error(method: str, value: float) -> None:
    builder, splats = import_module(f"sparklod_cli.lod.{method}"), random_splats(2)
    plan = import_module(f"sparklod_cli.lod.{method}_stages").plan
    for build_or_plan in (lambda: builder.build(splats, value), lambda: plan(check(splats), splats, value)):
        with pytest.raises(ValueError, match=BUILDERS[method].setting):
            build_or_plan()


@pytest.mark.parametrize("method", METHODS)
def test_a_region_without_splats_hands_on_nothing(method: str) -> None:
    builder, splats = import_module(f"sparklod_cli.lod.{method}_stages"), random_splats(50, sh_degree=1, seed=2)
    plan = builder.plan(check(splats), splats, 1.4)
    assert repr(pickle.loads(pickle.dumps(plan))) == repr(plan)  # other processes get it
    nothing = builder.leaves(splats.take(slice(0, 0)), np.arange(0), plan)
    families, left = builder.advance(nothing, Region((0.0,) * 3, (1.0,) * 3), 0, plan, progress=silent)
    assert len(families) == len(families.nodes) == len(left["center"]) == 0
    some = builder.leaves(splats.take(slice(1)), np.arange(1), plan)
    _, one = builder.advance(some, EVERYWHERE, 1, plan, progress=silent)
    assert joined([left, one])["sh"].shape == (1, 3, 3)


# The fast check of a builder's input, beside the definition of a valid and visible splat

#: A column and a number that it must not have.
FAULTS = [
    *((name, value) for name in COLUMNS for value in (np.nan, np.inf, -np.inf)),
    *(("scale", -1e-30), ("opacity", -1e-30), ("quat_xyzw", 1.1)),
]


@pytest.mark.parametrize("name", hard_cases())
def test_visible_splats_pass_the_check(name: str) -> None:
    assert is_valid_and_visible(hard_cases()[name], 1) == (True, True)


@pytest.mark.parametrize(("name", "value"), FAULTS)
@pytest.mark.parametrize("place", [0, 35])
def test_one_invalid_splat_fails_the_check(
    name: str, value: float, place: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(selection, "EXAMINED", 32)
    splats = random_splats(40, sh_degree=1)
    getattr(splats, name)[place] = value
    assert not is_valid_and_visible(splats, 2)[0]
    with pytest.raises(InvalidSplatsError, match=f"1 of 40 splats .* the first is splat {place}"):
        check_valid(splats, 2)


@pytest.mark.parametrize(("column", "factor"), [("opacity", 0), ("scale", 0), ("quat_xyzw", np.sqrt(1 + 0.8e-3))])
def test_splats_that_fail_the_fast_check_alone_are_valid(column: str, factor: float) -> None:
    """Invisible ones, and rotations near the tolerance, which the definition decides on."""
    splats = random_splats(9)
    getattr(splats, column)[4] *= np.float32(factor)
    is_valid, is_visible = is_valid_and_visible(splats, 1)
    assert is_valid == (column != "quat_xyzw") and not (is_valid and is_visible)
    check_valid(splats, 1)


# Quick


def test_a_prefix_of_a_quick_tree_is_a_coarser_scene() -> None:
    nodes, tree = quick.build(random_splats(5_000, seed=4))
    # Cells of a level are base times those of the level below, so what lies before has parents at least as coarse; the
    # spread of a node's children shows it: its median falls from part to part of the file.
    inner = np.flatnonzero(~tree.is_leaf)
    spread = np.array([np.ptp(nodes.center[children(tree, node)], axis=0).max() for node in inner])
    medians = [np.median(part) for part in np.array_split(spread[np.argsort(tree.child_start[inner])], 8)]
    assert all(later < earlier for earlier, later in itertools.pairwise(medians))
    assert (parents(tree)[1:] < np.arange(1, len(tree))).all()


@pytest.mark.parametrize("count", [100, 70_000])
def test_coincident_splats_are_split_among_intermediate_nodes(count: int) -> None:
    build("quick", coincident(count), 1.5)


def test_growth_of_a_real_scene_is_no_more_than_that_of_sparks_builder() -> None:
    splats = read_scene(real_scene("biker.ply")).splats
    nodes, tree = quick.build(splats.take(splats.opacity > 0))
    tree.validate()
    assert len(nodes) <= 179_851  # Spark's tiny builder, base 1.5


def check_stages_of_quick(splats: Splats, base: float, division: Division) -> None:
    """The tree in stages is the tree in memory, bit for bit."""
    assert same(build_in_stages(quick_stages, splats, base, division)[:2], quick.build(splats, base))


def clusters(rng: random.Random) -> Splats:
    """Clusters, copies in one point, huge and tiny splats, far from the origin or across it, on a raster or not."""
    count = rng.randint(1, rng.choice([4, 40, 300]))
    splats = random_splats(count, sh_degree=rng.choice([0, 0, 1]), seed=rng.getrandbits(32))
    some = np.array(rng.choices(range(count), k=count // 2 + 1))
    center = splats.center * np.float32(rng.choice([1e-3, 1.0, 1e3]))
    scale = splats.scale * np.float32(rng.choice([0.1, 1.0, 30.0]))
    if rng.random() < 0.4:
        center += np.float32([rng.choice([-1e5, -3.0, 7.0, 1e7]) for _ in range(3)])
    if rng.random() < 0.4:
        center = np.rint(center * 4) / 4
    if rng.random() < 0.4:
        center[some] = center[0]
    if rng.random() < 0.4:
        scale[some[:3]] *= np.float32(rng.choice([1e-6, 100.0, 1e6]))
    return dataclasses.replace(splats, center=center.astype(np.float32), scale=scale.astype(np.float32))


@given(st.integers(0, 2**32 - 1), st.sampled_from([1.1, 1.3, 1.5, 2.0]))
@settings(max_examples=60)
@pytest.mark.slow
def test_the_quick_tree_in_stages_is_the_tree_in_memory(seed: int, base: float) -> None:
    rng = random.Random(seed)
    splats = clusters(rng)
    check_stages_of_quick(splats, base, random_division(rng, splats.center, base))


@pytest.mark.parametrize("name", hard_cases())
@pytest.mark.parametrize("base", [1.1, 2.0])
@pytest.mark.slow
def test_quick_trees_of_hard_scenes_in_stages_are_those_in_memory(name: str, base: float) -> None:
    splats = hard_cases()[name]
    check_stages_of_quick(splats, base, random_division(random.Random(name), splats.center, base))


def test_the_quick_tree_of_coincident_splats_on_a_face_is_that_in_memory() -> None:
    splats = coincident(70_000)
    check_stages_of_quick(splats, 1.5, Division(parts=WHOLE.cut(0, float(splats.center[0, 0]))))


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_quick_blocks_hand_on_fewer_nodes_than_they_hold_and_joins_fewer_yet(sh_degree: int) -> None:
    """Small blocks of 5,000 splats, whose merges mostly wait for what is beyond their borders."""
    fat = random_splats(40_000, sh_degree=sh_degree)
    splats = dataclasses.replace(fat, scale=fat.scale * np.float32(0.05))
    nodes, tree, stages = build_in_stages(quick_stages, splats, 1.5, grid(splats.center, (2, 2, 1), (1, 1, 2)))
    assert same((nodes, tree), quick.build(splats))
    assert len(stages.families) == 8 + 4 + 1
    blocks = sum(count for stage, count in enumerate(stages.pending) if stage % 3 < 2 and stage < 12)
    joins = sum(stages.pending[2:12:3])
    assert joins < 0.8 * blocks < 0.8 * 0.9 * len(splats)


def test_families_have_the_centres_and_sizes_of_their_parents() -> None:
    nodes, tree, stages = build_in_stages(quick_stages, random_splats(2_000), 1.5, WHOLE)
    (families,) = stages.families
    inner = np.flatnonzero(tree.child_count)
    inner = inner[np.argsort(tree.child_start[inner])]
    assert np.array_equal(families.center, nodes.center[inner])
    assert np.array_equal(families.size, spark_size(nodes)[inner])


# Quality


@pytest.mark.parametrize("growth", GROWTHS)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_a_quality_tree_has_as_many_nodes_as_its_growth_allows(growth: float, sh_degree: int) -> None:
    splats = random_splats(3_000, sh_degree=sh_degree, seed=sh_degree)
    nodes, tree = build("quality", splats, growth)
    assert nodes.sh.shape[1:] == splats.sh.shape[1:]
    assert len(nodes) == min(int(growth * 3_000), 2 * 3_000 - 1)
    assert tree.child_count.max() <= {1.05: math.inf, 1.4: MOST_CHILDREN, 2.0: 2}[growth]


@given(
    st.integers(2, 200), st.floats(1.05, 2.0), st.integers(0, 2**32 - 1), st.sampled_from([1e-6, 1e-3, 1.0, 1e4, 1e9])
)
@settings(max_examples=60)
def test_scenes_of_any_size_make_valid_quality_trees(count: int, growth: float, seed: int, extent: float) -> None:
    build("quality", random_splats(count, seed=seed, extent=extent), growth)


@pytest.mark.parametrize("growth", GROWTHS)
@pytest.mark.parametrize("count", [65_535, 65_536])
def test_coincident_splats_give_no_quality_node_many_children(count: int, growth: float) -> None:
    _, tree = build("quality", coincident(count), growth)
    assert tree.child_count.max() < 1000  # where any pair is as good as another, no node has to have many


def test_one_splat_many_times_makes_a_shallow_tree() -> None:
    """Half of what is equal merges in each round, so the tree is not a chain."""
    _, tree = build("quality", random_splats(1).take(np.zeros(10_000, np.int64)), 2.0)
    assert tree.depths().max() < 5 * math.log2(10_000)


@pytest.mark.parametrize("growth", GROWTHS)
def test_a_prefix_of_a_quality_tree_is_a_coarser_scene(growth: float) -> None:
    nodes, tree = quality.build(random_splats(5_000, seed=4), growth)
    parent = parents(tree)
    assert (parent[1:] < np.arange(1, len(tree))).all()
    # Nodes' children come in order of the size from which on the traversal divides a node, in steps; one of the size of
    # its parent comes a step later.
    smallness = -STEPS * np.log2(spark_size(nodes).astype(np.float64))
    level = smallness - smallness[0]
    for node in range(1, len(tree)):
        smallness[node] = max(smallness[node], smallness[parent[node]])
        level[node] = max(smallness[node] - smallness[0], level[parent[node]] + 1)
    inner = np.flatnonzero(~tree.is_leaf)
    inner = inner[np.argsort(tree.child_start[inner])]
    assert (level[inner] >= np.maximum.accumulate(level[inner]) - 1.001).all()
    medians = [np.median(part) for part in np.array_split(smallness[inner], 8)]
    assert medians == sorted(medians)
    assert medians[-1] > medians[0] + STEPS


def test_merged_nodes_are_where_their_leaves_are() -> None:
    """Of two that cover the same the merged one may lie beyond their mean, yet by no more than they are wide."""
    nodes, tree = quality.build(random_splats(3_000, seed=9))
    low, high = nodes.center.astype(np.float64), nodes.center.astype(np.float64)
    reach = nodes.scale.max(axis=1).astype(np.float64)
    for node in np.flatnonzero(~tree.is_leaf)[::-1]:
        part = children(tree, node)
        low[node], high[node] = low[part].min(axis=0), high[part].max(axis=0)
        slack = reach[part].max() + 1e-6
        assert (nodes.center[node] >= low[node] - slack).all()
        assert (nodes.center[node] <= high[node] + slack).all()


def test_progress_is_full_only_at_the_end_of_each_stage() -> None:
    events = []
    nodes, _ = quality.build(random_splats(500, seed=1), progress=lambda *event: events.append(event))
    stages = {name: [event[1:3] for event in events if event[0] == name] for name, *_ in events}
    assert list(stages) == ["building", "pruning", "ordering"]
    for states in stages.values():
        assert [done for done, _ in states] == sorted(done for done, _ in states)
        assert all(done < total for done, total in states[:-1])
    assert stages["building"][-1] == (499, 499)
    assert events[-1] == ("ordering", len(nodes), len(nodes), "node")


def test_splats_farther_apart_than_float32_holds_make_a_node_as_large_as_it_holds() -> None:
    splats = random_splats(2)
    splats.center[:] = [[3e38, -3e38, 3e38], [-3e38, 3e38, -3e38]]
    nodes, _ = quality.build(splats)
    assert nodes.is_valid().all()
    assert nodes.scale.max() == np.finfo(np.float32).max


def picture(splats: Splats, camera: Camera) -> Image:
    return draw(shade([(splats, np.eye(4))], camera), camera, RasterSettings())


def cut_of(tree: tuple[Splats, LodTree], camera: Camera, budget: int) -> Splats:
    """The nodes that Spark draws."""
    forest = Forest([layouts.unpack_nodes(layouts.pack_nodes(*tree, threads=2))])
    return tree[0].take(SparkViewer(forest, [TreeInstance()]).cut(camera, budget=budget).indices()[0])


def test_cuts_of_a_real_scene_are_closer_to_full_detail_than_those_of_the_quick_builder() -> None:
    splats, _ = Selection().apply(read_scene(real_scene("playbot-125k.ply")).splats)
    splats = dataclasses.replace(splats, sh=splats.sh[:, :0])
    middle, radius = framing(splats.center)
    settings, balls = Settings(size=(240, 135), fov_y=math.radians(60)), balls_of(splats, slice(None), np.eye(4))
    cameras = orbit(3, tuple(middle), 1.6 * radius, 15, settings, lambda: balls).cameras

    def fidelity(tree: tuple[Splats, LodTree]) -> float:
        found = []
        for camera in cameras:
            full, coarse = picture(splats, camera), picture(cut_of(tree, camera, len(splats) // 10), camera)
            found += [psnr(on_background(coarse, gray), on_background(full, gray)) for gray in (0.0, 1.0)]
        return statistics.mean(found)

    assert fidelity(quality.build(splats)) >= fidelity(quick.build(splats)) + 1


@pytest.mark.parametrize("share", [0.05, 0.1, 0.25])
def test_coarse_cuts_of_a_single_layer_have_no_cracks(share: float) -> None:
    splats = single_layer(70)
    camera = Camera.look_at((0, -1.2, -0.6), (0, 0, 0), fov_y=40, size=(160, 120))
    middle = np.s_[30:90, 40:120, 3]
    cut = cut_of(quality.build(splats), camera, int(share * len(splats)))
    full, coarse = picture(splats, camera)[middle], picture(cut, camera)[middle]
    assert full.mean() > 0.95
    assert full.mean() - coarse.mean() < 0.01


# Quality in stages


@pytest.mark.parametrize("growth", GROWTHS)
def test_one_stage_of_quality_makes_the_tree_in_memory(growth: float) -> None:
    splats = random_splats(2_000, sh_degree=1, seed=1)
    assert same(build_in_stages(quality_stages, splats, growth, WHOLE)[:2], quality.build(splats, growth))


@given(
    st.integers(1, 300),
    st.floats(1.05, 2.0),
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-6, 1.0, 1e9]),
    st.sampled_from(SPLITS),
)
def test_scenes_of_any_size_make_valid_quality_trees_in_stages(
    count: int, growth: float, seed: int, extent: float, splits: list[tuple[int, int, int]]
) -> None:
    quality_in_stages(random_splats(count, sh_degree=seed % 2, seed=seed, extent=extent), growth, splits)


@pytest.mark.parametrize("splits", SPLITS)
@pytest.mark.parametrize("name", hard_cases())
def test_hard_scenes_make_valid_quality_trees_in_stages(name: str, splits: list[tuple[int, int, int]]) -> None:
    quality_in_stages(hard_cases()[name], 1.4, splits)


@pytest.mark.parametrize("splits", SPLITS)
def test_quality_in_stages_has_colours_of_leaves_and_few_children(splits: list[tuple[int, int, int]]) -> None:
    check_colours(*quality_in_stages(random_splats(2_000, sh_degree=1, seed=8), 1.4, splits))
    _, tree = quality_in_stages(coincident(20_000), 1.4, splits)
    assert tree.child_count.max() < 1000


def small_splats(count: int) -> Splats:
    """Splats on a wavy surface, much smaller than a block of them."""
    splats, rng = random_splats(count, seed=11), np.random.default_rng(12)
    center = rng.uniform(0, 1, (count, 3)).astype(np.float32)
    center[:, 2] = 0.1 * np.sin(6 * center[:, 0])
    scale = np.exp(rng.normal(-0.5, 0.4, (count, 3))) / np.sqrt(count)
    return dataclasses.replace(splats, center=center, scale=scale.astype(np.float32))


@pytest.mark.parametrize("growth", GROWTHS)
@pytest.mark.parametrize("splits", SPLITS)
def test_quality_blocks_use_what_the_growth_allows(growth: float, splits: list[tuple[int, int, int]]) -> None:
    splats = small_splats(10_000)
    nodes, tree = quality_in_stages(splats, growth, splits)
    assert len(nodes) >= len(splats) + 0.98 * min((growth - 1) * len(splats), len(splats) - 1)
    if growth == 1.4:
        assert tree.child_count.max() <= MOST_CHILDREN


def test_quality_blocks_hand_on_few_of_their_nodes() -> None:
    splats = small_splats(40_000)
    *_, stages = build_in_stages(quality_stages, splats, 1.4, grid(splats.center, (2, 2, 1)))
    assert sum(stages.pending[:4]) < 0.15 * len(splats)


def test_the_order_of_tasks_does_not_change_a_bit() -> None:
    """Stages share nothing but what they hand on, and numbers of stages are only in the numbers of families."""
    splats = random_splats(3_000, seed=4)
    plan = quality_stages.plan(check(splats), splats, 1.4)
    index = np.flatnonzero(splats.center[:, 0] < 0)
    region, pending = (
        Region((-np.inf,) * 3, (0.0, np.inf, np.inf)),
        quality_stages.leaves(splats.take(index), index, plan),
    )
    first, again = (quality_stages.advance(dict(pending), region, stage, plan, progress=silent) for stage in (0, 7))
    for name, column in first[1].items():
        other = again[1][name]
        if name == "family":
            other = np.where(other < 0, other, other - (7 << 32))
        assert column.tobytes() == other.tobytes(), name
    assert first[0].key.tobytes() == again[0].key.tobytes()
    assert first[0].nodes.center.tobytes() == again[0].nodes.center.tobytes()
