"""Whatever `build-lod` writes passes `inspect --check --leaves-of` its source, or it is not written at all.

The bakes are made in this process, through files, over scenes at the ends of what formats hold.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import sparklod_cli as sparklod
from fixtures import by_hand, by_hand_ksplat, by_hand_splat
from sparklod_cli.api.converting import convert_file
from sparklod_cli.bake.flow import bake, stage_shares
from sparklod_cli.bake.settings import BakeSettings, Resources
from sparklod_cli.bake.simplifying import SimplifyGoal
from sparklod_cli.codecs import ply, spz
from sparklod_cli.codecs.formats import (
    ENCODINGS,
    MAX_FRACTIONAL_BITS,
    TREE_SPZ_VERSIONS,
    WRITABLE,
    RadOptions,
    SogOptions,
    WriteOptions,
)
from sparklod_cli.codecs.rad import rad_writer as rad_options
from sparklod_cli.codecs.spark_codings import log_scale_table
from sparklod_cli.fitting.fit_settings import FitSettings
from sparklod_cli.inspection import leaves, values
from sparklod_cli.inspection.findings import ERROR, NOTE, Finding
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod.budget import parse_budget
from sparklod_cli.lod.chunk_order import viewpoints
from sparklod_cli.lod.tree_settings import METHODS, DetailSettings, TileSettings
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.tables import histograms
from tests.conftest import FIXTURES, real_scene
from tests.scenes import random_splats, splat_columns

pytestmark = pytest.mark.filterwarnings("error")

BITS = st.one_of(st.none(), st.integers(0, MAX_FRACTIONAL_BITS))

#: How far coordinates reach; SPZ's end, and float32's.
REACHES = (0.0, 1e-30, 1e-6, 0.1, 1.0, 100.0, 2047.9998, 65_504.0, 1e6)
REACHES += (8_388_606.0, 8_388_607.0, 8_388_608.0, 1e30, 3e38)
SIZES = (1e-38, 1e-20, 1e-6, 4e-5, 0.01, 1.0, 376.0, 1e5, 1e18, 1e30, 1e38)
SHAPES = ((1, 1, 1), (1, 1, 0), (1, 0, 0), (1, 1e-4, 1e-4), (1, 0.3, 1e-12))
OPACITIES = (1e-30, 1e-6, 0.001, 0.002, 0.5, 0.9999999, 1.0)
COLORS = (0.5, -1e38, 3e38, -0.44, 1.44)


@st.composite
def scenes(draw: st.DrawFn) -> Splats:
    """Splats of which each column is drawn from a few extremes, with some chance in between."""
    count, degree = draw(st.sampled_from([1, 2, 3, 20, 60])), draw(st.sampled_from([0, 0, 1, 3]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def some(values: tuple[float, ...], most: int) -> np.ndarray:
        chosen = draw(st.lists(st.sampled_from(values), min_size=1, max_size=most))
        return rng.choice(np.array(chosen), count)

    reach = some(REACHES, 2)[:, None]
    places = {
        "around": rng.uniform(-1, 1, (count, 3)),
        "corners": rng.choice([-1.0, 1.0], (count, 3)),
        "one place": np.ones((count, 3)),
        "a line": rng.uniform(-1, 1, (count, 1)) * [1, 0, 0],
    }
    shape = np.array(SHAPES)[rng.integers(len(SHAPES), size=count)]
    sh = rng.choice(
        np.array([0, 0.1, -0.9, draw(st.sampled_from([1.0, 3e38, -1e38]))]), (count, COEFFICIENTS[degree], 3)
    )
    # Below float32's largest, which a product may round up to.
    columns = {
        "center": np.clip(places[draw(st.sampled_from(sorted(places)))] * reach, -3e38, 3e38),
        "scale": np.clip(some(SIZES, 3)[:, None] * shape * rng.uniform(0.5, 1, (count, 1)), 0, 1e38),
        "quat_xyzw": normalized_quat(rng.normal(size=(count, 4))),
        "opacity": some(OPACITIES, 3),
        "rgb": np.stack([some(COLORS, 2) for _ in range(3)], axis=1),
        "sh": sh,
    }
    with np.errstate(under="ignore"):
        return Splats(**{name: np.ascontiguousarray(column, np.float32) for name, column in columns.items()})


def report_all(source: Path) -> None:
    """Make everything that `inspect` can report of a file."""
    report, scene = inspect(source, ReportSettings(values=True, all_quantities=True, check=True, at_once=True))
    json.dumps(report.as_dict(), allow_nan=False)
    assert scene is not None
    for name in values.names_of(scene.splats):
        histograms.as_text(values.histogram_of(scene.splats, name))


def findings_in(output: Path, source: Path) -> list[Finding]:
    """Findings of `inspect --check --leaves-of`."""
    report, scene = inspect(output, ReportSettings(check=True, at_once=True))
    assert scene is not None
    return [*(report.findings or []), *leaves.check(scene, read_scene(source))]


def findings_of(source: Path, how: BakeSettings) -> list[Finding]:
    """Findings in a bake."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder, "out.spz")
        bake(source, output, how)
        return findings_in(output, source)


