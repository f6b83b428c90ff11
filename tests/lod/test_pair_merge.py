"""Geometry and profiles of splats, costs of pairs and their unions, beside numpy and integrals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod.kernels import geometry, pair_merge
from sparklod_cli.lod.kernels.geometry import CONVERGED, ROWS, decompose
from sparklod_cli.lod.kernels.pair_merge import (
    CENTER,
    COLOR,
    COVARIANCE,
    COVERED,
    DENSITY,
    LOG_DET,
    WEIGHT,
    WIDTH,
    overlaps,
)
from sparklod_cli.lod.quality import BinaryTree, matched, partners
from sparklod_cli.model import falloff
from sparklod_cli.model.gaussian import MIN_OPACITY, lod_opacity, spark_size
from tests.references import gaussians
from tests.references import quality as twin
from tests.scenes import random_splats

# Axes


def matrices() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]

    def of(*values: object) -> np.ndarray:
        diagonal = np.stack([np.broadcast_to(value, 200) for value in values], axis=1)
        return np.einsum("nij,nj,nkj->nik", turn, diagonal, turn)

    return {
        "any": of(*np.exp(rng.normal(-8, 3, (3, 200)))),
        "spherical": of(1, 1, 1),
        "almost spherical": of(1, 1 + 1e-9, 1 - 1e-9),
        "flat": of(1, 0.5, 0),
        "disc": of(1, 1, 1e-12),
        "needle": of(1, 0, 0),
        "tiny": of(1e-60, 2e-60, 3e-60),
        "huge": of(1e70, 1e69, 1e60),
        "diagonal": np.tile(np.diag([3.0, 1.0, 2.0]), (200, 1, 1)),
        "nothing": np.zeros((200, 3, 3)),
    }


@pytest.mark.parametrize("name", matrices())
def test_eigenvalues_and_axes_make_the_matrix_again(name: str) -> None:
    matrix = matrices()[name]
    work = np.full((ROWS, len(matrix) + 3), np.nan)
    for row, (i, j) in enumerate(twin.ELEMENTS):
        work[row, : len(matrix)] = matrix[:, i, j]
    decompose(work, len(matrix))
    values, quat = work[:3, : len(matrix)].T, work[6:10, : len(matrix)].T
    assert np.allclose(np.linalg.norm(quat, axis=1), 1)
    rotation = gaussians.rotation_matrix(quat)
    assert np.allclose(np.linalg.det(rotation), 1)
    size = np.abs(matrix).max()
    bound = 3 * CONVERGED**0.5  # what is left beside the diagonal, in the worst case of equal eigenvalues
    again = np.einsum("nij,nj,nkj->nik", rotation, values, rotation)
    assert np.abs(again - matrix).max() <= bound * size
    assert np.abs(np.sort(values) - np.linalg.eigvalsh(matrix)).max() <= bound * size
    assert np.isnan(work[:, len(matrix) :]).all()  # columns beyond the count are left alone


def test_the_matrices_beside_it_do_not_change_a_bit_of_a_matrix() -> None:
    matrix = np.concatenate(list(matrices().values()))
    rows = np.zeros((ROWS, len(matrix)))
    rows[:6] = [matrix[:, i, j] for i, j in twin.ELEMENTS]
    together = rows.copy()
    decompose(together, len(matrix))
    for i in range(len(matrix)):
        alone = rows[:, i : i + 1].copy()
        decompose(alone, 1)
        assert alone.tobytes() == together[:, i].tobytes()


# Profiles


@pytest.mark.parametrize("a", [1, 2, 3, 10, 100, 5000])
def test_harmonic_numbers_of_integers_are_sums(a: int) -> None:
    first, second = falloff.harmonic(np.array([float(a)]))
    assert first[0] == pytest.approx(math.fsum(1 / k for k in range(1, a + 1)), rel=1e-5)
    assert second[0] == pytest.approx(math.fsum(1 / k**2 for k in range(1, a + 1)), rel=1e-5)


#: Whether it is of needles; D and density of the sharpest geometry.
SHARPEST = [
    pytest.param(False, geometry.MAX_D, float(geometry.MAX_DENSITY), id="splat"),
    pytest.param(True, geometry.NEEDLE_D, geometry.NEEDLE_DENSITY, id="needle"),
]


@pytest.mark.parametrize(("needle", "d", "densest"), SHARPEST)
@pytest.mark.parametrize("share", [0.01, 0.3, 0.8, 0.9, 0.9999, 1, 1.2, 20])
def test_a_profile_has_its_density_and_its_variance(share: float, needle: bool, d: float, densest: float) -> None:
    """A splat that is denser than a profile can be is larger, and covers as much."""
    density = share * densest
    opacity, spread = geometry.profile_of(density, needle)
    coverage, variance = twin.moments_of_profile(opacity)
    assert coverage / spread == pytest.approx(density, rel=1e-4)
    if share < 1:
        assert variance == pytest.approx(spread, rel=1e-4)
    else:
        assert lod_opacity(np.float32([opacity]))[0] == pytest.approx(d, rel=1e-5)


@given(st.floats(0, 10), st.floats(0, 10), st.booleans())
def test_denser_profiles_are_no_less_opaque(one: float, other: float, needle: bool) -> None:
    less, more = (geometry.profile_of(density, needle)[0] for density in sorted([one, other]))
    assert less <= more * (1 + 1e-5)
    for density in (one / 10, other / 10):  # up to 1 it is the opacity
        assert geometry.profile_of(density, needle) == (max(density, MIN_OPACITY), 1)


@given(st.permutations([1.0, 0.999, 0.2]), st.permutations([1.0, 1.001, 0.2]), st.floats(1e-20, 1e20))
def test_needles_have_a_second_axis_below_a_share_of_the_longest(
    below: list[float], above: list[float], size: float
) -> None:
    """Lengths along the axes; the middle one as a multiple of the limit, the shortest as a share of it."""
    for axes, expected in ((below, True), (above, False)):
        lengths = [size * (1 if axis == 1 else axis * geometry.NEEDLE) for axis in axes]
        assert geometry.is_needle(*(length * length for length in lengths)) == expected


def test_the_size_factor_is_that_of_sparks_size() -> None:
    splats = random_splats(50)
    splats.opacity[:] = np.geomspace(0.1, 1000, 50)
    expected = spark_size(splats) / (2 * splats.scale.mean(axis=1))
    np.testing.assert_allclose([geometry.size_factor(float(a)) for a in splats.opacity], expected, rtol=1e-5)


# Costs

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
    first = int(cost.argmin())
    assert partner[first] < 0 or partner[partner[first]] == first
    with_partner = np.flatnonzero(partner >= 0)
    np.testing.assert_allclose(expected[with_partner, partner[with_partner]], cost[with_partner], rtol=1e-3, atol=1e-3)


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


# Unions

#: Axes of the planes of `overlaps`, in its order.
PLANES = ((0, 1), (0, 2), (1, 2))


@pytest.mark.parametrize(
    "variances", [(1.0, 1.0, 1.0), (4.0, 1.0, 0.0), (9.0, 0.0, 0.0), (1e30, 1e30, 1e28), (1e-30, 1e-31, 1e-32)]
)
def test_semi_axes_are_roots_of_eigenvalues(variances: tuple[float, float, float]) -> None:
    largest = math.sqrt(max(variances))
    got = pair_merge.semi_axes(variances[1], variances[2], variances[0], 0.0, 0.0, 0.0)
    np.testing.assert_allclose(got, np.sqrt(variances), atol=1e-7 * largest + pair_merge.SHORTEST)
    assert min(got) >= pair_merge.SHORTEST
    for row in twin.random_rows(50, seed=4):
        got = pair_merge.semi_axes(*row[COVARIANCE : COVARIANCE + 6].astype(np.float64))
        np.testing.assert_allclose(got, np.sqrt(np.linalg.eigvalsh(twin.matrix(row)))[::-1], rtol=1e-7)


def overlap_share(a: np.ndarray, b: np.ndarray) -> float:
    return float(pair_merge.overlap_share(overlaps(a, b), a[DENSITY], b[DENSITY]))


def picture_error(a: np.ndarray, b: np.ndarray, merged: np.ndarray) -> float:
    return float(pair_merge.picture_error(a, b, merged, overlaps(a, b)))


@pytest.mark.parametrize("seed", range(4))
def test_overlaps_are_integrals(seed: int) -> None:
    a, b = twin.random_rows(2, seed + 10, spread=0.7)
    shared = alone = 0.0
    for axes, found in zip(PLANES, overlaps(a, b), strict=True):
        both, area_a, area_b = twin.integrals(a, b, axes)
        np.testing.assert_allclose(found, np.array([both, area_a, area_b]) / (2 * math.pi), rtol=1e-5)
        area_a, area_b = a[DENSITY] * area_a, b[DENSITY] * area_b
        shared += min(a[DENSITY] * b[DENSITY] * both, area_a, area_b)
        alone += area_a + area_b
    assert overlap_share(a, b) == pytest.approx(shared / alone, rel=1e-5)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.slow
def test_the_error_of_a_picture_is_an_integral(seed: int) -> None:
    a, b, merged = twin.random_rows(3, seed + 20, spread=0.7)
    total = 0.0
    for channel in range(4):
        high = [min(r[DENSITY], 1) * (r[COLOR + channel] if channel < 3 else 1) for r in (a, b, merged)]
        for axes in PLANES:

            def over(one: np.ndarray, other: np.ndarray, axes: tuple[int, int] = axes) -> float:
                return twin.integrals(one, other, axes)[0]

            total += high[0] ** 2 * over(a, a) + high[1] ** 2 * over(b, b) + high[2] ** 2 * over(merged, merged)
            total += 2 * high[0] * high[1] * over(a, b)
            total -= 2 * high[2] * (high[0] * over(a, merged) + high[1] * over(b, merged))
    assert picture_error(a, b, merged) == pytest.approx(total / (2 * math.pi), rel=1e-4)


def united(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    merged = np.zeros_like(a)
    pair_merge.merge_pair(a, b, overlaps(a, b), merged)
    return merged


def test_two_equal_splats_overlap_by_a_quarter() -> None:
    """A Gaussian's square sums to half of it, so two opaque equals cover 3/2 of one, with (2 - 1/4) / (3/2) of V."""
    a = twin.random_rows(1, seed=6)[0]
    a[COVERED] /= a[DENSITY]
    a[DENSITY] = 1
    merged = united(a, a)
    assert overlap_share(a, a) == pytest.approx(1 / 4)
    assert merged[COVERED] == pytest.approx(1.5 * a[COVERED], rel=1e-6)
    np.testing.assert_allclose(merged[CENTER : CENTER + 3], a[CENTER : CENTER + 3], atol=1e-6)
    expected = 7 / 6 * twin.matrix(a)
    np.testing.assert_allclose(twin.matrix(merged), expected, atol=1e-5 * np.trace(expected))


