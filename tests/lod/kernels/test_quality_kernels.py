"""The quality builder's kernels against slow, obvious twins, and their laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.gaussian import MIN_OPACITY, lod_opacity, spark_size
from sparklod_cli.lod.kernels import keep, pairs, profile, state, union
from sparklod_cli.lod.kernels.pairs import CENTER, COLOR, COVARIANCE, COVERED, DENSITY, LOG_DET, WEIGHT
from sparklod_cli.tree import LodTree
from tests.references import quality as twin
from tests.references import reference
from tests.scenes import random_splats

PLANES = {(0, 1): union.PLANES[0], (0, 2): union.PLANES[1], (1, 2): union.PLANES[2]}
NO_LIMIT = np.float32(np.inf)


# Pairs.


def test_the_logarithm_of_a_determinant_is_numpys() -> None:
    for row in twin.random_rows(200, seed=1):
        assert pairs.log_det(*row[COVARIANCE : COVARIANCE + 6]) == pytest.approx(row[LOG_DET], abs=1e-4)


@pytest.mark.parametrize("flat", [(1.0, 1.0, 0.0), (1.0, 0.0, 0.0), (1e-30, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_the_logarithm_of_the_determinant_of_what_is_flat_is_finite(flat: tuple[float, float, float]) -> None:
    zero = np.float32(0)
    assert np.isfinite(pairs.log_det(*np.float32(flat), zero, zero, zero))


@pytest.mark.parametrize("largest", [np.inf, 8.0])
@pytest.mark.parametrize(("count", "window"), [(1, 4), (2, 4), (5, 12), (60, 3), (200, 12), (pairs.BLOCK + 40, 5)])
def test_the_cheapest_partner_is_that_of_brute_force(count: int, window: int, largest: float) -> None:
    rows = twin.random_rows(count, seed=count)
    nodes = np.random.default_rng(count).permutation(count).astype(np.uint32)
    partner, cost = pairs.cheapest(rows, nodes, window, np.float32(largest))
    expected = twin.costs(rows[nodes], window, largest)
    np.testing.assert_allclose(cost, expected.min(axis=1, initial=np.inf), rtol=1e-3, atol=1e-3)
    assert ((partner < 0) == np.isinf(cost)).all()
    with_partner = np.flatnonzero(partner >= 0)
    np.testing.assert_allclose(expected[with_partner, partner[with_partner]], cost[with_partner], rtol=1e-3, atol=1e-3)


def test_the_cheapest_of_all_pairs_is_mutual() -> None:
    rows = twin.random_rows(300, seed=2)
    partner, cost = pairs.cheapest(rows, np.arange(300, dtype=np.uint32), 12, NO_LIMIT)
    first = int(cost.argmin())
    assert partner[partner[first]] == first


def test_of_equals_half_find_each_other() -> None:
    for count in (2, 3, 100, pairs.BLOCK + 1, 3 * pairs.BLOCK + 7):
        rows = np.repeat(twin.random_rows(1, seed=3), count, axis=0)
        nodes = np.arange(count, dtype=np.uint32)
        found, _ = pairs.pair_up(nodes, *pairs.cheapest(rows, nodes, 12, NO_LIMIT), NO_LIMIT, count)
        assert 4 * 2 * len(found) >= count


@given(st.integers(1, 80), st.integers(1, 12), st.integers(0, 1000), st.floats(0, 1), st.booleans())
@settings(max_examples=80)
def test_pairs_are_disjoint_and_mutual_and_nobody_is_lost(
    count: int, window: int, seed: int, share: float, coincident: bool
) -> None:
    rows = twin.random_rows(count, seed)
    if coincident:  # some are equal
        rows = rows[np.random.default_rng(seed).integers(0, (count + 3) // 4, count)]
    nodes = np.random.default_rng(seed + 1).permutation(count).astype(np.uint32)
    partner, cost = pairs.cheapest(rows, nodes, window, NO_LIMIT)
    limit = np.float32(np.quantile(cost, share)) if count > 1 else NO_LIMIT
    found, rest = pairs.pair_up(nodes, partner, cost, limit, 1000)

    place = {int(node): i for i, node in enumerate(nodes)}
    expected = [(i, int(partner[i])) for i in range(count) if i < partner[i] and partner[partner[i]] == i]
    expected = [(i, j) for i, j in expected if cost[i] <= limit]
    assert [(place[int(a)], place[int(b)]) for a, b in found] == expected
    made = {i: 1000 + at for at, (i, _) in enumerate(expected)}
    seconds = {j for _, j in expected}
    assert rest.tolist() == [made.get(i, int(nodes[i])) for i in range(count) if i not in seconds]
    assert sorted([*found.ravel().tolist(), *(node for node in rest.tolist() if node < 1000)]) == list(range(count))


# Unions.


def test_semi_axes_are_roots_of_eigenvalues() -> None:
    rows = twin.random_rows(200, seed=4)
    for row in rows:
        got = union.semi_axes(*row[COVARIANCE : COVARIANCE + 6].astype(np.float64))
        expected = np.sqrt(np.linalg.eigvalsh(twin.matrix(row)))[::-1]
        np.testing.assert_allclose(got, expected, rtol=1e-7)


@pytest.mark.parametrize(
    "variances", [(1.0, 1.0, 1.0), (4.0, 1.0, 0.0), (9.0, 0.0, 0.0), (1e30, 1e30, 1e28), (1e-30, 1e-31, 1e-32)]
)
def test_semi_axes_of_what_is_round_or_flat(variances: tuple[float, float, float]) -> None:
    xx, yy, zz = variances[1], variances[2], variances[0]
    largest = math.sqrt(max(variances))
    got = union.semi_axes(xx, yy, zz, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(got, np.sqrt(variances), atol=1e-7 * largest + union.SHORTEST)
    assert min(got) >= union.SHORTEST


@pytest.mark.parametrize("seed", range(4))
def test_products_on_planes_are_integrals(seed: int) -> None:
    a, b = twin.random_rows(2, seed, spread=0.7)
    for axes, plane in PLANES.items():
        expected = np.array(twin.integrals(a, b, axes)) / (2 * math.pi)
        np.testing.assert_allclose(union.product(a, b, plane), expected, rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_the_shared_share_is_that_of_integrals(seed: int) -> None:
    a, b = twin.random_rows(2, seed + 10, spread=0.7)
    shared = alone = 0.0
    for axes in PLANES:
        both, area_a, area_b = twin.integrals(a, b, axes)
        area_a, area_b = a[DENSITY] * area_a, b[DENSITY] * area_b
        shared += min(a[DENSITY] * b[DENSITY] * both, area_a, area_b)
        alone += area_a + area_b
    assert union.shared_share(a, b) == pytest.approx(shared / alone, rel=1e-5)


@pytest.mark.parametrize("seed", range(2))
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
    assert union.picture_error(a, b, merged) == pytest.approx(total / (2 * math.pi), rel=1e-4)


def test_a_merged_node_that_looks_as_its_two_is_without_error() -> None:
    a, nothing = twin.random_rows(2, seed=5)
    nothing[DENSITY] = 0
    assert union.picture_error(a, nothing, a) == pytest.approx(0, abs=1e-5)


def united(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    merged = np.zeros_like(a)
    union.unite(a, b, merged)
    return merged


def test_a_quarter_of_what_two_equals_cover_both_do() -> None:
    """A Gaussian's square sums to half of it, so two opaque equals cover 3/2 of one, with (2 - 1/4) / (3/2) of V."""
    a = twin.random_rows(1, seed=6)[0]
    a[COVERED] /= a[DENSITY]
    a[DENSITY] = 1
    merged = united(a, a)
    assert union.shared_share(a, a) == pytest.approx(1 / 4)
    assert merged[COVERED] == pytest.approx(1.5 * a[COVERED], rel=1e-6)
    np.testing.assert_allclose(merged[CENTER : CENTER + 3], a[CENTER : CENTER + 3], atol=1e-6)
    expected = 7 / 6 * twin.matrix(a)
    np.testing.assert_allclose(twin.matrix(merged), expected, atol=1e-5 * np.trace(expected))


