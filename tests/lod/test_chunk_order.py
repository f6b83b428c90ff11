"""The order of nodes in chunks: the same tree, whole families in full chunks, and fewer chunks for a view."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod import chunk_order, quality, quick
from sparklod_cli.lod.chunk_order import arrange, family_order, parts_of
from sparklod_cli.lod.chunk_order import chunk_order as order_of
from sparklod_cli.lod.kernels.chunk_sets import LANES, fill_demand
from sparklod_cli.lod.kernels.pixel_scale import NODE
from sparklod_cli.lod.kernels.tree_links import find_limits, find_parents
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import CHUNK_NODES, LodTree, Nodes
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.threads import on_threads
from sparklod_cli.viewers.cut import Forest, TreeCut, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from sparklod_cli.viewers.viewer_settings import LodSettings
from tests.lod.forests import links
from tests.lod.sights import CutView
from tests.lod.trees import check_threads
from tests.references import chunk_splits
from tests.references.chunk_orders import reordered, spark_order
from tests.scenes import random_splats

SMALL = 16


@pytest.fixture(scope="class")
def small_chunks() -> Iterator[None]:
    """Small chunks, so that small trees have many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunk_order, "CHUNK_NODES", SMALL)
        yield


def grown(fan_out: list[int], seed: int = 0) -> tuple[Splats, LodTree]:
    """A tree whose inner nodes have so many children, which scatter around their parents and are mostly smaller."""
    rng = np.random.default_rng(seed)
    tree = links(fan_out)
    splats = random_splats(len(tree), seed=seed)
    center, scale = splats.center, splats.scale
    center[0], scale[0] = 0, 1
    for node in np.flatnonzero(tree.child_count):
        part = slice(int(tree.child_start[node]), int(tree.child_start[node]) + int(tree.child_count[node]))
        count = part.stop - part.start
        center[part] = center[node] + rng.normal(size=(count, 3)) * scale[node]
        scale[part] = scale[node] * rng.uniform(0.3, 1.1, (count, 1))
    numbered = dataclasses.replace(splats, rgb=np.arange(3 * len(tree), dtype=np.float32).reshape(-1, 3))
    return numbered, tree


def check_same_tree(before: tuple[Splats, LodTree], after: tuple[Splats, LodTree]) -> np.ndarray:
    """The same splats, root and children, by colours that number them; returns the old node at each place."""
    (splats, tree), (ordered, arranged) = before, after
    arranged.validate()
    old = (ordered.rgb[:, 0] / 3).astype(np.int64)
    assert np.array_equal(np.sort(old), np.arange(len(tree)))
    for name in ("center", "scale", "quat_xyzw", "opacity", "rgb", "sh"):
        assert np.array_equal(getattr(ordered, name), getattr(splats, name)[old])
    assert old[0] == 0
    assert np.array_equal(arranged.child_count, tree.child_count[old])
    for node in np.flatnonzero(arranged.child_count):
        count = int(arranged.child_count[node])
        first, now = int(tree.child_start[old[node]]), int(arranged.child_start[node])
        assert old[now : now + count].tolist() == list(range(first, first + count))
    return old


fan_outs = st.lists(st.integers(1, 7), max_size=60)


