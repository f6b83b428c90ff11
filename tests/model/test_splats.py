"""The data model: columns, formulas of one splat, its falloff, invalid splats, and the selection of splats."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import sparklod_cli as sparklod
from fixtures import by_hand_ksplat, by_hand_splat
from sparklod_cli.cli import run
from sparklod_cli.lod.kernels import geometry
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model import falloff, gaussian, morton, selection
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity, normalized_quat
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.selection import REASONS, Selection, describe
from sparklod_cli.model.sh import COEFFICIENTS, degree_of
from sparklod_cli.model.splats import COLUMNS, INVALID, Splats
from sparklod_cli.render.kernels import ellipse, project
from sparklod_cli.system.errors import FormatError, InvalidSplatsError
from tests.references import gaussians
from tests.scenes import random_splats

# Columns


@pytest.mark.parametrize("degree", range(4))
def test_columns_have_their_shapes(degree: int) -> None:
    splats = random_splats(7, sh_degree=3).with_max_sh(degree)
    assert (len(splats), splats.sh_degree, splats.sh.shape) == (7, degree, (7, COEFFICIENTS[degree], 3))
    assert np.array_equal(splats.sh, random_splats(7, sh_degree=3).sh[:, : COEFFICIENTS[degree]])
    assert splats.with_max_sh(3).sh_degree == degree
    assert Splats.empty(3, degree).sh.shape == (3, COEFFICIENTS[degree], 3)


def test_a_wrong_number_of_coefficients_is_an_error() -> None:
    with pytest.raises(FormatError, match="4 SH coefficients"):
        degree_of(4)


@pytest.mark.parametrize("name", COLUMNS)
def test_a_column_of_another_kind_is_refused(name: str) -> None:
    splats = random_splats(4, sh_degree=1)
    column = getattr(splats, name)
    strided = np.asfortranarray(np.repeat(column, 2, axis=0))[::2]
    for wrong in (column[:3], column.astype(np.float64), strided, column[..., None]):
        with pytest.raises(ValueError, match="expected"):
            dataclasses.replace(splats, **{name: wrong})


@pytest.mark.parametrize("name", COLUMNS)
def test_take_filters_permutes_and_slices_all_columns(name: str) -> None:
    splats = random_splats(10, sh_degree=2)
    column = getattr(splats, name)
    for index in (np.arange(10) % 3 == 0, np.array([4, 4, 0]), slice(2, 5)):
        assert np.array_equal(getattr(splats.take(index), name), column[index])
    both = Splats.concat([splats.take(slice(0, 3)), splats.take(slice(3, 10))])
    assert np.array_equal(getattr(both, name), column)


# Formulas

QUATS = random_splats(50, seed=4).quat_xyzw


@given(arrays(np.float32, st.tuples(st.integers(1, 20)), elements=st.floats(np.float32(1e-6), 1000, width=32)))
def test_lod_opacity_can_be_inverted(opacity: np.ndarray) -> None:
    coded = lod_opacity(opacity)
    assert coded.dtype == np.float32
    assert np.array_equal(coded[opacity <= 1], opacity[opacity <= 1])
    assert ((coded > 1) == (opacity > 1))[np.abs(opacity - 1) > 1e-6].all()
    assert np.allclose(linear_opacity(coded), opacity, rtol=2e-5)
    assert lod_opacity(np.float32([1000.0]))[0] == pytest.approx(4.45, abs=0.005)  # as Spark's design says


@given(
    arrays(np.float32, (5, 4), elements=st.floats(-1, 1, width=32).filter(lambda x: x == 0 or abs(x) > 1e-6)),
    st.sampled_from([1e-30, 1.0, 1e30]),
)
def test_quaternions_of_any_length_become_units(quat: np.ndarray, length: float) -> None:
    scaled = quat * np.float32(length)
    unit = normalized_quat(scaled)
    zero = ~scaled.any(axis=1)
    assert np.isnan(unit[zero]).all()
    assert np.allclose(np.linalg.norm(unit[~zero], axis=1), 1, atol=1e-6)
    assert (np.sign(unit[~zero]) == np.sign(scaled[~zero])).all()


@given(arrays(np.float32, (3,), elements=st.floats(np.float32(1e-10), np.float32(1e10), width=32)))
def test_the_area_of_an_ellipsoid_is_thomsens_formula(scale: np.ndarray) -> None:
    assert geometry.ellipsoid_area(*scale) == pytest.approx(gaussians.ellipsoid_area(scale), rel=1e-5)


@pytest.mark.parametrize(
    ("scale", "expected"),
    [
        ((2, 2, 2), 16 * math.pi),
        ((1, 0, 1), 2 * math.pi),  # a disc has two faces; the formula is within 1.061 %, and at its worst on discs
        ((0, 0, 1), 0),
        ((1e18, 1e18, 1e18), 4e36 * math.pi),
    ],
)
def test_spheres_discs_and_needles_have_areas(scale: tuple[float, ...], expected: float) -> None:
    area = geometry.ellipsoid_area(*np.float32(scale))
    assert area > 0
    assert area == pytest.approx(expected, rel=0.0107, abs=1e-15)


def test_rotation_matrices_turn_vectors_as_quaternions_do() -> None:
    """In numpy and, bit for bit the same, in kernels."""
    np.testing.assert_allclose(
        gaussian.rotation_matrices(QUATS).transpose(2, 0, 1), gaussians.rotation_matrix(QUATS), atol=1e-6
    )
    for kind, kernel in ((np.float32, ellipse.rotation_matrix), (np.float64, geometry.rotation_matrix)):
        quats = QUATS.astype(kind)
        expected = np.array(gaussian.rotation_matrix(*quats.T, kind(1)), kind)
        assert np.array_equal([kernel(*quat, kind(1)) for quat in quats], expected.T)


def test_kernels_have_the_opacities_of_numpy() -> None:
    opacity = np.geomspace(1.001, 1000, 200, dtype=np.float32)
    d = lod_opacity(opacity)
    back = [project.linear_opacity_above_1(value, np.float32(1), np.float32(np.e)) for value in d]
    np.testing.assert_allclose(back, linear_opacity(d), rtol=1e-6)
    found = [geometry.lod_opacity_above_1(float(value), 1.0, np.e) for value in opacity]
    np.testing.assert_allclose(found, d, rtol=1e-6)


@pytest.mark.filterwarnings("error")
def test_sizes_of_splats_that_are_not_finite_are_no_warning() -> None:
    splats = random_splats(3)
    splats.scale[:2] = [[np.inf, -np.inf, 1], [3e38, 3e38, 3e38]]
    assert np.isfinite(gaussian.spark_size(splats)).tolist() == [False, False, True]


# Falloff


def alpha(z2: float, d: float, design: bool) -> float:
    """In float64, as the pages on Spark's shader and its LoD design have it."""
    if d <= 1:
        return d * math.exp(-z2 / 2)
    if design:
        return math.exp(-d / 2 * max(0.0, math.sqrt(z2) - (d - 1)) ** 2)
    return 1 - (1 - math.exp(-z2 / 2)) ** math.exp((d * d - 1) / math.e)