def test_two_that_share_nothing_are_merged_by_their_moments() -> None:
    a, b = twin.random_rows(2, seed=7)
    b[CENTER : CENTER + 3] += np.float32([60, -50, 40])
    merged = united(a, b)
    share = a[COVERED] / (a[COVERED] + b[COVERED])
    center = share * a[CENTER : CENTER + 3] + (1 - share) * b[CENTER : CENTER + 3]
    assert merged[COVERED] == pytest.approx(a[COVERED] + b[COVERED], rel=1e-6)
    np.testing.assert_allclose(merged[CENTER : CENTER + 3], center, rtol=1e-5)
    expected = twin.joint_covariance(a, b)
    np.testing.assert_allclose(twin.matrix(merged), expected, atol=1e-5 * np.trace(expected))


@pytest.mark.parametrize("spread", [0.0, 0.5, 3.0])
def test_a_union_is_of_two_whichever_is_first(spread: float) -> None:
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
    rows = np.zeros((30, pairs.WIDTH), np.float32)
    rows[:20] = twin.random_rows(20, seed=8, spread=0.5)
    joined = np.arange(20, dtype=np.uint32).reshape(10, 2)[::-1].copy()
    children = np.zeros((30, 2), np.uint32)
    size, error = np.zeros(30, np.float32), np.zeros(30, np.float32)
    union.unite_pairs(joined, 20, rows, children, size, error)
    assert np.array_equal(children[20:], joined)
    for (a, b), row, seen, off in zip(rows[joined], rows[20:], size[20:], error[20:], strict=True):
        expected = united(a, b)
        assert np.array_equal(row[COVARIANCE : COVARIANCE + 6], expected[COVARIANCE : COVARIANCE + 6])
        assert row[COVERED] == expected[COVERED]
        assert row[WEIGHT] == pytest.approx(a[WEIGHT] + b[WEIGHT])
        color = np.average([a[COLOR : COLOR + 3], b[COLOR : COLOR + 3]], axis=0, weights=[a[WEIGHT], b[WEIGHT]])
        np.testing.assert_allclose(row[COLOR : COLOR + 3], color, rtol=1e-5)
        axes = np.sqrt(np.linalg.eigvalsh(twin.matrix(row)))
        assert row[DENSITY] == pytest.approx(row[COVERED] / reference.ellipsoid_area(axes), rel=1e-5)
        assert row[LOG_DET] == pytest.approx(np.linalg.slogdet(twin.matrix(row))[1], abs=1e-4)
        opacity, spread = profile.profile_of(float(row[DENSITY]))
        larger = 1 + 0.7 * max(0.0, float(lod_opacity(np.float32([opacity]))[0]) - 1)
        assert seen == pytest.approx(2 * axes.mean() / math.sqrt(spread) * larger, rel=1e-5)
        assert off == pytest.approx(union.picture_error(a, b, row), rel=1e-6)