def test_splats_that_do_not_overlap_are_merged_by_their_moments() -> None:
    a, b = twin.random_rows(2, seed=7)
    b[CENTER : CENTER + 3] += np.float32([60, -50, 40])
    merged = united(a, b)
    share = a[COVERED] / (a[COVERED] + b[COVERED])
    center = share * a[CENTER : CENTER + 3] + (1 - share) * b[CENTER : CENTER + 3]
    assert merged[COVERED] == pytest.approx(a[COVERED] + b[COVERED], rel=1e-6)
    np.testing.assert_allclose(merged[CENTER : CENTER + 3], center, rtol=1e-5)
    expected = twin.joint_covariance(a, b)
    np.testing.assert_allclose(twin.matrix(merged), expected, atol=1e-5 * np.trace(expected))


def test_layers_keep_a_part_of_their_overlap_and_what_is_round_long_or_dense_keeps_none() -> None:
    closing, most = pair_merge.closing, pair_merge.CLOSING
    assert closing(0.14, 1.0, 0.8, 0.05) == pytest.approx(most)
    assert closing(0.05, 1.0, 0.8, 0.05) == 0.05  # all of it
    assert 0 < closing(0.14, 1.0, 0.8, 0.2) < most
    assert closing(0.14, 1.0, 0.8, 0.4) == closing(0.14, 1.0, 0.1, 0.005) == closing(0.2, 1.0, 0.8, 0.05) == 0


