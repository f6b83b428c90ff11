"""The orders of nodes: in chunks of whole families, of which views need few; and in bands from coarse to fine."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.codecs.spark_nodes import Nodes
from sparklod_cli.lod import chunk_order, quality, quick
from sparklod_cli.lod.chunk_order import arrange, banded, family_order, parts_of
from sparklod_cli.lod.kernels.chunk_sets import LANES, fill_demand
from sparklod_cli.lod.kernels.pixel_scale import NODE
from sparklod_cli.lod.kernels.tree_links import find_limits
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import CHUNK_NODES, LodTree
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.threads import on_threads
from sparklod_cli.viewers.loaded_scene import Forest, TreeCut, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from sparklod_cli.viewers.viewer_settings import LodSettings
from tests.lod.trees import CutView, check_threads, check_tree, children, links, parents, sorted_rows
from tests.references import chunk_orders
from tests.references.chunk_orders import reordered, spark_order
from tests.scenes import random_splats

SMALL = 16


@pytest.fixture(scope="class")
def small_chunks() -> Iterator[None]:
    """Small chunks, so that small trees have many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunk_order, "CHUNK_NODES", SMALL)
        yield


@pytest.fixture(scope="module")
def built() -> tuple[Splats, LodTree]:
    """A tree of five chunks."""
    return quick.build(random_splats(220_000, seed=2))


@pytest.fixture(scope="module")
def quality_tree() -> tuple[Splats, LodTree]:
    return quality.build(random_splats(60_000, seed=3), 1.3)


def grown(fan_out: list[int], seed: int = 0) -> tuple[Splats, LodTree]:
    """A tree whose inner nodes have so many children, which scatter around their parents and are mostly smaller."""
    rng = np.random.default_rng(seed)
    tree = links(fan_out)
    splats = random_splats(len(tree), seed=seed)
    center, scale = splats.center, splats.scale
    center[0], scale[0] = 0, 1
    for node in np.flatnonzero(tree.child_count):
        part, count = children(tree, node), int(tree.child_count[node])
        center[part] = center[node] + rng.normal(size=(count, 3)) * scale[node]
        scale[part] = scale[node] * rng.uniform(0.3, 1.1, (count, 1))
    return dataclasses.replace(splats, rgb=np.arange(3 * len(tree), dtype=np.float32).reshape(-1, 3)), tree


def numbers_of(splats: Splats) -> np.ndarray:
    """The numbers that nodes of `grown` have in their colours."""
    return (splats.rgb[:, 0] / 3).astype(np.int64)


def limits(nodes: Splats, tree: LodTree) -> np.ndarray:
    """The least size from the root to each node."""
    limit, parent = spark_size(nodes).copy(), parents(tree)
    for node in range(1, len(tree)):
        limit[node] = min(limit[node], limit[parent[node]])
    return limit


def check_same_tree(before: tuple[Splats, LodTree], after: tuple[Splats, LodTree]) -> None:
    """The same splats, root and children."""
    (splats, tree), (ordered, arranged) = before, after
    arranged.validate()
    old = numbers_of(ordered)
    assert np.array_equal(np.sort(old), np.arange(len(tree)))
    for name in COLUMNS:
        assert np.array_equal(getattr(ordered, name), getattr(splats, name)[old])
    assert old[0] == 0
    assert np.array_equal(arranged.child_count, tree.child_count[old])
    for node in np.flatnonzero(arranged.child_count):
        assert old[children(arranged, node)].tolist() == list(range(len(tree))[children(tree, old[node])])


