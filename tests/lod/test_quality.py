"""Laws of the quality builder."""

from __future__ import annotations

import dataclasses
import itertools
import math
import statistics

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.cameras.camera import DEFAULT_UP, Camera, Settings
from sparklod_cli.cameras.framing import framing
from sparklod_cli.cameras.sources import cameras_of, orbit_frames
from sparklod_cli.codecs import spark_nodes
from sparklod_cli.images.metrics import on_background, psnr
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quality, quick
from sparklod_cli.lod.kernels.prune import MOST_CHILDREN, STEPS
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import Image, draw, shade
from sparklod_cli.render.render_settings import RasterSettings
from sparklod_cli.viewers.cut import Forest, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from tests.conftest import real_scene
from tests.lod.trees import check_tree, children, coincident, parents
from tests.scenes import random_splats, single_layer

GROWTHS = [1.05, 1.4, 2.0]


def check(splats: Splats, growth: float) -> tuple[Splats, LodTree]:
    """What holds for every scene."""
    nodes, tree = quality.build(splats, growth)
    check_tree(splats, nodes, tree)
    assert len(nodes) <= max(growth * len(splats), len(splats) + 1)
    return nodes, tree


@pytest.mark.parametrize("growth", GROWTHS)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_leaves_are_the_input_and_nodes_no_more_than_asked_for(growth: float, sh_degree: int) -> None:
    splats = random_splats(3_000, sh_degree=sh_degree, seed=sh_degree)
    nodes, tree = check(splats, growth)
    assert nodes.sh.shape[1:] == splats.sh.shape[1:]
    assert len(nodes) == min(int(growth * 3_000), 2 * 3_000 - 1)  # and no fewer
    most = {1.05: math.inf, 1.4: MOST_CHILDREN, 2.0: 2}
    assert tree.child_count.max() <= most[growth]


@given(
    st.integers(2, 200), st.floats(1.05, 2.0), st.integers(0, 2**32 - 1), st.sampled_from([1e-6, 1e-3, 1.0, 1e4, 1e9])
)
@settings(max_examples=60)
def test_scenes_of_any_size_make_valid_trees(count: int, growth: float, seed: int, extent: float) -> None:
    check(random_splats(count, seed=seed, extent=extent), growth)


@pytest.mark.parametrize("growth", GROWTHS)
@pytest.mark.parametrize("count", [65_535, 65_536])
def test_coincident_splats_give_no_quality_node_many_children(count: int, growth: float) -> None:
    _, tree = check(coincident(count), growth)
    assert tree.child_count.max() < 1000  # where any pair is as good as another, no node has to have many


def test_one_splat_many_times_makes_a_shallow_tree() -> None:
    """Half of what is equal merges in each round, so the tree is not a chain."""
    _, tree = check(random_splats(1).take(np.zeros(10_000, np.int64)), 2.0)
    assert tree.depths().max() < 5 * math.log2(10_000)


@pytest.mark.parametrize("growth", GROWTHS)
def test_two_splats_have_one_parent(growth: float) -> None:
    _, tree = check(random_splats(2, sh_degree=1), growth)
    assert tree.child_count.tolist() == [2, 0, 0]


@pytest.mark.parametrize("growth", GROWTHS)
def test_a_prefix_of_a_quality_tree_is_a_coarser_scene(growth: float) -> None:
    nodes, tree = quality.build(random_splats(5_000, seed=4), growth)
    parent = parents(tree)
    assert (parent[1:] < np.arange(1, len(tree))).all()
    # Nodes' children come in order of the size from which on the traversal divides a node, in steps; one of the size of
    # its parent comes a step later.
    with np.errstate(divide="ignore"):
        smallness = -STEPS * np.log2(spark_size(nodes).astype(np.float64))
    level = smallness - smallness[0]
    for node in range(1, len(tree)):
        smallness[node] = max(smallness[node], smallness[parent[node]])
        level[node] = max(smallness[node] - smallness[0], level[parent[node]] + 1)
    inner = np.flatnonzero(~tree.is_leaf)
    inner = inner[np.argsort(tree.child_start[inner])]
    assert (level[inner] >= np.maximum.accumulate(level[inner]) - 1.001).all()
    medians = [np.median(part) for part in np.array_split(smallness[inner], 8)]
    assert all(later >= earlier for earlier, later in itertools.pairwise(medians))
    assert medians[-1] > medians[0] + STEPS