@pytest.mark.parametrize("spread", [0.0, 0.5, 3.0])
def test_a_union_does_not_depend_on_the_order(spread: float) -> None:
    for seed in range(20):
        a, b = twin.random_rows(2, seed, spread)
        one, other = united(a, b), united(b, a)
        trace = np.trace(twin.matrix(one))
        np.testing.assert_allclose(one[CENTER : CENTER + 3], other[CENTER : CENTER + 3], atol=1e-5 * math.sqrt(trace))
        np.testing.assert_allclose(twin.matrix(one), twin.matrix(other), atol=1e-5 * trace)
        assert one[COVERED] == pytest.approx(other[COVERED], rel=1e-6)


@given(st.integers(0, 2**32 - 1), st.floats(0, 5), st.sampled_from([(1, 1, 1), (1, 1, 0), (1, 0, 0), (1, 1, 1e-6)]))
@settings(max_examples=60)
def test_a_union_covers_no_less_than_the_larger_and_no_more_than_both(
    seed: int, spread: float, flat: tuple[float, float, float]
) -> None:
    rows = twin.random_rows(2, seed, spread)
    rows[:, DENSITY] = np.minimum(rows[:, DENSITY], 1)
    for row in rows:
        squashed = np.diag(flat) @ twin.matrix(row) @ np.diag(flat)
        row[COVARIANCE : COVARIANCE + 6] = [squashed[i, j] for i, j in twin.ELEMENTS]
        row[COVERED] = row[DENSITY]
    merged = united(*rows)
    assert np.isfinite(merged).all()
    assert merged[COVERED] <= rows[:, COVERED].sum() * (1 + 1e-6)
    assert merged[COVERED] >= rows[:, COVERED].sum() / 2 * (1 - 1e-6)
    trace = np.trace(twin.matrix(merged))
    assert np.linalg.eigvalsh(twin.matrix(merged))[0] >= -1e-5 * trace