def exponent(z2: float, d: float) -> np.float32:
    """The argument of falloffs: its power of two is alpha up to D = 1, and exp(-z^2 / 2) above."""
    return np.float32(math.log2(min(d, 1)) - z2 / 2 * math.log2(math.e))


@pytest.mark.parametrize("design", [False, True])
@pytest.mark.parametrize("d", [0.01, 0.5, 1.0, 1.2, 2.0, 4.0, 5.0])
def test_both_falloffs_are_those_of_spark(d: float, design: bool) -> None:
    opacity, power = np.float32(d), np.float32(math.exp((np.float32(d) ** 2 - 1) / math.e) if d > 1 else 1)
    for z in np.linspace(0, 5, 101, dtype=np.float32):
        z2 = float(z) ** 2
        t = exponent(z2, d)
        expected = alpha(z2, float(opacity), design)
        merged = falloff.shifted(t, opacity) if design else falloff.merged(t, power)
        assert falloff.alpha_at(t, opacity, power, design) == pytest.approx(expected, abs=2e-6)
        assert (falloff.plain(t) if d <= 1 else merged) == pytest.approx(expected, abs=3e-6)


@pytest.mark.parametrize("d", [1.2, 5.0])
def test_the_power_of_a_merged_splat_does_not_enlarge_rounding(d: float) -> None:
    """Where 1 - exp(-z^2 / 2) is nearly 1 and the power is thousands."""
    power = np.float32(math.exp((d * d - 1) / math.e))
    for z in np.linspace(3, 5.6, 50):
        expected = -math.expm1(float(power) * math.log1p(-math.exp(-z * z / 2)))
        assert falloff.merged(exponent(z * z, d), power) == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("d", [2.0, 5.0])
