"""Scenes and trees of the API, read and written: the bytes of the commands, options of formats, chunks of RAD."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import sparklod_cli as sparklod
from fuzz.laws import check_passes
from sparklod_cli.codecs.formats import MANIFEST, RAD_ENCODINGS, RadOptions, SogOptions
from sparklod_cli.lod import quick
from sparklod_cli.lod.tree_settings import METHODS, DetailSettings
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.system.errors import SparklodError
from tests.commands.cli import NAMED, Cli
from tests.scenes import random_splats

DEMO = "demo.ply"

# --- Scenes and trees -------------------------------------------------------------------------------------------------


def test_a_tree_is_read_as_one_and_its_leaves_are_the_scene(
    scene: Scene, tree: sparklod.Tree, held: sparklod.Tree
) -> None:
    assert isinstance(held, sparklod.Tree)
    assert np.array_equal(held.tree.child_start, tree.tree.child_start)
    assert np.array_equal(held.tree.child_count, tree.tree.child_count)
    assert all(word in repr(held) for word in ("nodes", "leaves", "depth"))
    leaves = sparklod.extract_leaves(tree)
    order, original = (np.lexsort(each.splats.center.T) for each in (leaves, scene))
    assert leaves.tree is None and np.array_equal(leaves.splats.center[order], scene.splats.center[original])


@pytest.mark.parametrize(
    ("options", "ours"),
    [
        ("-o a.spz --method quick", lambda scene: sparklod.write("b.spz", sparklod.build_lod(scene))),
        (
            "-o a.spz --method quality",
            lambda scene: sparklod.write("b.spz", sparklod.build_lod(scene, method="quality")),
        ),
        ("-o a.rad", lambda scene: sparklod.write("b.rad", sparklod.arrange_chunks(sparklod.build_lod(scene)))),
        (
            "-o a/lod-meta.json --max-sh 0 --levels 20%",
            lambda scene: sparklod.write(
                "b/lod-meta.json",
                sparklod.build_lod(scene, method="quality", growth=2, max_sh=0),
                detail=sparklod.DetailSettings(levels=(0.2,)),
            ),
        ),
    ],
)
def test_the_bytes_are_those_of_the_command(options: str, ours: Any, scene: Scene, cli: Cli) -> None:
    cli(f"build-lod {DEMO} {options} -q")
    ours(scene)
    names = cli.made()
    theirs = [name for name in names if name.startswith("a")]
    assert [name for name in names if name not in theirs] == [f"b{name[1:]}" for name in theirs]
    assert all(Path(name).read_bytes() == Path(f"b{name[1:]}").read_bytes() for name in theirs)


@pytest.mark.parametrize("encoding", ["packed", "ext", "lodtree", "texture"])
def test_arrays_are_those_of_the_command(encoding: str, held: sparklod.Tree, file: Path, cli: Cli) -> None:
    cli(f"convert {file} theirs.npz --layout {encoding} -q")
    sparklod.write("ours.npz", held, encoding=encoding)
    assert Path("ours.npz").read_bytes() == Path("theirs.npz").read_bytes()


def test_a_report_is_that_of_inspect(file: Path, cli: Cli) -> None:
    theirs = cli(f"inspect {file} --json --check --stats").json
    ours = sparklod.inspect(file, all_quantities=True, check=True).as_dict()
    assert json.loads(json.dumps(ours)) == theirs


@pytest.mark.parametrize(("encoding", "near", "coarse"), [("packed", 2**-11, 0.045), ("ext", 0.0, 0.006)])
def test_viewer_arrays_are_unpacked(
    encoding: str, near: float, coarse: float, scene: Scene, tree: sparklod.Tree
) -> None:
    again = sparklod.unpack(sparklod.pack(tree, encoding) | sparklod.pack(tree, "lodtree"))
    assert isinstance(again, sparklod.Tree) and again.splats.opacity.max() > 1
    assert np.array_equal(again.tree.child_start, tree.tree.child_start)
    np.testing.assert_allclose(again.splats.center, tree.splats.center, rtol=near, atol=near and 2**-25)
    np.testing.assert_allclose(np.log(again.splats.scale), np.log(tree.splats.scale), atol=coarse)
    assert sparklod.unpack(sparklod.pack(scene, encoding)).tree is None
    with pytest.raises(sparklod.FormatError, match="nodes but"):
        sparklod.unpack(sparklod.pack(scene, encoding) | sparklod.pack(tree, "lodtree"))


@pytest.mark.parametrize("name", ["scene.sog", "web/meta.json"])
def test_sog_is_a_file_or_a_folder(name: str, tmp_path: Path) -> None:
    scene = Scene(random_splats(300, sh_degree=1))
    written = sparklod.write(tmp_path / name, scene)
    again = sparklod.read(written.path)
    assert (written.format, len(again)) == ("SOG", 300)
    assert written.bytes == sum(each.stat().st_size for each in written.path.parent.iterdir())
    np.testing.assert_allclose(np.sort(again.splats.rgb, axis=0), np.sort(scene.splats.rgb, axis=0), atol=0.01)
    with pytest.raises(sparklod.OutputError, match="exists, add --overwrite"):
        sparklod.write(tmp_path / name, scene)
    smaller = sparklod.write(tmp_path / name, scene, sog=SogOptions(sh_codes=2), overwrite=True)
    assert smaller.bytes < written.bytes
    assert len(np.unique(sparklod.read(smaller.path).splats.sh, axis=0)) == 2


def test_streamed_sog_has_its_levels_and_environment(tmp_path: Path) -> None:
    tree = sparklod.build_lod(Scene(random_splats(400, extent=9)), method="quality", growth=2)
    sky, path, stages = Scene(random_splats(30, extent=99)), tmp_path / "web" / MANIFEST, set[str]()
    how: dict[str, Any] = {"detail": DetailSettings(levels=(0.5, 0.1)), "environment": sky}
    made = sparklod.write(path, tree, **how, progress=lambda stage, *_: stages.add(stage))
    assert (made.path, made.format, bool(stages)) == (path, "Streamed SOG", True)
    assert made.bytes == sum(each.stat().st_size for each in path.parent.rglob("*") if each.is_file())
    counts = json.loads(path.read_text())["counts"]
    assert counts[0] == 400 and counts[1:] == pytest.approx([200, 40], abs=2)
    scene = sparklod.read(path.parent)
    assert type(scene) is Scene and len(scene) == 430
    sparklod.write(path, tree, overwrite=True)
    assert len(sparklod.read(path)) == 400
    for wrong, message in (
        (tree, "the environment has a tree; extract_leaves gives its splats"),
        (Scene(sky.splats.take(slice(0, 0))), "the environment has no splats to write"),
    ):
        with pytest.raises(SparklodError, match=message):
            sparklod.write(tmp_path / "other" / MANIFEST, tree, environment=wrong)


# --- Options and suffixes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "is_tree", "options", "error", "message"),
    [
        ("x.sog", False, {"sog": {"sh_codes": 9}}, TypeError, "sog is {'sh_codes': 9}; give SogOptions"),
        ("x.spz", False, {"sog": SogOptions()}, ValueError, "sog is of SOG; leave it out, or write a .sog"),
        ("x.sog", False, {"rad": RadOptions()}, ValueError, "chunked and rad are of RAD"),
        ("x.spz", True, {"chunked": True}, ValueError, "chunked and rad are of RAD; leave them out"),
        ("x.rad", True, {"encoding": "ext", "chunked": True}, ValueError, "chunked and rad are of RAD; leave them out"),
        ("x.rad", True, {"spz_version": 2}, ValueError, "spz_version and fractional_bits are of SPZ"),
        ("x.rad", False, {"rad": {"center": "f32"}}, TypeError, "rad is {'center': 'f32'}; give RadOptions"),
        ("x.rad", False, {"rad": RadOptions(ranges=3)}, TypeError, "ranges is 3; give a SplatEncoding"),  # type: ignore[arg-type]
        ("x.spz", False, {"compression_level": 99}, ValueError, "compression_level"),
        ("x.spz", False, {"fractional_bits": 99}, ValueError, "fractional_bits"),
        ("x.ply", False, {"spz_version": 2}, ValueError, "spz_version"),
        ("x.npz", False, {"fractional_bits": 9, "encoding": "packed"}, ValueError, "fractional_bits"),
        ("a.spz", True, {"detail": DetailSettings()}, ValueError, "leave them out, or write a lod-meta.json"),
        ("a.rad", True, {"environment": "sky"}, ValueError, "detail and environment are of Streamed SOG"),
        (MANIFEST, True, {"detail": (0.5,)}, TypeError, "detail is (0.5,); give DetailSettings"),
        (MANIFEST, True, {"environment": "sky.ply"}, TypeError, "'sky.ply'; read reads a file"),
        (MANIFEST, True, {"rad": RadOptions()}, ValueError, "chunked and rad are of RAD"),
        (MANIFEST, True, {"spz_version": 2}, ValueError, "are of SPZ"),
        (
            MANIFEST,
            False,
            {},
            sparklod.FormatError,
            "are cuts of a tree; build_lod makes one, best by method",
        ),
        ("x.sog", True, {}, sparklod.FormatError, "a tree is written as .spz, .rad, which"),
        ("x.ply", True, {}, sparklod.FormatError, "a tree is written as .spz, .rad, which"),
        ("x.json", False, {}, sparklod.FormatError, "a scene is written as .ply, .spz, .rad, .sog, meta.json, .glb"),
        ("x", False, {}, sparklod.FormatError, "which the name does not end in"),
        ("x", False, {"encoding": "ext"}, sparklod.FormatError, "which the name does not end in"),
        ("", False, {}, sparklod.OutputError, "is a folder; name a file in it"),
        ("new.spz/", False, {}, sparklod.OutputError, "is a folder; name a file in it"),
    ],
)
def test_wrong_options_and_names_are_refused_before_anything_is_written(
    name: str, is_tree: bool, options: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    scene = Scene(random_splats(40, sh_degree=1))
    with pytest.raises(error, match=re.escape(message)):
        sparklod.write(f"{tmp_path}/{name}", sparklod.build_lod(scene) if is_tree else scene, **options)
    assert not list(tmp_path.iterdir())


def test_merged_splats_do_not_fit_into_sog(tree: sparklod.Tree, tmp_path: Path) -> None:
    merged = Scene(dataclasses.replace(tree.splats, opacity=tree.splats.opacity * np.float32(2)))
    with pytest.raises(sparklod.FormatError, match=r"opacities reach [0-9.]+, and SOG holds 0 to 1"):
        sparklod.write(tmp_path / "x.sog", merged)
    assert not list(tmp_path.iterdir())


# --- RAD --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def large() -> sparklod.Tree:
    """A tree of more nodes than a chunk has."""
    return sparklod.Tree(*quick.build(random_splats(60_000, sh_degree=1, extent=50)))


@pytest.fixture(scope="module", params=[False, True], ids=["whole", "chunked"])
def rad(request: pytest.FixtureRequest, large: sparklod.Tree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rad") / "large.rad"
    sparklod.write(path, large, chunked=request.param, compression_level=1)
    return path


def test_a_header_is_read_without_its_chunks(rad: Path, large: sparklod.Tree, tmp_path: Path) -> None:
    again = sparklod.read(rad)
    assert isinstance(again, sparklod.Tree)
    np.testing.assert_array_equal(again.tree.child_start, large.tree.child_start)
    # Rounded to a 16th of small splats, which are 0.2 here.
    np.testing.assert_allclose(again.splats.center, large.splats.center, atol=0.01)
    np.testing.assert_allclose(again.splats.rgb, large.splats.rgb, atol=0.01)
    header = sparklod.read_rad_header(rad)
    assert (header.count, header.max_sh, header.lod_tree, header.chunk_size) == (len(large), 1, True, CHUNK_NODES)
    assert [entry.bytes for entry in header.chunks] == list(again.chunk_bytes or ())
    alone = tmp_path / "alone.rad"
    alone.write_bytes(rad.read_bytes()[: header.bytes])
    assert sparklod.read_rad_header(alone) == header
    chunk = sparklod.read_rad_chunk(rad, np.int64(1))  # type: ignore[arg-type]
    assert chunk.tree is not None and chunk.header.base == CHUNK_NODES
    np.testing.assert_array_equal(chunk.splats.center, again.splats.center[CHUNK_NODES:])
    with pytest.raises(ValueError, match=r"shape \(7, 8, 3\); that of this file has \(codes, 3, 3\)$"):
        sparklod.read_rad_chunk(rad, 1, palette=np.zeros((7, 8, 3), np.float32))
    if header.chunks[0].filename is not None:
        with pytest.raises(sparklod.FormatError, match=r"it is one chunk of a RAD file; give the \.rad file"):
            sparklod.read_rad_header(rad.with_name(header.chunks[0].filename))


def test_options_of_rad_reach_the_file(large: sparklod.Tree, scene: Scene, tmp_path: Path) -> None:
    options = RadOptions(center="f32", rgb="f32", ranges=sparklod.SplatEncoding(lod_opacity=True))
    sparklod.write(tmp_path / "x.rad", large, rad=options)
    again = sparklod.read(tmp_path / "x.rad")
    for name in ("center", "rgb"):
        np.testing.assert_array_equal(getattr(again.splats, name), getattr(large.splats, name))
    assert sparklod.read_rad_header(tmp_path / "x.rad").encoding == options.ranges
    written = sparklod.write(tmp_path / "y" / "y.rad", large, rad=RadOptions(chunked=True))
    assert sparklod.read_rad_header(tmp_path / "y" / "y.rad").chunked
    assert written.bytes == sum(path.stat().st_size for path in (tmp_path / "y").iterdir())
    assert sorted(path.name for path in (tmp_path / "y").iterdir()) == ["y-0.radc", "y-1.radc", "y.rad"]
    sparklod.write(tmp_path / "plain.rad", scene)
    assert sparklod.read(tmp_path / "plain.rad").tree is None


@pytest.mark.parametrize(
    ("ranges", "error", "message"),
    [
        ({"ln_scale_min": 9}, ValueError, "ln_scale_min is 9, which is not below ln_scale_max, 9"),
        ({"rgb_max": float("nan")}, ValueError, "rgb_max is nan; give a number"),
        ({"ln_scale_max": 1e39}, ValueError, "ln_scale_max is 1e+39; give a number"),
        ({"rgb_min": "a"}, TypeError, "rgb_min is 'a'; give a number"),
    ],
)
def test_impossible_ranges_are_refused(ranges: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"^{re.escape(message)}"):
        sparklod.SplatEncoding(**ranges)


def test_other_files_and_numbers_of_chunks_are_refused(rad: Path, tmp_path: Path) -> None:
    with pytest.raises(sparklod.FormatError, match=r"demo\.ply: no RAD header"):
        sparklod.read_rad_header(NAMED[DEMO])
    for missing in (tmp_path / "missing.rad", tmp_path):
        with pytest.raises(sparklod.FormatError, match="cannot be read"):
            sparklod.read_rad_header(missing)
    for number in (-1, 2):
        with pytest.raises(ValueError, match=f"number is {number}; its chunks are 0 to 1"):
            sparklod.read_rad_chunk(rad, number)
    wrong: Any
    for wrong in (1.0, "1", None, True):
        with pytest.raises(TypeError, match="give a whole number, which counts chunks from 0"):
            sparklod.read_rad_chunk(rad, wrong)
    with pytest.raises(ValueError, match="no rad center 'r8'; give one of auto, f32"):
        RadOptions(center="r8")


# --- Extreme scenes: every written file passes our own check, or the scene is refused ---------------------------------

LARGEST = float(np.finfo(np.float32).max)
TINIEST = float(np.finfo(np.float32).smallest_subnormal)

#: Magnitudes of coordinates, scales, colours and SH.
SIZES = st.sampled_from([0.0, TINIEST, 1e-30, 1e-6, 1e-3, 1.0, 1.0, 100.0, 70_000.0, 1e9, 1e20, 1e30, 1e38, LARGEST])


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Splats of a few magnitudes, some of them alike."""
    count, rng = draw(st.sampled_from([1, 2, 3, 17, 150, 300])), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    degree, different = draw(st.integers(0, 3)), draw(st.sampled_from([1, 2, count]))

    def spread(*shape: int) -> np.ndarray:
        """Values up to a magnitude, or up to two of them."""
        sizes = np.array([draw(SIZES), draw(SIZES)])[rng.integers(0, 1 + draw(st.booleans()), (count, *shape[1:]))]
        return np.clip(sizes * rng.uniform(-1, 1, shape), -LARGEST, LARGEST)

    opacity = rng.normal(draw(st.sampled_from([0.0, 0.5, 1.0])), draw(st.sampled_from([0, 0.3])), count)
    columns = {
        "center": spread(count, 3),
        "scale": np.abs(spread(count, 3)),
        "quat_xyzw": normalized_quat(rng.normal(size=(count, 4)).astype(np.float32)),
        "opacity": np.clip(opacity, 0, 1),
        "rgb": spread(count, 3),
        "sh": spread(count, COEFFICIENTS[degree], 3),
    }
    return Scene.from_arrays(**{name: values[np.arange(count) % different] for name, values in columns.items()})