# Profiles.


@pytest.mark.parametrize("a", [1, 2, 3, 10, 100, 5000])
def test_harmonic_numbers_of_integers_are_sums(a: int) -> None:
    first, second = profile.harmonic(np.array([float(a)]))
    assert first[0] == pytest.approx(math.fsum(1 / k for k in range(1, a + 1)), rel=1e-5)
    assert second[0] == pytest.approx(math.fsum(1 / k**2 for k in range(1, a + 1)), rel=1e-5)


@pytest.mark.parametrize("density", [0.01, 0.3, 1.0, 1.0001, 1.1, 1.3, 1.5, float(profile.DENSEST) * 0.9999])
def test_a_profile_has_the_density_and_the_variance_that_are_asked_for(density: float) -> None:
    opacity, spread = profile.profile_of(density)
    coverage, variance = twin.moments_of_profile(opacity)
    assert coverage / spread == pytest.approx(density, rel=1e-4)
    assert variance == pytest.approx(spread, rel=1e-4)


@pytest.mark.parametrize("density", [1.0, 1.2, 1.9, 2.5, 40.0])
def test_what_is_denser_than_a_profile_can_be_is_larger_and_covers_as_much(density: float) -> None:
    density = max(density, float(profile.DENSEST))
    opacity, spread = profile.profile_of(density)
    assert lod_opacity(np.float32([opacity]))[0] == pytest.approx(profile.SHARPEST, rel=1e-5)
    assert twin.moments_of_profile(opacity)[0] / spread == pytest.approx(density, rel=1e-4)


