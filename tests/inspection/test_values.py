"""Statistics of values, findings about them, and the columns of SPZ that a report reads."""

from __future__ import annotations

import dataclasses
import gzip
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sparklod_cli.codecs import ply
from sparklod_cli.codecs.spz import ANTIALIASED, HEADER, LOD, MAGIC, Layout
from sparklod_cli.inspection.findings import Finding
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.inspection.values import LEVELS, MAIN, QUANTITIES, Numbers, ValueFacts, names_of, quantity
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.splats import COLUMNS, Splats
from tests.conftest import FIXTURES
from tests.inspection import report_of
from tests.scenes import random_splats

NAN, INF = math.nan, math.inf
EXACT = 1e-5  # of six digits


def examine(splats: Splats, *, all_quantities: bool = False) -> ValueFacts:
    facts = report_of(Scene(splats), values=True, all_quantities=all_quantities).values
    assert facts is not None
    return facts


def check(scene: Scene) -> list[Finding]:
    return [each for each in report_of(scene, check=True).findings or [] if each.code.startswith("values.")]


def three() -> Splats:
    """Three splats whose quantities can be told by hand."""
    f32 = np.float32
    sh = np.zeros((3, COEFFICIENTS[2], 3), f32)
    sh[0, :3], sh[1, 3:] = 0.5, [3.0, 0.0, 4.0]
    sh[2, 0, 0] = 3.0
    return Splats(
        center=np.array([[0, 0, 0], [1, 10, -5], [3, -10, 5]], f32),
        scale=np.array([[1, 2, 4], [0.5, 0.5, 0.5], [3, 1, 2]], f32),
        quat_xyzw=np.tile(f32([0, 0, 0, 1]), (3, 1)),
        opacity=np.array([0.25, 1.0, 2.0], f32),
        rgb=np.array([[0, 0.5, 1], [0.25, 0.5, 1], [0.5, 0.5, 2]], f32),
        sh=sh,
    )


#: Of each of the three. Size: twice the mean scale, and more where D is above 1.
D_OF_2 = math.sqrt(1 + math.e * math.log(2))

BY_HAND = {
    "x": [0, 1, 3],
    "y": [0, 10, -10],
    "z": [0, -5, 5],
    "scale": [4, 0.5, 3],
    "scale_min": [1, 0.5, 1],
    "anisotropy": [4, 1, 3],
    "opacity": [0.25, 1, 2],
    "size": [14 / 3, 1, 4 * (1 + 0.7 * (D_OF_2 - 1))],
    "red": [0, 0.25, 0.5],
    "green": [0.5, 0.5, 0.5],
    "blue": [1, 1, 2],
    "sh1": [0.5, 0, 1],
    "sh2": [0, math.sqrt(25 / 3), 0],
}


@pytest.mark.parametrize("name", BY_HAND)
def test_each_quantity_of_three_splats_is_as_worked_out_by_hand(name: str) -> None:
    assert quantity(three(), name).tolist() == pytest.approx(BY_HAND[name])
    summary = examine(three(), all_quantities=True).quantities[name]
    assert summary["min"] == pytest.approx(min(BY_HAND[name]), rel=EXACT)
    assert summary["p50"] == pytest.approx(sorted(BY_HAND[name])[1], rel=EXACT)
    assert summary["max"] == pytest.approx(max(BY_HAND[name]), rel=EXACT)
    assert summary["mean"] == pytest.approx(sum(BY_HAND[name]) / 3, rel=EXACT)


@pytest.mark.parametrize("degree", range(4))
def test_quantities_depend_on_the_sh_degree(degree: int) -> None:
    splats = random_splats(5, sh_degree=degree)
    names = list(QUANTITIES)[: len(QUANTITIES) - 3 + degree]
    assert names_of(splats) == names
    assert list(examine(splats, all_quantities=True).quantities) == names
    assert list(examine(splats).quantities) == list(MAIN)