@pytest.mark.usefixtures("small_chunks")
class TestSmallChunks:
    @given(st.lists(st.integers(1, 7), max_size=60), st.integers(0, 3))
    @settings(max_examples=60)
    def test_it_is_the_same_tree(self, fan_out: list[int], seed: int) -> None:
        tree = grown(fan_out, seed)
        check_same_tree(tree, arrange(*tree))

    @pytest.mark.parametrize("seed", range(5))
    def test_chunks_are_those_of_plain_lists(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        splats, tree = grown(rng.integers(2, 6, 40 + 20 * seed).tolist(), seed)
        expected, arranged_parent, rank, bits = plain_chunks(splats, tree)
        ordered, arranged = arrange(splats, tree)
        inner = np.flatnonzero(arranged.child_count)
        families = numbers_of(ordered)[inner[np.argsort(arranged.child_start[inner])]].tolist()
        at = 0
        for chunk in expected:
            nodes, numbers = families[at : at + len(chunk)], dict(chunk)
            at += len(chunk)
            assert sorted(nodes) == sorted(numbers)
            members = [number for _, number in chunk]
            keys = dict(zip(members, chunk_orders.inside(members, arranged_parent, rank, bits), strict=True))
            got = [keys[numbers[node]] for node in nodes]
            assert got == sorted(got)
        assert at == len(families)


def plain_chunks(splats: Splats, tree: LodTree) -> tuple[list[list[tuple[int, int]]], list[int], list[list[int]], int]:
    """(node, family) of each chunk by plain lists; and parents, ranks and bits of the families' numbers."""
    size, parent = spark_size(splats), parents(tree)
    limit = limits(splats, tree)
    nodes = sorted(np.flatnonzero(tree.child_count).tolist(), key=lambda node: (-limit[node], node))
    number = {node: at for at, node in enumerate(nodes)}
    above = [number[int(parent[node])] if node else -1 for node in nodes]
    centers = splats.center[nodes]
    rank = np.argsort(np.argsort(centers, axis=0, kind="stable"), axis=0).tolist()
    records = np.zeros(len(nodes), NODE)
    records["x"], records["y"], records["z"] = centers.T
    records["size"], records["child_count"] = size[nodes], tree.child_count[nodes]
    least, most = min(len(tree) / 16, SMALL), len(tree)
    columns = [chunk_orders.demand(records, above, view, least, most) for view in chunk_order.viewpoints(centers)]
    demand = np.array(columns).T.tolist()
    counts = tree.child_count[nodes].astype(int).tolist()
    chunks = chunk_orders.Splitter(above, counts, rank, demand, SMALL).chunks()
    bits = (len(nodes) - 1).bit_length()
    return [[(nodes[family], family) for family in chunk] for chunk in chunks], above, rank, bits


@pytest.mark.parametrize(
    "fan_out",
    [[], [1], [1] * 300, [65535], [65535, *[3] * 40], [65535] * 3, [2] * 200, [9, *[0] * 8, 5]],
    ids=["one node", "two", "chain", "star", "star and more", "three stars", "small", "deep at the end"],
)
def test_degenerate_trees_keep_their_links(fan_out: list[int]) -> None:
    tree = grown(fan_out)
    check_same_tree(tree, arrange(*tree))


@pytest.mark.parametrize("name", ["center", "scale"])
@pytest.mark.parametrize("value", [0.0, 1e30])
def test_trees_with_equal_centres_or_sizes_keep_their_links(name: str, value: float) -> None:
    splats, tree = grown([3] * 30_000)
    getattr(splats, name)[:] = value
    check_same_tree((splats, tree), arrange(splats, tree))


def test_nodes_without_a_size_are_not_lost() -> None:
    """Sizes that are not numbers count as none, as a viewer would never refine such a node."""
    splats, tree = grown([3] * 30_000)
    splats.scale[5:50] = np.nan
    order, child_start = chunk_order.chunk_order(splats, tree)
    assert np.array_equal(np.sort(order), np.arange(len(tree)))
    LodTree(tree.child_count[order], child_start).validate()


def test_threads_do_not_change_a_bit(built: tuple[Splats, LodTree]) -> None:
    check_threads(lambda: arrange(*built))
    check_threads(lambda: banded([quick.build(random_splats(20_000, seed=3), 1.5)]))


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


def test_the_first_chunk_refines_the_largest_nodes_and_no_family_is_in_two_chunks(
    built: tuple[Splats, LodTree],
) -> None:
    """No node outside is larger than all but the last inside."""
    splats, tree = arrange(*built)
    inner = ~tree.is_leaf
    first = tree.child_start[inner].astype(np.int64)
    last = first + tree.child_count[inner] - 1
    assert np.array_equal(first // CHUNK_NODES, last // CHUNK_NODES)
    sizes, in_first = limits(splats, tree)[inner], last < CHUNK_NODES
    assert np.sort(sizes[in_first])[100] >= sizes[~in_first].max()


@pytest.mark.slow
def test_views_touch_fewer_chunks_than_in_sparks_order() -> None:
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
    across, along = np.array([np.cos(turn), 0, np.sin(turn)]), np.array([-np.sin(turn), 0, np.cos(turn)])
    pose = np.eye(4)
    pose[:3] = np.stack([across, [0, 1, 0], -along, 9 * across], axis=1)
    forest = Forest([Nodes(tree[0].center, spark_size(tree[0]), tree[1])])
    viewer = SparkViewer(forest, [TreeInstance(foveation=LodSettings().foveation)])
    return viewer.cut(CutView(pose, 1.5, 1.0), budget=40_000)


def test_progress_ends_at_the_number_of_nodes(built: tuple[Splats, LodTree]) -> None:
    seen: list[tuple[str, int, int, str]] = []
    arrange(*built, progress=lambda *event: seen.append(event))
    done = [at for _, at, _, _ in seen]
    assert done == sorted(done) and seen[-1] == ("arranging", len(built[1]), len(built[1]), "node")


# Families


class Families(NamedTuple):
    """The arguments of `family_order`."""

    parent: np.ndarray
    count: np.ndarray
    center: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, splats: Splats, tree: LodTree) -> Families:
        nodes, parent = chunk_order.families_of(tree)
        return cls(parent, tree.child_count[nodes], splats.center[nodes], spark_size(splats)[nodes])

    @property
    def limit(self) -> np.ndarray:
        return find_limits(self.parent, np.fmax(self.size, np.float32(0)))[1]

    def parts(self, most: int) -> list[np.ndarray]:
        return list(parts_of(self.parent, self.center, self.limit, most))


def random_families(count: int, seed: int) -> Families:
    """Families below random others; sizes of a few values, so that there are ties."""
    rng = np.random.default_rng(seed)
    parent = np.array([-1, *(rng.integers(max(0, i - 20), i) for i in range(1, count))], np.int32)
    size = rng.choice([0.5, 1, 2, np.nan], count).astype(np.float32)
    return Families(parent, rng.integers(1, 9, count).astype(np.uint16), rng.random((count, 3), np.float32), size)


def check_order(families: Families, sequence: np.ndarray) -> None:
    """All families, parents first."""
    place = np.empty(len(sequence), np.int64)
    place[sequence] = np.arange(len(sequence))
    assert np.array_equal(np.sort(sequence), np.arange(len(families.parent)))
    assert (place[families.parent[1:]] < place[1:]).all()


def test_demand_never_rises_from_parent_to_child() -> None:
    rng, count = np.random.default_rng(1), 500
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
    rng, count = np.random.default_rng(3), 1 << 17
    parent = ((np.arange(count) - 1) // 3).astype(np.int32)
    parent[0] = -1
    size = np.exp(-6 * rng.random(count)).astype(np.float32)
    families = Families(parent, np.full(count, 3, np.uint16), rng.random((count, 3), np.float32), size)
    family_order(*(column[:9] for column in families))  # loads kernels
    tracemalloc.start()
    try:
        with on_threads(2):
            family_order(*families)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    kernels = 4 + 8 + 8  # arrays of `sort_within_chunks`, of both chunks at the same time; not of Python's memory
    assert peak / count + kernels == pytest.approx(chunk_order.family_bytes(2), rel=0.1)


@given(st.integers(1, 400), st.integers(0, 1000), st.integers(1, 100))
@settings(max_examples=60)
def test_parts_are_small_and_parents_come_first(count: int, seed: int, most: int) -> None:
    families = random_families(count, seed)
    parts = families.parts(most)
    assert max(map(len, parts)) <= most and min(map(len, parts)) >= 1
    check_order(families, np.concatenate(parts))
    assert all((np.diff(part) > 0).all() for part in parts)
    rest = np.delete(families.limit, parts[0])
    assert len(parts[0]) == min(most, count) and families.limit[parts[0]].min() >= rest.max(initial=-1)
    with pytest.MonkeyPatch.context() as patch:  # parts do not depend on how many families are processed at a time
        patch.setattr(chunk_order, "_ROWS", 16)
        again = families.parts(most)
    assert len(again) == len(parts) and all(map(np.array_equal, again, parts))


@pytest.mark.parametrize("most", [700, 4_000])
def test_chunks_are_full_across_parts(
    most: int, quality_tree: tuple[Splats, LodTree], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part goes on where the one before ends, so that hardly a family lies in two chunks."""
    monkeypatch.setattr(chunk_order, "CHUNK_NODES", 1_024)
    families = Families.of(*quality_tree)
    before = [column.copy() for column in families]
    sequence = family_order(*families, most=most)
    assert all(map(np.array_equal, families, before))
    check_order(families, sequence)
    last = np.cumsum(families.count[sequence].astype(np.int64))  # the root is node 0
    first = last - families.count[sequence] + 1
    across, parts = int(np.count_nonzero(first // 1_024 != last // 1_024)), len(families.parts(most))
    assert parts > 4 and across <= parts // 2 + 1
    assert not np.array_equal(sequence, family_order(*families))


def test_one_part_is_the_order_of_the_tree(quality_tree: tuple[Splats, LodTree]) -> None:
    families, (_, tree) = Families.of(*quality_tree), quality_tree
    assert len(families.parts(len(families.parent))) == 1
    sequence = family_order(*families, most=len(families.parent))
    order, _ = chunk_order.chunk_order(*quality_tree)
    first = tree.child_start[np.flatnonzero(tree.child_count)[sequence]]
    assert np.array_equal(first, order[np.cumsum([1, *families.count[sequence]])[:-1]])


# Bands


@pytest.fixture(scope="class")
def small_bands() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunk_order, "FIRST_BAND", 16)
        yield


def bands_of(nodes: Splats, tree: LodTree) -> tuple[np.ndarray, np.ndarray]:
    """The parents of families in the order of these, and the band of each: by how many nodes larger ones need."""
    inner = np.flatnonzero(tree.child_count)
    order = np.argsort(-limits(nodes, tree)[inner], kind="stable")
    needed = np.cumsum(tree.child_count[inner][order].astype(int)) - tree.child_count[inner][order]
    band = np.empty(len(inner), int)
    band[order] = [sum(n >= 16 * 4**k for k in range(20)) for n in needed]
    by_children = np.argsort(tree.child_start[inner])
    return inner[by_children], band[by_children]


@pytest.mark.usefixtures("small_bands")
class TestSmallBands:
    @given(st.integers(1, 400), st.integers(0, 2**32 - 1), st.sampled_from(["quick", "quality"]))
    @settings(max_examples=15)
    def test_bands_go_from_coarse_to_fine_and_each_along_the_tree(self, count: int, seed: int, method: str) -> None:
        splats = random_splats(count, sh_degree=1, seed=seed)
        before, links_before = quick.build(splats, 1.3) if method == "quick" else quality.build(splats, 1.4)
        nodes, tree = banded([(before, links_before)])
        check_tree(splats, nodes, tree)
        assert np.array_equal(sorted_rows(nodes), sorted_rows(before))
        order, _ = bands_of(nodes, tree)
        # Bands are counted in the order that the tree had: sizes that are equal are in it.
        old, band = bands_of(before, links_before)
        band_of = {before.center[node].tobytes(): b for node, b in zip(old, band, strict=True)}
        found = np.array([band_of[nodes.center[node].tobytes()] for node in order])
        assert (np.diff(found) >= 0).all()
        # In a band, a family is followed by those of its own members that are in it.
        parent = parents(tree)
        place = {int(node): at for at, node in enumerate(order)}
        ends = np.arange(len(order)) + 1
        for at in reversed(range(len(order))):
            for node in range(*children(tree, order[at]).indices(len(tree))):
                if node in place and found[place[node]] == found[at]:
                    ends[at] = max(ends[at], ends[place[node]])
        for at, node in enumerate(order):
            if node and found[place[int(parent[node])]] == found[at]:
                assert place[int(parent[node])] < at < ends[place[int(parent[node])]]
            assert (found[at : ends[at]] == found[at]).all()

    def test_siblings_keep_their_order(self) -> None:
        before, links_before = quick.build(random_splats(2_000, seed=1), 1.5)
        nodes, tree = banded([(before, links_before)])
        place = {row.tobytes(): at for at, row in enumerate(before.center)}
        old = np.array([place[row.tobytes()] for row in nodes.center])
        for node in np.flatnonzero(tree.child_count):
            assert (np.diff(old[children(tree, node)]) == 1).all()

    def test_the_end_of_a_band_is_an_even_scene(self) -> None:
        """Nodes refined in later bands are smaller than nodes refined before, but for the family across the border."""
        nodes, tree = banded([quality.build(random_splats(5_000, seed=2), 1.4)])
        limit, (order, band) = limits(nodes, tree), bands_of(nodes, tree)
        for end in np.flatnonzero(np.diff(np.maximum.accumulate(band))):
            assert limit[order[: end + 1]].min() >= limit[order[end + 1 :]].max()