@given(st.floats(0, 1))
def test_up_to_one_the_density_is_the_opacity(density: float) -> None:
    assert profile.profile_of(density) == (max(density, MIN_OPACITY), 1)


@given(st.floats(0, 10), st.floats(0, 10))
def test_what_is_denser_is_no_less_opaque(one: float, other: float) -> None:
    assert profile.profile_of(min(one, other))[0] <= profile.profile_of(max(one, other))[0] * (1 + 1e-12)


def test_the_size_factor_is_that_of_sparks_size() -> None:
    splats = random_splats(50)
    splats.opacity[:] = np.geomspace(0.1, 1000, 50)
    expected = spark_size(splats) / (2 * splats.scale.mean(axis=1))
    np.testing.assert_allclose([profile.size_factor(float(a)) for a in splats.opacity], expected, rtol=1e-5)


# What is kept.


#: Of a place in the order that nobody has taken.
UNUSED = np.uint32(0xFFFFFFFF)


class Binary:
    """A random binary tree as it has grown: leaves first, then nodes after their children."""

    def __init__(self, leaves: int, seed: int, equal: bool) -> None:
        rng = np.random.default_rng(seed)
        total = 2 * leaves - 1
        self.leaves = leaves
        self.children = np.zeros((total, 2), np.uint32)
        self.size = np.ones(total, np.float32)
        self.error = np.zeros(total, np.float32)
        if not equal:
            self.size[:] = np.exp(rng.normal(0, 2, total))
            self.error[leaves:] = rng.uniform(0, 1, leaves - 1)
        left = list(range(leaves))
        for node in range(leaves, total):
            for side in range(2):
                self.children[node, side] = left.pop(int(rng.integers(len(left))))
            left.append(node)
            if not equal and rng.random() < 0.8:  # mostly larger than their children
                self.size[node] = self.size[self.children[node]].max() * rng.uniform(1, 2)
        self.log_size, self.weight, self.lost = (np.empty(total, np.float32) for _ in range(3))
        self.saved = np.empty(total, np.int32)
        self.parent = keep.value_nodes(
            self.children, leaves, self.size, self.error, self.log_size, self.weight, self.lost
        )

    def drop(self, most: int) -> np.ndarray:
        """Drops; returns which are kept, leaves among them."""
        keep.drop_nodes(self.leaves, most, self.parent, self.log_size, self.weight, self.lost, self.saved)
        return np.flatnonzero(self.saved >= 0)

    def place(self) -> tuple[np.ndarray, LodTree, np.ndarray, np.ndarray]:
        """The node of each final index, the tree, inner nodes and their places."""
        level = keep.levels_of(self.leaves, self.parent, self.log_size, self.saved)
        inner = np.flatnonzero(level >= 0).astype(np.uint32)
        inner = inner[np.argsort(level[inner], kind="stable")]
        total = self.leaves + len(inner)
        order = np.full(total, UNUSED)
        tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
        places = keep.place_nodes(inner, self.parent, self.saved, order, tree.child_start, tree.child_count)
        return order, tree, inner, places


BINARIES = st.builds(Binary, st.integers(2, 150), st.integers(0, 2**32 - 1), st.booleans())


@given(BINARIES)
def test_every_node_is_valued_below_its_parent(binary: Binary) -> None:
    total = len(binary.size)
    assert binary.parent[total - 1] == total - 1
    for node in range(binary.leaves, total):
        assert (binary.parent[binary.children[node]] == node).all()
    expected = np.log(binary.size)
    for node in range(total - 2, -1, -1):
        expected[node] = min(expected[node], expected[binary.parent[node]])
    np.testing.assert_allclose(binary.log_size, expected, atol=1e-5)
    assert (binary.log_size <= binary.log_size[binary.parent]).all()
    inner = slice(binary.leaves, None)
    assert (binary.weight[inner] > 0).all() and (binary.weight[inner] <= 1).all()
    assert np.isfinite(binary.lost[inner]).all() and (binary.lost[inner] >= 0).all()


