"""Zips of a scene's files: read as the folder that they are, or refused by name; never the first of several."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.merging import ZipFolder
from sparklod_cli.codecs.streamed_manifest import parse
from sparklod_cli.io.reading import open_reader, read_parts, read_scene
from sparklod_cli.system.errors import FormatError, NotSplatsError
from sparklod_cli.viewers.playcanvas import read_detail_files
from tests.codecs.cases import assert_same
from tests.conftest import FIXTURES, Capture

GOLDEN = FIXTURES / "golden"
SETS = {name: GOLDEN / name for name in ("sh1-sog", "sh1-streamed-sog", "sh1-tiles")}


def files_in(folder: Path) -> dict[str, bytes]:
    return {each.relative_to(folder).as_posix(): each.read_bytes() for each in folder.rglob("*") if each.is_file()}


def zipped(path: Path, files: dict[str, bytes], *, method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def assert_holds(path: Path, kind: str, **how: int) -> None:
    found, expected = read_scene(path, **how), read_scene(SETS[kind])
    assert found.format == expected.format
    assert_same(found.splats, expected.splats)


WAYS: dict[str, Callable[[dict[str, bytes]], dict[str, bytes]]] = {
    "as it is": lambda files: files,
    "reversed": lambda files: dict(reversed(files.items())),
    "in a folder": lambda files: {f"scene/{name}": data for name, data in files.items()},
    "of Finder": lambda files: {f"s/{name}": data for name, data in files.items()} | {"__MACOSX/s/._meta.json": b"\0"},
    "of Windows": lambda files: {name.replace("/", "\\"): data for name, data in files.items()},
    "of here": lambda files: {f"./{name}": data for name, data in files.items()},
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", SETS)
def test_a_zip_is_read_as_its_folder(kind: str, way: str, tmp_path: Path) -> None:
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        path = zipped(tmp_path / "scene.ssog", WAYS[way](files_in(SETS[kind])), method=method)
        for threads in (1, 3):
            assert_holds(path, kind, threads=threads)


@pytest.mark.parametrize("kind", ["sh1-streamed-sog", "sh1-tiles"])
def test_a_zip_has_the_levels_and_sizes_of_its_folder(kind: str, tmp_path: Path) -> None:
    path = zipped(tmp_path / "scene.zip", files_in(SETS[kind]))
    found, expected = read_parts(path), read_parts(SETS[kind])
    assert found is not None and expected is not None
    np.testing.assert_array_equal(found.splats.center, expected.splats.center)
    np.testing.assert_array_equal(found.counts, expected.counts)
    if kind == "sh1-streamed-sog":
        requests = read_detail_files(path).requests
        assert requests == read_detail_files(SETS[kind]).requests
        assert min(map(min, requests)) > 0


def test_bundles_in_a_zip_are_read(tmp_path: Path) -> None:
    """Chunks that are .sog themselves, all in one folder, whose sizes are their own."""
    files = files_in(SETS["sh1-streamed-sog"])
    folders = sorted({name.partition("/")[0] for name in files if name.endswith("/meta.json")})
    (tmp_path / "flat").mkdir()
    manifest = files["lod-meta.json"]
    for folder in folders:
        members = {name.partition("/")[2]: data for name, data in files.items() if name.startswith(f"{folder}/")}
        zipped(tmp_path / "flat" / f"{folder}.sog", members)
        manifest = manifest.replace(f"{folder}/meta.json".encode(), f"{folder}.sog".encode())
    (tmp_path / "flat" / "lod-meta.json").write_bytes(manifest)
    path = zipped(tmp_path / "scene.ssog", files_in(tmp_path / "flat"))
    assert_holds(path, "sh1-streamed-sog")
    requests = read_detail_files(tmp_path / "flat").requests
    assert requests == read_detail_files(path).requests
    assert requests == [((tmp_path / "flat" / name).stat().st_size,) for name in parse(manifest).names()]


def test_commands_read_a_zipped_streamed_sog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.chdir(tmp_path)
    zipped(tmp_path / "scene.ssog", files_in(SETS["sh1-streamed-sog"]))
    count = len(read_scene(SETS["sh1-streamed-sog"]).splats)
    assert run(["inspect", "--json", "scene.ssog"]) == 0
    assert f'"splats": {count}' in capsys.readouterr().out
    assert run(["build-lod", "scene.ssog", "-o", "tree.spz", "-q"]) == 0
    tree = read_scene(Path("tree.spz")).tree
    assert tree is not None
    assert int(tree.is_leaf.sum()) == count
    with open_reader(Path("scene.ssog")) as stream:
        assert sum(map(len, stream.blocks(0, stream.count))) == count
    assert run(["view", "scene.ssog", "--export", "site"]) == 1
    assert "viewers do not read lod-meta.json in a zip; unzip it" in capsys.readouterr().err
    assert not Path("site").exists()


SOG, STREAMED, TILES = map(files_in, SETS.values())


@pytest.mark.parametrize(
    ("files", "named"),
    [
        ({"kitchen/meta.json": b"{}", "bath/meta.json": b"{}"}, "'kitchen/meta.json', 'bath/meta.json'"),
        (SOG | {"old/meta.json": b"{}"}, "meta.json"),
        (STREAMED | {"meta.json": b"{}"}, "'meta.json'"),
        (STREAMED | {"tileset.json": b"{}"}, "'tileset.json'"),
        (STREAMED | {"0_0/lod-meta.json": b"{}"}, "'0_0/lod-meta.json'"),
        (TILES | {"tiles/meta.json": b"{}"}, "'tiles/meta.json'"),
        ({f"{folder}/{name}": data for folder in "ab" for name, data in STREAMED.items()}, "'a/lod-meta.json'"),
        ({f"{number}/meta.json": b"{}" for number in range(9)}, r"'0/meta.json', '1/meta.json', '2/meta.json', \.\.\."),
    ],
)
def test_several_scenes_in_a_zip_are_refused_by_name(files: dict[str, bytes], named: str, tmp_path: Path) -> None:
    for order in (files, dict(reversed(files.items()))):
        with pytest.raises(NotSplatsError, match=r"a zip archive of several scenes \(.*\): unzip it") as caught:
            read_scene(zipped(tmp_path / "scene.sog", order))
        if order is files:
            assert caught.match(named)


def test_a_zip_of_a_folder_of_scans_is_said_to_be_unzipped(tmp_path: Path) -> None:
    path = zipped(tmp_path / "scans.zip", {"scans/": b"", "scans/room.ply": b"ply\n"})
    with pytest.raises(NotSplatsError, match=r"a zip archive \('scans/room.ply'\) without meta.json, .*: unzip it"):
        read_scene(path)
    with pytest.raises(NotSplatsError, match="unzip it"):
        ZipFolder(io.BytesIO(zipped(path, {"x/": b""}).read_bytes()))


def test_a_manifest_in_a_zip_is_held_to_its_format(tmp_path: Path) -> None:
    for data, reason in (
        (b"{}", "not a splat file"),
        (b'{"lodLevels": 1}', "filenames of lod-meta.json: expected a list, but it is missing"),
    ):
        with pytest.raises(FormatError, match=reason):
            read_scene(zipped(tmp_path / "scene.zip", {"lod-meta.json": data}))
    missing = {name: data for name, data in STREAMED.items() if not name.startswith("0_0/")}
    with pytest.raises(FormatError, match=r"'0_0/meta\.json', which is not in the archive"):
        read_scene(zipped(tmp_path / "scene.zip", missing))
    damaged = bytearray(zipped(tmp_path / "scene.zip", STREAMED).read_bytes())
    at = damaged.index(b"RIFF", damaged.index(b"0_0/means_l.webp"))
    damaged[at + 60] ^= 255
    (tmp_path / "scene.zip").write_bytes(damaged)
    with pytest.raises(FormatError, match="cannot be unpacked: Bad CRC"):
        read_scene(tmp_path / "scene.zip")


@pytest.mark.parametrize("others", [("tileset.json",), ("meta.json",), ("tileset.json", "meta.json")])
def test_a_folder_of_several_scenes_is_refused_by_name(others: tuple[str, ...], tmp_path: Path) -> None:
    for name, data in (STREAMED | dict.fromkeys(others, b"{}")).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    with pytest.raises(FormatError, match=f"a directory with lod-meta.json and {others[0]}.*; give one of them"):
        read_scene(tmp_path)
    assert_holds(tmp_path / "lod-meta.json", "sh1-streamed-sog")
