"""What is drawn of regions, and what is asked for, while chunk files load."""

from __future__ import annotations

import numpy as np

from sparklod_cli.viewers.playcanvas import (
    ANOTHER_LEVEL,
    ENVIRONMENT,
    NEXT,
    NOTHING_DRAWN,
    Chains,
    DetailFiles,
    loading,
)
from sparklod_cli.viewers.viewer_settings import DetailRule

#: Three regions at three levels; the last has no level 1. Each level is a file, and the environment the fourth.
COUNTS = np.array([[40, 20, 10], [40, 20, 10], [40, 0, 10]])
FILES = DetailFiles(np.where(COUNTS > 0, [0, 1, 2], -1), np.array([400, 200, 100, 50]), 3, 9)
CHAINS = Chains.of(COUNTS, DetailRule())


def state(
    chosen: list[int], there: list[int], before: list[int] | None = None, underfill: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    resident = np.isin(np.arange(4), there)
    past = None if before is None else np.array(before)
    return loading(CHAINS, FILES, np.array(chosen), np.array([1.0, 4.0, 9.0]), resident, past, underfill)


def order(priority: np.ndarray) -> list[int]:
    """Files that are asked for, the most important first."""
    asked = np.flatnonzero(priority > 0)
    return asked[np.argsort(-priority[asked], kind="stable")].tolist()


def test_nothing_is_drawn_before_files_come_and_coarse_levels_are_asked_for_first() -> None:
    drawn, priority = state([0, 1, 2], [])
    assert drawn.tolist() == [-1, -1, -1]
    assert order(priority) == [3, 2, 1, 0]
    assert priority[3] == ENVIRONMENT and (np.floor(priority[:3]) == NOTHING_DRAWN).all()


def test_a_region_is_drawn_when_the_file_of_its_level_is_there() -> None:
    assert state([0, 1, 2], [1])[0].tolist() == [-1, 1, -1]
    assert state([0, 1, 2], [0, 1, 2])[0].tolist() == [0, 1, 2]
    assert state([0, 0, 2], [1])[0].tolist() == [-1, -1, -1], "another level of it is no reason to draw it"


def test_a_region_stays_as_it_was_until_its_level_is_there() -> None:
    drawn, priority = state([0, 2, 0], [1], before=[1, 1, -1])
    assert drawn.tolist() == [1, 1, -1]
    assert np.floor(priority[:3]).tolist() == [NOTHING_DRAWN, NOTHING_DRAWN, ANOTHER_LEVEL]


def test_underfill_draws_the_finest_level_that_is_there_and_asks_for_the_next() -> None:
    drawn, priority = state([0, 0, 0], [], underfill=9)
    assert order(priority)[:2] == [3, 2], "the coarsest comes first"
    drawn, priority = state([0, 0, 0], [2], underfill=9)
    assert drawn.tolist() == [2, 2, 2]
    assert np.floor(priority[:2]).tolist() == [NEXT, NEXT], "of the last region level 0, for it has no level 1"
    drawn, priority = state([0, 0, 0], [1, 2], underfill=9)
    assert drawn.tolist() == [1, 1, 2]
    assert state([0, 0, 0], [2], underfill=1)[0].tolist() == [-1, -1, 2], "one step of a chain at most"


def test_a_region_without_splats_at_its_level_needs_no_file() -> None:
    counts = np.array([[40, 0, 0], [40, 20, 10]])
    files = DetailFiles(np.where(counts > 0, [0, 1, 2], -1), np.array([400, 200, 100]))
    drawn, priority = loading(
        Chains.of(counts, DetailRule()), files, np.array([1, 2]), np.ones(2), np.zeros(3, bool), None, 0
    )
    assert drawn.tolist() == [1, -1] and priority[0] == 0
