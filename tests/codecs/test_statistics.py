"""Statistics of pieces, merged, are those of the whole: a file that comes in pieces is settled as one in memory."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sparklod_cli.codecs import quantize, spz
from sparklod_cli.codecs.formats import DEFAULTS
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.statistics import (
    ALL,
    EXACT_BITS,
    LARGEST_ERROR,
    LOWER,
    SMALL_QUANTILE,
    STEPS_A_SPLAT,
    UPPER,
    Distribution,
    Statistics,
    enough,
    fine_bits,
    sh_code_counts,
    sh_error,
    tops,
)
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.transforms import sh_basis
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import decode, encode, splats_with, star
from tests.scenes import random_splats


def tree_of(count: int, sh_degree: int) -> Scene:
    """A root over many leaves, with values in which clamping and rounding are not simple."""
    rng = np.random.default_rng(count + sh_degree)
    splats = random_splats(count, sh_degree=sh_degree, seed=count)
    splats.scale[:] *= np.exp(rng.normal(0, 2, size=(count, 1)))
    splats.rgb[rng.random(count) < 0.01] *= -3
    splats.sh[rng.random(count) < 0.02] *= 9
    return Scene(splats, star(count))


def pieces_of(scene: Scene, cuts: list[int], needed: frozenset[str] = ALL) -> list[Statistics]:
    """Statistics of the pieces between these places."""
    leaf = np.ones(len(scene), bool) if scene.tree is None else scene.tree.is_leaf
    parts = [slice(start, stop) for start, stop in zip([0, *cuts], [*cuts, len(scene)], strict=True)]
    return [Statistics.of(scene.splats.take(part), leaf[part] if scene.tree else None, needed) for part in parts]


@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("codec", [spz, rad])
def test_pieces_in_any_order_settle_as_the_whole(codec, sh_degree: int) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(sh_degree)
    for scene in (tree_of(2_000, sh_degree), Scene(random_splats(700, sh_degree=sh_degree))):
        cuts = sorted(rng.integers(0, len(scene), size=5).tolist())
        parts = pieces_of(scene, [0, *cuts], codec.needed(DEFAULTS))
        rng.shuffle(parts)  # type: ignore[arg-type]
        found = Statistics.merged([Statistics.merged(parts[:3]), *parts[3:]])
        assert codec.settled(found, DEFAULTS) == codec.settled(scene, DEFAULTS)


def test_statistics_refuse_what_the_scene_refuses() -> None:
    far = splats_with(5, center=-1e7)
    with pytest.raises(FormatError, match=r"coordinates reach 1e\+07"):
        spz.settled(Statistics.merged(pieces_of(Scene(far), [2, 4], spz.needed(DEFAULTS))), DEFAULTS)
    options = rad.settled(Scene(random_splats(1)), DEFAULTS)
    with pytest.raises(FormatError, match="4,294,967,296 splats; RAD numbers at most 4,294,967,295"):
        rad.settled(Statistics(1 << 32, 0, True), options)
    with pytest.raises(ValueError, match="cannot be merged"):
        Statistics.merged([Statistics.of(random_splats(3, sh_degree=degree)) for degree in (0, 1)])


@pytest.mark.parametrize("seed", range(3))
def test_tops_are_above_quantiles_by_less_than_a_hundredth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = (rng.normal(size=(20_001, 3)) * np.exp(rng.normal(0, 3, size=(20_001, 1)))).astype(np.float32)
    found = Distribution.of(values)
    assert (found.count, found.lowest, found.highest) == (values.size, values.min(), values.max())
    counts = found.magnitudes(1) + found.magnitudes(-1)
    size = np.abs(values).reshape(-1)
    for share in (0.0, 1e-3, 1e-2, 0.5):
        (top,) = tops(counts, size.size, float(size.max()), np.array([share]))
        assert np.count_nonzero(size > top) <= share * size.size
        exact = np.sort(size)[::-1][int(share * size.size)]
        assert exact * (1 - 1e-6) <= top <= exact * 1.009


def test_signs_and_ends_are_kept_apart() -> None:
    found = Distribution.of(np.array([[-2.5, 0.0, 0.75], [1e-30, 4e30, -1e-42], [1, -0.0, 0.75]], np.float32))
    positive, negative = found.magnitudes(1), found.magnitudes(-1)
    assert (positive.sum(), negative.sum()) == (7, 2)
    for counts, values in ((positive, [0, 1e-30, 0.75, 1, 4e30]), (negative, [1e-42, 2.5])):
        bins = np.flatnonzero(counts)
        assert (LOWER[bins] <= values).all() and (values < UPPER[bins]).all()
    assert tops(negative, 9, 2.5, np.array([0.0])) == [2.5]


def bits_of(values: np.ndarray) -> int:
    """Fractional bits by the quantile itself."""
    small = float(np.quantile(values.astype(np.float64), SMALL_QUANTILE)) if len(values) else 0.0
    return math.ceil(math.log2(STEPS_A_SPLAT / small)) if small > 0 else EXACT_BITS


@pytest.mark.parametrize("seed", range(40))
def test_bits_are_those_of_the_quantile(seed: int) -> None:
    """Few values, so that the quantile lies between two of them that are far apart."""
    rng = np.random.default_rng(seed)
    spread = rng.uniform(0, 4)
    values = np.exp(rng.normal(rng.uniform(-40, 40), spread, size=rng.integers(1, 400))).astype(np.float32)
    values[rng.random(len(values)) < rng.choice([0, 0.01, 0.02])] = 0
    assert fine_bits(Distribution.of(values)) == bits_of(values)


def test_a_quantile_between_two_bins_is_exact() -> None:
    values = np.array([1.5, 1.75, 200, 300], np.float32)
    for share in (0, 0.2, 0.5, 1):
        assert Distribution.of(values).quantile(share) == np.quantile(values, share)
    assert Distribution.of(np.array([1, -np.nan], np.float32)).quantile(0) == math.inf


@given(
    arrays.arrays("<f4", st.integers(1, 60), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)),
    st.lists(st.integers(0, 60), max_size=4),
    st.floats(0, 1),
)
def test_quantiles_of_merged_parts_are_off_by_less_than_a_hundredth(
    values: np.ndarray, cuts: list[int], share: float
) -> None:
    parts = [Distribution.of(part) for part in np.split(values, sorted(cuts))]
    found = Distribution.merged([*parts[1:], parts[0]])
    whole = Distribution.of(values)
    for name, column in vars(whole).items():
        np.testing.assert_array_equal(getattr(found, name), column)
    ordered, place = np.sort(values).astype(np.float64), share * (len(values) - 1)
    ends = ordered[[math.floor(place), math.ceil(place)]]
    off = 0.008 * np.abs(ends) + 1e-38
    assert ends[0] - off[0] <= found.quantile(share) <= ends[1] + off[1]
    assert (found.quantile(0), found.quantile(1)) == (values.min(), values.max())


@pytest.mark.parametrize("values", [[], [0, 0, 5], [1, math.nan], [math.inf, math.inf]])
def test_without_a_size_nothing_is_rounded(values: list[float]) -> None:
    found = Distribution.of(np.array(values, np.float32))
    assert fine_bits(found) == EXACT_BITS
    if not values:
        assert (found.count, found.lowest, found.highest, found.quantile(0.5)) == (0, 0, 0, 0)
        assert tops(found.magnitudes(1), 1, 0, np.array([0.0, 0.5])).tolist() == [0, 0]


def sh_of(degree: int, spread: float, count: int = 400, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(0, spread, (count, COEFFICIENTS[degree], 3)).clip(-1, 0.99).astype(np.float32)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_error_is_that_of_colours_over_all_directions(degree: int) -> None:
    sh = quantize.decode_sh(quantize.encode_sh(sh_of(degree, 0.2), quantize.ALL_BITS))
    counts, _ = sh_code_counts(sh)
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(1_000, 3))
    basis = sh_basis(direction / np.linalg.norm(direction, axis=1, keepdims=True), degree)
    for bits in range(4, 8):
        off = quantize.decode_sh(quantize.encode_sh(sh, bits)) - sh
        seen = np.sqrt(np.square(np.einsum("dk,nkc->dnc", basis, off)).mean())
        assert sh_error(counts, bits) == pytest.approx(seen, rel=0.05)
    assert sh_error(counts, quantize.ALL_BITS) == 0


@pytest.mark.parametrize(("degree", "spread", "bits"), [(3, 0.002, 4), (1, 0.2, 4), (2, 0.2, 6), (3, 0.2, 7)])
def test_stronger_sh_keep_more_bits(degree: int, spread: float, bits: int) -> None:
    counts, between = sh_code_counts(sh_of(degree, spread))
    assert enough(counts, between) == bits
    assert sh_error(counts, bits) <= LARGEST_ERROR
    assert bits == 4 or sh_error(counts, bits - 1) > LARGEST_ERROR


@settings(max_examples=30)
@given(st.integers(4, 8), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_codes_keep_the_bits_that_they_have(bits: int, degree: int, seed: int) -> None:
    sh = quantize.decode_sh(quantize.encode_sh(sh_of(degree, 0.3, seed=seed), bits))
    counts, between = sh_code_counts(sh)
    assert between == 0
    kept = enough(counts, between)
    assert kept <= bits
    np.testing.assert_array_equal(quantize.decode_sh(quantize.encode_sh(sh, kept)), sh)


def test_leaves_decide_and_merged_splats_keep_the_fewest() -> None:
    splats = random_splats(500, sh_degree=3, seed=5)
    nodes, tree = quick.build(splats)
    scene = Scene(nodes, tree)
    bits = spz.settled(scene, DEFAULTS).sh_bits
    assert bits is not None and bits > 4
    assert bits == spz.settled(Scene(splats), DEFAULTS).sh_bits
    back = decode(spz, encode(spz, scene)).splats.sh
    for rows, kept in ((tree.is_leaf, bits), (~tree.is_leaf, 4)):
        np.testing.assert_array_equal(back[rows], quantize.decode_sh(quantize.encode_sh(nodes.sh[rows], kept)))