def test_a_squared_distance_that_is_rounded_below_0_is_the_centre(d: float) -> None:
    opacity, power, t = np.float32(d), np.float32(d**2), np.float32(1e-9)
    for found in (
        *(falloff.alpha_at(t, opacity, power, design) for design in (False, True)),
        falloff.merged(t, power),
        falloff.shifted(t, opacity),
    ):
        assert found == pytest.approx(1, abs=1e-6)


# The Morton curve


def place(cell: list[int]) -> int:
    """The place along the curve of a cell: its bits in turns, z first."""
    places = [(bit, axis) for bit in range(morton.BITS) for axis in range(3)]
    return sum((cell[axis] >> bit & 1) << 3 * bit + axis for bit, axis in places)


@given(arrays(np.uint32, st.tuples(st.integers(0, 30), st.just(3)), elements=st.integers(0, 2**morton.BITS - 1)))
def test_cells_are_ordered_by_their_bits_in_turns(cells: np.ndarray) -> None:
    expected = sorted(range(len(cells)), key=lambda row: place(cells[row].tolist()))  # stable
    np.testing.assert_array_equal(morton.order_of_cells(cells), expected)


FINITE = st.floats(-(2.0**127), 2.0**127, width=32)


@given(arrays(np.float32, st.tuples(st.integers(0, 30), st.just(3)), elements=FINITE))
def test_any_finite_points_get_an_order(center: np.ndarray) -> None:
    order = morton.order(center)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(center)))


# Invalid splats

#: A number that makes a splat invalid, by the kind of invalid splats.
SPOILERS = {
    "non_finite": ("rgb", np.nan),
    "bad_rotation": ("quat_xyzw", 2),
    "negative_scale": ("scale", -0.1),
    "negative_opacity": ("opacity", -0.5),
}


def with_value(splats: Splats, name: str, row: int, value: float) -> Splats:
    """The splats with another last number of a column in a row."""
    column = getattr(splats, name).copy()
    column.reshape(len(splats), -1)[row, -1] = value
    return dataclasses.replace(splats, **{name: column})


def spoiled(splats: Splats, kind: str, at: int) -> Splats:
    name, value = SPOILERS[kind]
    return with_value(splats, name, at, value)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", INVALID)
def test_every_kind_is_refused_by_builders_and_dropped_by_a_selection(kind: str, method: str) -> None:
    assert list(SPOILERS) == list(INVALID) == list(REASONS)[: len(INVALID)]
    good = random_splats(20, sh_degree=1)
    splats = spoiled(good, kind, 4)
    assert {each: mask.tolist() for each, mask in splats.invalid().items()} == {kind: [at == 4 for at in range(20)]}
    for refuse in (lambda: sparklod.build_lod(Scene(splats), method=method), lambda: Selection().apply(splats)):
        with pytest.raises(InvalidSplatsError, match=r"1 of 20 splats is .*the first is splat 4"):
            refuse()
    kept, dropped = Selection(drop_invalid=True).apply(splats)
    assert dropped == {kind: 1}
    assert np.array_equal(kept.center, np.delete(good.center, 4, axis=0))


