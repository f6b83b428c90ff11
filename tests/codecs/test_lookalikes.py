"""Files that are no splats are called what they are; JSON is told by its keys, with or without a byte order mark."""

from __future__ import annotations

import codecs
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import HEAD, JSON_HEAD, head_of, sniff
from sparklod_cli.io.local_files import read_text
from sparklod_cli.io.reading import read_scene
from sparklod_cli.system.errors import FormatError, SparklodError
from tests.conftest import FIXTURES, Capture

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


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_texts_of_users_may_have_a_byte_order_mark(encoding: str, tmp_path: Path) -> None:
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": [{"transform_matrix": matrix}]}), encoding)
    assert run(["traverse", str(TREE), "--camera-path", str(path), "-o", str(tmp_path / "t.csv")]) == 0
    instances = tmp_path / "instances.json"
    instances.write_text(json.dumps({"instances": [{"file": str(TREE)}]}), encoding)
    assert read_text(instances).startswith("{")
    expect = tmp_path / "expect.txt"
    expect.write_text("bytes<=10", encoding)
    assert read_text(expect) == "bytes<=10"


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


def replaced(folder: Path, manifest: str, pattern: str) -> Path:
    path = copied(folder, manifest)
    next(iter(sorted(folder.glob(pattern)))).write_bytes(POINTER)
    return path


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
    with pytest.raises(FormatError, match="a Git LFS pointer; run git lfs pull"):
        read_scene(replaced(tmp_path, name, pattern))


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
