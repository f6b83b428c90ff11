"""Spark reads trees of real scenes, and its own builder makes nearly the same trees."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.io import read_scene
from sparklod_cli.lod.builders import BUILDERS
from sparklod_cli.model.scene import Scene
from tests.conftest import real_scene
from tests.interop import laws
from tests.interop.spark import Spark


@cache
def baked(name: str, method: str = "quick") -> Scene:
    return Scene(*BUILDERS[method].load().build(read_scene(real_scene(name)).splats))


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    ("name", "method"),
    [("biker.ply", "quick"), ("biker.spz", "quick"), ("playbot-125k.ply", "quick"), ("biker.ply", "quality")],
)
def test_spark_reads_the_tree_of_a_real_scene_as_it_was_baked(
    spark: Spark, name: str, method: str, version: int
) -> None:
    laws.check(spark, baked(name, method), WriteOptions(spz_version=version), threads=2)


@pytest.mark.parametrize("name", ["biker.ply", "playbot-125k.ply"])
def test_growth_is_that_of_sparks_own_builder(spark: Spark, name: str) -> None:
    """Spark builds from float16 opacities and scales, so a few splats fall into neighbouring cells."""
    ours = baked(name).tree
    theirs = spark.load(real_scene(name), lod=True).nodes
    assert ours is not None
    assert theirs is not None
    assert np.count_nonzero(theirs["child_count"] == 0) == np.count_nonzero(ours.is_leaf)
    assert len(theirs) == pytest.approx(len(ours), rel=0.01)
    # The shapes agree as well: numbers of nodes with two children, with three, and so on.
    most = max(theirs["child_count"].max(), ours.child_count.max()) + 1
    difference = np.bincount(theirs["child_count"], minlength=most) - np.bincount(ours.child_count, minlength=most)
    assert np.abs(difference).sum() <= 0.01 * np.count_nonzero(ours.child_count)