def spoiled(seed: int) -> Splats:
    """A scene of which every column has numbers that are not finite, and some splats no opacity or no scale."""
    splats = random_splats(400, sh_degree=3, seed=seed)
    rng = np.random.default_rng(seed)
    for name in COLUMNS:
        flat = getattr(splats, name).reshape(-1)
        flat[rng.integers(flat.size, size=5)] = rng.choice([NAN, INF, -INF], 5)
    splats.opacity[rng.integers(400, size=30)] = 0
    splats.scale[rng.integers(400, size=20)] = 0
    splats.scale[rng.integers(400, size=20), 1] = 0
    splats.opacity[rng.integers(400, size=25)] = 3
    return splats


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(4))
def test_facts_are_those_of_numpy_over_the_finite_splats(seed: int) -> None:
    splats = spoiled(seed)
    facts = examine(splats, all_quantities=True)
    finite = np.ones(len(splats), np.bool_)
    for name in COLUMNS:
        finite &= np.isfinite(getattr(splats, name).reshape(len(splats), -1)).all(axis=1)
    assert 350 < finite.sum() < 400
    assert facts.non_finite == (~finite).sum()
    assert facts.zero_opacity == (splats.opacity[finite] == 0).sum() > 0
    assert facts.zero_scale == (splats.scale[finite] == 0).all(axis=1).sum() > 0
    assert facts.more_than_opaque == (splats.opacity[finite] > 1).sum() > 0
    center = splats.center[finite].astype(np.float64)
    for box, low, high in ((facts.box, 0, 100), (facts.box_98, 1, 99)):
        assert box is not None
        assert box.min == pytest.approx(np.percentile(center, low, axis=0).tolist(), rel=EXACT)
        assert box.max == pytest.approx(np.percentile(center, high, axis=0).tolist(), rel=EXACT)
    scale = splats.scale[finite].astype(np.float64)
    some = scale.min(axis=1) > 0  # without the others: they are infinitely thin
    expected = {
        "opacity": splats.opacity[finite].astype(np.float64),
        "anisotropy": scale[some].max(axis=1) / scale[some].min(axis=1),
        "z": center[:, 2],
        "sh3": np.sqrt((splats.sh[finite].astype(np.float64)[:, 8:] ** 2).mean(axis=(1, 2))),
    }
    for name, numbers in expected.items():
        summary = facts.quantities[name]
        for key, level in LEVELS.items():
            assert summary[key] == pytest.approx(np.percentile(numbers, level), rel=EXACT, abs=1e-9), (name, key)
        assert summary["mean"] == pytest.approx(numbers.mean(), rel=EXACT)


@pytest.mark.parametrize("all_quantities", [True, False])
@pytest.mark.parametrize("degree", [0, 3])
def test_no_splats_have_no_numbers(degree: int, all_quantities: bool) -> None:
    for splats in (random_splats(3, sh_degree=degree), random_splats(0, sh_degree=degree)):
        splats.center[:] = NAN
        facts = examine(splats, all_quantities=all_quantities)
        assert (facts.box, facts.box_98, facts.non_finite) == (None, None, len(splats))
        for summary in facts.quantities.values():
            assert set(summary.values()) == {None}


@pytest.mark.filterwarnings("error")
def test_numbers_at_the_end_of_what_floats_hold_can_be_printed() -> None:
    splats = random_splats(2, sh_degree=1)
    largest = np.finfo(np.float32).max
    for name in COLUMNS:
        column, positive = getattr(splats, name), name in ("scale", "opacity")
        if name != "quat_xyzw":  # whose length is 1
            column[0], column[1] = largest, np.float32(1e-45) if positive else -largest
    facts = examine(splats, all_quantities=True)
    json.dumps(dataclasses.asdict(facts), allow_nan=False)
    assert facts.box is not None
    assert facts.box.max == pytest.approx([largest] * 3, rel=EXACT)


# --- Percentiles of numbers that come block by block ------------------------------------------------------------------


def numbers_of(kind: str) -> st.SearchStrategy[np.ndarray]:
    elements = arrays.from_dtype(np.dtype(kind), allow_nan=False, allow_infinity=False)
    return arrays.arrays(kind, st.integers(1, 60), elements=elements | st.sampled_from([0.0, -0.0, 1.0, 1.5]))


def summary_of(values: np.ndarray, limit: float, step: int, *, centred: bool = False) -> dict[str, float]:
    numbers = Numbers(limit, centred=centred)
    for start in range(0, len(values), step):
        numbers.add(values[start : start + step])
    assert numbers.count == np.isfinite(values).sum()
    return numbers.summary()


