"""Spark reads trees of real scenes."""

from __future__ import annotations

from functools import cache
from importlib import import_module

import pytest

from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from tests.conftest import real_scene
from tests.interop import laws
from tests.interop.spark import Spark

pytestmark = pytest.mark.slow


@cache
def baked(name: str, method: str = "quick") -> Scene:
    return Scene(*import_module(f"sparklod_cli.lod.{method}").build(read_scene(real_scene(name)).splats))


@pytest.mark.parametrize(
    ("name", "method", "version"),
    [("biker.ply", "quick", 2), ("playbot-125k.ply", "quick", 3), ("biker.spz", "quality", 3)],
)
def test_spark_reads_the_tree_of_a_real_scene_as_it_was_baked(
    spark: Spark, name: str, method: str, version: int
) -> None:
    laws.check(spark, baked(name, method), WriteOptions(spz_version=version), threads=2)
