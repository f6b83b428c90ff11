"""The table of formats keeps the contract of codecs; files are called what they are, and empty values mean nothing."""

from __future__ import annotations

import codecs
import inspect
import io
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand_sog
from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import (
    FORMATS,
    HEAD,
    JSON_HEAD,
    WRITABLE,
    Format,
    WriteOptions,
    ending_of,
    head_of,
    sniff,
)
from sparklod_cli.codecs.reader import FileNote, comment_of, note_of, read_comment, read_note
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import AXES, Scene
from sparklod_cli.system.errors import FormatError, SparklodError
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats


def parameters(function: object) -> dict[str, bool]:
    """The parameters of a function, and whether each must be named."""
    found = inspect.signature(function).parameters.values()  # type: ignore[arg-type]
    return {each.name: each.kind == each.KEYWORD_ONLY for each in found}


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.name)
def test_a_codec_has_the_signatures_of_all(form: Format) -> None:
    codec = form.codec()
    assert parameters(codec.open_content) == {"source": False}
    is_written = any(each.endings for each in FORMATS if each.module == form.module)  # one may be read in two forms
    assert hasattr(codec, "encode") == hasattr(codec, "settled") == is_written
    if is_written:
        written = {"scene": False, "options": False, "threads": True, "progress": True}
        assert parameters(codec.encode) == written
        assert parameters(codec.settled) == {"scene": False, "options": False}
    assert hasattr(codec, "encode_files") == (form.unbundled is not None or form.parts is not None)
    assert hasattr(codec, "decode_parts") == (form.parts is not None)
    if form.parts is not None:
        named = {"threads": True, "progress": True, "open_companion": True}
        assert parameters(codec.decode_parts) == {"file": False} | named
    assert hasattr(codec, "encoder") == hasattr(codec, "needed") == form.trees
    if form.trees:
        assert parameters(codec.needed) == {"options": False}
        named = {"counting": True, "threads": True, "progress": True}
        assert parameters(codec.encoder) == {"scene": False, "options": False} | named
        assert parameters(codec.stored) == {"source": False, "options": False}


def test_the_name_of_a_file_tells_how_it_is_written() -> None:
    endings = {"a.SOG": ".sog", "x": "", ".ply": "", "meta.json": "meta.json", "Meta.JSON": "meta.json"}
    endings |= {"a-meta.json": ".json", "meta.json.ply": ".ply"}
    assert {name: ending_of(name) for name in endings} == endings


@pytest.mark.parametrize("suffix", sorted(suffix for suffix, form in WRITABLE.items() if not form.trees))
def test_what_holds_no_tree_says_so_before_a_byte_is_written(suffix: str) -> None:
    tree = Scene(random_splats(2), LodTree(np.array([1, 0], np.uint16), np.array([1, 0], np.uint32)))
    codec = WRITABLE[suffix].codec()
    for write in (lambda: codec.settled(tree, WriteOptions()), lambda: next(codec.encode(tree))):
        with pytest.raises(FormatError, match="holds no Level-of-Detail tree"):
            write()