@pytest.mark.filterwarnings("ignore:overflow")
@given(st.one_of(numbers_of("<f4"), numbers_of("<f8")), st.integers(1, 20))
@example(np.array([-0.0, 0.0, 0.0], np.float32), 2)
def test_percentiles_of_numbers_that_are_kept_are_those_of_numpy(values: np.ndarray, step: int) -> None:
    found, wide = summary_of(values, len(values), step), values.astype(np.float64)
    assert list(found) == [*LEVELS, "mean"]
    for name, level in LEVELS.items():
        assert found[name] == pytest.approx(np.percentile(wide, level), rel=6e-6, abs=1e-320)
        assert found[name] or not np.signbit(found[name])  # no -0, whose place among zeros is not fixed
    assert found["mean"] == pytest.approx(wide.mean(), rel=6e-6, abs=1e-9 * float(np.abs(wide).max()))


@pytest.mark.parametrize("origin", [0, 500_000])
@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_percentiles_of_more_numbers_are_off_by_less_than_a_hundredth(kind: str, origin: int) -> None:
    rng = np.random.default_rng(0)
    away = (rng.normal(size=5_000) * np.exp(rng.normal(size=5_000))).astype(np.float32)
    away[:3] = np.nan, np.inf, -np.inf
    values = (origin + away).astype(kind)
    found, finite = summary_of(values, 100, 64, centred=True), values[np.isfinite(values)].astype(np.float64)
    for name, level in LEVELS.items():
        expected = np.percentile(finite, level)
        assert found[name] == pytest.approx(expected, abs=0.009 * abs(expected - origin) + 5e-6 * abs(expected) + 2e-3)
    assert found["mean"] == pytest.approx(finite.mean(), rel=1e-5)


# --- Findings ---------------------------------------------------------------------------------------------------------


def edited(count: int, name: str, at: Any, value: float) -> Splats:
    """A scene with other numbers in one column."""
    splats = random_splats(count, sh_degree=1)
    getattr(splats, name)[at] = value
    return splats


@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_a_number_that_is_not_finite_is_an_error_in_every_column(name: str, value: float) -> None:
    finding = check(Scene(edited(20, name, 0, value)))[0]
    assert (finding.code, finding.index, finding.count) == ("values.non-finite", 0, 1)


SPZ = {"version": 3, "fractional_bits": 12}
#: The largest coordinate, and the smallest and largest scale, of the codes of such a file.
FAR_END = (2**23 - 1) / 2**12
SMALL, LARGE = (float(end) for end in np.exp(np.float32([-10, 255 / 16 - 10])))


@pytest.mark.parametrize(
    ("count", "name", "at", "value", "header", "expected"),
    [
        (20, "opacity", 0, 1.01, {}, "values.opacity"),
        (20, "opacity", 0, -0.01, {}, "values.opacity"),
        (20, "opacity", 0, 1.0, {}, ""),
        (20, "opacity", slice(2), 0.0, {}, ""),  # a tenth is not many
        (20, "opacity", slice(3), 0.0, {}, "values.invisible"),
        (20, "scale", slice(2), 0.0, {}, ""),
        (20, "scale", slice(3), 0.0, {}, "values.invisible"),
        (20, "scale", (slice(20), 2), 0.0, {}, ""),  # flat splats can be drawn
        *((20, "center", (0, 0), FAR_END, {**SPZ, "version": each}, "values.center-clamped") for each in (2, 3, 4)),
        (20, "center", (0, 0), -FAR_END, SPZ, "values.center-clamped"),
        (20, "center", (0, 0), FAR_END - 2**-12, SPZ, ""),
        (20, "center", (0, 0), FAR_END, {**SPZ, "version": 1}, ""),  # which has floats
        (20, "center", (0, 0), FAR_END, {}, ""),
        (20, "center", (0, 0), 65_519.9, {}, ""),
        (20, "center", (0, 0), 65_520.0, {}, "values.center-far"),
        (20, "center", (0, 0), -1e7, {}, "values.center-far"),
        (2_000, "scale", slice(2), SMALL, SPZ, ""),  # a thousandth is not many
        (2_000, "scale", slice(3), SMALL, SPZ, "values.scale-clamped"),
        (2_000, "scale", slice(2), LARGE, SPZ, "values.scale-clamped"),  # one splat of a sky may fill the picture
        (2_000, "scale", slice(3), LARGE, {}, ""),
        (200, "scale", (slice(200), 2), SMALL, SPZ, ""),  # thin splats
        (200, "scale", (slice(100), 2), LARGE, SPZ, "values.scale-clamped"),
    ],
)
def test_numbers_beyond_or_at_the_end_of_their_range_are_findings(
    count: int, name: str, at: Any, value: float, header: dict[str, int], expected: str
) -> None:
    findings = check(Scene(edited(count, name, at, value), header=header))
    assert [finding.code for finding in findings] == expected.split()


