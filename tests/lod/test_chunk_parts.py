"""The order of chunks in parts: still the same tree, in full chunks, and nearly as good for viewers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod import chunk_order, quality
from sparklod_cli.lod.chunk_order import chunk_order as order_of
from sparklod_cli.lod.chunk_order import family_order
from sparklod_cli.lod.chunk_parts import parts_of
from sparklod_cli.lod.kernels.family_links import find_limits
from sparklod_cli.lod.kernels.tree_links import find_parents
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from tests.scenes import random_splats


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


def test_parts_are_the_same_whatever_is_looked_at_together(monkeypatch: pytest.MonkeyPatch) -> None:
    families = random_tree(900, 1)
    expected = families.parts(70)
    monkeypatch.setattr("sparklod_cli.lod.chunk_parts._ROWS", 16)
    found = families.parts(70)
    assert len(found) == len(expected) and all(map(np.array_equal, found, expected))


@pytest.fixture(scope="module")
def built() -> tuple[Splats, LodTree]:
    return quality.build(random_splats(60_000, seed=3), 1.3)


@pytest.mark.parametrize("most", [700, 4_000])
def test_chunks_are_full_across_parts(
    most: int, built: tuple[Splats, LodTree], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part goes on where the one before ends, so that hardly a family lies in two chunks."""
    monkeypatch.setattr(chunk_order, "CHUNK_NODES", 1_024)
    families = families_of(*built)
    sequence = family_order(*families, most=most)
    check_order(families, sequence)
    last = np.cumsum(families.count[sequence].astype(np.int64))  # the root is node 0
    first = last - families.count[sequence] + 1
    across, parts = int(np.count_nonzero(first // 1_024 != last // 1_024)), len(families.parts(most))
    assert parts > 4 and across <= parts // 2 + 1
    assert not np.array_equal(sequence, family_order(*families))


def test_one_part_is_the_order_of_the_tree(built: tuple[Splats, LodTree]) -> None:
    families, (_, tree) = families_of(*built), built
    assert len(families.parts(len(families.parent))) == 1
    sequence = family_order(*families, most=len(families.parent))
    order, _ = order_of(*built)
    first = tree.child_start[np.flatnonzero(tree.child_count)[sequence]]
    assert np.array_equal(first, order[np.cumsum([1, *families.count[sequence]])[:-1]])


def test_an_order_leaves_its_arguments(built: tuple[Splats, LodTree]) -> None:
    families = families_of(*built)
    before = [column.copy() for column in families]
    family_order(*families, most=2_000)
    for column, values in zip(families, before, strict=True):
        assert np.array_equal(column, values)