def test_tables_load_nothing_heavy() -> None:
    """`--help` names what stands in them."""
    program = (
        "import sys; from sparklod_cli.codecs import formats;"
        "from sparklod_cli.tables import columns; from sparklod_cli.cameras import camera_formats as table;"
        "assert not {'numpy', 'numba'} & set(sys.modules), 'heavy'"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


# --- Notes of sparklod, those of others, and broken ones --------------------------------------------------------------


@pytest.mark.parametrize("up", [None, *AXES])
@pytest.mark.parametrize("antialiased", [False, True])
def test_a_note_is_json_that_names_its_writer_and_comes_back(antialiased: bool, up: str | None) -> None:
    comment, note = comment_of(antialiased=antialiased, up=up), note_of(antialiased=antialiased, up=up)
    assert json.loads(comment) == note
    assert comment.isascii() and comment.isprintable()
    assert list(note) == ["generator", *["antialiased"] * antialiased, *["up"] * (up is not None)]
    assert read_comment(comment) == read_note(note) == FileNote(antialiased, up, is_ours=True)


OTHERS = '"antialiased": true, "up": "y"}'


@pytest.mark.parametrize(
    "comment",
    [
        *(None, "", b"", b"\xff\xfe", "sparklod antialiased", '["sparklod 1", "antialiased"]', "[" * 10_000),
        *("{" + OTHERS, '{"generator": "another", ' + OTHERS, '{"generator": ["sparklod "], ' + OTHERS),
    ],
)
def test_comments_of_others_say_nothing(comment: str | bytes | None) -> None:
    assert read_comment(comment) == FileNote()
    assert read_comment('{"generator": "sparklod 1", "antialiased": "yes", "up": null}') == FileNote(is_ours=True)


@pytest.mark.parametrize("up", ["Y", "--help", "", 1, True, [], ["y"], {"y": 1}, "y" * 1000, "\x1b[31m"])
def test_an_up_axis_that_is_none_is_ignored_with_a_problem(up: object) -> None:
    noted = read_note({"generator": "sparklod 1", "up": up})
    assert noted.up is None
    (problem,) = noted.problems
    assert "up axis" in problem and problem.isprintable() and len(problem) < 250


# --- Files that hold no splats, and JSON in any order and encoding ----------------------------------------------------

GOLDEN = FIXTURES / "golden"
TREE = GOLDEN / "tree-v3.spz"
MANIFESTS = ("sh1-sog/meta.json", "sh1-streamed-sog/lod-meta.json", "sh1-tiles/tileset.json")
POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 123456\n".encode()

GLTF = {"asset": {"version": "2.0"}, "meshes": [], "nodes": []}
CAMERAS = {"camera_angle_x": 0.7, "frames": [{"file_path": "a"}]}


def copied(folder: Path, manifest: str) -> Path:
    shutil.copytree((GOLDEN / manifest).parent, folder, dirs_exist_ok=True)
    return folder / Path(manifest).name


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (GLTF, "glTF without splats"),
        ({"extensionsUsed": [], "asset": {"version": "2.0"}, "buffers": []}, "glTF without splats"),
        ({"asset": {"version": "2.0"}, "nodes": []}, "a glTF without splats"),
        (CAMERAS, "a file of cameras; give it as --camera-path"),
        ({"camera_path": []}, "a file of cameras"),
        ([{"id": 0, "img_name": "a"}], "a JSON list; if it holds cameras, give it as --camera-path"),
        ({"totalLevel": 5, "splats": []}, "the manifest of an LCC scene"),
        ({"a": 1}, "a JSON object of no format that holds splats (a)"),
        ({"means": 1, "name": "x"}, "a JSON object of no format that holds splats (means, name)"),
        ({"root": {"geometricError": 1, "lodLevels": 2}}, "a JSON object of no format that holds splats (root)"),
        (dict.fromkeys("abcdefg", 0), "(a, b, c, d, e, ...)"),
        ({"\x1b[31m" * 99: 0}, "\\x1b[31m"),
        ({}, "not a splat file that sparklod reads"),
        (5, "not a splat file that sparklod reads"),
    ],
)
@pytest.mark.parametrize("name", ["meta.json", "scene.gltf", "a.splat", "x"])
def test_json_is_called_what_it_is(content: Any, said: str, name: str, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / name
    for mark in (b"", codecs.BOM_UTF8):
        path.write_bytes(mark + json.dumps(content).encode())
        if name == "a.splat" and "that sparklod reads" in said:
            continue  # of any bytes
        assert run(["inspect", str(path)]) == 1
        err = capsys.readouterr().err
        assert said in err
        assert "means.files" not in err
        assert err.count("\n") == 1
        if said.startswith("a "):
            assert "not a splat file, but a " in err


def test_a_web_page_is_named(tmp_path: Path) -> None:
    (tmp_path / "scene.splat").write_text("\n<!DOCTYPE html><html></html>")
    with pytest.raises(FormatError, match="not a splat file, but a web page"):
        read_scene(tmp_path / "scene.splat")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("manifest", MANIFESTS)
def test_a_byte_order_mark_makes_no_difference(manifest: str, encoding: str, tmp_path: Path) -> None:
    expected = read_scene(GOLDEN / manifest)
    path = copied(tmp_path, manifest)
    for each in tmp_path.rglob("*.json"):  # metas of chunks and nested tilesets, too
        each.write_text(each.read_text(), encoding)
    for given in (path, path.parent):
        found = read_scene(given)
        assert (found.splats.center == expected.splats.center).all()
        assert found.format == expected.format


@pytest.mark.parametrize("manifest", MANIFESTS)
def test_keys_may_stand_anywhere(manifest: str, tmp_path: Path) -> None:
    """Behind a long value, and with other objects that have the keys inside."""
    path = copied(tmp_path, manifest)
    content = json.loads(path.read_text())
    for filler in ("x" * HEAD, {"means": 1, "quats": 1, "lodLevels": 1, "geometricError": 1}, [[[]]] * HEAD):
        path.write_text(json.dumps({"extras": filler} | content, indent=1))
        assert read_scene(path).format == read_scene(GOLDEN / manifest).format


def test_only_so_much_of_an_object_is_searched() -> None:
    for size, known in ((HEAD, True), (JSON_HEAD, False)):
        file = io.BytesIO(json.dumps({"extras": "x" * size, "lodLevels": 1}).encode())
        form = sniff(head_of(file), "")
        assert (form is not None) == known
        assert file.tell() == 0


@pytest.mark.parametrize("data", [b"{" * 70_000, b'{"a":' * 70_000, b'{"a":' + b"[" * 70_000, b'{"a":' + b"1" * 70_000])
def test_hostile_json_is_no_format(data: bytes) -> None:
    assert sniff(head_of(io.BytesIO(data)), "") is None


SUFFIXES = (".ply", ".spz", ".rad", ".sog", ".glb", ".ksplat", ".splat", ".hier", ".pt", ".json", "")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_pointer_of_git_lfs_is_named_whatever_its_suffix(suffix: str, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(POINTER)
    for command in (["inspect"], ["build-lod"], ["render"], ["view", "--export", str(tmp_path / "site")]):
        assert run([*command, str(path)]) == 1
        assert "a Git LFS pointer; run git lfs pull" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("manifest", "pattern"),
    [
        *(("sh1-sog/meta.json", name) for name in ("meta.json", "means_l.webp", "shN_labels.webp")),
        *(("sh1-streamed-sog/lod-meta.json", name) for name in ("lod-meta.json", "0_0/meta.json", "0_0/scales.webp")),
        *(("sh1-tiles/tileset.json", name) for name in ("tileset.json", "tiles/*.json", "tiles/2-3.glb")),
        *(("sh3-rad/*.rad", name) for name in ("*.rad", "*.radc")),
    ],
)
def test_a_pointer_among_the_files_of_a_scene_is_named(manifest: str, pattern: str, tmp_path: Path) -> None:
    name = next(GOLDEN.glob(manifest)).relative_to(GOLDEN).as_posix()
    path = copied(tmp_path, name)
    min(tmp_path.glob(pattern)).write_bytes(POINTER)
    with pytest.raises(FormatError, match="a Git LFS pointer; run git lfs pull"):
        read_scene(path)


Command = Callable[[str], list[str]]


@pytest.mark.parametrize(
    "command",
    [
        lambda path: ["traverse", str(TREE), "--camera-path", path],
        lambda path: ["render", str(TREE), "--camera-path", path],
        lambda path: ["traverse", "--scene", path],
        lambda path: ["inspect", str(TREE), "--expect", path],
        lambda path: ["build-lod", str(FIXTURES / "one.ply"), "--rgba", path],
    ],
)
@pytest.mark.parametrize("name", ["a.json", "images.txt", "a.csv", "a.rgba"])
def test_a_pointer_in_place_of_another_input_is_named(
    command: Command, name: str, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / name).write_bytes(POINTER)
    assert run(command(str(tmp_path / name))) in (1, 2)
    assert "Git LFS pointer; run git lfs pull" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "hint"),
    [
        (("a.ply", "b.ply", "c.spz", "notes.txt"), "; give {folder}/*.ply"),
        (("a.PLY", "b.PLY"), "; give {folder}/*.PLY"),
        (("my room.splat", "photo.jpg"), "; give {folder}/'my room.splat'"),
        (("notes.txt", "x.json"), ""),
        ((), ""),
    ],
)
def test_a_folder_of_scans_gets_a_hint(names: tuple[str, ...], hint: str, tmp_path: Path) -> None:
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(SparklodError) as caught:
        read_scene(tmp_path)
    assert str(caught.value).endswith(f"a lod-meta.json or a tileset.json{hint.format(folder=tmp_path)}")