@given(BINARIES, st.floats(0, 1))
def test_no_more_are_kept_than_asked_for_and_their_parents_are_nearest_of_them(binary: Binary, share: float) -> None:
    most = max(1, int(share * (binary.leaves - 1)))
    above = binary.parent.copy()
    kept = binary.drop(most)
    root = len(above) - 1
    assert binary.saved[root] > 0
    assert (binary.saved[: binary.leaves] == 0).all()
    assert len(kept) - binary.leaves == min(most, binary.leaves - 1)  # neither more than wanted is dropped
    is_kept = binary.saved >= 0
    children = np.zeros(len(above), int)
    for node in kept[:-1]:
        nearest = above[node]
        while not is_kept[nearest]:
            nearest = above[nearest]
        assert binary.parent[node] == nearest
        children[nearest] += 1
    inner = kept[kept >= binary.leaves]
    assert np.array_equal(binary.saved[inner] + 1, children[inner])


def test_what_saves_most_for_its_error_is_kept() -> None:
    """Of two inner nodes under a root, equal but for their errors, the one with less of it."""
    children = np.array([[0, 0]] * 4 + [[0, 1], [2, 3], [4, 5]], np.uint32)
    for worse in (4, 5):
        size = np.array([1, 1, 1, 1, 2, 2, 8], np.float32)
        error = np.array([0, 0, 0, 0, 0.1, 0.1, 1], np.float32)
        error[worse] = 0.4
        log_size, weight, lost = (np.empty(7, np.float32) for _ in range(3))
        saved = np.empty(7, np.int32)
        parent = keep.value_nodes(children, 4, size, error, log_size, weight, lost)
        keep.drop_nodes(4, 2, parent, log_size, weight, lost, saved)
        assert saved[worse] == -1
        assert saved[9 - worse] == 1
        assert saved[6] == 2


@given(BINARIES, st.floats(0, 1))
def test_levels_rise_along_every_path(binary: Binary, share: float) -> None:
    kept = binary.drop(max(1, int(share * (binary.leaves - 1))))
    level = keep.levels_of(binary.leaves, binary.parent, binary.log_size, binary.saved)
    inner = kept[kept >= binary.leaves]
    assert level[inner[-1]] == 0
    assert (level[inner[:-1]] > level[binary.parent[inner[:-1]]]).all()
    others = np.setdiff1d(np.arange(len(level)), inner)
    assert (level[others] == -1).all()
    octaves = (binary.log_size[-1] - binary.log_size[inner]) / math.log(2)
    assert (level[inner] >= np.floor(keep.STEPS * octaves - 1e-3)).all()


@given(BINARIES, st.floats(0, 1))
def test_placing_makes_a_tree_of_what_is_kept(binary: Binary, share: float) -> None:
    kept = binary.drop(max(1, int(share * (binary.leaves - 1))))
    order, tree, inner, places = binary.place()
    tree.validate()
    assert np.array_equal(np.sort(order), kept)
    assert order[0] == len(binary.size) - 1
    assert np.array_equal(order[places], inner)
    assert np.array_equal(tree.is_leaf, order < binary.leaves)
    for place, node in zip(places, inner, strict=True):
        start = int(tree.child_start[place])
        assert (binary.parent[order[start : start + int(tree.child_count[place])]] == node).all()
    assert np.array_equal(tree.child_start[places], np.sort(tree.child_start[places]))  # in the order of their parents


