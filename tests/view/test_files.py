"""Which files are served, and what the page is told of them."""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from fixtures import by_hand_glb, by_hand_rad
from sparklod_cli.codecs.rad.rad_header import RadChunkEntry, RadHeader, pack_header, read_chunk_header
from sparklod_cli.io.reading import read_parts
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import CameraPathError, FormatError, SparklodError
from sparklod_cli.view.files import shown_files
from tests.conftest import FIXTURES
from tests.scenes import random_splats
from tests.view.conftest import CHUNKED, TREE, prepared

GOLDEN = FIXTURES / "golden"


def settings_of(*paths: Path, **options: Any) -> dict[str, Any]:
    content = prepared(paths, **options).resources["view.json"]
    assert isinstance(content, bytes)
    return json.loads(content)


@pytest.mark.parametrize(
    ("name", "kind", "leaves"),
    [
        ("../sh1.ply", "ply", None),
        ("sh3-compressed.ply", "ply", None),
        ("sh3-v3.spz", "spz", None),
        ("tree-v3.spz", "spz", True),
        ("sh0.splat", "splat", None),
        ("sh2-level1.ksplat", "ksplat", None),
        ("sh3-v2.sog", "pcsogszip", None),
        ("sh1-tree.rad", "rad", True),
    ],
)
def test_the_page_is_told_what_each_file_is(name: str, kind: str, leaves: bool | None) -> None:
    (file,) = settings_of(GOLDEN / name)["files"]
    scene = sparklod.read(GOLDEN / name)
    assert (file["type"], file["splats"]) == (kind, len(scene.splats))
    assert (file["leaves"] is not None) == bool(leaves)
    if scene.tree is not None:
        assert file["leaves"] == int(scene.tree.is_leaf.sum())


def test_files_of_the_same_name_have_different_addresses() -> None:
    first, second = settings_of(TREE, TREE)["files"]
    assert first["name"] == second["name"]
    assert first["url"] != second["url"]


@pytest.mark.parametrize("name", ["sh1-sog", "sh1-sog/meta.json"])
def test_an_unpacked_sog_is_refused_as_spark_does_not_read_it(name: str) -> None:
    with pytest.raises(FormatError, match=r"zip its files into a \.sog$"):
        shown_files([GOLDEN / name])


def test_a_folder_that_is_no_splat_file_is_not_called_a_sog(tmp_path: Path) -> None:
    with pytest.raises(
        FormatError,
        match=r"is a directory, without the meta\.json of an unpacked SOG, a lod-meta\.json or a tileset\.json$",
    ):
        shown_files([tmp_path])


@pytest.mark.parametrize("name", ["sh1-streamed-sog", "sh1-streamed-sog/lod-meta.json"])
def test_streamed_sog_is_shown_by_playcanvas_with_all_its_files(name: str) -> None:
    site = prepared([GOLDEN / name])
    settings = settings_of(GOLDEN / name)
    (file,) = settings["files"]
    scene = read_parts(GOLDEN / name)
    assert (settings["engine"], file["url"], file["levels"]) == ("playcanvas", "data/0/lod-meta.json", scene.levels)
    assert (file["splats"], file["leaves"]) == (len(scene.splats), int(scene.counts[:, 0].sum()))
    folder = GOLDEN / "sh1-streamed-sog"
    names = {f"data/0/{each.relative_to(folder).as_posix()}" for each in folder.rglob("*") if each.is_file()}
    assert {each for each in site.resources if each.startswith("data/")} == names
    assert file["bytes"] == sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())


def test_streamed_sog_is_framed_without_its_environment(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN / "sh1-streamed-sog", tmp_path / "web")
    start = settings_of(tmp_path / "web")["start"]
    coarse = read_parts(tmp_path / "web")
    level = coarse.splats.take(coarse.level(coarse.levels - 1))
    assert np.linalg.norm(np.subtract(start["center"], np.median(level.center, axis=0))) < start["radius"]
    manifest = json.loads((tmp_path / "web" / "lod-meta.json").read_text())
    del manifest["environment"]
    (tmp_path / "web" / "lod-meta.json").write_text(json.dumps(manifest))
    assert settings_of(tmp_path / "web")["start"] == start


def test_3d_tiles_are_shown_by_cesium_with_all_their_tiles(tileset: Path, packages: Path) -> None:
    settings = settings_of(tileset, spark_dir=packages)
    (file,) = settings["files"]
    scene = read_parts(tileset)
    assert (settings["engine"], file["url"], file["up"]) == ("cesium", "data/0/tileset.json", "-y")
    assert (file["splats"], file["leaves"], file["levels"]) == (len(scene.splats), 300, int(scene.level.max()) + 1)
    names = {f"data/0/{each.relative_to(tileset.parent).as_posix()}" for each in tileset.parent.rglob("*.*")}
    site = prepared([tileset.parent], spark_dir=packages)
    assert {each for each in site.resources if each.startswith("data/")} == names