def no_errors(findings: Iterable[Finding]) -> bool:
    return not any(each.severity == ERROR for each in findings)


def file_of(folder: str | Path, splats: Splats) -> Path:
    path = Path(folder, "scene.ply")
    path.write_bytes(b"".join(ply.encode(Scene(splats))))
    return path


@contextlib.contextmanager
def or_refused() -> Iterator[None]:
    """Accept an error whose message is one line."""
    try:
        yield
    except SparklodError as error:
        assert str(error) and "\n" not in str(error)


@given(scenes(), st.sampled_from(METHODS), st.sampled_from(TREE_SPZ_VERSIONS), BITS)
@settings(max_examples=100)
def test_baked_spz_passes_inspect_check(splats: Splats, method: str, version: int, bits: int | None) -> None:
    how = BakeSettings(method=method, options=WriteOptions(spz_version=version, fractional_bits=bits))
    with tempfile.TemporaryDirectory() as folder, or_refused():
        assert no_errors(findings_of(file_of(folder, splats), how))


@given(scenes(), st.sampled_from(METHODS), st.booleans(), st.sampled_from([None, None, 2, 65_536]))
def test_baked_rad_passes_inspect_check(splats: Splats, method: str, chunked: bool, codes: int | None) -> None:
    assume(np.abs(splats.center).max() < 1e38)  # beyond, a merged splat may be infinitely large
    options = WriteOptions(rad=RadOptions(chunked=chunked, sh_codes=codes))
    with tempfile.TemporaryDirectory() as folder, or_refused():
        output = Path(folder, "out.rad")
        bake(file_of(folder, splats), output, BakeSettings(method=method, suffix=".rad", options=options))
        report, _ = inspect(output, ReportSettings(check=True))
        assert no_errors(report.findings or [])
        report_all(output)


def test_the_largest_scales_and_coordinates_of_float32_stay_finite_in_rad() -> None:
    splats = random_splats(4)
    splats.scale[0] = np.finfo(np.float32).max
    ranges = rad_options.settled(Scene(splats), WriteOptions()).rad.ranges
    assert ranges is not None
    table = log_scale_table(ranges.ln_scale_min, ranges.ln_scale_max)
    assert np.isfinite(table).all()
    assert table[-1] > 3e38
    eyes = viewpoints(np.array([[-1.5e38, 0, 0], [1.5e38, 0, 0]], np.float32))
    assert all(np.isfinite(eyes[f"origin_{axis}"]).all() for axis in "xyz")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bits", [None, *range(MAX_FRACTIONAL_BITS + 1)])
