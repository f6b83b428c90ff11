"""The files of a Streamed SOG as outputs: where they go, what is refused, what is removed and what never is."""

from __future__ import annotations

import errno
import json
import os
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.identity import files_of
from sparklod_cli.io.local_files import companions, leads_away
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.io.writing import parts_output, siblings_of
from sparklod_cli.system import output as outputs
from sparklod_cli.system.addresses import Address
from sparklod_cli.system.errors import OutputError
from tests.conftest import FIXTURES
from tests.outputs import write_files
from tests.system.test_output_sets import held

posix = pytest.mark.skipif(os.name != "posix", reason="POSIX only")
GOLDEN = FIXTURES / "golden" / "sh1-streamed-sog"
GOLDEN_NAMES = sorted(path.relative_to(GOLDEN).as_posix() for path in GOLDEN.rglob("*") if path.is_file())


def output(*folders: str, mark: str = "") -> dict[str, bytes]:
    """What a codec writes, of one image a chunk: lod-meta.json comes last."""
    files = dict[str, bytes]()
    for folder in folders:
        files[f"{folder}/means_l.webp"] = f"image {folder}{mark}".encode()
        files[f"{folder}/meta.json"] = json.dumps({"means": {"files": ["means_l.webp"]}, "mark": mark}).encode()
    chunks = [f"{folder}/meta.json" for folder in folders if folder != "env"]
    meta = {"lodLevels": 1, "filenames": chunks, "tree": {"lods": {}}}
    environment = {"environment": "env/meta.json"} if "env" in folders else {}
    return files | {"lod-meta.json": json.dumps(meta | environment).encode()}


def pieces(files: dict[str, bytes]) -> Iterator[tuple[str, Iterable[bytes]]]:
    yield from ((name, [data]) for name, data in files.items())


def put(folder: Path, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def write(target: Path, files: dict[str, bytes], *, overwrite: bool = False) -> int:
    return write_files(parts_output(target, overwrite=overwrite), pieces(files))


@pytest.mark.parametrize("name", ["lod-meta.json", "web.json"])
def test_the_folders_of_chunks_stand_beside_the_manifest(name: str, tmp_path: Path) -> None:
    files = output("0_0", "0_1", "env")
    target = tmp_path / "new" / name
    assert write(target, files) == sum(map(len, files.values()))
    manifest = files.pop("lod-meta.json")
    assert held(target.parent) == files | {name: manifest}
    assert sorted(siblings_of(Path("lod-meta.json")).existing(target)) == sorted(files)


def test_a_former_output_is_replaced_and_its_further_chunks_are_removed(tmp_path: Path) -> None:
    target = tmp_path / "lod-meta.json"
    write(target, output("0_0", "0_1", "1_0", "env"))
    others = {"0_0/notes.txt": b"precious", "0_1/notes.txt": b"precious", "7_0/meta.json": b"{}", "x": b"precious"}
    others |= {"1_0/other.webp": b"precious, for no meta.json names it"}
    put(tmp_path, others)
    new = output("0_0", "2_0", mark="new")
    write(target, new, overwrite=True)
    assert held(tmp_path) == new | others
    assert not (tmp_path / "env").exists()


@pytest.mark.parametrize("unpacked_first", [False, True])
def test_an_environment_is_replaced_by_one_of_the_other_form(unpacked_first: bool, tmp_path: Path) -> None:
    unpacked = output("0_0", "env")
    manifest = unpacked["lod-meta.json"].replace(b"env/meta.json", b"env/env.sog")
    bundled = output("0_0") | {"env/env.sog": b"PK", "lod-meta.json": manifest}
    order = [unpacked, bundled] if unpacked_first else [bundled, unpacked]
    for overwrite, files in enumerate(order):
        write(tmp_path / "lod-meta.json", files, overwrite=bool(overwrite))
        assert held(tmp_path) == files


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["0_0/meta.json", "0_0/anything", "0_0", "0_1/x", "env/x"])
def test_what_is_not_of_a_former_output_is_in_the_way(name: str, overwrite: bool, tmp_path: Path) -> None:
    put(tmp_path, {name: b"precious"})
    folder = name.partition("/")[0]
    with pytest.raises(OutputError, match=rf"{folder} exists, and lod-meta\.json there does not name it; move it away"):
        write(tmp_path / "lod-meta.json", output("0_0", "0_1", "env"), overwrite=overwrite)
    assert held(tmp_path) == {name: b"precious"}


