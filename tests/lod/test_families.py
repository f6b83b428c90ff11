"""Laws of the order of nodes in bands: a valid tree of the same nodes, coarse before fine, along the tree in a band."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod import chunk_order, quality, quick
from sparklod_cli.lod.chunk_order import banded, families_of
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from tests.lod.trees import check_threads, check_tree, children, parents, sorted_rows
from tests.scenes import random_splats


@pytest.fixture(autouse=True)
def _small_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunk_order, "FIRST_BAND", 16)


def limits(nodes: Splats, tree: LodTree) -> np.ndarray:
    """The least size from the root to each node."""
    limit, parent = spark_size(nodes).copy(), parents(tree)
    for node in range(1, len(tree)):
        limit[node] = min(limit[node], limit[parent[node]])
    return limit


def bands_of(nodes: Splats, tree: LodTree) -> tuple[np.ndarray, np.ndarray]:
    """The parents of families in the order of these, and the band of each: by how many nodes larger ones need."""
    inner = np.flatnonzero(tree.child_count)
    limit = limits(nodes, tree)[inner]
    order = np.argsort(-limit, kind="stable")
    needed = np.cumsum(tree.child_count[inner][order].astype(int)) - tree.child_count[inner][order]
    band = np.empty(len(inner), int)
    band[order] = [sum(n >= 16 * 4**k for k in range(20)) for n in needed]
    by_children = np.argsort(tree.child_start[inner])
    return inner[by_children], band[by_children]


@given(st.integers(2, 400), st.integers(0, 2**32 - 1), st.sampled_from(["quick", "quality"]))
@settings(max_examples=15, deadline=None)
def test_bands_go_from_coarse_to_fine_and_each_along_the_tree(count: int, seed: int, method: str) -> None:
    splats = random_splats(count, sh_degree=1, seed=seed)
    before, links = quick.build(splats, 1.3) if method == "quick" else quality.build(splats, 1.4)
    nodes, tree = banded([(before, links)])
    check_tree(splats, nodes, tree)
    assert np.array_equal(sorted_rows(nodes), sorted_rows(before))
    order, _ = bands_of(nodes, tree)
    # Bands are counted in the order that the tree had: sizes that are equal are in it.
    old, band = bands_of(before, links)
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
        inside = [found[k] == found[at] for k in range(at, ends[at])]
        assert all(inside)


def test_siblings_keep_their_order() -> None:
    before, links = quick.build(random_splats(2_000, seed=1), 1.5)
    nodes, tree = banded([(before, links)])
    place = {row.tobytes(): at for at, row in enumerate(before.center)}
    old = np.array([place[row.tobytes()] for row in nodes.center])
    for node in np.flatnonzero(tree.child_count):
        assert (np.diff(old[children(tree, node)]) == 1).all()


def test_the_end_of_a_band_is_an_even_scene() -> None:
    """What is left for later is smaller than whatever was refined before, but for the family across the border."""
    before, links = quality.build(random_splats(5_000, seed=2), 1.4)
    nodes, tree = banded([(before, links)])
    limit = limits(nodes, tree)
    order, band = bands_of(nodes, tree)
    for end in np.flatnonzero(np.diff(np.maximum.accumulate(band))):
        assert limit[order[: end + 1]].min() >= limit[order[end + 1 :]].max()


def test_a_single_node_stays() -> None:
    nodes, tree = banded([quick.build(random_splats(1), 1.5)])
    assert len(nodes) == len(tree) == 1
    assert families_of(tree)[0].size == 0


def test_threads_do_not_change_a_bit() -> None:
    before = quick.build(random_splats(20_000, seed=3), 1.5)
    check_threads(lambda: banded([before]))
