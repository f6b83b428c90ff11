"""The order of chunks in parts: still the same tree, in full chunks, and nearly as good for viewers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod import chunk_order, quick
from sparklod_cli.lod.chunk_order import sequence_of
from sparklod_cli.lod.chunk_parts import FamilyTree, parts_of
from tests.scenes import random_splats


def random_tree(count: int, seed: int) -> FamilyTree:
    """Families below random others; sizes of a few values, so that there are ties."""
    rng = np.random.default_rng(seed)
    parent = np.array([-1, *(rng.integers(max(0, i - 20), i) for i in range(1, count))], np.int32)
    size = rng.choice([0.5, 1, 2, np.nan], count).astype(np.float32)
    return FamilyTree(parent, rng.integers(1, 9, count).astype(np.uint16), rng.random((count, 3), np.float32), size)


def limits_plainly(tree: FamilyTree) -> np.ndarray:
    limit = np.fmax(tree.size, 0)
    for family in range(1, len(tree)):
        limit[family] = min(limit[family], limit[tree.parent[family]])
    return limit


def check_sequence(tree: FamilyTree, sequence: np.ndarray) -> None:
    """All families, parents first."""
    place = np.empty(len(tree), np.int64)
    place[sequence] = np.arange(len(tree))
    assert np.array_equal(np.sort(sequence), np.arange(len(tree)))
    assert (place[tree.parent[1:]] < place[1:]).all()


@given(st.integers(1, 400), st.integers(0, 1000), st.integers(1, 100))
@settings(max_examples=60)
def test_parts_are_small_and_parents_come_first(count: int, seed: int, most: int) -> None:
    tree = random_tree(count, seed)
    limit = tree.limits()
    assert np.array_equal(limit, limits_plainly(tree))
    parts = list(parts_of(tree, limit, np.arange(count, dtype=np.int32), most))
    assert max(map(len, parts)) <= most and min(map(len, parts)) >= 1
    check_sequence(tree, np.concatenate(parts))
    assert limit[parts[0]].min() >= np.sort(limit)[::-1][: len(parts[0])].min()


def test_limits_of_many_families_go_through_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.lod.chunk_parts._ROWS", 16)
    tree = random_tree(300, 1)
    assert np.array_equal(tree.limits(), limits_plainly(tree))
    assert sum(map(len, parts_of(tree, tree.limits(), np.arange(300, dtype=np.int32), 40))) == 300


@pytest.fixture(scope="module")
def families() -> FamilyTree:
    splats, tree = quick.build(random_splats(60_000, seed=3), 1.5)
    return chunk_order._family_tree(splats, tree, np.flatnonzero(tree.child_count).astype(np.uint32))


@pytest.mark.parametrize("most", [700, 4_000, 1 << 30])
def test_chunks_are_full_across_parts(families: FamilyTree, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first part goes on where the root ends, and each other one where the one before ends."""
    monkeypatch.setattr(chunk_order, "CHUNK_NODES", 1_024)
    sequence = sequence_of(families, most=most)
    check_sequence(families, sequence)
    count = families.count[sequence].astype(np.int64)
    last = np.cumsum(count)  # the root is node 0
    first = last - count + 1
    across = np.count_nonzero(first // 1_024 != last // 1_024)
    parts = len(list(parts_of(families, families.limits(), np.arange(len(families), dtype=np.int32), most)))
    print("across", across, parts, last[-1] // 1_024)
    assert across <= 2 * parts
    if most >= len(families):
        assert np.array_equal(sequence, sequence_of(families))
        assert parts == 1
    else:
        assert parts > 1 and not np.array_equal(sequence, sequence_of(families))


def test_a_sequence_leaves_its_arguments(families: FamilyTree) -> None:
    before = [getattr(families, name).copy() for name in ("parent", "count", "center", "size")]
    sequence_of(families, most=2_000)
    for name, values in zip(("parent", "count", "center", "size"), before, strict=True):
        assert np.array_equal(getattr(families, name), values)
