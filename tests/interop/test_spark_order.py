"""The twin of Spark's order of chunks, against files that Spark's own tool wrote."""

from __future__ import annotations

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.model.lod_tree import CHUNK_NODES
from tests.conftest import real_scene
from tests.references.chunk_orders import size_order, spark_order

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["rad/biker-spark.rad", "rad/playbot-125k-spark/p-lod.rad"])
def test_the_twin_fills_spark_s_chunks_with_the_same_nodes(name: str) -> None:
    """All but a few: the file has sizes in steps of 8 %, so that nodes of similar size change places."""
    scene = sparklod.read(real_scene(name))
    assert scene.tree is not None
    kept = [shares(order(scene.splats, scene.tree)) for order in (spark_order, size_order)]
    assert min(kept[0]) > 0.88
    assert min(kept[1]) < 0.75


def shares(order: np.ndarray) -> list[float]:
    """The share of each chunk's nodes that are in it in the file, too."""
    return [
        float(np.mean(part // CHUNK_NODES == number))
        for number, part in enumerate(np.split(order, range(CHUNK_NODES, len(order), CHUNK_NODES)))
    ]