def test_a_splat_is_of_one_kind_and_the_first_of_all_is_named() -> None:
    splats = random_splats(20)
    for at, kind in enumerate(INVALID):
        splats = spoiled(splats, kind, 10 - at)
    splats = spoiled(splats, "negative_scale", 10)  # which is not finite either
    first = {kind: int(mask.argmax()) for kind, mask in splats.invalid().items()}
    assert first == dict(zip(INVALID, (10, 9, 8, 7), strict=True))
    assert np.flatnonzero(~splats.is_valid()).tolist() == [7, 8, 9, 10]
    with pytest.raises(InvalidSplatsError) as raised:
        Selection().apply(splats)
    assert str(raised.value).startswith(
        "4 of 20 splats are invalid (1 not finite, 1 rotation not of length 1, 1 negative scale, 1 negative opacity;"
        " the first is splat 7), add"
    )


def test_zeros_of_either_sign_and_huge_numbers_are_valid() -> None:
    splats = random_splats(4)
    splats.scale[0] = splats.opacity[1] = splats.scale[2, 1] = -0.0
    splats.center[3] = 3e38
    assert splats.invalid() == {}


BAD = (7, 30)


def columns(value: float) -> dict[str, np.ndarray]:
    """50 splats as the writers of formats take them, two of them with this scale along one axis."""
    splats = random_splats(50, seed=2)
    doubles = {name: getattr(splats, name).astype(np.float64) for name in ("center", "scale", "opacity", "rgb", "sh")}
    doubles["scale"][BAD, (1, 2)] = value
    return doubles | {"quat_wxyz": splats.quat_xyzw[:, [3, 0, 1, 2]].astype(np.float64)}


def ksplat(level: int) -> Callable[[float], bytes]:
    return lambda value: by_hand_ksplat.ksplat(**columns(value), level=level)


#: Writers of formats that can hold a negative scale. The others hold logarithms.
WRITERS: dict[str, Callable[[float], bytes]] = {
    "a.splat": lambda value: by_hand_splat.splat(**columns(value)),
    "0.ksplat": ksplat(0),
    "1.ksplat": ksplat(1),
    "2.ksplat": ksplat(2),
}


def messages(capfd: pytest.CaptureFixture[str]) -> list[str]:
    return [line for line in capfd.readouterr().err.splitlines() if not line.startswith("Compiling")]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [-0.02, -60_000.0, -1e30])