# --- Values of JSON that say that something is not there, by whatever writer ------------------------------------------

#: What viewers take for false, and what means nothing else.
NOTHING = ("", None, False, [], {})


def nodes(tree: Any) -> Iterator[dict[str, Any]]:
    yield tree
    for child in tree.get("children") or []:
        yield from nodes(child)


@pytest.mark.parametrize("nothing", NOTHING)
def test_an_empty_environment_is_none(nothing: Any, tmp_path: Path, capsys: Capture) -> None:
    path = copied(tmp_path, "sh1-streamed-sog/lod-meta.json")
    root = json.loads(path.read_text())
    path.write_text(json.dumps(root | {"environment": nothing}))
    assert len(read_scene(path).splats) == 60
    assert run(["inspect", "--check", str(path)]) == 0
    assert run(["view", str(path), "--export", str(tmp_path / "site")]) == 0
    assert "streamed-sog.environment" not in capsys.readouterr().out


@pytest.mark.parametrize("nothing", NOTHING[:-1])
def test_empty_children_of_a_region_are_none(nothing: Any, tmp_path: Path) -> None:
    path = copied(tmp_path, "sh1-streamed-sog/lod-meta.json")
    root = json.loads(path.read_text())
    for node in nodes(root["tree"]):
        if node.get("children"):
            node["lods"] = node["errors"] = None
        else:
            node["children"] = nothing
    for key in ("asset", "lodErrors"):
        root[key] = None
    path.write_text(json.dumps(root))
    assert len(read_scene(path).splats) == 66
    assert run(["inspect", "--check", str(path)]) == 0


