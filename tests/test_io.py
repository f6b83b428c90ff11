"""Inputs: formats by content, files that cannot be read, names in untrusted files, and companions."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from sparklod_cli.bake.identity import files_of
from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import FORMATS
from sparklod_cli.codecs.rad.rad_header import RadChunkEntry, RadHeader, pack_header
from sparklod_cli.io import files
from sparklod_cli.io.files import companions, leads_away
from sparklod_cli.io.reading import read_scene
from sparklod_cli.system.errors import FormatError, UnreadableError
from tests.conftest import FIXTURES, IS_ROOT, Capture
from tests.part_files import put_files

SAMPLES = {"PLY": "sh1.ply", "PLY ascii": "sh1-ascii.ply", "SPZ": "golden/sh3-v3.spz", "SPZ 4": "golden/hand-v4.spz"}
STREAMED = FIXTURES / "golden" / "sh1-streamed-sog"
TREE = str(FIXTURES / "golden" / "tree-v3.spz")

# --- Formats and unreadable files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [*(suffix for form in FORMATS for suffix in form.suffixes), ".PLY", ".dat", ""])
@pytest.mark.parametrize("kind", SAMPLES)
def test_the_content_decides_the_format_for_any_suffix(kind: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"scene{suffix}"
    path.write_bytes((FIXTURES / SAMPLES[kind]).read_bytes())
    assert read_scene(path).format.startswith(kind.split()[0])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "the file is empty"),
        (
            b"x",
            r"not a splat file that sparklod reads \(.*, 3D Tiles, glTF, checkpoint, SOG, GLB, KSPLAT, HIER, SPLAT\)",
        ),
        (b"plywood\n" * 99, "not a splat file"),
        (b"PLY\nformat ascii 1.0\n", "not a splat file"),
        (b"ply", "not a splat file"),
        (b"ply\n", "the PLY header does not end"),
        (b"\x1f", "not a splat file"),
        (b"\x1f\x8b\x08\x00", "cut short"),
        (b"PK\x03\x04" + bytes(100), "not a complete zip archive"),
        (b"\x28\xb5\x2f\xfd" + bytes(100), "not a splat file"),  # bare zstd
    ],
)
def test_files_of_no_known_format_are_refused_with_a_reason(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=reason):
        read_scene(path)


def test_missing_files_folders_and_files_without_permission_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="cannot be read: no such file"):
        read_scene(tmp_path / "missing.ply")
    for path in (tmp_path, tmp_path / ("n" * 300)):
        with pytest.raises(FormatError, match="cannot be read"):
            read_scene(path)
    if not IS_ROOT:
        (tmp_path / "scene.ply").touch(0)
        with pytest.raises(FormatError, match="cannot be read: permission denied"):
            read_scene(tmp_path / "scene.ply")


def test_a_scene_outlives_its_file(tmp_path: Path) -> None:
    """Binary PLY is memory-mapped; what is returned must not be."""
    path = tmp_path / "scene.ply"
    path.write_bytes((FIXTURES / "sh1.ply").read_bytes())
    splats = read_scene(path).splats
    before = splats.center.copy()
    path.write_bytes(bytes(path.stat().st_size))
    assert (splats.center == before).all()


def test_texts_must_be_regular_files_below_a_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text, pipe = tmp_path / "a.json", tmp_path / "pipe"
    text.write_bytes(b"\xef\xbb\xbf{}")
    assert files.read_text(text) == "{}"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, Path("/dev/zero"), Path("/dev/null"), tmp_path / "missing"):
        with pytest.raises(UnreadableError, match=re.escape(f"{path} cannot be read: ")):
            files.read_text(path)
    monkeypatch.setattr(files, "MAX_TEXT", 5)
    assert files.read_text(text) == "{}"
    text.write_bytes(b"123456")
    with pytest.raises(UnreadableError, match="is larger than"):
        files.read_text(text)


@pytest.mark.parametrize("option", ["--scene", "--camera-path", "--world-transform"])
@pytest.mark.parametrize("source", ["/dev/zero", "/dev/null"])
def test_no_command_reads_a_device(option: str, source: str, capsys: Capture) -> None:
    tree = [] if option == "--scene" else [TREE]
    cameras = ["--orbit", "2"] if option == "--scene" else []
    more = ["--camera-path", str(FIXTURES / "cameras" / "sparklod.json")] if option == "--world-transform" else []
    assert run(["traverse", *tree, *cameras, *more, option, source]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {source} cannot be read: it is a pipe or a device")


# --- Suggestions for missing inputs -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "missing", "meant"),
    [
        (["build-lod", "X"], "scen.ply", "scene.ply"),
        (["inspect", "X"], "scene.pyl", "scene.ply"),
        (["render", "X"], "Scene.ply", "scene.ply"),
        (["view", "X"], "scene.ply2", "scene.ply"),
        (["view", "X"], "wbe-lod", "web-lod"),
        (["traverse", TREE, "--camera-path", "X"], "paht.json", "path.json"),
        (["inspect", TREE, "--expect", "X"], "pth.json", "path.json"),
        (["inspect", "X"], "scene.spz", "scene.ply"),
        (["build-lod", "scene.ply", "--rgba", "X"], "pth.json", "path.json"),
        (["inspect", "X"], "other.spz", None),
        (["inspect", "X"], "no/scene.ply", None),
        (["inspect", "X"], "s.ply", None),
    ],
)
def test_a_missing_input_suggests_a_similar_name(
    command: list[str],
    missing: str,
    meant: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    (tmp_path / "web-lod").mkdir()
    (tmp_path / "path.json").write_text("{}")
    (tmp_path / "scene.ply").write_bytes((FIXTURES / "one.ply").read_bytes())
    monkeypatch.chdir(tmp_path)
    for folder in ("", f"{tmp_path}/"):
        assert run([f"{folder}{missing}" if each == "X" else each for each in command]) == 1
        message = "cannot be read: no such file or directory" + ", did you mean " * (meant is not None)
        ending = f"{meant if command == ['view', 'X'] else f'{folder}{meant}'}?\n" if meant else f"{message}\n"
        err = capsys.readouterr().err
        assert message in err and err.endswith(ending)


# --- Files that are read together -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "folders_allowed"),
    [
        *((name, True) for name in ("0_0/meta.json", "a/b/c", "..a/b")),
        *((name, False) for name in ("/a", "a/../b", "../a", "a//b", "a/", "./a", "a/.", "c:/a", "a\\b/c", "", "..")),
        ("http://x/y", False),
    ],
)
def test_names_in_files_must_not_lead_out_of_their_folder(name: str, folders_allowed: bool) -> None:
    assert leads_away(name)
    assert leads_away(name, folders=True) is not folders_allowed


@pytest.mark.parametrize("path", [STREAMED, STREAMED / "lod-meta.json"])
def test_all_files_of_a_streamed_sog_are_companions(path: Path) -> None:
    found = [Path(str(each)).relative_to(STREAMED).as_posix() for each in files_of(path)]
    assert sorted(found) == sorted(each.relative_to(STREAMED).as_posix() for each in STREAMED.rglob("*.*"))


def test_a_manifest_that_names_itself_and_files_elsewhere_has_companions(tmp_path: Path) -> None:
    names = ["lod-meta.json", "../x/meta.json", "0_0/meta.json"]
    manifest = json.dumps({"lodLevels": 1, "filenames": names, "tree": {}}).encode()
    chunk = {"0_0/means_l.webp": b"", "0_0/meta.json": b'{"means": {"files": ["means_l.webp"]}}'}
    put_files(tmp_path, chunk | {"lod-meta.json": manifest, "meta.json": b"{}"})
    found = [path.relative_to(tmp_path).as_posix() for path in companions(tmp_path / "lod-meta.json", ())]
    assert found == ["lod-meta.json", "0_0/meta.json", "0_0/means_l.webp"]
    assert files_of(tmp_path)[0] == tmp_path / "lod-meta.json"  # also with a meta.json beside it


def test_chunk_files_beside_a_rad_header_are_its_companions(tmp_path: Path) -> None:
    entries = tuple(RadChunkEntry(0, 8, name) for name in ("y-0.radc", "../away.radc", "missing.radc", "y-1.radc"))
    data = pack_header(RadHeader(100, 0, True, 65536, 32, entries))
    put_files(tmp_path, dict.fromkeys(("sub/y-0.radc", "sub/y-1.radc", "away.radc"), b"") | {"sub/x.rad": data})
    header = tmp_path / "sub" / "x.rad"
    assert [path.name for path in companions(header, [])] == ["y-0.radc", "y-1.radc"]
    for cut in (4, 8, 100):
        header.write_bytes(data[:cut])
        assert companions(header, []) == []
