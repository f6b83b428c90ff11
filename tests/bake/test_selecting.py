"""Selection is the same for whole scenes and for blocks of them, with the fast test of splats and without."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.bake.in_memory import select
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.model.selection import Selection, SelectionTally
from sparklod_cli.system.errors import InvalidSplatsError
from tests.lod.trees import hard_cases
from tests.scenes import random_splats


@pytest.mark.parametrize("name", hard_cases())
def test_splats_that_can_be_drawn_are_kept_as_they_are(name: str) -> None:
    splats = hard_cases()[name]
    assert select(splats, BakeSettings()) == (splats, SelectionTally(len(splats)))


def test_a_splat_without_extent_is_dropped_and_counted() -> None:
    splats = random_splats(9)
    splats.scale[4] = 0
    selected, tally = select(splats, BakeSettings())
    assert len(selected) == tally.selected == 8
    assert tally.dropped == {"zero_scale": 1}


def test_blocks_have_the_tally_of_the_whole() -> None:
    splats = random_splats(50)
    settings = BakeSettings(selection=Selection(min_opacity=float(np.median(splats.opacity))))
    selected, tally = select(splats, settings)
    assert sum(tally.dropped.values()) == 50 - len(selected) > 0
    parts = [select(splats.take(slice(start, start + 20)), settings) for start in (0, 20, 40)]
    assert parts[0][1].then(parts[1][1]).then(parts[2][1]) == tally
    assert np.array_equal(np.concatenate([part.center for part, _ in parts]), selected.center)


def test_no_splats_are_an_error() -> None:
    settings = BakeSettings()
    with pytest.raises(InvalidSplatsError, match="no splats"):
        settings.selection.check(select(random_splats(0), settings)[1])
