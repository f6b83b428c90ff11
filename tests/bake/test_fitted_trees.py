"""`--refine`: the values of a tree that change, what stays bit for bit, and the laws of trees, in every format."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import Baked, BakeSettings, Resources
from sparklod_cli.bake.skipping import SUFFIX, bake_unless_there
from sparklod_cli.codecs.formats import WRITABLE, RadOptions, WriteOptions
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.fitting import fit, pictures
from sparklod_cli.fitting.fit_settings import SHARES, FitSettings
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import same_rows
from sparklod_cli.system.errors import CameraPathError, FormatError, InvalidSplatsError, OutOfMemoryError, OutputError
from sparklod_cli.system.output import write_file
from tests.conftest import FIXTURES
from tests.fittings import StandIn
from tests.fittings import stand_in as stand_in
from tests.lod.trees import check_tree, sorted_rows

SOURCE = FIXTURES / "sh2.ply"
PLAIN = BakeSettings(method="quality", converts=True)
REFINE = dataclasses.replace(PLAIN, refine=FitSettings())

#: Options under which values are written exactly, or nearly.
FLOATS = WriteOptions(rad=RadOptions("f32", "f32", "f32", "f32", "f32", "f32"))

#: Format and options of a tree that is read and written.
FORMATS = {
    "spz": (".spz", WriteOptions()),
    "spz 2": (".spz", WriteOptions(spz_version=2)),
    "spz of few bits": (".spz", WriteOptions(fractional_bits=6)),
    "rad": (".rad", WriteOptions()),
    "rad of floats": (".rad", FLOATS),
    "rad of halves": (".rad", WriteOptions(rad=RadOptions("f16", "f16", "f16", "ln_f16", "f16", "f16"))),
    "rad with a palette": (".rad", WriteOptions(rad=RadOptions(sh_codes=64))),
    "rad in chunks": (".rad", WriteOptions(rad=RadOptions(chunked=True))),
}


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """A tree that is not fitted."""
    path = tmp_path / "tree.spz"
    bake(SOURCE, path, PLAIN)
    return path


def check_fitted(before: Scene, after: Scene) -> None:
    """The tree and its leaves are the same, bit for bit; most merged splats are not."""
    assert before.tree is not None
    assert after.tree is not None
    for name in ("child_count", "child_start"):
        assert np.array_equal(getattr(after.tree, name), getattr(before.tree, name))
    same = same_rows(after.splats, before.splats)
    assert same[before.tree.is_leaf].all()
    assert 0.1 < same[~before.tree.is_leaf].mean() < 0.4
    assert not after.splats.invalid()
    assert after.antialiased == before.antialiased


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_keeps_its_tree_and_leaves(name: str, tmp_path: Path, stand_in: StandIn) -> None:
    suffix, options = FORMATS[name]
    plain, target = tmp_path / f"tree{suffix}", tmp_path / f"fitted{suffix}"
    bake(SOURCE, plain, dataclasses.replace(PLAIN, suffix=suffix, options=options))
    refine = dataclasses.replace(REFINE, suffix=suffix)
    baked = bake(plain, target, refine)
    before, after = read_scene(plain), read_scene(target)
    check_fitted(before, after)
    assert baked.method is None
    assert baked.refine is not None
    for key in {"version", "fractional_bits"} & {*before.header}:
        assert after.header[key] == before.header[key]
    if options == WriteOptions():  # without a gain, the output is the input, byte by byte
        stand_in.kept = 0
        bake(plain, target, refine, overwrite=True)
        assert target.read_bytes() == plain.read_bytes()


def test_a_file_may_be_its_own_output(plain: Path, stand_in: StandIn) -> None:
    before = read_scene(plain)
    with pytest.raises(OutputError, match="exists"):
        bake(plain, plain, REFINE)
    bake(plain, plain, REFINE, overwrite=True)
    check_fitted(before, read_scene(plain))


@pytest.mark.parametrize("method", ["quick", "quality"])
def test_a_scene_gets_the_tree_of_a_bake_without_fitting(method: str, tmp_path: Path, stand_in: StandIn) -> None:
    trees = []
    for name, settings in (("plain", PLAIN), ("fitted", REFINE)):
        bake(SOURCE, tmp_path / f"{name}.spz", dataclasses.replace(settings, method=method))
        trees.append(read_scene(tmp_path / f"{name}.spz"))
    check_fitted(*trees)


def test_another_version_and_format_can_be_chosen(plain: Path, tmp_path: Path, stand_in: StandIn) -> None:
    target = tmp_path / "fitted.spz"
    bake(plain, target, dataclasses.replace(REFINE, options=WriteOptions(spz_version=2)))
    assert read_scene(target).header["version"] == 2
    bake(plain, tmp_path / "fitted.rad", dataclasses.replace(REFINE, suffix=".rad"))
    assert read_scene(tmp_path / "fitted.rad").format == "RAD LoD"


def test_a_tree_is_refused_without_refining_or_with_options_that_have_no_effect(
    plain: Path, tmp_path: Path, stand_in: StandIn
) -> None:
    with pytest.raises(FormatError, match=r"Level-of-Detail file already.* --refine fits"):
        bake(plain, tmp_path / "out.spz", PLAIN)
    with pytest.raises(FormatError, match="--refine keeps; leave out --base, --up"):
        bake(plain, tmp_path / "out.spz", dataclasses.replace(REFINE, unused=("--base", "--up")))
    assert not stand_in.calls


def test_settings_and_cameras_reach_the_fitting(tmp_path: Path, stand_in: StandIn) -> None:
    cameras = tmp_path / "cameras.csv"
    cameras.write_text("x,y,z,target_x,target_y,target_z\n0,0,-3,0,0,0\n0,1,-3,0,0,0\n")
    given = dataclasses.replace(REFINE, refine=FitSettings(steps=7, seed=3), camera_path=cameras)
    baked = bake(SOURCE, tmp_path / "out.spz", given, threads=2)
    ((settings, how),) = stand_in.calls
    assert (settings.steps, settings.seed, how["threads"]) == (7, 3, 2)
    assert settings.path is not None
    assert len(settings.path) == 2
    assert baked.refine is not None
    assert (baked.refine.steps, baked.refine.seed) == (7, 3)
    assert baked.seconds["refine"] > 0
    assert [*baked.seconds] == ["read", "build", "refine", "write"]
    none = dataclasses.replace(REFINE, camera_path=tmp_path / "none.json")
    with pytest.raises(CameraPathError, match=r"none\.json"):  # before any work
        bake(tmp_path / "missing.ply", tmp_path / "other.spz", none)


def test_a_whole_tree_is_fitted_in_memory_or_not_at_all(tmp_path: Path, stand_in: StandIn) -> None:
    target = tmp_path / "out.spz"
    with pytest.raises(OutOfMemoryError, match="--refine fits a whole tree, not in blocks"):
        bake(SOURCE, target, REFINE, resources=Resources(memory=1))
    assert not list(tmp_path.iterdir())
    said: list[str] = []
    bake(SOURCE, target, REFINE, resources=Resources(block_splats=1 << 16), say=said.append)
    assert said[0].endswith("goes on in memory, although blocks were requested: --refine fits a whole tree")
    assert said[1] == "fit 1 of 1: 2 % 30.0 -> 32.5 dB"


def test_a_fitted_output_is_skipped_only_for_the_same_settings_and_cameras(tmp_path: Path, stand_in: StandIn) -> None:
    cameras, target = tmp_path / "cameras.csv", tmp_path / "out.spz"
    cameras.write_text("x,y,z,target_x,target_y,target_z\n0,0,-3,0,0,0\n")
    given = dataclasses.replace(REFINE, camera_path=cameras)
    assert bake_unless_there(SOURCE, target, given) is not None
    assert bake_unless_there(SOURCE, target, given) is None
    for refine, difference in (
        (FitSettings(steps=9), "refine.steps was None and is 9"),
        (FitSettings(seed=1), "refine.seed was 0 and is 1"),
        (None, "refine.seed was 0 and is None"),
    ):
        with pytest.raises(OutputError, match=difference):
            bake_unless_there(SOURCE, target, dataclasses.replace(given, refine=refine))
    cameras.write_text("x,y,z,target_x,target_y,target_z\n0,0,-4,0,0,0\n")
    with pytest.raises(OutputError, match=r"cameras\.csv changed since"):
        bake_unless_there(SOURCE, target, given)


def test_an_interrupted_fitting_is_written_if_it_gained_and_is_not_skipped(tmp_path: Path, stand_in: StandIn) -> None:
    target, said = tmp_path / "out.spz", []
    stand_in.is_complete, stand_in.kept = False, 0
    with pytest.raises(KeyboardInterrupt):
        bake(SOURCE, target, REFINE)
    assert not list(tmp_path.iterdir())
    stand_in.kept = 0.8
    baked = bake_unless_there(SOURCE, target, REFINE, say=said.append)
    assert baked is not None
    assert baked.refine is not None
    assert not baked.refine.is_complete
    assert target.exists()
    assert not target.with_name(f"{target.name}{SUFFIX}").exists()
    assert "writing the improvements of the finished stages" in said[-1]


def test_merged_splats_stay_within_the_range_of_the_coordinates(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stand_in: StandIn
) -> None:
    def far(nodes: Any, tree: Any, settings: Any, **how: Any) -> Any:
        nodes, report = stand_in(nodes, tree, settings, **how)
        nodes.center[~tree.is_leaf] *= 1e6
        return nodes, report

    monkeypatch.setattr("sparklod_cli.fitting.fit.fit", far)
    bake(plain, tmp_path / "fitted.spz", REFINE)
    before, after = read_scene(plain), read_scene(tmp_path / "fitted.spz")
    assert before.tree is not None
    assert same_rows(after.splats, before.splats)[before.tree.is_leaf].all()
    assert np.abs(after.splats.center).max() <= np.abs(before.splats.center).max()


def test_a_tree_with_numbers_that_are_not_finite_is_refused(tmp_path: Path, stand_in: StandIn) -> None:
    plain = tmp_path / "tree.rad"
    floats = WriteOptions(rad=RadOptions(rgb="f32", ranges=SplatEncoding(lod_opacity=True)))
    bake(SOURCE, plain, dataclasses.replace(PLAIN, suffix=".rad", options=floats))
    scene = read_scene(plain)
    rgb = scene.splats.rgb.copy()
    rgb[5] = np.nan
    spoiled = dataclasses.replace(scene, splats=dataclasses.replace(scene.splats, rgb=rgb))
    write_file(plain, WRITABLE[".rad"].codec().encode(spoiled, floats), overwrite=True)
    with pytest.raises(InvalidSplatsError, match="splats is not finite"):
        bake(plain, tmp_path / "out.rad", dataclasses.replace(REFINE, suffix=".rad"))
    assert not stand_in.calls


#: Settings, and the splats of a scene, of trees that are really fitted.
SETTINGS, COUNT = dataclasses.replace(PLAIN, suffix=".rad", options=FLOATS, converts=False), 2_000
FITTED = dataclasses.replace(SETTINGS, refine=FitSettings(steps=100, seed=1))


@pytest.fixture(scope="module")
def small_pictures() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "SIZE", (160, 90))
        patch.setattr(fit, "HELD_OUT", 4)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, small_pictures: None) -> Path:
    """A part of the demo scene, and its tree, in floats."""
    folder = tmp_path_factory.mktemp("refined")
    splats = read_scene(FIXTURES / "demo.ply").splats
    near = np.argsort(np.linalg.norm(splats.center - np.median(splats.center, axis=0), axis=1), kind="stable")
    scene = Scene(splats.take(np.sort(near[:COUNT])))
    write_file(folder / "scene.ply", WRITABLE[".ply"].codec().encode(scene), overwrite=False)
    bake(folder / "scene.ply", folder / "tree.rad", SETTINGS)
    return folder


@pytest.fixture(scope="module")
def baked(folder: Path) -> Baked:
    return bake(folder / "tree.rad", folder / "fitted.rad", FITTED)


@pytest.fixture(scope="module")
def fitted(folder: Path, baked: Baked) -> Scene:
    return read_scene(folder / "fitted.rad")


def test_a_fitted_tree_has_the_same_leaves_and_mostly_new_merged_splats(
    folder: Path, baked: Baked, fitted: Scene
) -> None:
    before, plain = read_scene(folder / "tree.rad"), read_scene(folder / "scene.ply").splats
    assert fitted.tree is not None
    assert before.tree is not None
    leaves = fitted.splats.take(fitted.tree.is_leaf)
    check_tree(leaves, fitted.splats, fitted.tree)
    np.testing.assert_allclose(sorted_rows(leaves)[:, :3], sorted_rows(plain)[:, :3], atol=1e-6)
    assert np.array_equal(fitted.tree.child_start, before.tree.child_start)
    same = same_rows(fitted.splats, before.splats)
    assert same[before.tree.is_leaf].all()
    assert same[~before.tree.is_leaf].mean() < 0.5
    report = baked.refine
    assert report is not None
    assert 50 < report.steps <= 100
    assert report.is_complete
    assert [*report.psnr_before] == [*report.psnr_after] == [*SHARES]
    assert all(report.psnr_after[share] >= psnr for share, psnr in report.psnr_before.items())
    assert 0 < report.kept <= 1
    bake(folder / "tree.rad", folder / "again.rad", FITTED, threads=2)
    assert (folder / "again.rad").read_bytes() == (folder / "fitted.rad").read_bytes()
