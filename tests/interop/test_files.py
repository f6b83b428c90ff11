"""Spark reads the files that `spz.encode` writes of synthetic scenes."""

from __future__ import annotations

import dataclasses
from importlib import import_module

import numpy as np
import pytest

from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.lod_tree import MAX_CHILDREN
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from tests.interop import laws
from tests.interop.spark import Spark
from tests.scenes import random_splats

pytestmark = pytest.mark.slow


def baked(splats: Splats, method: str = "quick") -> Scene:
    return Scene(*import_module(f"sparklod_cli.lod.{method}").build(splats))


def encoded(scene: Scene) -> bytes:
    return b"".join(spz.encode(scene))


@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_spark_reads_a_tree_as_it_was_baked(spark: Spark, method: str, version: int, sh_degree: int) -> None:
    scene = baked(random_splats(2000, sh_degree=sh_degree), method)
    got = laws.check(spark, scene, WriteOptions(spz_version=version))
    assert got.sh.shape == scene.splats.sh.shape
    assert got.lod_opacity.max() > 1  # there are merged splats with a D above 1


@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("version", [2, 3])
def test_spark_reads_plain_splats_as_they_were_written(spark: Spark, version: int, sh_degree: int) -> None:
    laws.check(spark, Scene(random_splats(2000, sh_degree=sh_degree)), WriteOptions(spz_version=version))


def test_spark_refuses_version_4(spark: Spark) -> None:
    """As docs/formats/spz.md says: once this fails, its table has changed."""
    with pytest.raises(AssertionError, match="failed"):
        spark.load(b"".join(spz.encode(Scene(random_splats(2)), WriteOptions(spz_version=4))))


@pytest.mark.parametrize("extent, bits", [(5e3, 0), (1, 12), (0.05, 24), (0.05, None), (1, None), (5e3, None)])
def test_spark_reads_any_number_of_fractional_bits(spark: Spark, extent: float, bits: int | None) -> None:
    scene = baked(random_splats(2000, extent=extent))
    laws.check(spark, scene, WriteOptions(fractional_bits=bits))


def test_spark_reads_coordinates_at_the_limit(spark: Spark) -> None:
    splats = random_splats(2)
    limit = spz.LAST_CODE
    splats.center[:] = [[limit, -limit, 0.4], [-limit, limit, -0.6]]
    laws.check(spark, Scene(splats), WriteOptions(fractional_bits=0))


def test_spark_reads_a_tree_of_one_node(spark: Spark) -> None:
    got = laws.check(spark, baked(random_splats(1, sh_degree=3)))
    assert len(got.center) == 1


def test_spark_reads_more_coincident_splats_than_a_node_has_children(spark: Spark) -> None:
    count = MAX_CHILDREN + 5000
    scene = baked(random_splats(1).take(np.zeros(count, np.intp)))
    got = laws.check(spark, scene)
    assert got.nodes is not None
    assert np.count_nonzero(got.nodes["child_count"] == 0) == count
    assert got.nodes["child_count"].sum() == len(got.nodes) - 1


def test_antialiased_changes_only_the_flag(spark: Spark) -> None:
    scene = baked(random_splats(500))
    flagged = dataclasses.replace(scene, antialiased=True)
    assert encoded(flagged) != encoded(scene)
    a, b = laws.check(spark, flagged), laws.check(spark, scene)
    np.testing.assert_array_equal(a.nodes, b.nodes)
    np.testing.assert_array_equal(a.center, b.center)
    np.testing.assert_array_equal(a.alpha, b.alpha)


def test_a_page_that_asks_for_lod_gets_our_tree(spark: Spark) -> None:
    """`SplatMesh({lod: true})` decodes in another way, from which Spark builds a tree if the file has none."""
    scene = baked(random_splats(2000, sh_degree=3))
    got = spark.load(encoded(scene), lod=True)
    assert scene.tree is not None
    laws.check_tree(got, scene.tree)


def test_spark_refuses_a_truncated_file(spark: Spark) -> None:
    """This shows that the tests above would notice if Spark could not read a file."""
    data = encoded(baked(random_splats(500)))
    with pytest.raises(AssertionError, match="failed: "):
        spark.load(data[: len(data) // 2])