@pytest.mark.parametrize("buffer", ["tile.bin", "data.env", ".ssh/tile.bin", "../tile.bin"])
def test_the_buffers_of_tiles_are_shown_if_they_are_called_so(buffer: str, tmp_path: Path) -> None:
    folder = tmp_path / "web" / "tiles"
    (folder / ".ssh").mkdir(parents=True)
    text, content = by_hand_glb.as_json((GOLDEN / "sh2.glb").read_bytes(), buffer)
    (folder / "a.gltf").write_bytes(text)
    (folder / buffer).write_bytes(content)
    root = {"geometricError": 0, "boundingVolume": {"sphere": [0, 0, 0, 99]}, "content": {"uri": "tiles/a.gltf"}}
    tileset = {"asset": {"version": "1.1"}, "geometricError": 1, "root": root}
    (tmp_path / "web" / "tileset.json").write_text(json.dumps(tileset))
    if buffer == "tile.bin":
        (file,) = shown_files([tmp_path / "web"])
        names = ("tileset.json", "tiles/a.gltf", "tiles/tile.bin")
        assert list(file.files) == [f"data/0/{name}" for name in names]
    else:
        with pytest.raises(
            FormatError, match=r"not called like a part of a scene|not a file (?:beside it|below its folder)"
        ):
            shown_files([tmp_path / "web"])


def test_3d_tiles_have_no_budget(tileset: Path, packages: Path) -> None:
    with pytest.raises(SparklodError, match=r"CesiumJS has no budget of splats; leave out --budget$"):
        prepared([tileset], spark_dir=packages, budget=1_000)


@pytest.mark.skipif(os.name != "posix", reason="POSIX only")
def test_a_missing_tile_and_a_tile_that_is_a_link_are_refused(tileset: Path, tmp_path: Path) -> None:
    shutil.copytree(tileset.parent, tmp_path / "web")
    tile = tmp_path / "web" / "tiles" / "0-0.glb"
    tile.rename(tmp_path / "away.glb")
    with pytest.raises(FormatError, match=r"'tiles/0-0\.glb'"):
        shown_files([tmp_path / "web"])
    tile.symlink_to(tmp_path / "away.glb")
    with pytest.raises(FormatError, match=r"is a link to another folder; copy it there"):
        shown_files([tmp_path / "web"])


def test_files_of_different_engines_are_refused_together() -> None:
    with pytest.raises(FormatError, match=r"cannot show all of these files: .*tree-v3\.spz by Spark, .* by PlayCanvas"):
        shown_files([TREE, GOLDEN / "sh1-streamed-sog"])


@pytest.mark.skipif(os.name != "posix", reason="POSIX only")
def test_a_missing_chunk_and_a_folder_that_is_a_link_are_refused(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN / "sh1-streamed-sog", tmp_path / "web")
    (tmp_path / "web" / "1_0").rename(tmp_path / "away")
    with pytest.raises(FormatError, match=r"chunk file '1_0/meta\.json' is missing"):
        shown_files([tmp_path / "web"])
    (tmp_path / "web" / "1_0").symlink_to(tmp_path / "away")
    with pytest.raises(FormatError, match=r"is a link to another folder; copy it there"):
        shown_files([tmp_path / "web"])


@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("golden/hand-v4.spz", "Spark 2.2.0 does not read SPZ version 4"),
        ("sh1-ascii.ply", "Spark 2.2.0 does not read PLY that is ascii or big-endian"),
        ("sh1-big-endian.ply", "Spark 2.2.0 does not read PLY that is ascii or big-endian"),
        ("golden/sh3-rad/sh3.rad", "Spark streams chunks of 65,536 nodes, not of 24"),
        ("sh1.ply", None),
        ("golden/sh3-compressed.ply", None),
        ("golden/hand-v3.spz", None),
        ("golden/sh1-tree.rad", None),
    ],
)
def test_what_spark_does_not_read_is_noted(name: str, note: str | None) -> None:
    (shown,) = shown_files([FIXTURES / name])
    assert (shown.note or "").startswith("" if note is None else f"{shown.name}: {note}")
    assert (shown.note is None) == (note is None)


