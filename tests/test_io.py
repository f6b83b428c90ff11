"""Files are told by what is in them, whatever they are called, and what cannot be read is said."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import FORMATS
from sparklod_cli.io import local_files
from sparklod_cli.io.reading import read_scene
from sparklod_cli.system.errors import FormatError, UnreadableError
from tests.conftest import FIXTURES, IS_ROOT

SAMPLES = {"PLY": "sh1.ply", "PLY ascii": "sh1-ascii.ply", "SPZ": "golden/sh3-v3.spz", "SPZ 4": "golden/hand-v4.spz"}


@pytest.mark.parametrize("suffix", [*(suffix for form in FORMATS for suffix in form.suffixes), ".PLY", ".dat", ""])
@pytest.mark.parametrize("kind", SAMPLES)
def test_the_content_decides_the_format_whatever_the_suffix(kind: str, suffix: str, tmp_path: Path) -> None:
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
def test_files_that_are_not_splat_files_are_refused_with_a_reason(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=reason):
        read_scene(path)


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="cannot be read: no such file"):
        read_scene(tmp_path / "missing.ply")
    with pytest.raises(FormatError, match="cannot be read"):
        read_scene(tmp_path)
    with pytest.raises(FormatError, match="cannot be read"):
        read_scene(tmp_path / ("n" * 300))


@pytest.mark.skipif(IS_ROOT, reason="root may read everything")
def test_a_file_without_permission_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes((FIXTURES / "one.ply").read_bytes())
    path.chmod(0)
    with pytest.raises(FormatError, match="cannot be read: permission denied"):
        read_scene(path)


def test_a_scene_outlives_its_file(tmp_path: Path) -> None:
    """Binary PLY is memory-mapped; what is returned must not be."""
    path = tmp_path / "scene.ply"
    path.write_bytes((FIXTURES / "sh1.ply").read_bytes())
    splats = read_scene(path).splats
    before = splats.center.copy()
    path.write_bytes(bytes(path.stat().st_size))
    assert (splats.center == before).all()


def test_texts_must_be_regular_files_below_a_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is named, what is read is bounded, and nothing waits for what never comes."""
    text, pipe = tmp_path / "a.json", tmp_path / "pipe"
    text.write_bytes(b"\xef\xbb\xbf{}")
    assert local_files.read_text(text) == "{}"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, Path("/dev/zero"), Path("/dev/null"), tmp_path / "missing"):
        with pytest.raises(UnreadableError, match=re.escape(f"{path} cannot be read: ")):
            local_files.read_text(path)
    monkeypatch.setattr(local_files, "MAX_TEXT", 5)
    assert local_files.read_text(text) == "{}"
    text.write_bytes(b"123456")
    with pytest.raises(UnreadableError, match="is larger than"):
        local_files.read_text(text)


@pytest.mark.parametrize("option", ["--scene", "--camera-path", "--world-transform"])
@pytest.mark.parametrize("source", ["/dev/zero", "/dev/null"])
def test_no_command_reads_a_device(option: str, source: str, capsys: pytest.CaptureFixture[str]) -> None:
    tree = [] if option == "--scene" else [str(FIXTURES / "golden" / "hand-tree-v3.spz")]
    cameras = ["--orbit", "2"] if option == "--scene" else []
    more = ["--camera-path", str(FIXTURES / "cameras" / "sparklod.json")] if option == "--world-transform" else []
    assert run(["traverse", *tree, *cameras, *more, option, source]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {source} cannot be read: it is a pipe or a device")