def needle(rng: np.random.Generator, center: np.ndarray, thickness: float) -> np.ndarray:
    """A needle of length 1 that points nearly along x."""
    axes = np.linalg.qr(np.eye(3) + rng.normal(0, 0.02, (3, 3)))[0]
    return twin.row(center, (axes * np.array([1, thickness, thickness]) ** 2) @ axes.T, 0.2)


@pytest.mark.parametrize("thickness", [0.03, 0.01, 0.003])
def test_needles_side_by_side_are_as_long_together_as_each(thickness: float) -> None:
    """Seen along y or z they overlap, but where their lines come nearest may be far beyond their ends."""
    rng = np.random.default_rng(10)
    for _ in range(300):
        a, b = (needle(rng, rng.normal(0, (0.5, 3 * thickness, 0.2), 3), thickness) for _ in range(2))
        merged = united(a, b)
        matrix, plain = twin.matrix(merged), twin.joint_covariance(a, b)
        assert np.trace(matrix) >= 0.5 * np.trace(plain)
        assert np.linalg.eigvalsh(matrix)[0] >= -1e-5 * np.trace(plain)
        middle = (a[CENTER : CENTER + 3] + b[CENTER : CENTER + 3]) / 2
        assert np.linalg.norm(merged[CENTER : CENTER + 3] - middle) <= math.sqrt(np.trace(plain))
        assert merged[COVERED] <= (a[COVERED] + b[COVERED]) * (1 + 1e-6)


