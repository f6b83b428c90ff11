"""Laws of the quick builder in stages: the tree is that of the builder in memory, whatever the blocks."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.lod import quick
from sparklod_cli.lod.stages import quick as staged_quick
from tests.lod.stages.assembled import build_in_stages
from tests.scenes import random_splats


@pytest.mark.parametrize("base", [1.1, 1.5, 2.0])
def test_the_tree_in_stages_is_the_tree_in_memory(base: float) -> None:
    splats = random_splats(3000, sh_degree=1)
    nodes, tree = build_in_stages(staged_quick, splats, base, [(2, 2, 2), (1, 2, 1)])
    expected, expected_tree = quick.build(splats, base)
    assert np.array_equal(tree.child_count, expected_tree.child_count)
    assert np.array_equal(tree.child_start, expected_tree.child_start)
    assert np.allclose(nodes.center, expected.center, atol=1e-6)
    assert np.allclose(nodes.sh, expected.sh, atol=1e-6)