def test_the_first_chunk_is_looked_at_before_any_work(tmp_path: Path) -> None:
    put(tmp_path, {"0_0/x": b"precious", "env/x": b"precious"})
    with pytest.raises(OutputError, match="0_0 exists"):
        parts_output(tmp_path / "lod-meta.json", overwrite=True)
    (tmp_path / "0_0" / "x").unlink()
    write(tmp_path / "lod-meta.json", output("0_0"))  # an empty folder, and an env that the output has not
    assert (tmp_path / "env" / "x").read_bytes() == b"precious"


def test_an_existing_manifest_is_refused_before_any_work(tmp_path: Path) -> None:
    target = tmp_path / "lod-meta.json"
    write(target, output("0_0"))
    before = held(tmp_path)
    with pytest.raises(OutputError, match="exists, add --overwrite to replace it"):
        parts_output(target, overwrite=False)
    assert held(tmp_path) == before


@pytest.mark.parametrize(
    "names",
    [
        {"filenames": ["precious/meta.json", "../0_0/meta.json", "/0_0/meta.json", "0_0/../x", "0_0/x.txt"]},
        {"filenames": ["0_0/meta.json"], "environment": "precious/meta.json"},
    ],
)
def test_a_manifest_cannot_make_other_files_be_removed(names: dict[str, object], tmp_path: Path) -> None:
    meta = json.dumps({"a": {"files": ["photo.jpg", "../photo.webp", "../x/means.webp", "/tmp/x.webp", "means.webp"]}})
    precious = {"precious/meta.json": meta.encode(), "precious/photo.jpg": b"precious", "photo.webp": b"precious"}
    precious |= {"x/means.webp": b"precious", "precious/means.webp": b"precious"}
    put(tmp_path, precious | {"lod-meta.json": json.dumps({"lodLevels": 1, "tree": {"lods": {}}} | names).encode()})
    if "environment" in names:
        put(tmp_path, {"0_0/meta.json": meta.encode(), "0_0/photo.jpg": b"precious"})
        precious |= {"0_0/photo.jpg": b"precious"}
    write(tmp_path / "lod-meta.json", new := output("0_0"), overwrite=True)
    assert held(tmp_path) == precious | new


@posix
def test_a_link_to_a_folder_is_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "web" / "lod-meta.json"
    write(target, output("0_0", "1_0"))
    (tmp_path / "web" / "1_0").rename(tmp_path / "elsewhere")
    (tmp_path / "web" / "1_0").symlink_to(tmp_path / "elsewhere")
    before = held(tmp_path / "elsewhere")
    write(target, output("0_0"), overwrite=True)
    with pytest.raises(OutputError, match="1_0 exists"):
        write(target, output("0_0", "1_0"), overwrite=True)
    assert held(tmp_path / "elsewhere") == before
    assert (tmp_path / "web" / "1_0").is_symlink()