@pytest.mark.usefixtures("small_chunks")
class TestSmallChunks:
    @given(fan_outs, st.integers(0, 3))
    @settings(max_examples=60)
    def test_it_is_the_same_tree(self, fan_out: list[int], seed: int) -> None:
        tree = grown(fan_out, seed)
        check_same_tree(tree, arrange(*tree))

    @pytest.mark.parametrize("seed", range(5))
    def test_chunks_are_those_of_plain_lists(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        splats, tree = grown(rng.integers(2, 6, 40 + 20 * seed).tolist(), seed)
        expected, arranged_parent, rank, bits = plainly(splats, tree)
        ordered, arranged = arrange(splats, tree)
        old = (ordered.rgb[:, 0] / 3).astype(np.int64)
        inner = np.flatnonzero(arranged.child_count)
        families = old[inner[np.argsort(arranged.child_start[inner])]].tolist()
        at = 0
        for chunk in expected:
            nodes, numbers = families[at : at + len(chunk)], dict(chunk)
            at += len(chunk)
            assert sorted(nodes) == sorted(numbers)
            members = [number for _, number in chunk]
            keys = dict(zip(members, chunk_splits.inside(members, arranged_parent, rank, bits), strict=True))
            got = [keys[numbers[node]] for node in nodes]
            assert got == sorted(got)
        assert at == len(families)


def plainly(splats: Splats, tree: LodTree) -> tuple[list[list[tuple[int, int]]], list[int], list[list[int]], int]:
    """(node, family) of each chunk by plain lists; and parents, ranks and bits of the families' numbers."""
    size = spark_size(splats)
    parent, limit = np.full(len(tree), -1), size.copy()
    for node in np.flatnonzero(tree.child_count):
        for child in range(int(tree.child_start[node]), int(tree.child_start[node]) + int(tree.child_count[node])):
            parent[child], limit[child] = node, min(size[child], limit[node])
    nodes = sorted(np.flatnonzero(tree.child_count).tolist(), key=lambda node: (-limit[node], node))
    number = {node: at for at, node in enumerate(nodes)}
    above = [number.get(int(parent[node]), -1) for node in nodes]
    centers = splats.center[nodes]
    rank = np.argsort(np.argsort(centers, axis=0, kind="stable"), axis=0).tolist()
    records = np.zeros(len(nodes), NODE)
    records["x"], records["y"], records["z"] = centers.T
    records["size"], records["child_count"] = size[nodes], tree.child_count[nodes]
    least, most = min(len(tree) / 16, SMALL), len(tree)
    columns = [chunk_splits.demand(records, above, view, least, most) for view in chunk_order.viewpoints(centers)]
    demand = np.array(columns).T.tolist()
    counts = tree.child_count[nodes].tolist()
    chunks = chunk_splits.Splitter(above, counts, rank, demand, SMALL).chunks()
    return [[(nodes[f], f) for f in chunk] for chunk in chunks], above, rank, (len(nodes) - 1).bit_length()


@pytest.mark.parametrize(
    "fan_out",
    [[], [1], [1] * 300, [65535], [65535, *[3] * 40], [65535] * 3, [2] * 200, [9, *[0] * 8, 5]],
    ids=["one node", "two", "chain", "star", "star and more", "three stars", "small", "deep at the end"],
)
def test_degenerate_trees(fan_out: list[int]) -> None:
    tree = grown(fan_out)
    check_same_tree(tree, arrange(*tree))


@pytest.mark.parametrize("name", ["center", "scale"])
@pytest.mark.parametrize("value", [0.0, 1e30])
def test_equal_centres_and_sizes(name: str, value: float) -> None:
    splats, tree = grown([3] * 30_000)
    splats = dataclasses.replace(splats, **{name: np.full_like(getattr(splats, name), value)})
    check_same_tree((splats, tree), arrange(splats, tree))


@pytest.fixture(scope="module")
def built() -> Iterator[tuple[Splats, LodTree]]:
    """A tree of five chunks."""
    yield quick.build(random_splats(220_000, seed=2))


def test_the_number_of_threads_changes_nothing(built: tuple[Splats, LodTree]) -> None:
    check_threads(lambda: arrange(*built))


def test_chunks_are_not_taken_for_sets(built: tuple[Splats, LodTree], monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread may ask for the chunk of a parent before another has told it: the number of a set may not stand there.

    Both are small numbers from 0 on, so that the order would depend, rarely, on which thread is first.
    """
    sort, asked = chunk_order.sort_within_chunks, []

    def sort_within_chunks(*arguments: Any) -> None:
        asked.append(int(arguments[6].max()))
        sort(*arguments)

    monkeypatch.setattr(chunk_order, "sort_within_chunks", sort_within_chunks)
    arrange(*built)
    assert asked == [-1]


def test_the_first_chunk_is_a_coarse_picture_of_the_whole(built: tuple[Splats, LodTree]) -> None:
    """It refines the largest nodes: none outside is larger than all but the last inside."""
    splats, tree = arrange(*built)
    limit = spark_size(splats).astype(np.float64)
    for node in np.flatnonzero(tree.child_count):
        part = slice(int(tree.child_start[node]), int(tree.child_start[node]) + int(tree.child_count[node]))
        limit[part] = np.minimum(limit[part], limit[node])
    inner = ~tree.is_leaf
    in_first = tree.child_start[inner] + tree.child_count[inner].astype(np.int64) <= CHUNK_NODES
    sizes = limit[inner]
    fits = np.sort(sizes[in_first])
    assert fits[100] >= sizes[~in_first].max()


def test_no_family_is_in_two_chunks(built: tuple[Splats, LodTree]) -> None:
    _, tree = arrange(*built)
    start = tree.child_start[~tree.is_leaf].astype(np.int64)
    assert np.array_equal(start // CHUNK_NODES, (start + tree.child_count[~tree.is_leaf] - 1) // CHUNK_NODES)


@pytest.mark.slow
def test_views_touch_fewer_chunks_than_in_spark_s_order() -> None:
    """A ring of clusters, seen from among them: an example; docs/streaming-measured.md has the measurements."""
    rng = np.random.default_rng(5)
    angle = rng.integers(0, 24, 200_000) * (2 * np.pi / 24)
    splats = random_splats(len(angle), seed=5)
    place = 10 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    splats = dataclasses.replace(splats, center=(splats.center * 0.3 + place).astype(np.float32))
    spread = np.exp(rng.normal(0, 1, (len(angle), 1)))
    tree = quality.build(dataclasses.replace(splats, scale=(splats.scale * spread).astype(np.float32)))
    touched = [
        sum(len(cut_at(nodes, np.radians(turn)).wanted()) for turn in range(0, 360, 15))
        for nodes in (arrange(*tree), reordered(*tree, spark_order(*tree)))
    ]
    assert touched[0] < 0.95 * touched[1]


def cut_at(tree: tuple[Splats, LodTree], turn: float) -> TreeCut:
    """The cut of a viewer on the ring who looks along it."""
    across = np.array([np.cos(turn), 0, np.sin(turn)])
    along = np.array([-np.sin(turn), 0, np.cos(turn)])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = across, [0, 1, 0], -along, 9 * across
    foveation = LodSettings().foveation
    found = SparkViewer(
        Forest([Nodes(tree[0].center, spark_size(tree[0]), tree[1])]), [TreeInstance(foveation=foveation)]
    )
    return found.cut(CutView(pose, 1.5, 1.0), budget=40_000)


def test_progress_ends_at_the_number_of_nodes(built: tuple[Splats, LodTree]) -> None:
    seen: list[tuple[str, int, int, str]] = []
    arrange(*built, progress=lambda *event: seen.append(event))
    done = [at for _, at, _, _ in seen]
    assert done == sorted(done) and seen[-1] == ("arranging", len(built[1]), len(built[1]), "node")


def test_nodes_without_a_size_come_last_and_are_not_lost() -> None:
    """Sizes that are not numbers count as none, as a viewer would never refine such a node."""
    splats, tree = grown([3] * 30_000)
    scale = splats.scale.copy()
    scale[5:50] = np.nan
    splats = dataclasses.replace(splats, scale=scale)
    order, child_start = chunk_order.chunk_order(splats, tree)
    assert np.array_equal(np.sort(order), np.arange(len(tree)))
    LodTree(tree.child_count[order], child_start).validate()


def test_demand_never_rises_from_parent_to_child() -> None:
    rng = np.random.default_rng(1)
    count = 500
    parent = np.concatenate([[-1], [rng.integers(0, i) for i in range(1, count)]]).astype(np.int32)
    nodes = np.zeros(count, NODE)
    for name in ("x", "y", "z"):
        nodes[name] = rng.normal(size=count)
    nodes["size"], nodes["child_count"] = np.exp(rng.normal(size=count)), rng.integers(1, 9, count)
    views = chunk_order.viewpoints(rng.normal(size=(count, 3)).astype(np.float32))
    demand = np.zeros((count, len(views)), np.uint8)
    fill_demand(len(views) // LANES, nodes, parent, views, 20.0, float(nodes["child_count"].sum()), demand)
    assert (demand[1:] <= demand[parent[1:]]).all()
    assert demand[0].min() > 0 and len(np.unique(demand)) > 50


def test_families_take_the_memory_that_is_estimated() -> None:
    rng, families = np.random.default_rng(3), 1 << 17
    parent = ((np.arange(families) - 1) // 3).astype(np.int32)
    parent[0] = -1
    count, center = np.full(families, 3, np.uint16), rng.random((families, 3), np.float32)
    size = np.exp(-6 * rng.random(families)).astype(np.float32)
    chunk_order.family_order(parent[:9], count[:9], center[:9], size[:9])  # loads kernels
    tracemalloc.start()
    try:
        with on_threads(2):
            chunk_order.family_order(parent, count, center, size)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak / families == pytest.approx(chunk_order.family_bytes(2), rel=0.1)


class Families(NamedTuple):
    """The arguments of `family_order`."""

    parent: np.ndarray
    count: np.ndarray
    center: np.ndarray
    size: np.ndarray

    def parts(self, most: int) -> list[np.ndarray]:
        limit = find_limits(self.parent, np.fmax(self.size, np.float32(0)))[1]
        return list(parts_of(self.parent, self.center, limit, most))


def random_tree(count: int, seed: int) -> Families:
    """Families below random others; sizes of a few values, so that there are ties."""
    rng = np.random.default_rng(seed)
    parent = np.array([-1, *(rng.integers(max(0, i - 20), i) for i in range(1, count))], np.int32)
    size = rng.choice([0.5, 1, 2, np.nan], count).astype(np.float32)
    return Families(parent, rng.integers(1, 9, count).astype(np.uint16), rng.random((count, 3), np.float32), size)


def families_of(splats: Splats, tree: LodTree) -> Families:
    nodes = np.flatnonzero(tree.child_count)
    number = np.full(len(tree), -1, np.int32)
    number[nodes] = np.arange(len(nodes))
    above = find_parents(tree.child_count, tree.child_start)[0][nodes]
    parent = np.where(above < 0, np.int32(-1), number[above])
    return Families(parent, tree.child_count[nodes], splats.center[nodes], spark_size(splats)[nodes])


def check_order(families: Families, sequence: np.ndarray) -> None:
    """All families, parents first."""
    place = np.empty(len(sequence), np.int64)
    place[sequence] = np.arange(len(sequence))
    assert np.array_equal(np.sort(sequence), np.arange(len(families.parent)))
    assert (place[families.parent[1:]] < place[1:]).all()


@given(st.integers(1, 400), st.integers(0, 1000), st.integers(1, 100))
@settings(max_examples=60)
def test_parts_are_small_and_parents_come_first(count: int, seed: int, most: int) -> None:
    families = random_tree(count, seed)
    parts = families.parts(most)
    assert max(map(len, parts)) <= most and min(map(len, parts)) >= 1
    check_order(families, np.concatenate(parts))
    assert all((np.diff(part) > 0).all() for part in parts)


def test_the_first_part_has_the_largest_families() -> None:
    families = random_tree(500, 4)
    limit = find_limits(families.parent, np.fmax(families.size, np.float32(0)))[1]
    first = families.parts(60)[0]
    rest = np.delete(limit, first)
    assert len(first) == 60 and limit[first].min() >= rest.max()


@pytest.fixture(scope="module")
def quality_tree() -> tuple[Splats, LodTree]:
    return quality.build(random_splats(60_000, seed=3), 1.3)


@pytest.mark.parametrize("most", [700, 4_000])
def test_chunks_are_full_across_parts(
    most: int, quality_tree: tuple[Splats, LodTree], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part goes on where the one before ends, so that hardly a family lies in two chunks."""
    monkeypatch.setattr(chunk_order, "CHUNK_NODES", 1_024)
    families = families_of(*quality_tree)
    sequence = family_order(*families, most=most)
    check_order(families, sequence)
    last = np.cumsum(families.count[sequence].astype(np.int64))  # the root is node 0
    first = last - families.count[sequence] + 1
    across, parts = int(np.count_nonzero(first // 1_024 != last // 1_024)), len(families.parts(most))
    assert parts > 4 and across <= parts // 2 + 1
    assert not np.array_equal(sequence, family_order(*families))


def test_one_part_is_the_order_of_the_tree(quality_tree: tuple[Splats, LodTree]) -> None:
    families, (_, tree) = families_of(*quality_tree), quality_tree
    assert len(families.parts(len(families.parent))) == 1
    sequence = family_order(*families, most=len(families.parent))
    order, _ = order_of(*quality_tree)
    first = tree.child_start[np.flatnonzero(tree.child_count)[sequence]]
    assert np.array_equal(first, order[np.cumsum([1, *families.count[sequence]])[:-1]])


def test_an_order_does_not_depend_on_the_one_before(built: tuple[Splats, LodTree]) -> None:
    """But for ties, of which this tree has none: arranging twice is arranging once."""
    once = arrange(*built)
    twice = arrange(*once)
    assert np.array_equal(once[1].child_start, twice[1].child_start)
    assert np.array_equal(once[0].center, twice[0].center)


def test_parts_are_the_same_whatever_is_looked_at_together(monkeypatch: pytest.MonkeyPatch) -> None:
    families = random_tree(900, 1)
    expected = families.parts(70)
    monkeypatch.setattr("sparklod_cli.lod.chunk_order._ROWS", 16)
    found = families.parts(70)
    assert len(found) == len(expected) and all(map(np.array_equal, found, expected))


def test_an_order_leaves_its_arguments(quality_tree: tuple[Splats, LodTree]) -> None:
    families = families_of(*quality_tree)
    before = [column.copy() for column in families]
    family_order(*families, most=2_000)
    for column, values in zip(families, before, strict=True):
        assert np.array_equal(column, values)