def test_a_coordinate_is_written_up_to_the_last_but_one_code(bits: int | None, method: str, tmp_path: Path) -> None:
    """The last code is what writers clamp to, which is what a coordinate that has it is taken for."""
    step = 2.0 ** -(bits or 0)
    for code, sign in itertools.product((-1, 0, 1), (1, -1)):
        splats = random_splats(5)
        splats.center[:] = 0
        splats.center[3, 1] = sign * (spz.LAST_CODE + code) * step
        source = file_of(tmp_path, splats)
        how = BakeSettings(method=method, options=WriteOptions(fractional_bits=bits))
        if code < 1:
            assert no_errors(findings_of(source, how))
        else:
            with pytest.raises(SparklodError, match=r"does not fit|SPZ holds at most 8388606: scale the scene"):
                findings_of(source, how)


@given(scenes(), st.sampled_from(METHODS), st.sampled_from(list(ENCODINGS)))
def test_every_layout_and_report_of_an_extreme_scene_is_made_without_a_warning(
    splats: Splats, method: str, layout: str
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        source = file_of(folder, splats)
        with or_refused():  # if no splat can be seen
            sparklod.pack(sparklod.build_lod(sparklod.read(source), method=method), layout)
        report_all(source)


SPECIAL = np.array([0, -0.0, 1, -1, 1e-45, 1e-38, 1e30, -1e30, 65_519, 65_520, 3.4e38, -3.4e38, np.inf, np.nan])


def any_floats(rng: np.random.Generator, count: int, width: int) -> np.ndarray:
    """(count, width) float32 as damaged files have them: ordinary ones, special ones, and any bits at all."""
    kinds = rng.choice(3, (count, width), p=[0.9, 0.06, 0.04])
    bits = rng.integers(0, 2**32, (count, width), np.uint32).view(np.float32)
    ordinary = rng.normal(size=(count, width)) * 0.1
    return np.choose(kinds, [ordinary, rng.choice(SPECIAL, (count, width)), bits.astype(np.float64)])


def raw_file(rng: np.random.Generator, kind: str) -> bytes:
    """A file of 40 splats of any numbers."""
    columns = splat_columns(40, sh_degree=1)
    if kind == ".ply":
        for name in columns:
            columns[name] = any_floats(rng, 40, 1)[:, 0].astype(np.float32)
        return by_hand.ply(columns)
    splats = random_splats(40)
    plain = {"center": splats.center, "scale": any_floats(rng, 40, 3), "quat_wxyz": splats.quat_xyzw}
    plain |= {"opacity": splats.opacity, "rgb": splats.rgb, "sh": any_floats(rng, 40, 24).reshape(40, 8, 3)}
    if kind == ".splat":
        return by_hand_splat.splat(**plain | {"center": any_floats(rng, 40, 3)})
    return by_hand_ksplat.ksplat(**plain | {"center": any_floats(rng, 40, 3)}, level=0)


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([".ply", ".splat", ".ksplat"]),
    st.sampled_from(METHODS),
    st.sampled_from([None, ".npz", *WRITABLE]),
    st.booleans(),
)
@settings(max_examples=60)
def test_any_numbers_are_baked_refused_and_reported_without_a_warning(
    seed: int, kind: str, method: str, ending: str | None, drop: bool
) -> None:
    with np.errstate(all="ignore"):
        data = raw_file(np.random.default_rng(seed), kind)
    with tempfile.TemporaryDirectory() as folder:
        source, output = Path(folder, f"scene{kind}"), Path(folder, "out.spz")
        source.write_bytes(data)
        how = BakeSettings(method=method, suffix=ending or ".spz", selection=Selection(drop_invalid=drop))
        with or_refused():
            if ending is None:
                bake(source, output, how)
                assert no_errors(findings_in(output, source))
            else:
                convert_file(source, Path(folder, f"out{ending}"), how, layout="ext" if ending == ".npz" else None)
        report_all(source)


#: Findings in bakes of scenes that SPZ does not hold, or hardly.
ODD = {"huge.ply": {"values.center-far", "values.scale-clamped"}}
SCENES = ("sh0.ply", "sh3.ply", "flat.ply", "needle.ply", "coincident.ply", "one.ply", "demo.ply", *ODD)
REAL = ("biker.ply", "biker.spz", "playbot-125k.ply", "meadow.sog")