def test_pairs_become_rows_that_cover_as_much_and_are_as_large_as_they_are_drawn() -> None:
    rows = twin.random_rows(20, seed=8, spread=0.5)
    before = rows.copy()
    joined = np.arange(20, dtype=np.uint32).reshape(10, 2)[::-1].copy()
    tree = BinaryTree.of_leaves(rows, np.zeros(20, np.float32))
    merge(tree, joined)
    assert np.array_equal(tree.children[:10], joined)
    assert np.array_equal(tree.row[:10], joined[:, 0])
    merged = rows[tree.row[:10]], tree.size[20:30], tree.error[:10]
    for (a, b), row, seen, off in zip(before[joined], *merged, strict=True):
        expected = united(a, b)
        assert np.array_equal(row[COVARIANCE : COVARIANCE + 6], expected[COVARIANCE : COVARIANCE + 6])
        assert row[COVERED] == expected[COVERED]
        assert row[WEIGHT] == pytest.approx(a[WEIGHT] + b[WEIGHT])
        color = np.average([a[COLOR : COLOR + 3], b[COLOR : COLOR + 3]], axis=0, weights=[a[WEIGHT], b[WEIGHT]])
        np.testing.assert_allclose(row[COLOR : COLOR + 3], color, rtol=1e-5)
        axes = np.sqrt(np.linalg.eigvalsh(twin.matrix(row)))
        assert row[DENSITY] == pytest.approx(row[COVERED] / gaussians.ellipsoid_area(axes), rel=1e-5)
        assert row[LOG_DET] == pytest.approx(np.linalg.slogdet(twin.matrix(row))[1], abs=1e-4)
        opacity, spread = geometry.profile_of(float(row[DENSITY]), geometry.is_needle(*axes**2))
        larger = 1 + 0.7 * max(0.0, float(lod_opacity(np.float32([opacity]))[0]) - 1)
        assert seen == pytest.approx(2 * axes.mean() / math.sqrt(spread) * larger, rel=1e-5)
        assert off == pytest.approx(picture_error(a, b, row), rel=1e-6)


def merge(tree: BinaryTree, pairs: np.ndarray) -> None:
    columns = tree.rows, tree.row, tree.spare, tree.children, tree.size, tree.error
    pair_merge.merge_pairs(len(pairs), pairs, tree.used, tree.leaves, *columns)
    tree.used += len(pairs)


@given(st.integers(2, 60), st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_merged_nodes_have_the_rows_that_leaves_no_longer_need(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    expected = list(twin.random_rows(count, seed=seed % 1000))
    tree = BinaryTree.of_leaves(np.array(expected), np.zeros(count, np.float32))
    active = np.arange(count, dtype=np.uint32)
    while len(active) > 1:
        active = rng.permutation(active)
        pairs = active[: 2 * int(rng.integers(1, len(active) // 2 + 1))].reshape(-1, 2)
        active = np.concatenate([active[2 * len(pairs) :], np.arange(len(pairs), dtype=np.uint32) + tree.used])
        active = active.astype(np.uint32)
        expected += [united(expected[a], expected[b]) for a, b in pairs]
        merge(tree, pairs)
        for node in active:  # those that will be merged, which no other may have written over
            row = tree.rows[tree.rows_of(np.array([node], np.uint32))[0]]
            assert np.array_equal(row[:COLOR], expected[node][:COLOR])
            expected[node] = row.copy()  # with what `united` does not fill
    inner = np.arange(count, 2 * count - 1, dtype=np.uint32)
    assert len(np.unique(tree.rows_of(inner))) == count - 1
    for node in inner:
        assert np.array_equal(tree.rows[tree.rows_of(np.array([node], np.uint32))[0]], expected[node])
    kept = rng.permutation(count - 1)[: int(rng.integers(1, count))].astype(np.uint32)
    tree.keep_rows(kept)
    assert tree.rows.shape == (len(kept), WIDTH)
    for slot in kept:
        assert np.array_equal(tree.rows[tree.row[slot]], expected[count + slot])