@pytest.mark.parametrize("line", ["comment made by hand", "obj_info 1", "comment format binary_little_endian 1.0"])
def test_a_ply_is_ascii_whatever_comes_before_its_format(line: str, tmp_path: Path) -> None:
    data = (FIXTURES / "sh1-ascii.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"ply\n", f"ply\n{line}\n".encode(), 1))
    (shown,) = shown_files([tmp_path / "a.ply"])
    assert shown.note is not None and "ascii" in shown.note


def test_chunk_files_without_a_tree_are_noted(tmp_path: Path) -> None:
    splats = random_splats(3)
    columns = {name: getattr(splats, name) for name in ("center", "scale", "opacity", "rgb", "sh")}
    for name, data in by_hand_rad.rad(**columns, quat_wxyz=splats.quat_xyzw[:, [3, 0, 1, 2]], stem="scene").items():
        (tmp_path / name).write_bytes(data)
    (shown,) = shown_files([tmp_path / "scene.rad"])
    assert shown.note == "scene.rad: Spark streams trees only; bake it first with sparklod build-lod"


def test_the_size_counts_chunk_files() -> None:
    (shown,) = shown_files([CHUNKED])
    assert shown.bytes == sum(path.stat().st_size for path in CHUNKED.parent.iterdir())


@pytest.mark.parametrize("content", [None, b"", b"neither of both"])
def test_a_file_that_cannot_be_shown_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "scene.spz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FormatError, match=f"^{path}: "):
        shown_files([path])


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "scene.spz")
    with pytest.raises(FormatError, match="a pipe or a device"):
        shown_files([tmp_path / "scene.spz"])


def test_a_missing_chunk_file_is_named(tmp_path: Path) -> None:
    shutil.copytree(CHUNKED.parent, tmp_path / "rad")
    (tmp_path / "rad" / "sh3-1.radc").unlink()
    with pytest.raises(FormatError, match=r"its chunk file 'sh3-1.radc' is missing"):
        shown_files([tmp_path / "rad" / CHUNKED.name])


def test_a_chunk_file_that_is_no_chunk_is_not_published(tmp_path: Path) -> None:
    shutil.copytree(CHUNKED.parent, tmp_path / "rad")
    (tmp_path / "rad" / "sh3-1.radc").write_text("a secret")
    with pytest.raises(FormatError, match=r"'sh3-1.radc', which it names, is no RAD chunk"):
        shown_files([tmp_path / "rad" / CHUNKED.name])


def test_a_chunk_file_that_is_a_link_to_elsewhere_is_refused(tmp_path: Path) -> None:
    shutil.copytree(CHUNKED.parent, tmp_path / "rad")
    chunk = tmp_path / "rad" / "sh3-1.radc"
    chunk.rename(tmp_path / "elsewhere.radc")
    chunk.symlink_to(tmp_path / "elsewhere.radc")
    with pytest.raises(FormatError, match="link to another folder"):
        shown_files([tmp_path / "rad" / CHUNKED.name])


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "..", "a\\b", "https://elsewhere.example/x"])
def test_a_chunk_file_outside_of_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret").write_text("not yours")
    folder = tmp_path / "rad"
    folder.mkdir()
    header = RadHeader(10, 0, True, 65_536, 5, (RadChunkEntry(0, 5, name),))
    (folder / "scene.rad").write_bytes(pack_header(header))
    with pytest.raises(FormatError, match="which is not a file beside it"):
        shown_files([folder / "scene.rad"])


def test_a_link_that_the_user_names_is_followed_once(tmp_path: Path) -> None:
    (tmp_path / "link.spz").symlink_to(TREE)
    (shown,) = shown_files([tmp_path / "link.spz"])
    assert list(shown.files.items()) == [("data/0/link.spz", TREE.resolve())]


# --- what a stranger's manifest cannot have published


@pytest.fixture
def web(tmp_path: Path) -> Path:
    """A Streamed SOG in a folder with a secret key and a secret file."""
    shutil.copytree(GOLDEN / "sh1-streamed-sog", tmp_path / "web")
    (tmp_path / "web" / ".ssh").mkdir()
    (tmp_path / "web" / ".ssh" / "id_rsa").write_text("secret")
    (tmp_path / "web" / "0_0" / "secret.env").write_text("secret")
    return tmp_path / "web" / "lod-meta.json"


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    root = json.loads(path.read_text())
    change(root)
    path.write_text(json.dumps(root))


def test_a_file_that_no_region_refers_to_is_not_published(web: Path) -> None:
    before = set(shown_files([web])[0].files)
    edit(web, lambda root: root["filenames"].append(".ssh/id_rsa"))
    assert set(shown_files([web])[0].files) == before


