"""Several stages are shown as one job: it never goes back, and ends when its last stage does."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.system.progress import StagedProgress

SHARES = {"reading": 1.0, "building": 3.0, "writing": 4.0}


def test_stages_have_their_shares() -> None:
    job = StagedProgress(SHARES)
    reached = [job.reach(stage, done, 2) for stage in SHARES for done in (1, 2)]
    assert reached == pytest.approx([1 / 16, 1 / 8, 5 / 16, 1 / 2, 3 / 4, 1])


@given(st.lists(st.tuples(st.sampled_from([*SHARES, "compiling"]), st.integers(0, 20), st.integers(0, 10))))
def test_it_never_goes_back_nor_beyond_the_end(calls: list[tuple[str, int, int]]) -> None:
    job, last = StagedProgress(SHARES), 0.0
    for stage, done, total in calls:
        reached = job.reach(stage, done, total)
        assert last <= reached <= 1
        if stage == "compiling":
            assert reached == last
        last = reached
