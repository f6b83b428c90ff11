"""Cutting a scene into blocks."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.bake.out_of_core.job import cut_into_blocks


@pytest.mark.parametrize(
    ("count", "block", "blocks"), [(5000, 500, 10), (5000, 5000, 1), (5000, 2500, 2), (1000, 90, 12)]
)
def test_blocks_have_nearly_as_many_splats_each(count: int, block: int, blocks: int) -> None:
    center = np.random.default_rng(5).normal(size=(count, 3))
    division = cut_into_blocks(center, count, block)
    _, ends = division.sort(center)
    sizes = np.diff(ends)
    assert len(sizes) == division.count == blocks
    assert sizes.sum() == count
    assert sizes.max() <= 1.2 * count / blocks