def test_a_file_that_is_no_image_of_the_scene_is_not_published(web: Path) -> None:
    before = set(shown_files([web])[0].files)
    edit(web.parent / "0_0" / "meta.json", lambda meta: meta["means"]["files"].append("secret.env"))
    edit(web.parent / "0_0" / "meta.json", lambda meta: meta.update(other={"files": ["secret.env"]}))
    assert set(shown_files([web])[0].files) == before


@pytest.mark.parametrize("name", ["secret.env", ".ssh/id_rsa", ".ssh/id.json", "../web/0_0/meta.json"])
def test_a_chunk_that_is_not_called_like_one_is_refused(web: Path, name: str) -> None:
    shutil.copy(web.parent / "0_0" / "meta.json", web.parent / ".ssh" / "id.json")
    shutil.copytree(web.parent / "0_0", web.parent, dirs_exist_ok=True)
    for secret in ("secret.env", ".ssh/id_rsa"):
        shutil.copy(web.parent / "0_0" / "meta.json", web.parent / secret)
    for image in (web.parent / "0_0").glob("*.webp"):
        shutil.copy(image, web.parent / ".ssh")
    edit(web, lambda root: root["filenames"].__setitem__(0, name))
    with pytest.raises(FormatError, match=r"not called like a part of a scene|not a file beside it"):
        shown_files([web])


@pytest.mark.parametrize("chunk", ["means", "sh0"])
def test_an_image_that_is_a_text_is_refused(web: Path, chunk: str) -> None:
    (web.parent / "0_0" / "secret.webp").write_text("secret")
    edit(web.parent / "0_0" / "meta.json", lambda meta: meta[chunk]["files"].__setitem__(0, "secret.webp"))
    with pytest.raises(FormatError, match=r"'secret\.webp' is not a WebP image"):
        prepared([web])


def test_a_tileset_that_is_not_read_is_refused(tileset: Path, tmp_path: Path, packages: Path) -> None:
    shutil.copytree(tileset.parent, tmp_path / "web")
    (tmp_path / "web" / "secret.json").write_text('{"secret": 1}')
    root = tmp_path / "web" / "tileset.json"

    def hide(found: dict[str, Any]) -> None:
        found["root"] = {**found["root"], "content": {"uri": "secret.json"}, "children": [found["root"]]}

    edit(root, hide)
    with pytest.raises(FormatError, match="a nested tileset and children beside it, which is not read"):
        prepared([root], spark_dir=packages)


def test_only_buffers_that_a_tile_is_read_from_are_published(tmp_path: Path, packages: Path) -> None:
    shutil.copytree(GOLDEN / "sh1-gltf", tmp_path / "web")
    box = {"box": [0, 0, 0, 9, 0, 0, 0, 9, 0, 0, 0, 9]}
    root = {"boundingVolume": box, "geometricError": 0, "refine": "REPLACE", "content": {"uri": "scene.gltf"}}
    tileset = {"asset": {"version": "1.1"}, "geometricError": 1, "root": root}
    (tmp_path / "web" / "tileset.json").write_text(json.dumps(tileset))
    (tmp_path / "web" / "secret.bin").write_text("secret")
    edit(
        tmp_path / "web" / "scene.gltf",
        lambda gltf: gltf["buffers"].append({"uri": "secret.bin", "byteLength": 6}),
    )
    names = {name for name in prepared([tmp_path / "web"], spark_dir=packages).resources if name.startswith("data/")}
    assert names == {"data/0/tileset.json", "data/0/scene.gltf", "data/0/buffers/sh1.bin"}


# --- the first look


def test_the_first_look_is_that_of_render() -> None:
    from sparklod_cli.cameras.camera import Settings
    from sparklod_cli.cameras.sources import whole_scene
    from sparklod_cli.model.instances import instances_of
    from sparklod_cli.viewers.scenes import read_scenes

    start = settings_of(TREE)["start"]
    scenes = read_scenes(instances_of([TREE]))
    (camera,) = whole_scene(15.0, Settings(size=(1280, 720)), scenes.balls).cameras
    assert start["eye"] == pytest.approx(camera.position.tolist())
    ahead = np.subtract(start["target"], start["eye"])
    assert ahead / np.linalg.norm(ahead) == pytest.approx(camera.forward)


def test_a_large_rad_tree_is_framed_by_its_first_chunk_and_only_its_leaves_are_counted(tmp_path: Path) -> None:
    shutil.copytree(CHUNKED.parent, tmp_path / "rad")
    whole = settings_of(tmp_path / "rad" / CHUNKED.name)
    for number in (1, 2):  # what else they hold would be found to be damaged
        keep_child_counts(tmp_path / "rad" / f"sh3-{number}.radc")
    found = settings_of(tmp_path / "rad" / CHUNKED.name)
    assert found == whole
    coarse, scene = found["start"], sparklod.read(CHUNKED)
    assert scene.tree is not None
    assert found["files"][0]["leaves"] == int(scene.tree.is_leaf.sum()) < len(scene)
    distance = np.linalg.norm(scene.splats.center - np.array(coarse["center"]), axis=1)
    assert coarse["radius"] == pytest.approx(float(np.quantile(distance, 0.9)), rel=0.5)