@posix
def test_where_a_link_leads_all_files_are_together(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    link = tmp_path / "web.json"
    link.symlink_to(tmp_path / "store" / "lod-meta.json")
    write(link, files := output("0_0"))
    assert held(tmp_path / "store") == files
    assert link.is_symlink()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
@pytest.mark.parametrize("existing", [False, True])
def test_an_error_on_the_way_leaves_what_was_there(error: BaseException, existing: bool, tmp_path: Path) -> None:
    target = tmp_path / "lod-meta.json"
    if existing:
        write(target, output("0_0", "0_1", "env"))
    before = held(tmp_path)

    def broken() -> Iterator[tuple[str, Iterable[bytes]]]:
        yield from list(pieces(output("0_0", "0_2")))[:-1]
        raise error

    with pytest.raises(KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else OutputError):
        write_files(parts_output(target, overwrite=existing), broken())
    assert held(tmp_path) == before


def test_a_folder_that_appears_meanwhile_is_named_by_the_error(tmp_path: Path) -> None:
    def some() -> Iterator[tuple[str, Iterable[bytes]]]:
        yield from pieces(output("0_0", "0_1"))
        put(tmp_path, {"0_1/meta.json": b"another's"})

    with pytest.raises(OutputError, match=r"meta\.json exists, add --overwrite"):
        write_files(parts_output(tmp_path / "lod-meta.json", overwrite=False), some())
    assert held(tmp_path) == {"0_1/meta.json": b"another's"}


def test_places_for_no_or_one_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a directory"):
        parts_output(tmp_path, overwrite=True)
    with pytest.raises(OutputError, match="standard output cannot take several files"):
        parts_output(Path("-"), overwrite=True)
    with pytest.raises(OutputError, match="is a pipe or a device"):
        parts_output(Path(os.devnull), overwrite=True)


# --- Addresses --------------------------------------------------------------------------------------------------------


@pytest.fixture
def address() -> Address:
    pytest.importorskip("fsspec")
    return Address(f"memory://{uuid.uuid4().hex}") / "lod-meta.json"


def held_at(address: Address) -> dict[str, bytes]:
    folder = address.parent
    return {name: (folder / name).read(0, (folder / name).size()) for name in folder.files()}


@pytest.mark.slow
def test_an_output_at_an_address_replaces_a_former_one(address: Address) -> None:
    old = output("0_0", "0_1", "env")
    assert write_files(parts_output(address, overwrite=False), pieces(old)) == sum(map(len, old.values()))
    assert held_at(address) == old
    with pytest.raises(OutputError, match="exists, add --overwrite"):
        parts_output(address, overwrite=False)
    (address.parent / "0_1/notes").write([b"precious"])
    new = output("0_0", "1_0", mark="new")
    write_files(parts_output(address, overwrite=True), pieces(new))
    assert held_at(address) == new | {"0_1/notes": b"precious"}


@pytest.mark.slow
def test_what_is_in_the_way_at_an_address_is_told_before_anything_is_removed(address: Address) -> None:
    write_files(parts_output(address, overwrite=False), pieces(output("0_0")))
    (address.parent / "2_0/meta.json").write([b"precious"])
    before = held_at(address)
    with pytest.raises(OutputError, match=r"2_0 exists, and lod-meta\.json there does not name it"):
        parts_output(address, overwrite=True)
    assert held_at(address) == before


@pytest.mark.slow
def test_what_was_sent_is_removed_where_the_rest_cannot_be_made(address: Address) -> None:
    def broken() -> Iterator[tuple[str, Iterable[bytes]]]:
        yield from list(pieces(output("0_0", "0_1")))[:-1]
        raise OSError(errno.EIO, "broken")

    with pytest.raises(OutputError, match=r"cannot write memory://.*: broken"):
        write_files(parts_output(address, overwrite=False), broken())
    assert held_at(address) == {}


@pytest.mark.slow
def test_an_output_at_an_address_is_read_from_there(address: Address) -> None:
    files = {name: (GOLDEN / name).read_bytes() for name in GOLDEN_NAMES if name != "lod-meta.json"}
    write_files(
        parts_output(address, overwrite=False),
        pieces(files | {"lod-meta.json": (GOLDEN / "lod-meta.json").read_bytes()}),
    )
    for place in (address, address.parent):
        np.testing.assert_array_equal(read_scene(place).splats.center, read_scene(GOLDEN).splats.center)
    assert read_parts(address.parent).counts.tolist() == read_parts(GOLDEN).counts.tolist()


# --- Files that are read together -------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", [GOLDEN, GOLDEN / "lod-meta.json"])
def test_all_files_of_the_folder_are_companions(path: Path) -> None:
    found = [each.relative_to(GOLDEN).as_posix() for each in map(Path, map(str, files_of(path)))]
    assert sorted(found) == GOLDEN_NAMES
    assert len(found) == len(set(found))


def test_a_manifest_that_names_itself_or_others_is_no_loop(tmp_path: Path) -> None:
    names = ["lod-meta.json", "../x/meta.json", "0_0/meta.json"]
    put(
        tmp_path,
        output("0_0") | {"lod-meta.json": json.dumps({"lodLevels": 1, "filenames": names, "tree": {}}).encode()},
    )
    found = [path.relative_to(tmp_path).as_posix() for path in companions(tmp_path / "lod-meta.json", ())]
    assert found == ["lod-meta.json", "0_0/meta.json", "0_0/means_l.webp"]


def test_a_folder_with_both_is_a_streamed_sog(tmp_path: Path) -> None:
    put(tmp_path, output("0_0") | {"meta.json": b"{}"})
    assert files_of(tmp_path)[0] == tmp_path / "lod-meta.json"


@pytest.mark.parametrize("name", ["0_0/meta.json", "a/b/c", "..a/b"])
def test_names_with_folders_lead_away_unless_they_may_have_them(name: str) -> None:
    assert leads_away(name)
    assert not leads_away(name, folders=True)


@pytest.mark.parametrize(
    "name", ["/a", "a/../b", "../a", "a//b", "a/", "./a", "a/.", "c:/a", "a\\b/c", "http://x/y", "", ".."]
)
def test_names_that_lead_away_with_folders_too(name: str) -> None:
    assert leads_away(name, folders=True)


@pytest.fixture(autouse=True)
def first_run() -> None:
    outputs.sweep.cache_clear()
