"""Palettes of spherical harmonics: what holds for each, and the kernels against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.codecs import sh_palette
from sparklod_cli.codecs.kernels import sh_clustering
from sparklod_cli.codecs.sh_palette import ShPalette, cluster, visible_weight
from tests.codecs.cases import splats_with
from tests.references.sh_palettes import distances, halved, k_means, squared_error

#: SH coefficients of degree 1 to 3.
DEGREES = (3, 8, 15)


def coefficients(count: int, k: int, seed: int = 0) -> np.ndarray:
    """SH like those of trained scenes: clumps, a few large ones, and equal rows."""
    rng = np.random.default_rng(seed)
    middles = rng.normal(0, 0.3, (40, k, 3)) * rng.exponential(1, (40, 1, 1))
    sh = middles[rng.integers(0, 40, count)] + rng.normal(0, 0.1, (count, k, 3))
    sh[rng.integers(0, count, count // 10)] = 0
    return sh.astype(np.float32)


def flat(sh: np.ndarray) -> np.ndarray:
    return sh.reshape(len(sh), 3 * sh.shape[1])


@pytest.fixture(scope="module", params=DEGREES)
def clustered(request: pytest.FixtureRequest) -> tuple[np.ndarray, ShPalette]:
    sh = coefficients(6000, request.param)
    return sh, cluster(sh, 700)


def test_a_palette_has_at_most_as_many_codes_and_a_label_for_each_row(
    clustered: tuple[np.ndarray, ShPalette],
) -> None:
    sh, palette = clustered
    assert palette.codes.shape == (700, *sh.shape[1:])
    assert palette.codes.dtype == np.float32
    assert palette.labels.shape == (len(sh),)
    assert palette.labels.dtype == np.uint32
    assert np.array_equal(np.unique(palette.labels), np.arange(700))
    assert np.isfinite(palette.codes).all()
    assert np.array_equal(palette.expand(), palette.codes[palette.labels])


def test_nearly_every_row_has_the_nearest_code(clustered: tuple[np.ndarray, ShPalette]) -> None:
    sh, palette = clustered
    away = distances(flat(sh), flat(palette.codes))
    own = away[np.arange(len(sh)), palette.labels]
    assert (own <= away.min(axis=1) * (1 + 1e-5) + 1e-12).mean() > 0.9
    assert own.sum() < 1.05 * away.min(axis=1).sum()


def test_the_error_is_at_most_that_of_k_means_by_brute_force() -> None:
    sh = coefficients(2000, 8)
    weight = np.random.default_rng(1).exponential(1, 2000)
    palette = cluster(sh, 150, weight=weight)
    ours = squared_error(flat(sh), flat(palette.codes), weight)
    for seed in range(2):
        assert ours < squared_error(flat(sh), k_means(flat(sh), 150, weight, 12, seed), weight)


def test_the_result_is_the_same_for_any_number_of_threads_and_in_every_run() -> None:
    sh = coefficients(9000, 3)
    weight = np.random.default_rng(1).exponential(1, len(sh))
    first = cluster(sh, 1000, weight=weight, threads=1)
    for threads in (1, 2, 3, 4, None):
        again = cluster(sh, 1000, weight=weight, threads=threads)
        assert again.codes.tobytes() == first.codes.tobytes()
        assert again.labels.tobytes() == first.labels.tobytes()


@pytest.mark.parametrize("count", [0, 1, 2, 500])
def test_as_many_codes_as_rows_hold_them_exactly(count: int) -> None:
    sh = coefficients(500, 8)[:count]
    palette = cluster(sh, 500)
    assert palette.expand().shape == sh.shape
    assert np.array_equal(palette.expand(), sh)
    assert len(palette.codes) == len(np.unique(flat(sh), axis=0))


def test_equal_rows_share_a_code_and_zeros_of_either_sign_are_equal() -> None:
    sh = np.tile(coefficients(50, 3), (20, 1, 1))
    sh[::7] = 0
    sh[::14] *= -1
    palette = cluster(sh, 51)
    assert np.array_equal(palette.expand(), sh)
    one = cluster(np.full((10_000, 3, 3), 0.25, np.float32), 100)
    assert len(one.codes) == 1
    assert not one.labels.any()


def test_rows_with_equal_hashes_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sh_clustering, "hash_rows", lambda rows, bits, hashes: hashes.fill(0))
    sh = np.repeat(coefficients(30, 3), 2, axis=0)
    assert np.array_equal(cluster(sh, 60).expand(), sh)


def test_heavy_rows_are_nearer_to_their_codes() -> None:
    sh = coefficients(4000, 8, seed=3)
    heavy = np.arange(4000) % 4 == 0
    plain, weighted = cluster(sh, 300), cluster(sh, 300, weight=np.where(heavy, 100.0, 1.0))
    errors = [((palette.expand() - sh)[heavy] ** 2).sum() for palette in (plain, weighted)]
    assert errors[1] < 0.7 * errors[0]


def test_only_ratios_of_weights_count_and_rows_without_weight_get_codes_too() -> None:
    sh = coefficients(2000, 3)
    plain = cluster(sh, 100)
    for weight in (np.full(2000, 1e-30), np.full(2000, 1e30), np.zeros(2000)):
        assert np.array_equal(cluster(sh, 100, weight=weight).labels, plain.labels)
    some = cluster(sh, 100, weight=np.arange(2000) < 500)
    away = distances(flat(sh), flat(some.codes))
    assert (away[np.arange(2000), some.labels] < 1.05 * away.min(axis=1) + 1e-6).mean() > 0.9


@pytest.mark.parametrize("size", [3e38, 1e-38, 1e-44])
def test_coefficients_of_any_size_make_a_finite_palette(size: float) -> None:
    sh = (np.random.default_rng(0).uniform(-1, 1, (3000, 3, 3)) * size).astype(np.float32)
    palette = cluster(sh, 200)
    assert np.isfinite(palette.codes).all()
    assert len(palette.codes) <= 200
    assert np.abs(palette.codes).max() <= np.abs(sh).max()


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_coefficients_that_are_not_finite_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="sh holds NaN or infinity"):
        cluster(np.full((5, 3, 3), value, np.float32), 4)


def test_a_splat_weighs_as_its_two_longest_axes_and_its_opacity_say() -> None:
    splats = splats_with(4, scale=[[2, 3, 1], [2, 1, 3], [4, 6, 2], [2, 3, 1]], opacity=[0.5, 0.5, 0.5, 0])
    expected = np.array([3, 3, 12, 0]) ** sh_palette.AREA_POWER
    assert visible_weight(splats) == pytest.approx(expected)


def test_a_cell_is_cut_across_its_principal_axis() -> None:
    rng = np.random.default_rng(5)
    rows = (rng.normal(size=(1500, 9)) * np.array([3, 1.5, 1, 1, 1, 1, 0.5, 0.5, 0.2])).astype(np.float32)
    rows = (rows @ np.linalg.qr(rng.normal(size=(9, 9)))[0]).astype(np.float32)
    weight = rng.exponential(1, 1500)
    members = np.arange(1500, dtype=np.uint32)[::-1].copy()
    cuts, errors = np.empty(1, np.int64), np.empty((1, 2))
    sh_clustering.halve_cells(1, rows, weight, members, np.array([0]), np.array([1500]), cuts, errors, np.empty(1500))
    with_first, expected = halved(rows, weight)
    ours = np.zeros(1500, bool)
    ours[members[: cuts[0]]] = True
    assert np.array_equal(np.sort(members), np.arange(1500))
    assert ((ours == ours[0]) == with_first).mean() > 0.99
    assert sorted(errors[0]) == pytest.approx(sorted(expected), rel=0.02)


def test_cells_of_one_two_and_equal_rows_are_cut_in_the_middle() -> None:
    rows = np.array([[1, 2, 3], [4, 5, 6], [4, 5, 6], [4, 5, 6], [4, 5, 6], [7, 8, 9], [0, 0, 0]], np.float32)
    begin, end = np.array([0, 1, 5]), np.array([1, 5, 7])
    cuts, errors = np.empty(3, np.int64), np.empty((3, 2))
    sh_clustering.halve_cells(3, rows, np.ones(7), np.arange(7, dtype=np.uint32), begin, end, cuts, errors, np.empty(7))
    assert cuts.tolist() == [0, 3, 6]
    assert errors == pytest.approx(0)


def test_codes_are_the_weighted_means_of_their_cells() -> None:
    rng = np.random.default_rng(0)
    rows, weight = rng.normal(size=(60, 9)).astype(np.float32), rng.exponential(1, 60)
    members, begin = rng.permutation(60).astype(np.uint32), np.array([0, 10, 10, 60])
    codes = np.full((3, 9), 7, np.float32)
    sh_clustering.average_cells(3, rows, weight, members, begin, codes)
    parts = members[:10], members[10:]
    means = [np.average(rows[part], axis=0, weights=weight[part]) for part in parts]
    assert codes[[0, 2]] == pytest.approx(np.array(means), abs=1e-6)
    assert (codes[1] == 7).all()


def test_neighbours_are_the_nearest_codes_where_all_groups_are_searched() -> None:
    codes = flat(coefficients(sh_clustering.GROUP + 100, 3))
    codes += np.random.default_rng(0).normal(0, 1e-3, codes.shape).astype(np.float32)
    near, distance = sh_palette._neighbours(codes)
    away = distances(codes, codes)
    np.fill_diagonal(away, np.inf)
    expected = np.sort(away, axis=1)[:, : sh_palette.NEIGHBOURS]
    assert distance == pytest.approx(expected, rel=1e-4)
    assert np.take_along_axis(away, near, axis=1) == pytest.approx(expected, rel=1e-4)


def test_a_palette_with_fewer_codes_than_neighbours_has_itself_for_the_rest() -> None:
    near, distance = sh_palette._neighbours(flat(coefficients(20, 3)))
    assert (near[:, 19:] == np.arange(20)[:, None]).all()
    assert np.isinf(distance[:, 19:]).all()
    assert np.isfinite(distance[:, :19]).all()


def test_pruning_by_distance_changes_no_label() -> None:
    rows, codes = flat(coefficients(5000, 8)), flat(coefficients(400, 8, seed=1))
    near, distance = sh_palette._neighbours(codes)
    begin = np.linspace(0, len(rows), len(codes) + 1).astype(np.int64)
    members = np.argsort(distances(rows, codes[:1])[:, 0]).astype(np.uint32)
    found = []
    for known in (distance, np.zeros_like(distance)):
        labels, errors = np.empty(len(rows), np.int32), np.empty(len(rows), np.float32)
        sh_clustering.choose_codes(len(codes), rows, members, begin, codes, near, known, labels, errors)
        found.append((labels, errors))
    assert np.array_equal(found[0][0], found[1][0])
    assert found[0][1] == pytest.approx(((rows - codes[found[0][0]]) ** 2).sum(axis=1), rel=1e-4, abs=1e-6)