def check_written(path: Path, scene: Scene, **options: object) -> None:
    """Write a scene and check the files; a refusal leaves none."""
    try:
        sparklod.write(path, scene, **options)
    except SparklodError:
        assert not list(path.parent.iterdir())
        return
    check_passes(path)
    shutil.rmtree(path.parent)
    path.parent.mkdir()


@pytest.mark.filterwarnings("error")
@given(scenes(), st.data())
@settings(max_examples=25, phases=[Phase.explicit, Phase.generate])  # shrinking takes minutes, and any scene will do
def test_written_files_pass_the_check(scene: Scene, data: st.DataObject) -> None:
    rad = RadOptions(**{name: data.draw(st.sampled_from(["auto", *RAD_ENCODINGS[name]])) for name in RAD_ENCODINGS})
    shares = data.draw(st.sampled_from([(0.5,), (0.9, 0.5, 0.01), (0.3, 0.1)]))
    detail = DetailSettings(
        shares, data.draw(st.sampled_from([20, 40, 9999])), data.draw(st.sampled_from([1e-3, 16])), 1
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for ending in (".ply", ".splat", ".sog", ".spz"):
            check_written(folder / f"plain{ending}", scene)
        check_written(folder / "plain.rad", scene, rad=rad)
        with contextlib.suppress(SparklodError):
            tree = sparklod.build_lod(scene, method=data.draw(st.sampled_from(METHODS)))
            check_written(folder / "tree.spz", tree)
            check_written(folder / "tree.rad", tree, rad=rad)
            check_written(folder / MANIFEST, tree, detail=detail, sog=SogOptions(sh_codes=16))
            check_written(folder / "leaves.rad", sparklod.extract_leaves(tree), rad=rad)
