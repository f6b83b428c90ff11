"""Costs of pairs and who is merged with whom, against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod.kernels import pair_merge
from sparklod_cli.lod.kernels.pair_merge import COVARIANCE, LOG_DET
from sparklod_cli.lod.pair_tree import matched, partners
from tests.references import quality as twin

NO_LIMIT = np.float32(np.inf)


def test_the_logarithm_of_a_determinant_is_numpys() -> None:
    for row in twin.random_rows(200, seed=1):
        assert pair_merge.log_det(*row[COVARIANCE : COVARIANCE + 6]) == pytest.approx(row[LOG_DET], abs=1e-4)


@pytest.mark.parametrize("flat", [(1.0, 1.0, 0.0), (1.0, 0.0, 0.0), (1e-30, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_the_logarithm_of_the_determinant_of_what_is_flat_is_finite(flat: tuple[float, float, float]) -> None:
    zero = np.float32(0)
    assert np.isfinite(pair_merge.log_det(*np.float32(flat), zero, zero, zero))


@pytest.mark.parametrize("largest", [np.inf, 8.0])
@pytest.mark.parametrize(("count", "window"), [(1, 4), (2, 4), (5, 12), (60, 3), (200, 12), (pair_merge.BLOCK + 40, 5)])
def test_the_cheapest_partner_is_that_of_brute_force(count: int, window: int, largest: float) -> None:
    rows = twin.random_rows(count, seed=count)
    nodes = np.random.default_rng(count).permutation(count).astype(np.uint32)
    partner, cost = partners(rows, nodes, window, np.float32(largest))
    expected = twin.costs(rows[nodes], window, largest)
    np.testing.assert_allclose(cost, expected.min(axis=1, initial=np.inf), rtol=1e-3, atol=1e-3)
    assert ((partner < 0) == np.isinf(cost)).all()
    with_partner = np.flatnonzero(partner >= 0)
    np.testing.assert_allclose(expected[with_partner, partner[with_partner]], cost[with_partner], rtol=1e-3, atol=1e-3)


def test_the_cheapest_of_all_pairs_is_mutual() -> None:
    rows = twin.random_rows(300, seed=2)
    partner, cost = partners(rows, np.arange(300, dtype=np.uint32), 12, NO_LIMIT)
    first = int(cost.argmin())
    assert partner[partner[first]] == first


def test_among_equal_rows_half_find_each_other() -> None:
    for count in (2, 3, 100, pair_merge.BLOCK + 1, 3 * pair_merge.BLOCK + 7):
        rows = np.repeat(twin.random_rows(1, seed=3), count, axis=0)
        nodes = np.arange(count, dtype=np.uint32)
        found, _ = matched(nodes, *partners(rows, nodes, 12, NO_LIMIT), NO_LIMIT, count, 2)
        assert 4 * 2 * len(found) >= count


@given(
    st.integers(1, 80), st.integers(1, 12), st.integers(0, 1000), st.floats(0, 1), st.booleans(), st.integers(1, 100)
)
@settings(max_examples=80)
def test_pairs_are_disjoint_and_mutual_and_nobody_is_lost(
    count: int, window: int, seed: int, share: float, coincident: bool, blocks: int
) -> None:
    rows = twin.random_rows(count, seed)
    if coincident:  # some are equal
        rows = rows[np.random.default_rng(seed).integers(0, (count + 3) // 4, count)]
    nodes = np.random.default_rng(seed + 1).permutation(count).astype(np.uint32)
    partner, cost = partners(rows, nodes, window, NO_LIMIT)
    limit = np.float32(np.quantile(cost, share)) if count > 1 else NO_LIMIT
    found, rest = matched(nodes, partner, cost, limit, 1000, blocks)

    place = {int(node): i for i, node in enumerate(nodes)}
    expected = [(i, int(partner[i])) for i in range(count) if i < partner[i] and partner[partner[i]] == i]
    expected = [(i, j) for i, j in expected if cost[i] <= limit]
    assert [(place[int(a)], place[int(b)]) for a, b in found] == expected
    made = {i: 1000 + at for at, (i, _) in enumerate(expected)}
    seconds = {j for _, j in expected}
    assert rest.tolist() == [made.get(i, int(nodes[i])) for i in range(count) if i not in seconds]
    assert sorted([*found.ravel().tolist(), *(node for node in rest.tolist() if node < 1000)]) == list(range(count))