def test_merged_splats_may_be_more_than_opaque() -> None:
    tree = LodTree(np.array([19] + [0] * 19, np.uint16), np.array([1] + [0] * 19, np.uint32))
    assert check(Scene(edited(20, "opacity", 0, 900.0), tree)) == []
    assert [finding.code for finding in check(Scene(edited(20, "opacity", 0, -0.01), tree))] == ["values.opacity"]


def test_a_finding_names_the_first_splat_and_counts_the_others() -> None:
    (finding,) = check(Scene(edited(20, "opacity", [3, 7, 10], 0)))
    assert (finding.code, finding.index, finding.count) == ("values.invisible", 3, 3)
    assert "splat 3 and 2 more" in finding.message


@pytest.mark.parametrize(
    ("rgb", "sh", "hint"),
    [
        (0.0, 1.0, ["Spark's ExtSplats clip the SH"]),
        (0.0, 0.01, []),
        (1.0, 0.01, ["Spark's PackedSplats clamp colours or round centres"]),
    ],
)
@pytest.mark.parametrize("sh_degree", [2, 3])
def test_a_check_hints_at_the_layout_of_spark_that_loses_less(
    rgb: float, sh: float, hint: list[str], sh_degree: int, tmp_path: Path
) -> None:
    splats = random_splats(300, sh_degree=sh_degree)
    splats = replace(splats, rgb=splats.rgb + np.float32(rgb), sh=splats.sh * np.float32(sh))
    (tmp_path / "scene.ply").write_bytes(b"".join(ply.encode(Scene(splats))))
    report, _ = inspect(tmp_path / "scene.ply", ReportSettings(check=True))
    assert [each.partition(" (")[0] for each in report.hints] == hint
    assert report.findings == []
    assert all(("pagedExtSplats of" in each) == (sh_degree < 3) for each in report.hints if "clamp" in each)
    assert inspect(tmp_path / "scene.ply", ReportSettings())[0].hints == []


# --- Files ------------------------------------------------------------------------------------------------------------


SETTINGS = [
    ReportSettings(),
    ReportSettings(values=True),
    ReportSettings(check=True),
    ReportSettings(chunks=True, values=True, all_quantities=True, check=True),
]
FILES = sorted([*(FIXTURES / "golden").glob("*.spz"), *(FIXTURES / "faults").glob("*.spz")])


def check_columns(path: Path) -> None:
    """Compare reports from some columns, on several threads, with the report from the whole scene."""
    for settings in SETTINGS:
        expected, _ = inspect(path, replace(settings, at_once=True), threads=2)
        for threads in (1, 3):
            found, scene = inspect(path, settings, threads=threads)
            assert repr(found) == repr(expected)  # NaN differs from itself
            assert scene is None


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_columns_of_spz_give_the_report_of_the_whole_file(path: Path) -> None:
    check_columns(path)


def random_file(version: int, *, flags: int, count: int = 300, links: int = 0) -> bytes:
    """A file of any codes; its links lead anywhere up to `links`."""
    rng = np.random.default_rng(version)
    layout = Layout(version, count, 2, 12, flags)
    data = HEADER.pack(MAGIC, version, count, 2, 12, flags, 0)
    for stream in layout.streams():
        codes = rng.integers(0, 256, (count, stream.size), np.uint8)
        if stream.name.startswith("child"):
            kind = "<u2" if stream.size == 2 else "<u4"
            codes = rng.integers(0, links, count).astype(kind).view(np.uint8)
        data += codes.tobytes()
    return gzip.compress(data, 1)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # any bits are numbers
@pytest.mark.parametrize("flags", [0, ANTIALIASED, LOD])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_columns_of_any_codes(version: int, flags: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.inspection.findings.CHUNK_NODES", 64)
    path = tmp_path / "any.spz"
    path.write_bytes(random_file(version, flags=flags, links=5))
    check_columns(path)


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("flags", [0, LOD])
def test_no_code_but_positions_of_version_1_stands_for_an_invalid_splat(
    version: int, flags: int, tmp_path: Path
) -> None:
    path = tmp_path / "any.spz"
    path.write_bytes(random_file(version, flags=flags, count=40_000, links=1))
    splats = read_scene(path, validate=False).splats
    assert set(splats.invalid()) == ({"non_finite"} if version == 1 else set())
    splats = replace(splats, center=np.zeros_like(splats.center))
    assert splats.invalid() == {}