def test_merged_nodes_are_where_their_leaves_are() -> None:
    """Of two that cover the same the merged one may lie beyond their mean, yet by no more than they are wide."""
    splats = random_splats(3_000, seed=9)
    nodes, tree = quality.build(splats)
    low, high = nodes.center.astype(np.float64), nodes.center.astype(np.float64)
    reach = nodes.scale.max(axis=1).astype(np.float64)
    for node in np.flatnonzero(~tree.is_leaf)[::-1]:
        part = children(tree, node)
        low[node], high[node] = low[part].min(axis=0), high[part].max(axis=0)
        slack = reach[part].max() + 1e-6
        assert (nodes.center[node] >= low[node] - slack).all()
        assert (nodes.center[node] <= high[node] + slack).all()


def test_progress_tells_stage_by_stage_and_is_full_only_at_the_end_of_each() -> None:
    told = []
    nodes, _ = quality.build(random_splats(500, seed=1), progress=lambda *state: told.append(state))
    stages = {name: [state[1:3] for state in told if state[0] == name] for name, *_ in told}
    assert list(stages) == ["building", "pruning", "ordering"]
    for states in stages.values():
        assert [done for done, _ in states] == sorted(done for done, _ in states)
        assert all(done < total for done, total in states[:-1])
    assert stages["building"][-1] == (499, 499)
    assert told[-1] == ("ordering", len(nodes), len(nodes), "node")


def test_splats_farther_apart_than_float32_holds_make_a_node_as_large_as_it_holds() -> None:
    splats = random_splats(2)
    splats.center[:] = [[3e38, -3e38, 3e38], [-3e38, 3e38, -3e38]]
    nodes, _ = quality.build(splats)
    assert nodes.is_valid().all()
    assert nodes.scale.max() == np.finfo(np.float32).max


def cameras_around(splats: Splats) -> tuple[Camera, ...]:
    middle, radius = framing(splats.center)
    frames = orbit_frames(np.arange(3), 3, middle, 1.6 * radius, math.radians(15), DEFAULT_UP)
    settings = Settings(size=(240, 135), fov_y=math.radians(60))
    return cameras_of(frames, settings, "an orbit").cameras


def picture(splats: Splats, camera: Camera) -> Image:
    return draw(shade([(splats, np.eye(4))], camera), camera, RasterSettings())


def fidelity(splats: Splats, built: tuple[Splats, LodTree], share: float) -> float:
    """Mean PSNR of cuts of so many of the leaves, in dB."""
    nodes, tree = built
    forest = Forest([spark_nodes.unpack(spark_nodes.pack(nodes, tree, threads=2))])
    traversal = SparkViewer(forest, [TreeInstance()])
    found = []
    for camera in cameras_around(splats):
        full = picture(splats, camera)
        cut = traversal.cut(camera, budget=int(share * len(splats))).indices()[0]
        image = picture(nodes.take(cut), camera)
        found += [psnr(on_background(image, gray), on_background(full, gray)) for gray in (0.0, 1.0)]
    return statistics.mean(found)


def test_cuts_of_a_real_scene_are_closer_to_full_detail_than_those_of_the_quick_builder() -> None:
    splats, _ = Selection().apply(read_scene(real_scene("playbot-125k.ply")).splats)
    splats = dataclasses.replace(splats, sh=splats.sh[:, :0])
    ours, quicks = (fidelity(splats, builder.build(splats), 0.1) for builder in (quality, quick))
    assert ours >= quicks + 1


@pytest.mark.parametrize("share", [0.05, 0.1, 0.25])
def test_coarse_cuts_of_a_single_layer_have_no_cracks(share: float) -> None:
    splats = single_layer(70)
    nodes, tree = quality.build(splats)
    traversal = SparkViewer(Forest([spark_nodes.unpack(spark_nodes.pack(nodes, tree, threads=2))]), [TreeInstance()])
    camera = Camera.look_at((0, -1.2, -0.6), (0, 0, 0), fov_y=40, size=(160, 120))
    cut = traversal.cut(camera, budget=int(share * len(splats))).indices()[0]
    middle = np.s_[30:90, 40:120, 3]
    full, coarse = picture(splats, camera)[middle], picture(nodes.take(cut), camera)[middle]
    assert full.mean() > 0.95
    assert full.mean() - coarse.mean() < 0.01