def check_for_ci(source: Path, method: str) -> None:
    """The law of docs/ci.md: `--check --fail-on warning`."""
    findings = findings_of(source, BakeSettings(method=method))
    assert {each.code for each in findings if each.severity != NOTE} == ODD.get(source.name, set()), findings


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", [*SCENES, *REAL])
def test_bakes_of_files_pass_the_check_for_ci(name: str, method: str) -> None:
    check_for_ci(real_scene(name) if name in REAL else FIXTURES / name, method)


def town() -> Splats:
    scene = read_scene(FIXTURES / "traverse" / "town.spz")
    assert scene.tree is not None
    return scene.splats.take(scene.tree.is_leaf)


def without_width() -> Splats:
    """Splats to which SPZ gives a width, after the tree is built."""
    splats = random_splats(3)
    splats.scale[:] = [[8e-5, 1e-5, 1e-6], [3e-7, 7e-4, 1e-13], [1e-24, 1e-19, 11]]
    splats.center[:] = 0
    return splats


def far_apart() -> Splats:
    """Small splats whose merged splat is larger than SPZ holds, and clamped."""
    splats = random_splats(4)
    splats.scale[:] = 0.02
    splats.center[:] = [[2047.9999, 0, 0], [-2047.9999, 2048, 5], [0, 0, 0], [1, 1, 1]]
    return splats


def faint_and_large(seed: int) -> Splats:
    """Small opaque splats, and among them needles and balls that are a hundred times as large and hardly seen."""
    splats = random_splats(400, seed=seed)
    few = np.arange(400) % 10 == 0
    splats.scale[few] *= np.float32(100)
    splats.scale[few[::2].nonzero()[0] * 2, 1:] = 1e-3
    splats.opacity[few] = 0.004
    splats.opacity[~few] = 1
    return splats


HARD: dict[str, Callable[[], Splats]] = {
    "town": town,
    "without width": without_width,
    "far apart": far_apart,
    **{f"faint and large {seed}": functools.partial(faint_and_large, seed) for seed in range(10)},
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", HARD)
def test_bakes_of_hard_scenes_pass_the_check_for_ci(name: str, method: str, tmp_path: Path) -> None:
    check_for_ci(file_of(tmp_path, HARD[name]()), method)


@given(st.integers(2, 300), st.integers(0, 2**32 - 1), st.sampled_from([0.01, 1.0, 30.0]), st.sampled_from(METHODS))
def test_bakes_of_random_scenes_pass_the_check_for_ci(count: int, seed: int, extent: float, method: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        check_for_ci(file_of(folder, random_splats(count, seed=seed, extent=extent)), method)


CODES = WriteOptions(rad=RadOptions(sh_codes=64), sog=SogOptions(64))
OUTPUTS: dict[str, dict[str, Any]] = {
    "a.spz": {},
    "b.rad": {"suffix": ".rad"},
    "c.rad": {"suffix": ".rad", "method": "quality", "options": CODES},
    "d.spz": {"method": "quality", "refine": FitSettings(steps=2)},
    "e.sog": {"suffix": ".sog", "method": "quality", "simplify": SimplifyGoal(parse_budget("50%")), "options": CODES},
    "f/lod-meta.json": {"method": "quality", "detail": DetailSettings()},
    "g/tileset.json": {"method": "quality", "tiles": TileSettings()},
}


@pytest.mark.parametrize("out_of_core", [False, True], ids=["in memory", "out of core"])
@pytest.mark.parametrize("output", OUTPUTS)
def test_progress_names_the_stages_in_the_order_of_their_shares(output: str, out_of_core: bool, tmp_path: Path) -> None:
    how = BakeSettings(**OUTPUTS[output])
    stages: dict[str, None] = {}
    bake(
        FIXTURES / "sh1.ply",
        tmp_path / output,
        how,
        resources=Resources(block_splats=1 << 16 if out_of_core else None),
        progress=lambda stage, done, total, unit: stages.setdefault(stage),
    )
    assert [stage for stage in stage_shares(how) if stage in stages] == list(stages)
    assert stages