@given(BINARIES)
def test_with_nothing_dropped_the_tree_is_the_binary_one(binary: Binary) -> None:
    binary.drop(binary.leaves - 1)
    order, tree, inner, places = binary.place()
    assert len(order) == 2 * binary.leaves - 1
    for place, node in zip(places, inner, strict=True):
        start = int(tree.child_start[place])
        assert tree.child_count[place] == 2
        assert set(order[start : start + 2].tolist()) == set(binary.children[node].tolist())


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=2, max_size=30))
def test_keys_are_in_the_order_of_what_they_are_of(values: list[float]) -> None:
    keys = [keep.key_of(value) for value in sorted(values)]
    assert keys == sorted(keys)
    assert min(keys) >= 0 and max(keys) < 1 << keep.KEY_BITS


# Rows of state.


def test_rows_of_leaves_are_their_splats_in_units() -> None:
    splats = random_splats(100, seed=9)
    index = np.random.default_rng(1).permutation(100).astype(np.uint32)
    rows = np.zeros((120, pairs.WIDTH), np.float32)
    middle, unit = np.array([0.5, -1.0, 2.0]), 2.0**-6
    columns = splats.center, splats.scale, splats.quat_xyzw, splats.opacity, splats.rgb
    size = np.zeros(120, np.float32)
    state.fill_state(index, *columns, middle, unit, rows, size)
    assert not rows[100:].any() and not size[100:].any()
    np.testing.assert_allclose(size[:100] * unit, spark_size(splats)[index], rtol=1e-5)
    for row, i in zip(rows, index, strict=False):
        np.testing.assert_allclose(row[CENTER : CENTER + 3] * unit + middle, splats.center[i], atol=1e-5)
        covariance = reference.covariance(splats.scale[i], splats.quat_xyzw[i]) / unit**2
        np.testing.assert_allclose(twin.matrix(row), covariance, atol=1e-5 * np.trace(covariance))
        area = reference.ellipsoid_area(splats.scale[i]) / unit**2
        assert row[COVERED] == row[WEIGHT] == pytest.approx(splats.opacity[i] * area, rel=1e-5)
        assert row[DENSITY] == splats.opacity[i]
        assert np.array_equal(row[COLOR : COLOR + 3], splats.rgb[i])


def test_merged_nodes_are_drawn_with_the_variance_and_coverage_of_their_rows() -> None:
    rows = twin.random_rows(100, seed=10)
    rows[:, DENSITY] = np.geomspace(0.01, 5, 100)
    order = np.random.default_rng(2).permutation(100).astype(np.uint32)
    middle, unit = np.array([0.5, -1.0, 2.0]), 2.0**-6
    out = random_splats(100, seed=11)
    before = out.take(np.arange(100))
    state.fill_merged(order, 40, rows, middle, unit, out.center, out.scale, out.quat_xyzw, out.opacity)
    for i, node in enumerate(order):
        if node < 40:  # a leaf
            assert np.array_equal(out.center[i], before.center[i])
            assert out.opacity[i] == before.opacity[i]
            continue
        row = rows[node]
        np.testing.assert_allclose(out.center[i], row[CENTER : CENTER + 3] * unit + middle, rtol=1e-5)
        opacity, spread = profile.profile_of(float(row[DENSITY]))
        assert out.opacity[i] == pytest.approx(opacity)
        covariance = twin.matrix(row) * unit**2 / spread
        got = reference.covariance(out.scale[i], out.quat_xyzw[i])
        np.testing.assert_allclose(got, covariance, atol=1e-5 * np.trace(covariance))


def test_keys_are_places_on_a_morton_curve_and_what_is_outside_is_at_its_edge() -> None:
    rows = twin.random_rows(100, seed=12)
    low, step = np.array([-1.0, -1.5, -2.0]), 1e-3
    nodes = np.arange(100, dtype=np.uint32)[::-1].copy()
    most = (1 << state.CURVE_BITS) - 1
    cells = np.clip((rows[nodes, CENTER : CENTER + 3].astype(np.float64) - low) / step, 0, most).astype(int)
    expected = [
        sum(((int(axis) >> bit) & 1) << (3 * bit + k) for k, axis in enumerate(cell) for bit in range(state.CURVE_BITS))
        for cell in cells
    ]
    assert state.curve_keys(rows, nodes, low, step).tolist() == expected
