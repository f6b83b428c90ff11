"""Laws of bakes out of core: what they make is what a bake in memory makes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sparklod_cli.bake.out_of_core import order, store
from sparklod_cli.bake.out_of_core.in_blocks import InBlocks
from sparklod_cli.bake.out_of_core.job import Job
from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.bake.tree_output import BuiltTree
from sparklod_cli.codecs.statistics import ALL
from sparklod_cli.lod import chunk_order, quick
from sparklod_cli.lod.chunk_order import arrange
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.output import Output
from sparklod_cli.system.progress import silent
from tests.bake.out_of_core.plain import Loop, reader_of
from tests.scenes import random_splats

#: Without shrinking, which takes minutes, as any scene will do.
LAW = settings(max_examples=15, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])

BLOCKS = st.sampled_from([15, 40, 200, 1000])


@pytest.fixture(scope="module", autouse=True)
def _small_windows() -> Iterator[None]:
    """Windows, and ranges of keys, of which a small scene has several."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(order, "WINDOW_NODES", 64)
        patch.setattr(store, "GAP", 5)
        patch.setattr(chunk_order, "FIRST_BAND", 16)
        patch.setattr(order, "MERGED", 20)
        patch.setattr(order, "PROBES", 5)
        yield


def built(folder: str, splats: Splats, how: BakeSettings, block: int, engine: Loop, *, in_chunks: bool) -> BuiltTree:
    """A tree in a store, of blocks of about so many splats."""
    job = Job(Store(Path(folder)), reader_of(Scene(splats)), how, ALL, in_chunks)
    tree = BuiltTree(settings=how, out=Output(Path(folder) / "out", overwrite=False), options=how.options)
    blocks = InBlocks(job, engine, block, 1, silent)
    blocks.build(tree)
    blocks.order(tree)
    return tree


def same(found: tuple[Splats, LodTree], expected: tuple[Splats, LodTree]) -> None:
    """The same nodes, bit for bit, and the same tree."""
    for name in COLUMNS:
        assert getattr(found[0], name).tobytes() == getattr(expected[0], name).tobytes(), name
    assert np.array_equal(found[1].child_count, expected[1].child_count)
    assert np.array_equal(found[1].child_start, expected[1].child_start)


@given(
    st.integers(1, 400),
    st.integers(0, 2**32 - 1),
    BLOCKS,
    st.sampled_from([0, 0, 1, 2]),
    st.sampled_from([1.1, 1.5, 2.0]),
    st.booleans(),
)
@LAW
def test_quick_makes_the_tree_of_a_bake_in_memory(
    count: int, seed: int, block: int, degree: int, base: float, in_chunks: bool
) -> None:
    splats = random_splats(count, seed=seed, sh_degree=degree)
    rng = np.random.default_rng(seed)
    expected = quick.build(splats, base)
    expected = arrange(*expected) if in_chunks else expected
    with tempfile.TemporaryDirectory() as folder:
        found = built(folder, splats, BakeSettings(base=base), block, Loop(rng), in_chunks=in_chunks)
        total = found.nodes.count
        same(found.nodes.read(0, total), expected)
        start, stop = np.sort(rng.integers(0, total + 1, 2)).tolist()
        if start < stop:
            window = slice(start, stop)
            tree = LodTree(expected[1].child_count[window], expected[1].child_start[window])
            same(found.nodes.read(start, stop), (expected[0].take(window), tree))
    assert found.baked.levels == expected[1].depths().max() + 1
