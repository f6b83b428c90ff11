"""Depths and limits of families."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.lod.kernels.family_links import find_limits


@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_depth_and_limit_are_those_of_the_way_to_the_root(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    parent = np.array([-1, *(rng.integers(k) for k in range(1, count))], np.int32)
    size = rng.uniform(size=count).astype(np.float32)
    depth, limit = find_limits(parent, size)
    for family in range(count):
        way = [family]
        while parent[way[-1]] >= 0:
            way.append(int(parent[way[-1]]))
        assert depth[family] == len(way) - 1
        assert limit[family] == size[way].min()
