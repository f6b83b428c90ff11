"""`--refine`: which values of a tree change, and what stays bit for bit, whatever is read and written."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import BakeSettings, Resources
from sparklod_cli.bake.skipping import SUFFIX, bake_unless_there
from sparklod_cli.codecs.formats import WRITABLE
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.fitting.settings import FitSettings
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import same_rows
from sparklod_cli.system.errors import CameraPathError, FormatError, InvalidSplatsError, OutOfMemoryError, OutputError
from sparklod_cli.system.output import write_file
from tests.conftest import FIXTURES
from tests.fittings import StandIn
from tests.fittings import stand_in as stand_in

SOURCE = FIXTURES / "sh2.ply"
PLAIN = BakeSettings(method="quality", converts=True)
REFINE = dataclasses.replace(PLAIN, refine=FitSettings())

#: What is read and written, and how.
WAYS = {
    "spz": (".spz", WriteOptions()),
    "spz 2": (".spz", WriteOptions(spz_version=2)),
    "spz of few bits": (".spz", WriteOptions(fractional_bits=6)),
    "rad": (".rad", WriteOptions()),
    "rad of floats": (".rad", WriteOptions(rad=RadOptions("f32", "f32", "f32", "f32", "f32", "f32"))),
    "rad of halves": (".rad", WriteOptions(rad=RadOptions("f16", "f16", "f16", "ln_f16", "f16", "f16"))),
    "rad with a palette": (".rad", WriteOptions(rad=RadOptions(sh_codes=64))),
    "rad in chunks": (".rad", WriteOptions(rad=RadOptions(chunked=True))),
}


def check(before: Scene, after: Scene) -> None:
    """The tree and its leaves are the same, bit for bit; of the merged splats, most are not."""
    assert before.tree is not None
    assert after.tree is not None
    for name in ("child_count", "child_start"):
        assert np.array_equal(getattr(after.tree, name), getattr(before.tree, name))
    same = same_rows(after.splats, before.splats)
    assert same[before.tree.is_leaf].all()
    assert 0.1 < same[~before.tree.is_leaf].mean() < 0.4
    assert not after.splats.invalid()
    assert after.antialiased == before.antialiased


@pytest.mark.parametrize("name", WAYS)
def test_a_file_keeps_its_tree_and_leaves(name: str, tmp_path: Path, stand_in: StandIn) -> None:
    suffix, options = WAYS[name]
    plain, target = tmp_path / f"tree{suffix}", tmp_path / f"fitted{suffix}"
    bake(SOURCE, plain, dataclasses.replace(PLAIN, suffix=suffix, options=options))
    baked = bake(plain, target, dataclasses.replace(REFINE, suffix=suffix))
    check(read_scene(plain), read_scene(target))
    assert baked.method is None
    assert baked.refine is not None
    before, after = read_scene(plain).header, read_scene(target).header
    for key in {"version", "fractional_bits"} & {*before}:
        assert after[key] == before[key]


def test_nothing_that_is_kept_is_written_otherwise(tmp_path: Path, stand_in: StandIn) -> None:
    """Where no merged splat has gained, the output is the input, byte by byte."""
    stand_in.kept = 0
    for suffix in (".spz", ".rad"):
        plain, target = tmp_path / f"tree{suffix}", tmp_path / f"fitted{suffix}"
        bake(SOURCE, plain, dataclasses.replace(PLAIN, suffix=suffix))
        bake(plain, target, dataclasses.replace(REFINE, suffix=suffix))
        assert target.read_bytes() == plain.read_bytes()


def test_a_file_may_be_its_own_output(tmp_path: Path, stand_in: StandIn) -> None:
    plain = tmp_path / "tree.spz"
    bake(SOURCE, plain, PLAIN)
    before = read_scene(plain)
    with pytest.raises(OutputError, match="exists"):
        bake(plain, plain, REFINE)
    bake(plain, plain, REFINE, overwrite=True)
    check(before, read_scene(plain))


@pytest.mark.parametrize("method", ["quick", "quality"])
def test_a_scene_gets_the_tree_that_it_gets_without(method: str, tmp_path: Path, stand_in: StandIn) -> None:
    made = []
    for name, settings in (("plain", PLAIN), ("fitted", REFINE)):
        bake(SOURCE, tmp_path / f"{name}.spz", dataclasses.replace(settings, method=method))
        made.append(read_scene(tmp_path / f"{name}.spz"))
    check(*made)


def test_a_choice_is_heeded(tmp_path: Path, stand_in: StandIn) -> None:
    plain, target = tmp_path / "tree.spz", tmp_path / "fitted.spz"
    bake(SOURCE, plain, PLAIN)
    bake(plain, target, dataclasses.replace(REFINE, options=WriteOptions(spz_version=2)))
    assert read_scene(target).header["version"] == 2
    bake(plain, tmp_path / "fitted.rad", dataclasses.replace(REFINE, suffix=".rad"))
    assert read_scene(tmp_path / "fitted.rad").format == "RAD LoD"


def test_without_refining_a_tree_is_refused_as_ever(tmp_path: Path, stand_in: StandIn) -> None:
    plain = tmp_path / "tree.spz"
    bake(SOURCE, plain, PLAIN)
    with pytest.raises(FormatError, match=r"Level-of-Detail file already.* --refine fits"):
        bake(plain, tmp_path / "out.spz", PLAIN)
    with pytest.raises(FormatError, match="--refine keeps; leave out --base, --up"):
        bake(plain, tmp_path / "out.spz", dataclasses.replace(REFINE, unused=("--base", "--up")))
    assert not stand_in.calls


def test_the_fitting_knows_what_was_asked_for(tmp_path: Path, stand_in: StandIn) -> None:
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


def test_cameras_that_cannot_be_read_are_told_before_any_work(tmp_path: Path, stand_in: StandIn) -> None:
    with pytest.raises(CameraPathError, match=r"none\.json"):
        bake(
            tmp_path / "missing.ply",
            tmp_path / "out.spz",
            dataclasses.replace(REFINE, camera_path=tmp_path / "none.json"),
        )


def test_too_little_memory_for_a_whole_tree_is_refused(tmp_path: Path, stand_in: StandIn) -> None:
    with pytest.raises(OutOfMemoryError, match="--refine fits a whole tree, not in blocks"):
        bake(SOURCE, tmp_path / "out.spz", REFINE, resources=Resources(memory=1))
    assert not list(tmp_path.iterdir())


def test_blocks_that_were_asked_for_are_not_used(tmp_path: Path, stand_in: StandIn) -> None:
    said: list[str] = []
    bake(SOURCE, tmp_path / "out.spz", REFINE, resources=Resources(block_splats=1 << 16), say=said.append)
    assert said[0].endswith("goes on in memory, although blocks were requested: --refine fits a whole tree")
    assert said[1] == "fit 1 of 1: 2 % 30.0 -> 32.5 dB"


def test_an_output_is_there_already_only_of_the_same_fitting(tmp_path: Path, stand_in: StandIn) -> None:
    cameras, target = tmp_path / "cameras.csv", tmp_path / "out.spz"
    cameras.write_text("x,y,z,target_x,target_y,target_z\n0,0,-3,0,0,0\n")
    given = dataclasses.replace(REFINE, camera_path=cameras)
    assert bake_unless_there(SOURCE, target, given) is not None
    assert bake_unless_there(SOURCE, target, given) is None
    for other, said in (
        (dataclasses.replace(given, refine=FitSettings(steps=9)), "refine.steps was None and is 9"),
        (dataclasses.replace(given, refine=FitSettings(seed=1)), "refine.seed was 0 and is 1"),
        (dataclasses.replace(given, refine=None), "refine.seed was 0 and is None"),
    ):
        with pytest.raises(OutputError, match=said):
            bake_unless_there(SOURCE, target, other)
    cameras.write_text("x,y,z,target_x,target_y,target_z\n0,0,-4,0,0,0\n")
    with pytest.raises(OutputError, match=r"cameras\.csv changed since"):
        bake_unless_there(SOURCE, target, given)


def test_what_was_interrupted_is_written_and_is_not_there_already(tmp_path: Path, stand_in: StandIn) -> None:
    target, said = tmp_path / "out.spz", []
    stand_in.is_complete = False
    baked = bake_unless_there(SOURCE, target, REFINE, say=said.append)
    assert baked is not None
    assert baked.refine is not None
    assert not baked.refine.is_complete
    assert target.exists()
    assert not target.with_name(f"{target.name}{SUFFIX}").exists()
    assert "writing the improvements of the finished stages" in said[-1]


def test_what_gained_nothing_before_it_was_interrupted_is_not_written(tmp_path: Path, stand_in: StandIn) -> None:
    stand_in.is_complete, stand_in.kept = False, 0
    with pytest.raises(KeyboardInterrupt):
        bake(SOURCE, tmp_path / "out.spz", REFINE)
    assert not list(tmp_path.iterdir())


def test_merged_splats_stay_where_the_number_of_bits_still_holds_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stand_in: StandIn
) -> None:
    plain, target = tmp_path / "tree.spz", tmp_path / "fitted.spz"
    bake(SOURCE, plain, PLAIN)

    def far(nodes, tree, settings, **how):  # type: ignore[no-untyped-def]
        nodes, report = stand_in(nodes, tree, settings, **how)
        nodes.center[~tree.is_leaf] *= 1e6
        return nodes, report

    monkeypatch.setattr("sparklod_cli.fitting.fit.fit", far)
    bake(plain, target, REFINE)
    before, after = read_scene(plain), read_scene(target)
    assert before.tree is not None
    assert same_rows(after.splats, before.splats)[before.tree.is_leaf].all()
    assert np.abs(after.splats.center).max() <= np.abs(before.splats.center).max()


def test_a_tree_with_numbers_that_are_none_is_refused(tmp_path: Path, stand_in: StandIn) -> None:
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
