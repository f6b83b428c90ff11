"""Nodes as Spark has them: nearly those of unpacked words, whose last bits alone differ; with Spark's own arithmetic.

`tests/interop/test_loaded_nodes.py` holds them to Spark, bit for bit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sparklod_cli.codecs import ext_splats, packed_splats, quantize, spark_codings, spark_nodes
from sparklod_cli.codecs.formats import LOADED
from sparklod_cli.codecs.spark_codings import SplatEncoding, log_scale_table
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import LodTree, Nodes
from sparklod_cli.model.scene import PLAIN_SCALES, SPZ_SCALES, FileCoding, ScaleCoding, Scene
from sparklod_cli.model.splats import Splats
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
        return ext_splats.unpack(ext_splats.pack(scene.splats))
    return packed_splats.unpack(packed_splats.pack(scene.splats, encoding), encoding)


@pytest.mark.parametrize(
    ("layout", "encoding"), [("ext", NARROW), ("packed", NARROW), ("packed-pages", SplatEncoding(lod_opacity=True))]
)
def test_nodes_are_nearly_those_of_unpacked_words(scene: Scene, layout: str, encoding: SplatEncoding) -> None:
    """The range of the file is that of PackedSplats, but not of those in pages."""
    assert scene.tree is not None
    coding = FileCoding(packed_range=(NARROW.ln_scale_min, NARROW.ln_scale_max))
    found = nodes(scene, layout, coding)
    twin = spark_nodes.unpack(spark_nodes.pack(unpacked(scene, layout, encoding), scene.tree))
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
        ours, theirs = log_scale_table(-12, 9)[codes], log_scale_table(-12, 9, exp=spark_codings.exp)[codes]
    else:
        ours = quantize.decode_log_scale(codes) if coding == SPZ_SCALES else np.exp(logs)
        theirs = spark_codings.exp(logs)
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


@pytest.mark.parametrize("layout", LOADED)
def test_an_empty_tree_has_no_nodes(layout: str) -> None:
    empty = Scene(Splats.empty(0, 0), LodTree(np.zeros(0, np.uint16), np.zeros(0, np.uint32)))
    assert len(nodes(empty, layout, SPZ).size) == 0
