"""Sites: the files that they publish, the settings and libraries of the page, and their export."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from fixtures import by_hand_glb, by_hand_rad
from sparklod_cli.cameras.camera import Settings
from sparklod_cli.cameras.sources import whole_scene
from sparklod_cli.cli import run
from sparklod_cli.codecs.rad.rad_header import RadChunkEntry, RadHeader, pack_header, read_chunk_header
from sparklod_cli.io.reading import read_parts
from sparklod_cli.lod import quick
from sparklod_cli.model.instances import instances_of
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import CameraPathError, FormatError, OutputError, SparklodError
from sparklod_cli.view import site as exporting
from sparklod_cli.view.shown_files import shown_files
from sparklod_cli.view.site import (
    LICENSES,
    MODULES,
    PACKAGES,
    VERSIONS,
    Site,
    check_folder,
    export,
    from_cdn,
    from_folder,
)
from sparklod_cli.viewers.scenes import read_scenes
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats
from tests.view.conftest import CHUNKED, TREE, prepared

GOLDEN = FIXTURES / "golden"


def settings_of(*paths: Path, **options: Any) -> dict[str, Any]:
    content = prepared(paths, **options).resources["view.json"]
    assert isinstance(content, bytes)
    return json.loads(content)


def published(site: Site) -> set[str]:
    return {name.removeprefix("data/0/") for name in site.resources if name.startswith("data/")}


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    root = json.loads(path.read_text())
    change(root)
    path.write_text(json.dumps(root))


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
        ("../one.ply", "ply", None),
        ("sh2.glb", None, None),
    ],
)
def test_the_page_is_told_what_each_file_is(name: str, kind: str | None, leaves: bool | None) -> None:
    settings = settings_of(GOLDEN / name)
    (file,), start = settings["files"], settings["start"]
    assert start["radius"] > 0 and 0 < start["sizes"][0] <= start["sizes"][1]
    assert settings["engine"] == ("spark" if kind else "playcanvas")
    scene = sparklod.read(GOLDEN / name)
    assert (file["type"], file["splats"]) == (kind, len(scene.splats))
    assert (file["leaves"] is not None) == bool(leaves)
    if scene.tree is not None:
        assert file["leaves"] == int(scene.tree.is_leaf.sum())


def test_files_of_the_same_name_have_different_addresses() -> None:
    first, second = settings_of(TREE, TREE)["files"]
    assert first["name"] == second["name"]
    assert first["url"] != second["url"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("sh1-sog", r"zip its files into a \.sog$"),
        ("sh1-sog/meta.json", r"zip its files into a \.sog$"),
        ("hand-spz.glb", r"hand-spz\.glb: PlayCanvas does not read the SPZ in it; write it with --glb"),
        ("sh2-gsplat.pt", r"gsplat\.pt: Spark does not read checkpoint; bake it first with sparklod"),
        ("missing.spz", "missing.spz: "),
        ("../camera_files.py", "camera_files.py: "),
        ("/dev/null", "a pipe or a device"),
    ],
)
def test_a_file_that_no_engine_shows_is_an_error_that_names_it(name: str, said: str) -> None:
    with pytest.raises(FormatError, match=said):
        shown_files([GOLDEN / name])


def test_files_of_different_engines_are_refused_together() -> None:
    with pytest.raises(FormatError, match=r"cannot show all of these files: .*tree-v3\.spz by Spark, .* by PlayCanvas"):
        shown_files([TREE, GOLDEN / "sh1-streamed-sog"])


def test_a_folder_and_a_pipe_are_refused(tmp_path: Path) -> None:
    names = r"the meta\.json of an unpacked SOG, a lod-meta\.json or a tileset\.json$"
    with pytest.raises(FormatError, match=f"is a directory, without {names}"):
        shown_files([tmp_path])
    os.mkfifo(tmp_path / "scene.spz")
    with pytest.raises(FormatError, match="a pipe or a device"):
        shown_files([tmp_path / "scene.spz"])


@pytest.mark.parametrize("name", ["sh1-streamed-sog", "sh1-streamed-sog/lod-meta.json"])
def test_streamed_sog_is_shown_by_playcanvas_with_all_its_files(name: str) -> None:
    settings, scene = settings_of(GOLDEN / name), read_parts(GOLDEN / name)
    (file,) = settings["files"]
    assert (settings["engine"], file["url"], file["levels"]) == ("playcanvas", "data/0/lod-meta.json", scene.levels)
    assert (file["splats"], file["leaves"]) == (len(scene.splats), int(scene.counts[:, 0].sum()))
    folder = GOLDEN / "sh1-streamed-sog"
    files = [each for each in folder.rglob("*") if each.is_file()]
    assert published(prepared([GOLDEN / name])) == {each.relative_to(folder).as_posix() for each in files}
    assert file["bytes"] == sum(each.stat().st_size for each in files)


def test_streamed_sog_is_framed_without_its_environment(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN / "sh1-streamed-sog", tmp_path / "web")
    start = settings_of(tmp_path / "web")["start"]
    coarse = read_parts(tmp_path / "web")
    level = coarse.splats.take(coarse.level(coarse.levels - 1))
    assert np.linalg.norm(np.subtract(start["center"], np.median(level.center, axis=0))) < start["radius"]
    edit(tmp_path / "web" / "lod-meta.json", lambda manifest: manifest.pop("environment"))
    assert settings_of(tmp_path / "web")["start"] == start


def test_3d_tiles_are_shown_by_cesium_with_all_their_tiles_and_no_budget(tileset: Path, packages: Path) -> None:
    settings, scene = settings_of(tileset, spark_dir=packages), read_parts(tileset)
    (file,) = settings["files"]
    assert (settings["engine"], file["url"], file["up"]) == ("cesium", "data/0/tileset.json", "-y")
    assert (file["splats"], file["leaves"], file["levels"]) == (len(scene.splats), 300, int(scene.level.max()) + 1)
    names = {each.relative_to(tileset.parent).as_posix() for each in tileset.parent.rglob("*.*")}
    assert published(prepared([tileset.parent], spark_dir=packages)) == names
    with pytest.raises(SparklodError, match=r"CesiumJS has no budget of splats; leave out --budget$"):
        prepared([tileset], spark_dir=packages, budget=1_000)


@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("golden/hand-v4.spz", "Spark 2.2.0 does not read SPZ version 4; bake it first with sparklod build-lod"),
        ("sh1-ascii.ply", "Spark 2.2.0 does not read PLY that is ascii or big-endian; bake it first"),
        ("sh1-big-endian.ply", "Spark 2.2.0 does not read PLY that is ascii or big-endian"),
        ("golden/sh3-rad/sh3.rad", "Spark streams chunks of 65,536 nodes, not of 24; write it anew"),
        ("sh1.ply", None),
        ("golden/sh3-compressed.ply", None),
        ("golden/hand-v3.spz", None),
        ("golden/sh1-tree.rad", None),
    ],
)
def test_a_file_that_spark_does_not_read_is_noted_and_not_exported(
    name: str, note: str | None, tmp_path: Path, capfd: Capture
) -> None:
    (shown,) = shown_files([FIXTURES / name])
    assert run(["view", str(TREE), str(FIXTURES / name), "--export", str(tmp_path / "site"), "-q"]) == (
        note is not None
    )
    if note is None:
        assert shown.note is None
    else:
        assert (shown.note or "").startswith(f"{shown.name}: {note}")
        assert f"error: {FIXTURES / name}: {note}" in capfd.readouterr().err
        assert list(tmp_path.iterdir()) == []


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


def test_a_link_that_the_user_names_is_followed_once(tmp_path: Path) -> None:
    (tmp_path / "link.spz").symlink_to(TREE)
    (shown,) = shown_files([tmp_path / "link.spz"])
    assert list(shown.files.items()) == [("data/0/link.spz", TREE.resolve())]


# Files that the manifest of a stranger must not publish


@pytest.mark.skipif(os.name != "posix", reason="POSIX only")
@pytest.mark.parametrize(
    ("form", "file", "missing"),
    [
        ("rad", "sh3-1.radc", r"its chunk file 'sh3-1.radc' is missing"),
        ("sog", "1_0", r"chunk file '1_0/meta\.json' is missing"),
        ("tiles", "tiles/0-0.glb", r"'tiles/0-0\.glb'"),
    ],
)
def test_a_part_that_is_missing_or_a_link_to_elsewhere_is_refused(
    form: str, file: str, missing: str, tileset: Path, tmp_path: Path
) -> None:
    source = {"rad": CHUNKED, "sog": GOLDEN / "sh1-streamed-sog" / "lod-meta.json", "tiles": tileset}[form]
    shutil.copytree(source.parent, tmp_path / "web")
    part, away = tmp_path / "web" / file, tmp_path / Path(file).name
    part.rename(away)
    with pytest.raises(FormatError, match=missing):
        shown_files([tmp_path / "web" / source.name])
    part.symlink_to(away)
    with pytest.raises(FormatError, match=r"is a link to another folder; copy it there"):
        shown_files([tmp_path / "web" / source.name])


def test_a_chunk_file_that_is_no_chunk_is_not_published(tmp_path: Path) -> None:
    shutil.copytree(CHUNKED.parent, tmp_path / "rad")
    (tmp_path / "rad" / "sh3-1.radc").write_text("a secret")
    with pytest.raises(FormatError, match=r"'sh3-1.radc', which it names, is no RAD chunk"):
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


@pytest.mark.parametrize("buffer", ["tile.bin", "data.env", ".ssh/tile.bin", "../tile.bin"])
def test_buffers_of_tiles_are_published_if_their_names_are_those_of_parts(buffer: str, tmp_path: Path) -> None:
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
        with pytest.raises(FormatError, match=r"not called like a part of a scene|not a file (?:beside|below)"):
            shown_files([tmp_path / "web"])


@pytest.fixture
def web(tmp_path: Path) -> Path:
    """A Streamed SOG in a folder with a secret key and a secret file."""
    shutil.copytree(GOLDEN / "sh1-streamed-sog", tmp_path / "web")
    (tmp_path / "web" / ".ssh").mkdir()
    (tmp_path / "web" / ".ssh" / "id_rsa").write_text("secret")
    (tmp_path / "web" / "0_0" / "secret.env").write_text("secret")
    return tmp_path / "web" / "lod-meta.json"


def test_files_that_are_no_part_of_the_scene_are_not_published(web: Path) -> None:
    before = set(shown_files([web])[0].files)
    edit(web, lambda root: root["filenames"].append(".ssh/id_rsa"))  # no region refers to it
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
    names = published(prepared([tmp_path / "web"], spark_dir=packages))
    assert names == {"tileset.json", "scene.gltf", "buffers/sh1.bin"}


# The settings of the page


def test_the_first_look_is_that_of_render() -> None:
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


def test_the_options_of_the_first_look_and_a_camera_path_are_in_the_settings() -> None:
    look, path = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)), FIXTURES / "cameras" / "sparklod.json"
    settings = settings_of(TREE, look_at=look, fov=40.0, up=(0.0, 0.0, 1.0), budget=500)
    start = settings["start"]
    assert (start["eye"], start["target"], start["fov"], start["chosen"]) == ([1, 2, 3], [0, 0, 0], 40, False)
    assert (settings["up"], settings["budget"]) == ([0, 0, 1], 500)
    assert len(settings_of(TREE, camera_path=path)["path"]["frames"]) == len(sparklod.read_cameras(path))
    assert settings_of(TREE)["start"]["fov"] == 60
    with pytest.raises(CameraPathError):
        settings_of(TREE, look_at=((1.0,) * 3, (1.0,) * 3))


def test_a_broken_file_and_a_broken_tree_are_named(tmp_path: Path) -> None:
    cut, cycle = tmp_path / "scene.spz", FIXTURES / "faults" / "tree-cycle.spz"
    cut.write_bytes(TREE.read_bytes()[:-20])
    for path, said in ((cut, ""), (cycle, "its Level-of-Detail tree is broken: ")):
        with pytest.raises(SparklodError, match=f"^{path}: {said}"):
            settings_of(path)


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


# The libraries of the page

#: Engines that come from a CDN.
ON_CDN = [engine for engine in PACKAGES if engine != "cesium"]


@pytest.fixture
def shown(tileset: Path) -> dict[str, Path]:
    """A file of each engine."""
    return {"spark": TREE, "playcanvas": FIXTURES / "golden" / "sh1-streamed-sog", "cesium": tileset}


def page_of(site: Site) -> tuple[dict[str, dict[str, str]], str]:
    """The import map of the page, and its policy."""
    index = site.resources["index.html"]
    assert isinstance(index, bytes)
    found = re.search(r'<script type="importmap">(.*?)</script>', index.decode(), re.DOTALL)
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', index.decode())
    assert found and policy
    digest = base64.b64encode(hashlib.sha256(found[1].encode()).digest()).decode()
    assert f"'sha256-{digest}'" in html.unescape(policy[1])
    return json.loads(found[1]), html.unescape(policy[1])


@pytest.mark.parametrize("engine", ON_CDN)
def test_the_cdn_is_asked_for_fixed_versions_by_their_digests(engine: str, shown: dict[str, Path]) -> None:
    mapped, policy = page_of(prepared([shown[engine]]))
    assert all(url.startswith("https://") for url in mapped["imports"].values())
    assert len(mapped["integrity"]) == sum(package in PACKAGES[engine] for package, _ in MODULES)
    for url, digest in mapped["integrity"].items():
        assert any(f"{package}@{version}/" in url for package, version in VERSIONS.items())
        assert re.fullmatch(r"sha384-[A-Za-z0-9+/]{64}", digest)
        assert url in policy
    assert from_cdn(engine).notes() == []


@pytest.mark.parametrize("engine", PACKAGES)
def test_a_folder_needs_no_other_host(packages: Path, engine: str, shown: dict[str, Path]) -> None:
    site = prepared([shown[engine]], spark_dir=packages)
    mapped, policy = page_of(site)
    assert "http" not in json.dumps(mapped) + policy
    assert ("'unsafe-eval'" in policy) == ("'unsafe-inline'" in policy) == (engine == "cesium")
    for url in mapped["imports"].values():
        name = url.removeprefix("./")
        assert any(each == name or (url.endswith("/") and each.startswith(name)) for each in site.resources)
    licenses = [name for name in site.resources if name.endswith(LICENSES)]
    assert len(licenses) == len(PACKAGES[engine])


def test_workers_come_with_an_engine_and_from_no_cdn(packages: Path, tileset: Path) -> None:
    site = prepared([tileset], spark_dir=packages)
    assert "lib/cesium/Build/Cesium/Workers/gaussianSplatone.js" in site.resources
    with pytest.raises(SparklodError, match=r"^CesiumJS cannot be taken from a CDN; install it with npm .* cesium@"):
        prepared([tileset])


def test_the_folder_of_the_libraries_may_be_node_modules_and_have_links(packages: Path, tmp_path: Path) -> None:
    modules, store = packages / "node_modules", tmp_path / "store"
    assert from_folder(modules).files == from_folder(packages).files
    (modules / "three").rename(store)
    (modules / "three").symlink_to(store)
    assert from_folder(packages).files["lib/three/build/three.module.js"] == store / "build" / "three.module.js"


@pytest.mark.parametrize("package", VERSIONS)
def test_a_folder_without_a_package_says_how_to_install_it(packages: Path, package: str) -> None:
    (packages / "node_modules" / package).rename(packages / "away")
    with pytest.raises(SparklodError, match=f"has no {package}; install it with npm install --prefix {packages} "):
        from_folder(packages, next(engine for engine, needed in PACKAGES.items() if package in needed))


def test_another_version_is_noted_and_a_missing_module_or_version_is_an_error(packages: Path) -> None:
    three = packages / "node_modules" / "three"
    (three / "package.json").write_text('{"version": "0.180.0"}')
    note = f"{packages} has three 0.180.0; the page was tested with {VERSIONS['three']}"
    assert from_folder(packages).notes() == [note]
    (three / "build" / "three.module.js").unlink()
    with pytest.raises(SparklodError, match=r"three has no build/three.module.js"):
        from_folder(packages)
    for text in ("", "[]", "{}", "nothing"):
        (three / "package.json").write_text(text)
        with pytest.raises(SparklodError, match="has no version"):
            from_folder(packages)


def test_the_page_has_all_modules_that_it_imports() -> None:
    site = prepared([TREE])
    sources = {name: content.decode() for name, content in site.resources.items() if name.endswith(".js")}  # type: ignore[union-attr]
    assert sources
    for name, source in sources.items():
        for imported in re.findall(r"(?:from|import\() ?'([^']+)'", source):
            assert imported.removeprefix("./") in sources or imported in VERSIONS, (name, imported)
    index = site.resources["index.html"]
    assert isinstance(index, bytes)
    ids = set(re.findall(r'\bid="([^"]+)"', index.decode()))
    used = {each for source in sources.values() for each in re.findall(r"element\('([^']+)'\)", source)}
    assert used <= ids
    assert not re.search(r"\son\w+=|style=|{{", index.decode()), "the policy forbids it"


# Exported sites: whole or not at all, and never in the place of something else


@pytest.fixture(scope="module")
def static(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """A site with a file of one part, and with one of two."""
    chunked = tmp_path_factory.mktemp("chunked") / "chunked.rad"
    command = ["build-lod", str(FIXTURES / "sh1.ply"), "--format", "rad-chunked", "-o", str(chunked), "-q"]
    assert run(command) == 0
    return prepared([TREE, chunked], served=False)


def everything(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_site_has_every_resource_under_its_name(static: Site, packages: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "deep" / "site", tmp_path / "empty"):
        size = export(static, folder, overwrite=False)
        found = everything(folder)
        assert found.keys() == static.resources.keys()
        for name, content in static.resources.items():
            assert found[name] == (content if isinstance(content, bytes) else content.read_bytes())
        assert size == sum(map(len, found.values()))
        assert json.loads(found["view.json"])["cameras"] is None
    assert [path.name for path in tmp_path.rglob(".sparklod*")] == []
    export(prepared([TREE], served=False, spark_dir=packages), tmp_path / "own", overwrite=False)
    assert (tmp_path / "own/lib/three/build/three.core.js").is_file()
    assert (tmp_path / "own/lib/three/LICENSE").read_text() == "license of three"


def test_an_existing_folder_is_refused_and_replaced_only_if_it_is_a_site(static: Site, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    export(static, folder, overwrite=False)
    (folder / "old.js").write_text("of the site before")
    with pytest.raises(OutputError, match=f"^{folder} exists, add --overwrite"):
        export(static, folder, overwrite=False)
    assert (folder / "old.js").exists()
    export(static, folder, overwrite=True)
    assert everything(folder).keys() == static.resources.keys()
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


@pytest.mark.parametrize("name", [".git/HEAD", "CNAME", "notes.txt"])
def test_what_somebody_put_into_the_folder_of_a_site_is_never_removed(static: Site, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "site"
    export(static, folder, overwrite=False)
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("mine")
    with pytest.raises(
        OutputError, match=r"holds (\.git|CNAME|notes\.txt), which is not of the site; move it away first$"
    ):
        export(static, folder, overwrite=True)
    assert (folder / name).read_text() == "mine"


@pytest.mark.parametrize("content", [{"notes.txt": "mine"}, {"view.json": "{}"}, {"view.json": "no json"}])
def test_what_is_no_site_is_never_replaced(static: Site, tmp_path: Path, content: dict[str, str]) -> None:
    folder = tmp_path / "home"
    folder.mkdir()
    for name, text in content.items():
        (folder / name).write_text(text)
    with pytest.raises(OutputError, match="holds something else than a site"):
        export(static, folder, overwrite=True)
    assert {path.name: path.read_text() for path in folder.iterdir()} == content


def test_a_page_and_a_file_are_no_folders(static: Site, tmp_path: Path) -> None:
    said = rf"page\.html names a page, but --export writes a folder; give {tmp_path}/page$"
    with pytest.raises(OutputError, match=said):
        export(static, tmp_path / "page.html", overwrite=False)
    (tmp_path / "site").write_text("mine")
    with pytest.raises(OutputError, match="is a file"):
        check_folder(tmp_path / "site", overwrite=True)
    with pytest.raises(OutputError, match="cannot write"):
        export(static, tmp_path / "site" / "below", overwrite=True)


def test_a_site_that_shows_its_own_files_is_not_replaced(static: Site, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    export(static, folder, overwrite=False)
    again = prepared([folder / "data" / "0" / TREE.name], served=False)
    with pytest.raises(OutputError, match="which is to be shown"):
        export(again, folder, overwrite=True)
    assert everything(folder).keys() == static.resources.keys()


@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
@pytest.mark.parametrize("before", [True, False])
def test_a_failure_leaves_everything_as_it_was(
    static: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, before: bool
) -> None:
    folder = tmp_path / "site"
    if before:
        export(static, folder, overwrite=False)
        (folder / "old.js").write_text("of the site before")
    found = everything(tmp_path)
    write, calls = exporting.write_file, iter(range(100))

    def write_some(*arguments: object, **more: object) -> int:
        if next(calls) == 5:
            raise error
        return write(*arguments, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(exporting, "write_file", write_some)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        export(static, folder, overwrite=True)
    assert everything(tmp_path) == found
    assert folder.exists() == before


def test_a_folder_that_cannot_be_put_in_place_is_put_back(
    static: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "site"
    export(static, folder, overwrite=False)
    (folder / "old.js").write_text("of the site before")
    found, rename, calls = everything(tmp_path), Path.rename, iter(range(100))

    def rename_some(self: Path, target: Path) -> Path:
        if target == folder.resolve() and next(calls) == 0:
            raise OSError("cannot rename")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", rename_some)
    with pytest.raises(OutputError):
        export(static, folder, overwrite=True)
    assert everything(tmp_path) == found
