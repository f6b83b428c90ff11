"""Laws of bakes out of core: what they make is what a bake in memory makes."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sparklod_cli.bake import BakeSettings
from sparklod_cli.bake.clock import Clock
from sparklod_cli.bake.out_of_core.flow import Staged, build_in_store
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.support.progress import silent
from tests.bake.out_of_core.plain import Loop, PlainStore, stream_of
from tests.scenes import random_splats

#: Without shrinking, which takes minutes, as any scene will do.
LAW = settings(max_examples=40, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])


def staged(folder: str | Path, scene: Scene, how: BakeSettings, block: int, engine: Loop | None = None) -> Staged:
    """A tree in a store, of blocks of about so many splats."""
    return build_in_store(
        stream_of(scene),
        how,
        store=PlainStore(Path(folder)),
        engine=engine or Loop(),
        block_splats=block,
        check=lambda statistics: None,
        clock=Clock(),
        progress=silent,
    )


def same(found: tuple[Splats, LodTree], expected: tuple[Splats, LodTree]) -> None:
    """The same nodes, bit for bit, and the same tree."""
    for name in COLUMNS:
        assert getattr(found[0], name).tobytes() == getattr(expected[0], name).tobytes(), name
    assert np.array_equal(found[1].child_count, expected[1].child_count)
    assert np.array_equal(found[1].child_start, expected[1].child_start)


@given(
    st.integers(1, 600),
    st.integers(0, 2**32 - 1),
    st.sampled_from([7, 40, 200, 1000]),
    st.sampled_from([0, 0, 1, 2]),
    st.sampled_from([1.1, 1.5, 2.0]),
)
@LAW
def test_quick_makes_the_tree_of_a_bake_in_memory(count: int, seed: int, block: int, degree: int, base: float) -> None:
    splats = random_splats(count, seed=seed, sh_degree=degree)
    with tempfile.TemporaryDirectory() as folder:
        found = staged(folder, Scene(splats), BakeSettings(base=base), block, Loop(np.random.default_rng(seed)))
        nodes, tree = quick.build(splats, base)
        same(found.nodes.read(0, found.nodes.count), (nodes, tree))
        assert found.order.levels == tree.depths().max() + 1
