"""The worlds that tests of frames share."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.lod.traversal import Frustum
from sparklod_cli.world import Placement, World, read_world
from tests.lod.forests import transform
from tests.simulation.worlds import HAND, TOWN


@pytest.fixture(scope="package")
def town() -> World:
    """165,205 nodes in three chunks."""
    return read_world([Placement(TOWN, "town")])


@pytest.fixture(scope="package")
def three() -> World:
    """The town twice, once turned and larger, and a small tree."""
    return read_world(
        [
            Placement(TOWN, "here"),
            Placement(TOWN, "there", transform(np.random.default_rng(1), scale=1.5, spread=3), 0.5, Frustum(0.3, 0.1)),
            Placement(HAND, "hand"),
        ]
    )