@pytest.mark.parametrize("nothing", NOTHING)
@pytest.mark.parametrize("zipped", [False, True])
def test_empty_sh_of_a_sog_are_none(nothing: Any, zipped: bool, tmp_path: Path) -> None:
    path = copied(tmp_path, "sh1-sog/meta.json")
    root = json.loads(path.read_text())
    path.write_text(json.dumps(root | {"shN": nothing, "asset": nothing}))
    if zipped:
        path = tmp_path / "scene.sog"
        path.write_bytes(by_hand_sog.zipped({each.name: each.read_bytes() for each in tmp_path.iterdir()}))
    scene = read_scene(path)
    assert (len(scene.splats), scene.splats.sh_degree) == (60, 0)


def test_nulls_in_a_tileset_are_none(tmp_path: Path) -> None:
    path = copied(tmp_path, "sh1-tiles/tileset.json")
    root = json.loads(path.read_text())
    root |= {"extensionsRequired": None, "properties": None}
    for tile in nodes(root["root"]):
        for key in ("children", "content", "transform", "refine", "extensions", "viewerRequestVolume", "contents"):
            tile.setdefault(key, None)
    path.write_text(json.dumps(root))
    expected = read_scene(GOLDEN / "sh1-tiles")
    assert (read_scene(path).splats.center == expected.splats.center).all()
    found, parts = read_parts(path), read_parts(GOLDEN / "sh1-tiles")
    assert found is not None
    assert parts is not None
    assert (found.counts == parts.counts).all()


# --- Fixtures ---------------------------------------------------------------------------------------------------------

SCRIPT = FIXTURES / "make_fixtures.py"


def test_fixtures_are_what_the_script_makes() -> None:
    done = subprocess.run([sys.executable, SCRIPT, "--check"], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "all as they should be\n", "")
