"""LodTree: the layout by hand, both sizes, and the largest error of every field."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs.gpu import lod_tree
from sparklod_cli.lod import quick
from sparklod_cli.model import gaussian
from sparklod_cli.model.gaussian import linear_opacity
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.threads import BLOCK_ROWS
from tests.scenes import random_splats


def links(child_count: Any, child_start: Any) -> LodTree:
    return LodTree(np.asarray(child_count, np.uint16), np.asarray(child_start, np.uint32))


def splats_with(count: int, **columns: Any) -> Splats:
    splats = random_splats(count)
    for name, values in columns.items():
        getattr(splats, name)[:] = values
    return splats


def sized(size: np.ndarray) -> Splats:
    """Opaque splats that are spheres of this size."""
    return splats_with(len(size), scale=(size / 2)[:, None], opacity=1)


def test_a_node_is_four_words_of_these_bytes() -> None:
    splats = splats_with(2, center=[1, -2, 0.5], scale=[0.25, 0.5, 0.75], opacity=[1, linear_opacity(np.float32(3))])
    packed = lod_tree.pack(splats, links([65535, 0], [2**32 - 1, 0]))
    assert list(packed) == ["lod_tree"]
    expected = struct.pack("<4eII", 1, -2, 0.5, 1, 65535, 2**32 - 1) + struct.pack("<4eII", 1, -2, 0.5, 2.4, 0, 0)
    assert packed["lod_tree"].tobytes() == expected
    assert packed["lod_tree"].dtype == np.uint32
    assert packed["lod_tree"].shape == (2, 4)
    x, y, z, size = np.array([1, -2, 0.5, 1], np.float16).view(np.uint16).astype(int)
    assert packed["lod_tree"][0].tolist() == [x | y << 16, z | size << 16, 65535, 2**32 - 1]


def test_node_sizes_are_those_worked_out_by_hand() -> None:
    splats = splats_with(3, scale=[0.25, 0.5, 0.75], opacity=[0.3, 1, linear_opacity(np.float32(3))])
    np.testing.assert_allclose(gaussian.spark_size(splats), [1, 1, 2.4], rtol=1e-6)
    sizes = lod_tree.unpack(lod_tree.pack(splats, links([0, 0, 0], [0, 0, 0]))).size
    np.testing.assert_array_equal(sizes, np.float16([1, 1, 2.4]))


def test_sizes_keep_and_reach_their_error() -> None:
    size = np.exp(np.linspace(-20, np.log(65504), 100_001)).astype(np.float32)
    got = lod_tree.unpack(lod_tree.pack(sized(size), links([0] * size.size, [0] * size.size)))
    error = np.abs(got.size.astype(np.float64) - size) / np.maximum(2.0**-11 * size, 2.0**-25)
    assert 0.99 <= error.max() <= 1.001
    assert error[size < 2.0**-14].max() >= 0.99


@given(center=arrays(np.float32, (8, 3), elements=st.floats(-65504, 65504, width=32)))
def test_centres_keep_their_error(center: np.ndarray) -> None:
    back = lod_tree.unpack(lod_tree.pack(splats_with(8, center=center), links([0] * 8, [0] * 8))).center
    assert (np.abs(back.astype(float) - center) <= np.maximum(2.0**-11 * np.abs(center), 2.0**-25)).all()


@pytest.mark.filterwarnings("error")
def test_sizes_and_centres_beyond_float16_are_infinite_without_a_warning() -> None:
    splats = splats_with(1, center=[3e38, -3e38, 65519], scale=3e38, opacity=1000)
    got = lod_tree.unpack(lod_tree.pack(splats, links([0], [0])))
    assert got.center.tolist() == [[np.inf, -np.inf, 65504]]
    assert got.size.tolist() == [np.inf]


@pytest.mark.parametrize("threads", [1, 2])
def test_a_whole_tree_comes_back(threads: int) -> None:
    splats, tree = quick.build(random_splats(BLOCK_ROWS + 1000))
    packed = lod_tree.pack(splats, tree, threads=threads)
    got = lod_tree.unpack(packed)
    got.tree.validate()
    assert got.tree.child_count.dtype == np.uint16
    assert got.tree.child_start.dtype == np.uint32
    np.testing.assert_array_equal(got.tree.child_count, tree.child_count)
    np.testing.assert_array_equal(got.tree.child_start, tree.child_start)
    np.testing.assert_array_equal(got.center, splats.center.astype(np.float16))
    np.testing.assert_array_equal(got.size, gaussian.spark_size(splats).astype(np.float16))
    packed["lod_tree"][:] = 0
    got.tree.validate()  # a copy


def test_a_tree_of_no_nodes_is_an_empty_array() -> None:
    packed = lod_tree.pack(Splats.empty(0, 0), links([], []))
    assert packed["lod_tree"].shape == (0, 4)
    assert len(lod_tree.unpack(packed).tree) == 0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({}, "no array lod_tree"),
        ({"lod_tree": np.zeros((3, 3), np.uint32)}, "lod_tree is"),
        ({"lod_tree": np.zeros((3, 4), np.int64)}, "lod_tree is int64"),
        (
            {"lod_tree": np.uint32([[0, 0, 1, 1], [0, 0, 65536, 2]])},
            "node 1 has 65,536 children, a uint16 holds at most 65,535",
        ),
    ],
)
def test_arrays_that_are_not_a_tree_are_refused(change: dict[str, np.ndarray], text: str) -> None:
    with pytest.raises(FormatError, match=text):
        lod_tree.unpack(change)


def test_trees_that_do_not_fit_into_the_words_are_refused() -> None:
    with pytest.raises(FormatError, match="2 nodes, but 3 splats"):
        lod_tree.pack(random_splats(3), links([0, 0], [0, 0]))
