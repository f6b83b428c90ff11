"""A scene at several detail levels: its runs lie level after level, and full detail is level 0 with the environment."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.model.scene import DetailScene
from tests.scenes import random_splats

#: Three regions at two levels; the last one has no coarse level.
COUNTS = np.array([[5, 2], [4, 1], [3, 0]])


def detail_scene(**changes: object) -> DetailScene:
    """The scene of `COUNTS`, with splats that tell where they are."""
    given = {
        "splats": random_splats(int(COUNTS.sum())),
        "counts": COUNTS,
        "bounds": np.zeros((3, 2, 3)),
        "children": np.array([[-1, 1], [-2, -3]]),
    }
    return DetailScene(**(given | changes))  # type: ignore[arg-type]


def test_runs_lie_level_after_level_and_region_after_region() -> None:
    scene = detail_scene()
    runs = [scene.run(region, level) for level in range(2) for region in range(3)]
    assert [part.start for part in runs] == [0, 5, 9, 12, 14, 15]
    assert [part.stop for part in runs] == [5, 9, 12, 14, 15, 15]
    assert [scene.level(0), scene.level(1)] == [slice(0, 12), slice(12, 15)]


def test_full_detail_is_level_0_and_then_the_environment() -> None:
    sky = random_splats(2, seed=1)
    scene = detail_scene(environment=sky)
    full = scene.scene()
    assert np.array_equal(full.splats.center, np.concatenate([scene.splats.center[:12], sky.center]))
    assert len(detail_scene().scene()) == 12


def test_columns_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="bounds has the shape"):
        detail_scene(bounds=np.zeros((2, 2, 3)))
    with pytest.raises(ValueError, match="there are 14"):
        detail_scene(splats=random_splats(14))
