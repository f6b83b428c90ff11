"""`sparklod build-lod` with inputs and outputs at addresses: the same bytes as with paths."""

from __future__ import annotations

import json
import uuid
from pathlib import Path

import pytest

pytest.importorskip("fsspec")

from sparklod_cli.system.addresses import Address
from tests.commands.build_lod.runs import SMALL, build, convert
from tests.conftest import FIXTURES, Capture

pytestmark = pytest.mark.slow


@pytest.fixture
def folder() -> Address:
    return Address(f"memory://{uuid.uuid4().hex}")


@pytest.fixture
def scan(folder: Address) -> Address:
    place = folder / "scan.ply"
    place.write([SMALL.read_bytes()])
    return place


def content(place: Address) -> bytes:
    with place.open() as file:
        return file.read()


@pytest.mark.parametrize("form", ["spz", "rad", "rad-chunked"])
def test_the_bytes_are_those_of_paths(form: str, scan: Address, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "scan.ply"
    path.write_bytes(SMALL.read_bytes())
    assert build(path, "--format", form) == 0
    assert build(scan.url, "--format", form, "--json") == 0
    made = json.loads(capsys.readouterr().out)
    suffix = "spz" if form == "spz" else "rad"
    assert (made["input"], made["output"]) == (scan.url, (scan.parent / f"scan-lod.{suffix}").url)
    for each in tmp_path.glob("scan-lod*"):
        assert content(scan.parent / each.name) == each.read_bytes()
    assert len(scan.parent.files()) == len(list(tmp_path.iterdir()))


@pytest.mark.parametrize("name", ["sh1-ascii.ply", "golden/sh3-v2.sog", "golden/hand-v4.spz", "golden/sh0.splat"])
def test_each_way_of_reading_is_possible(name: str, folder: Address, tmp_path: Path) -> None:
    (folder / name).write([(FIXTURES / name).read_bytes()])
    assert build((folder / name).url, "-o", tmp_path / "at.spz") == 0
    assert build(FIXTURES / name, "-o", tmp_path / "path.spz") == 0
    assert (tmp_path / "at.spz").read_bytes() == (tmp_path / "path.spz").read_bytes()


def test_outputs_go_into_a_folder(folder: Address, tmp_path: Path) -> None:
    assert build(SMALL, "--output-dir", (folder / "web").url) == 0
    assert folder.files() == ["web/sh2-lod.spz"]
    assert convert((folder / "web/sh2-lod.spz").url, f"file://{tmp_path}/back.ply") == 0
    assert (tmp_path / "back.ply").is_file()


def test_a_folder_of_sog_is_written(folder: Address) -> None:
    tree, meta = folder / "tree.spz", folder / "web/meta.json"
    assert build(SMALL, "-o", tree.url) == 0
    assert convert(tree.url, meta.url) == 0
    names = ["means_l.webp", "means_u.webp", "meta.json", "quats.webp", "scales.webp", "sh0.webp"]
    assert meta.parent.files() == sorted([*names, "shN_centroids.webp", "shN_labels.webp"])
    assert convert(tree.url, meta.url) == 1
    assert convert(tree.url, meta.url, "-f") == 0


def test_an_output_is_replaced_only_where_that_is_asked_for(scan: Address, capsys: Capture) -> None:
    for form, name in (("spz", "scan-lod.spz"), ("rad-chunked", "scan-lod.rad")):
        options = [scan.url, "--format", form]
        assert build(*options) == 0
        assert build(*options) == 1
        assert f"{scan.parent / name} exists, add --overwrite to replace it" in capsys.readouterr().err
        assert build(*options, "--overwrite") == 0


def test_chunks_of_a_longer_output_go_and_chunks_without_a_header_are_refused(scan: Address, capsys: Capture) -> None:
    old, other = scan.parent / "scan-lod-7.radc", scan.parent / "scan-lod-old.radc"
    for place in (old, other):
        place.write([b"old"])
    assert build(scan.url, "--format", "rad-chunked") == 1
    assert f"{old} exists" in capsys.readouterr().err
    assert build(scan.url, "--format", "rad-chunked", "-f") == 0
    assert scan.parent.files() == ["scan-lod-0.radc", "scan-lod-old.radc", "scan-lod.rad", "scan.ply"]


def test_nothing_stays_of_an_output_that_fails(scan: Address, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Address.write

    def refused(self: Address, pieces: object) -> int:
        if self.name == "scan-lod.rad":
            raise ConnectionResetError(104, "reset by peer")
        return write(self, pieces)  # type: ignore[arg-type]

    monkeypatch.setattr(Address, "write", refused)
    assert build(scan.url, "--format", "rad-chunked") == 1
    assert scan.parent.files() == ["scan.ply"]


def test_what_cannot_be_is_said(scan: Address, folder: Address, capsys: Capture) -> None:
    for arguments, said in (
        ([folder / "none.ply"], f"{folder}/none.ply: cannot be read: no such file"),
        ([SMALL, "-o", "https://host/x.spz?secret=1"], "cannot write https://host/x.spz?***: https:// is for reading"),
        (["s4://bucket/scan.ply"], "addresses of s4:// cannot be opened"),
        (
            [scan, "-o", scan.parent / "scan.png"],
            "written as SPZ, RAD, Streamed SOG or 3D Tiles, not as .png",
        ),
    ):
        assert build(*(each.url if isinstance(each, Address) else each for each in arguments)) != 0
        assert said in capsys.readouterr().err
    assert scan.parent.files() == ["scan.ply"]


def test_an_input_is_not_replaced(folder: Address, capsys: Capture) -> None:
    tree = folder / "tree.spz"
    tree.write([SMALL.read_bytes()])
    assert build(tree.url, "-o", tree.url, "-f") == 2
    assert f"{tree} is an input; name another output" in capsys.readouterr().err