def keep_child_counts(path: Path) -> None:
    """Overwrite all properties of a chunk but the numbers of children."""
    data = path.read_bytes()
    chunk = read_chunk_header(io.BytesIO(data))
    counts = next(each for each in chunk.properties if each.name == "child_count")
    start = chunk.bytes + counts.offset
    damaged = bytearray(b"\xff" * len(data))
    for part in (slice(0, chunk.bytes), slice(start, start + counts.bytes)):
        damaged[part] = data[part]
    path.write_bytes(damaged)


def test_the_options_of_the_first_look_are_told() -> None:
    look = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    told = settings_of(TREE, look_at=look, fov=40.0, up=(0.0, 0.0, 1.0), budget=500)
    assert (told["start"]["eye"], told["start"]["target"], told["start"]["fov"]) == ([1, 2, 3], [0, 0, 0], 40)
    assert (told["up"], told["budget"], told["start"]["chosen"]) == ([0, 0, 1], 500, False)
    assert settings_of(TREE)["start"]["fov"] == 60
    with pytest.raises(CameraPathError):
        settings_of(TREE, look_at=((1.0,) * 3, (1.0,) * 3))


def test_a_camera_path_is_told() -> None:
    path = FIXTURES / "cameras" / "sparklod.json"
    told = settings_of(TREE, camera_path=path)["path"]
    assert len(told["frames"]) == len(sparklod.read_cameras(path))


def test_a_scene_of_one_point_can_be_shown() -> None:
    start = settings_of(FIXTURES / "one.ply")["start"]
    assert start["radius"] > 0
    assert 0 < start["sizes"][0] <= start["sizes"][1]


def test_a_broken_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.spz"
    path.write_bytes(TREE.read_bytes()[:-20])
    with pytest.raises(SparklodError, match=f"^{path}: "):
        settings_of(path)


def test_a_broken_tree_is_refused() -> None:
    path = FIXTURES / "faults" / "tree-cycle.spz"
    with pytest.raises(SparklodError, match=f"^{path}: its Level-of-Detail tree is broken: "):
        settings_of(path)


def test_a_name_that_is_no_text_is_shown_escaped(tmp_path: Path) -> None:
    name = os.fsdecode(b"\xff.spz")
    shutil.copy(TREE, tmp_path / name)
    resources = prepared([tmp_path / name]).resources
    assert rb"<title>\xff.spz" in bytes(resources["index.html"])  # type: ignore[arg-type]
    (file,) = settings_of(tmp_path / name)["files"]
    assert (file["name"], file["url"]) == (r"\xff.spz", "data/0/%FF.spz")


def test_a_glb_is_shown_by_playcanvas_unless_it_has_spz_inside() -> None:
    settings = settings_of(GOLDEN / "sh2.glb")
    assert (settings["engine"], settings["files"][0]["levels"]) == ("playcanvas", None)
    with pytest.raises(
        FormatError, match=r"hand-spz\.glb: PlayCanvas does not read the SPZ in it; write it with --glb"
    ):
        shown_files([GOLDEN / "hand-spz.glb"])


def test_a_format_that_no_engine_of_the_page_reads_is_refused() -> None:
    with pytest.raises(FormatError, match=r"gsplat\.pt: Spark does not read checkpoint; bake it first with sparklod"):
        shown_files([GOLDEN / "sh2-gsplat.pt"])


@pytest.mark.parametrize(
    ("name", "sh_degree", "strength", "layout"),
    [("a.rad", 2, 1, "packed"), ("b.rad", 2, 0.01, "ext"), ("c.rad", 3, 0.01, "packed"), ("d.spz", 3, 0, "ext")],
)
def test_the_page_knows_the_layout_in_which_spark_loses_least(
    name: str, sh_degree: int, strength: float, layout: str, tmp_path: Path
) -> None:
    """Pages of ExtSplats cannot have SH of degree 3; a file that is loaded whole can."""
    splats, tree = quick.build(random_splats(200, sh_degree=sh_degree))
    sparklod.write(tmp_path / name, Scene(replace(splats, sh=splats.sh * np.float32(strength)), tree))
    (file,) = settings_of(tmp_path / name)["files"]
    assert file["layout"] == layout
