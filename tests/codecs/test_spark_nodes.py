"""Nodes as Spark has them: the layout of its traversal, and nodes measured after Spark's coding, in its own arithmetic.

`tests/interop/test_spark_cuts.py` holds them to Spark, bit for bit.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs import layouts, quantize, spark_nodes
from sparklod_cli.codecs.formats import LOADED
from sparklod_cli.codecs.spark_codings import SplatEncoding, log_scale_table
from sparklod_cli.codecs.spark_nodes import Nodes
from sparklod_cli.lod import quick
from sparklod_cli.model import gaussian
from sparklod_cli.model.gaussian import linear_opacity
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import PLAIN_SCALES, SPZ_SCALES, FileCoding, ScaleCoding, Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.threads import BLOCK_ROWS
from tests.codecs.cases import half_float, splats_with
from tests.scenes import random_splats

SPZ = FileCoding((SPZ_SCALES,))
NARROW = SplatEncoding(ln_scale_min=-9, ln_scale_max=1, lod_opacity=True)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(*quick.build(random_splats(40_000)))


def nodes(scene: Scene, layout: str, coding: FileCoding | None = None, threads: int = 1) -> Nodes:
    assert scene.tree is not None
    return spark_nodes.nodes(scene.splats, scene.tree, layout, coding, threads=threads)


def unpacked(scene: Scene, layout: str, encoding: SplatEncoding) -> Splats:
    if layout == "ext":
        return layouts.unpack_ext(layouts.pack_ext(scene.splats))
    return layouts.unpack_packed(layouts.pack_packed(scene.splats, encoding), encoding)


@pytest.mark.parametrize(
    ("layout", "encoding"), [("ext", NARROW), ("packed", NARROW), ("packed-pages", SplatEncoding(lod_opacity=True))]
)
def test_nodes_are_nearly_those_of_unpacked_words(scene: Scene, layout: str, encoding: SplatEncoding) -> None:
    """The range of the file is that of PackedSplats, but not of those in pages."""
    assert scene.tree is not None
    coding = FileCoding(packed_range=(NARROW.ln_scale_min, NARROW.ln_scale_max))
    found = nodes(scene, layout, coding)
    twin = layouts.unpack_nodes(layouts.pack_nodes(unpacked(scene, layout, encoding), scene.tree))
    assert np.array_equal(found.center, twin.center)
    assert np.mean(found.size != twin.size) < 1e-3
    assert found.tree is scene.tree


@pytest.mark.parametrize("layout", LOADED)
def test_nodes_do_not_depend_on_threads(scene: Scene, layout: str) -> None:
    one, two = nodes(scene, layout, SPZ), nodes(scene, layout, SPZ, threads=2)
    assert np.array_equal(one.size, two.size) and np.array_equal(one.center, two.center)


def with_scales(scene: Scene, scale: np.ndarray) -> Scene:
    return replace(scene, splats=replace(scene.splats, scale=np.ascontiguousarray(scale, np.float32)))


@pytest.mark.parametrize("layout", LOADED)
@pytest.mark.parametrize("coding", [SPZ_SCALES, ("ln_0r8", -12, 9), ("ln_f16", 0, 0)])
def test_codes_are_decoded_as_spark_decodes_them(scene: Scene, layout: str, coding: ScaleCoding) -> None:
    """Not by the scales that they have in `Splats`, whose last bits differ and decide ties."""
    codes = np.random.default_rng(0).integers(1, 256, (len(scene), 3)).astype(np.uint8)
    logs = codes.astype(np.float32) / 16 - 10
    if coding[0] == "ln_0r8":
        ours, theirs = log_scale_table(-12, 9)[codes], log_scale_table(-12, 9, exp=spark_nodes.exp)[codes]
    else:
        ours = quantize.decode_log_scale(codes) if coding == SPZ_SCALES else np.exp(logs)
        theirs = spark_nodes.exp(logs)
    assert not np.array_equal(ours, theirs)
    known = nodes(with_scales(scene, ours), layout, FileCoding((coding,)))
    assert np.array_equal(known.size, nodes(with_scales(scene, theirs), layout).size)


@pytest.mark.parametrize("layout", LOADED)
def test_scales_that_do_not_come_from_codes_are_taken_as_they_are(scene: Scene, layout: str) -> None:
    """As those of a tree that was read from a file, and then refined."""
    found = nodes(scene, layout, SPZ)
    assert np.array_equal(found.size, nodes(scene, layout).size)


def test_runs_of_splats_have_codings_of_their_own(scene: Scene) -> None:
    plain, spz = PLAIN_SCALES, SPZ_SCALES
    ours = with_scales(scene, quantize.decode_log_scale(quantize.encode_log_scale(scene.splats.scale)))
    half = FileCoding((spz, spz, plain, plain), 10_000)
    assert [(part.start, part.stop) for part, _ in half.parts(len(scene))] == [(0, 20_000), (20_000, len(scene))]
    found, coded, uncoded = (nodes(ours, "ext", coding).size for coding in (half, SPZ, None))
    assert np.array_equal(found[:20_000], coded[:20_000])
    assert np.array_equal(found[20_000:], uncoded[20_000:])


# --- The layout of Spark's traversal ----------------------------------------------------------------------------------


def links(child_count: Any, child_start: Any) -> LodTree:
    return LodTree(np.asarray(child_count, np.uint16), np.asarray(child_start, np.uint32))


def test_a_node_is_four_words_of_these_bytes() -> None:
    splats = splats_with(2, center=[1, -2, 0.5], scale=[0.25, 0.5, 0.75], opacity=[1, linear_opacity(np.float32(3))])
    packed = layouts.pack_nodes(splats, links([65535, 0], [2**32 - 1, 0]))
    expected = struct.pack("<4eII", 1, -2, 0.5, 1, 65535, 2**32 - 1) + struct.pack("<4eII", 1, -2, 0.5, 2.4, 0, 0)
    assert packed["lod_tree"].tobytes() == expected
    assert (list(packed), packed["lod_tree"].dtype, packed["lod_tree"].shape) == (["lod_tree"], np.uint32, (2, 4))


def test_sizes_keep_and_reach_their_error() -> None:
    size = np.exp(np.linspace(-20, np.log(65504), 100_001)).astype(np.float32)
    spheres = splats_with(len(size), scale=(size / 2)[:, None], opacity=1)
    got = layouts.unpack_nodes(layouts.pack_nodes(spheres, links([0] * size.size, [0] * size.size)))
    ratio = np.abs(got.size.astype(np.float64) - size) / half_float(size)
    assert 0.99 <= ratio.max() <= 1.001
    assert ratio[size < 2.0**-14].max() >= 0.99


@given(center=arrays(np.float32, (8, 3), elements=st.floats(-65504, 65504, width=32)))
def test_centres_of_nodes_keep_their_error(center: np.ndarray) -> None:
    back = layouts.unpack_nodes(layouts.pack_nodes(splats_with(8, center=center), links([0] * 8, [0] * 8))).center
    assert (np.abs(back.astype(float) - center) <= half_float(center)).all()


@pytest.mark.filterwarnings("error")
def test_sizes_and_centres_beyond_float16_are_infinite_without_a_warning() -> None:
    splats = splats_with(1, center=[3e38, -3e38, 65519], scale=3e38, opacity=1000)
    got = layouts.unpack_nodes(layouts.pack_nodes(splats, links([0], [0])))
    assert got.center.tolist() == [[np.inf, -np.inf, 65504]]
    assert got.size.tolist() == [np.inf]


@pytest.mark.parametrize("threads", [1, 2])
def test_a_whole_tree_comes_back(threads: int) -> None:
    splats, tree = quick.build(random_splats(BLOCK_ROWS + 1000))
    packed = layouts.pack_nodes(splats, tree, threads=threads)
    got = layouts.unpack_nodes(packed)
    np.testing.assert_array_equal(got.tree.child_count, tree.child_count)
    np.testing.assert_array_equal(got.tree.child_start, tree.child_start)
    np.testing.assert_array_equal(got.center, splats.center.astype(np.float16))
    np.testing.assert_array_equal(got.size, gaussian.spark_size(splats).astype(np.float16))
    packed["lod_tree"][:] = 0
    got.tree.validate()  # a copy


def test_trees_of_no_nodes_are_empty_arrays_and_others_need_as_many_nodes_as_splats() -> None:
    packed = layouts.pack_nodes(Splats.empty(0, 0), links([], []))
    assert packed["lod_tree"].shape == (0, 4)
    assert len(layouts.unpack_nodes(packed).tree) == 0
    with pytest.raises(FormatError, match="2 nodes, but 3 splats"):
        layouts.pack_nodes(random_splats(3), links([0, 0], [0, 0]))