@pytest.mark.parametrize("name", WRITERS)
def test_a_negative_scale_is_an_error_or_dropped(
    name: str, value: float, method: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    if name[0] in "12" and value < -65_504:
        pytest.skip("a half does not hold it")
    source, output = tmp_path / name, tmp_path / "out.spz"
    source.write_bytes(WRITERS[name](value))
    for command in (
        ["build-lod", str(source), "-o", str(output), "--method", method],
        ["convert", str(source), str(output), "--overwrite"],
    ):
        assert run(command) == 1
        assert messages(capfd) == [
            f"error: {source}: 2 of 50 splats are invalid (2 negative scale; the first is splat 7),"
            " add --on-invalid drop to leave them out"
        ]
        assert output.exists() == (command[0] == "convert")
        assert run([*command, "--on-invalid", "drop"]) == 0
        assert "  left out: 2 negative scale" in "".join(messages(capfd))
        options = ["--leaves-of", str(source)] if command[0] == "build-lod" else []
        assert run(["inspect", "--check", *options, str(output)]) == 0
        capfd.readouterr()


# Selection


@pytest.mark.parametrize(("invalid", "advised"), [(1, True), (4, True), (5, False), (9, False), (10, False)])
@pytest.mark.parametrize("kind", ["center", "scale"])
def test_splats_are_left_out_by_advice_only_where_most_stay(invalid: int, advised: bool, kind: str) -> None:
    splats = random_splats(10)
    for row in range(invalid):
        splats = with_value(splats, kind, row, -1 if kind == "scale" else np.nan)
    with pytest.raises(InvalidSplatsError) as caught:
        Selection().apply(splats)
    assert ("--on-invalid drop" in str(caught.value)) is advised
    assert ("export it again" in str(caught.value)) is not advised


FAR = (100.0, 100.0, 100.0)


@pytest.mark.parametrize(
    ("splats", "min_box", "message"),
    [
        (with_value(random_splats(10), "opacity", 3, np.nan), FAR, r"1 of 10 .* no other splat is left \(9 cropped\)$"),
        (random_splats(5), FAR, r"no splat is left of 5 \(5 cropped\)"),
        (random_splats(0), None, "it has no splats"),
    ],
)
def test_an_empty_selection_is_an_error_that_says_why(
    splats: Splats, min_box: tuple[float, float, float] | None, message: str
) -> None:
    with pytest.raises(InvalidSplatsError, match=message):
        Selection(min_box=min_box).apply(splats)


def test_a_splat_is_counted_once_by_the_first_reason() -> None:
    splats = random_splats(20)
    splats.opacity[:3], splats.opacity[3:5] = 0, 0.001
    splats.scale[2:4] = 0
    splats.scale[10, :2] = 0  # a needle is a splat
    kept, dropped = Selection(min_opacity=0.01).apply(splats)
    assert dropped == {"zero_opacity": 3, "zero_scale": 1, "low_opacity": 1}
    assert len(kept) == 15
    assert describe(dropped) == "3 zero opacity, 1 zero scale, 1 below --min-opacity"
    everything = random_splats(5)
    assert Selection().apply(everything)[0] is everything


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"min_box": (1, 0, 0)}, [1, 3]),
        ({"max_box": (1, 2, 0)}, [0, 1, 2]),
        ({"min_box": (0, 0, 0), "max_box": (0, 2, 0)}, [0, 2]),
        ({"within": ((0, 0, 0), 5)}, [0, 1, 2, 3]),
        ({"within": ((0, 0, 0), 1)}, [0, 1]),
    ],
)
def test_cropping_keeps_splats_on_the_border(arguments: dict[str, object], expected: list[int]) -> None:
    splats = random_splats(4)
    splats.center[:] = [[0, 0, 0], [1, 0, 0], [0, 2, 0], [3, 0, 4]]
    kept, dropped = Selection(**arguments).apply(splats)
    assert kept.center.tolist() == splats.center[expected].tolist()
    assert dropped == ({"cropped": 4 - len(expected)} if len(expected) < 4 else {})
    tenth = dataclasses.replace(random_splats(1), center=np.full((1, 3), 0.1, np.float32))
    assert Selection(min_box=(0.1,) * 3, max_box=(0.1,) * 3).apply(tenth)[1] == {}


@pytest.mark.parametrize("threads", [1, 3])
def test_blocks_are_examined_as_the_whole(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    splats = with_value(with_value(random_splats(100, seed=3), "center", 71, np.nan), "opacity", 12, 0)
    keep, tally = Selection(drop_invalid=True).examine(splats)
    monkeypatch.setattr(selection, "EXAMINED", 16)
    kept, dropped = Selection(drop_invalid=True).apply(splats, threads=threads)
    assert dropped == tally.dropped == {"non_finite": 1, "zero_opacity": 1}
    assert np.array_equal(kept.center, splats.center[keep])
    with pytest.raises(InvalidSplatsError, match="splat 71"):
        Selection().apply(splats, threads=threads)
