"""Outputs: one file, or a header with files beside it, appear whole or not at all and replace only their own files."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import stat
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.codecs import formats
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.io.writing import parts_output, siblings_of
from sparklod_cli.system import output as outputs
from sparklod_cli.system.addresses import Address
from sparklod_cli.system.errors import FormatError, OutputError
from sparklod_cli.system.output import Output, check_writable, write_file
from tests.conftest import FIXTURES, IS_ROOT
from tests.part_files import put_files
from tests.scenes import write_files
from tests.system.test_output import has_unnamed_files, held

posix = pytest.mark.skipif(os.name != "posix", reason="POSIX only")
Files = dict[str, bytes]


@pytest.fixture(autouse=True)
def first_run() -> None:
    outputs.sweep.cache_clear()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# --- One file ---------------------------------------------------------------------------------------------------------


def test_pieces_become_a_file_which_only_overwrite_replaces(tmp_path: Path) -> None:
    target = tmp_path / "out.spz"
    assert write_file(target, [b"ab", b"", b"cde"], overwrite=False) == 5
    with pytest.raises(OutputError, match=r"out\.spz exists, add --overwrite to replace it"):
        write_file(target, [b"new"], overwrite=False)
    assert target.read_bytes() == b"abcde"
    target.chmod(0o600)
    before = target.stat().st_ino
    assert write_file(target, [b"new"], overwrite=True) == 3
    assert target.read_bytes() == b"new"
    assert target.stat().st_mode & 0o777 == 0o600  # as before
    assert target.stat().st_ino != before  # a new file in place of the old one
    assert names(tmp_path) == ["out.spz"]


def test_folders_are_made_when_there_is_something_to_write(tmp_path: Path) -> None:
    target, link = tmp_path / "a" / "b" / "out.spz", tmp_path / "link.spz"
    check_writable(target, overwrite=False)
    assert names(tmp_path) == []
    write_file(target, [b"x"], overwrite=False)
    link.symlink_to(tmp_path / "c" / "out.spz")
    write_file(link, [b"y"], overwrite=False)
    assert (target.read_bytes(), (tmp_path / "c" / "out.spz").read_bytes()) == (b"x", b"y")


@pytest.mark.parametrize("error", [RuntimeError("broken"), MemoryError(), KeyboardInterrupt(), SystemExit(3)])
@pytest.mark.parametrize("existing", [False, True])
def test_an_interrupted_file_leaves_the_former_one(error: BaseException, existing: bool, tmp_path: Path) -> None:
    def pieces() -> Iterator[bytes]:
        yield b"half a"
        raise error

    old = {"out.spz": b"old"} if existing else {}
    put_files(tmp_path, old)
    with pytest.raises(type(error)):
        write_file(tmp_path / "out.spz", pieces(), overwrite=True)
    assert held(tmp_path) == old


@pytest.mark.parametrize("named", [False, True])
def test_no_file_has_its_final_name_before_it_is_whole(
    named: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if named:
        monkeypatch.setattr(outputs, "UNNAMED", None)
    elif not has_unnamed_files(tmp_path):
        pytest.skip("no files without names here")
    seen: list[list[str]] = []

    def pieces() -> Iterator[bytes]:
        for _ in range(2):
            seen.append(names(tmp_path))
            yield b"x"

    write_file(tmp_path / "out.spz", pieces(), overwrite=False)
    assert [len(files) for files in seen] == [int(named)] * 2
    assert all("out.spz" not in files for files in seen)
    if named:  # hidden, and beside the target: a rename does not cross file systems
        assert seen[0][0].startswith(".sparklod-")


def test_concurrent_writers_of_one_name_do_not_share_a_temporary_file(tmp_path: Path) -> None:
    target = tmp_path / "out.spz"

    def pieces() -> Iterator[bytes]:
        yield b"outer"
        write_file(target, [b"inner"], overwrite=True)

    write_file(target, pieces(), overwrite=True)
    assert held(tmp_path) == {"out.spz": b"outer"}


@posix
@pytest.mark.parametrize("existing", [False, True])
def test_a_symbolic_link_is_followed(existing: bool, tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    real, link = tmp_path / "store" / "real.spz", tmp_path / "link.spz"
    if existing:
        real.write_bytes(b"old")
    link.symlink_to(real)
    write_file(link, [b"new"], overwrite=existing)
    assert link.is_symlink()
    assert real.read_bytes() == b"new"
    assert (names(tmp_path), names(tmp_path / "store")) == (["link.spz", "store"], ["real.spz"])


@posix
def test_devices_and_pipes_are_written_to_and_not_replaced(tmp_path: Path) -> None:
    null, pipe = Path(os.devnull), tmp_path / "pipe"
    assert write_file(null, [b"gone"], overwrite=False) == 4
    assert stat.S_ISCHR(null.stat().st_mode)
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        assert write_file(pipe, [b"through"], overwrite=False) == 7
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert names(tmp_path) == ["pipe"]


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="there is no /dev/fd here")
def test_a_pipe_is_written_to_by_its_number() -> None:
    """What a shell makes of `-o >(upload)`, and /dev/stdout in a pipeline: a link to nothing that has a path."""
    reader, writer = os.pipe()
    try:
        assert write_file(Path(f"/dev/fd/{writer}"), [b"through"], overwrite=False) == 7
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
        os.close(writer)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("size", [1, 1_000_000])
def test_a_full_disk_is_an_error(size: int) -> None:
    with pytest.raises(OutputError, match="cannot write /dev/full: no space left on device"):
        write_file(Path("/dev/full"), [bytes(size)], overwrite=False)
    assert stat.S_ISCHR(Path("/dev/full").stat().st_mode)


@posix
def test_a_file_that_exceeds_its_size_limit_leaves_nothing(tmp_path: Path) -> None:
    code = (
        "import resource, signal, sys, pathlib\n"
        "from sparklod_cli.system.errors import OutputError\n"
        "from sparklod_cli.system.output import write_file\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try:\n"
        "    write_file(pathlib.Path(sys.argv[1]), [bytes(400)] * 1000, overwrite=False)\n"
        "except OutputError as error:\n"
        "    print(error)\n"
    )
    target = tmp_path / "out.spz"
    done = subprocess.run([sys.executable, "-c", code, target], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == (f"cannot write {target}: file too large\n", "")
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("directory", "is a directory"),
        ("file/out.spz", "is a file, not a folder"),
        ("file/missing/out.spz", "is a file, not a folder"),
        ("n" * 300, "file name too long"),
        pytest.param("closed/out.spz", "permission denied", marks=pytest.mark.skipif(IS_ROOT, reason="root may write")),
    ],
)
def test_impossible_paths_are_errors_before_and_while_writing(name: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "directory").mkdir()
    (tmp_path / "closed").mkdir(0o500)
    with pytest.raises(OutputError, match=reason):
        check_writable(tmp_path / name, overwrite=True)
    with pytest.raises(OutputError, match=reason):
        write_file(tmp_path / name, [b"x"], overwrite=True)
    assert names(tmp_path) == ["closed", "directory", "file"]


@pytest.mark.parametrize("length", [200, 241, 250, 255])
def test_names_up_to_the_limit_of_the_file_system_are_written(length: int, tmp_path: Path) -> None:
    """The name of the temporary file contains the name of the file, and must not be too long because of that."""
    target = tmp_path / ("n" * (length - 4) + ".spz")
    write_file(target, [b"x"], overwrite=False)
    assert names(tmp_path) == [target.name]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_full_standard_output_is_an_error_of_one_line() -> None:
    code = (
        "from sparklod_cli.cli import main\nimport sys\n"
        f"sys.argv = ['sparklod', 'build-lod', {str(FIXTURES / 'one.ply')!r}, '-q', '-o', '-']\nmain()"
    )
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, timeout=300)
    lines = [line for line in done.stderr.splitlines() if not line.lower().startswith(("compiling", "compiled"))]
    assert done.returncode == 1
    assert len(lines) == 1, done.stderr
    assert "cannot write standard output: no space left on device" in lines[0]


@pytest.mark.parametrize("kind", ["path", pytest.param("address", marks=pytest.mark.slow)])
def test_a_file_grows_by_each_call_and_appears_at_the_end(kind: str, tmp_path: Path) -> None:
    place: Path | Address = tmp_path / "out.spz"
    if kind == "address":
        pytest.importorskip("fsspec")
        place = Address(f"memory://{uuid.uuid4().hex}") / "out.spz"
    for content, error in ((b"whole", None), (b"other", KeyboardInterrupt()), (b"other", FormatError("too large"))):
        out = Output(place, overwrite=error is not None)
        with contextlib.suppress(KeyboardInterrupt, FormatError), out:
            assert [out.write("out.spz", [content[:2]]), out.write("out.spz", [content[2:4], content[4:]])] == [2, 3]
            assert place.exists() == (error is not None)
            if error is not None:
                raise error
        with place.open("rb") as file:
            assert file.read() == b"whole"
    assert names(tmp_path) == ([] if kind == "address" else ["out.spz"])


# --- A header and the files beside it ---------------------------------------------------------------------------------


def rad(count: int = 2, stem: str = "x") -> Files:
    """Chunk files and their header."""
    chunks = {formats.rad_chunk_name(stem, number): f"chunk {number}".encode() for number in range(count)}
    return chunks | {f"{stem}.rad": b"header"}


def streamed(*folders: str, mark: str = "") -> Files:
    """A Streamed SOG of one image a chunk."""
    files = Files()
    for folder in folders:
        files[f"{folder}/means_l.webp"] = f"image {folder}{mark}".encode()
        files[f"{folder}/meta.json"] = json.dumps({"means": {"files": ["means_l.webp"]}, "mark": mark}).encode()
    chunks = [f"{folder}/meta.json" for folder in folders if folder != "env"]
    meta = {"lodLevels": 1, "filenames": chunks, "tree": {"lods": {}}}
    environment = {"environment": "env/meta.json"} if "env" in folders else {}
    return files | {"lod-meta.json": json.dumps(meta | environment).encode()}


#: By format: the header, and files of an output.
SETS: dict[str, tuple[str, Files]] = {
    "RAD": ("x.rad", rad(12)),
    "Streamed SOG": ("lod-meta.json", streamed("0_0", "0_1", "env")),
    "SOG": ("meta.json", {"means_l.webp": b"", "shN_labels.webp": b"labels", "meta.json": b"{}"}),
}
EVERY_SET = pytest.mark.parametrize(("header", "files"), SETS.values(), ids=SETS)


def output(path: Path | Address, *, overwrite: bool = False) -> Output:
    if path.suffix == ".json" and path.name != "meta.json":
        return parts_output(path, overwrite=overwrite)
    return Output(path, overwrite=overwrite, siblings=siblings_of(path))


def pieces_of(files: Files) -> Iterator[tuple[str, Iterable[bytes]]]:
    yield from ((name, [data[:3], data[3:]]) for name, data in files.items())


def write(path: Path | Address, files: Files, *, overwrite: bool = False) -> int:
    return write_files(output(path, overwrite=overwrite), pieces_of(files))


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *(("RAD", name) for name in ("x.rad", "x.RAD", "x")),
        *(("Streamed SOG", name) for name in ("lod-meta.json", "web.json")),
        ("SOG", "meta.json"),
    ],
)
def test_files_are_written_beside_the_header(kind: str, name: str, tmp_path: Path) -> None:
    header, files = SETS[kind]
    target = tmp_path / "new" / name
    assert write(target, files) == sum(map(len, files.values()))
    beside = {each: data for each, data in files.items() if each != header}
    assert held(target.parent) == beside | {name: files[header]}
    if name != "web.json":
        assert sorted(siblings_of(target).existing(target)) == sorted(beside)


def test_names_of_chunk_files_are_recognised() -> None:
    for number in (0, 7, 12345):
        assert formats.rad_chunk_number(formats.rad_chunk_name("x-lod", number), "x-lod") == number
    for name in (
        *("x-lod.rad", "x-lod-01.radc", "x-lod-.radc", "x-lod--1.radc", "x-lod-1.rad", "x-lod-1-1.radc", "1.radc"),
        *("y-lod-1.radc", "x-lod1.radc", "x-lod-1.radc.bak", "x-lod-1.RADC", "x-lod-٣.radc"),
    ):
        assert formats.rad_chunk_number(name, "x-lod") is None


@pytest.mark.parametrize(
    ("old", "new", "others"),
    [
        (
            rad(12),
            rad(2),
            ["x-01.radc", "x-7-lod.rad", "x-lod-11.radc", "y-11.radc", "x-11.radc.bak", "x-11.spz"],
        ),
        (
            streamed("0_0", "0_1", "1_0", "env"),
            streamed("0_0", "2_0", mark="new"),
            ["0_0/notes.txt", "0_1/notes.txt", "7_0/meta.json", "x", "1_0/other.webp"],
        ),
        (SETS["SOG"][1], {"quats.webp": b"image", "meta.json": b"{ }"}, ["other.webp", "meta-0.radc"]),
    ],
    ids=SETS,
)
def test_a_replaced_output_loses_its_surplus_files_and_no_others(
    old: Files, new: Files, others: list[str], tmp_path: Path
) -> None:
    target = tmp_path / list(old)[-1]
    write(target, old)
    precious = dict.fromkeys(others, b"precious")
    put_files(tmp_path, precious)
    write(target, new, overwrite=True)
    assert held(tmp_path) == new | precious
    assert not (tmp_path / "env").exists()


@pytest.mark.parametrize(
    ("header", "taken"),
    [("x.rad", name) for name in ("x.rad", "x-0.radc", "x-1.radc", "x-40.radc")]
    + [("lod-meta.json", "lod-meta.json"), ("meta.json", "meta.json")],
)
def test_an_existing_file_is_refused_before_any_work(header: str, taken: str, tmp_path: Path) -> None:
    put_files(tmp_path, {taken: b"precious"})
    with pytest.raises(OutputError, match=rf"{taken} exists, add --overwrite to replace it"):
        output(tmp_path / header)
    assert held(tmp_path) == {taken: b"precious"}


@pytest.mark.parametrize("suffix", ["rad", "json"])
def test_places_that_cannot_hold_several_files_are_refused(suffix: str, tmp_path: Path) -> None:
    open_output: Callable[..., Output] = output if suffix == "rad" else parts_output
    for place, reason in (
        (tmp_path, "is a directory"),
        (Path("-"), "standard output cannot take several files"),
        (Path(os.devnull), "is a pipe or a device"),
    ):
        with pytest.raises(OutputError, match=reason):
            open_output(place, overwrite=True)
    (tmp_path / "x-1.radc").mkdir()
    with pytest.raises(OutputError, match=r"x-1\.radc is not a file; move it away"):
        output(tmp_path / "x.rad", overwrite=True)
    with pytest.raises(OutputError, match="file name too long"):
        write(tmp_path / ("n" * 249 + ".rad"), rad(1, "n" * 249), overwrite=True)
    assert names(tmp_path) == ["x-1.radc"]


@posix
@EVERY_SET
def test_all_files_are_written_to_the_folder_that_a_linked_header_is_in(
    header: str, files: Files, tmp_path: Path
) -> None:
    (tmp_path / "store").mkdir()
    link = tmp_path / f"link{Path(header).suffix}" if header != "meta.json" else tmp_path / header
    link.symlink_to(tmp_path / "store" / header)
    write(link, files)
    assert held(tmp_path / "store") == files
    assert link.is_symlink()


def test_an_output_without_writes_is_no_file(tmp_path: Path) -> None:
    with Output(tmp_path / "new" / "out.spz", overwrite=False), output(tmp_path / "new" / "x.rad"):
        pass
    assert names(tmp_path) == []


# --- Folders of a Streamed SOG ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("unpacked_first", [False, True])
def test_an_environment_is_replaced_by_one_of_the_other_form(unpacked_first: bool, tmp_path: Path) -> None:
    unpacked = streamed("0_0", "env")
    manifest = unpacked["lod-meta.json"].replace(b"env/meta.json", b"env/env.sog")
    bundled = streamed("0_0") | {"env/env.sog": b"PK", "lod-meta.json": manifest}
    order = [unpacked, bundled] if unpacked_first else [bundled, unpacked]
    for overwrite, files in enumerate(order):
        write(tmp_path / "lod-meta.json", files, overwrite=bool(overwrite))
        assert held(tmp_path) == files


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["0_0/meta.json", "0_0/anything", "0_0", "0_1/x", "env/x"])
def test_a_folder_that_no_former_manifest_names_is_refused(name: str, overwrite: bool, tmp_path: Path) -> None:
    put_files(tmp_path, {name: b"precious"})
    folder = name.partition("/")[0]
    with pytest.raises(OutputError, match=rf"{folder} exists, and lod-meta\.json there does not name it; move it away"):
        write(tmp_path / "lod-meta.json", streamed("0_0", "0_1", "env"), overwrite=overwrite)
    assert held(tmp_path) == {name: b"precious"}


def test_the_folder_of_the_first_chunk_is_checked_before_any_work(tmp_path: Path) -> None:
    put_files(tmp_path, {"0_0/x": b"precious", "env/x": b"precious"})
    with pytest.raises(OutputError, match="0_0 exists"):
        output(tmp_path / "lod-meta.json", overwrite=True)
    (tmp_path / "0_0" / "x").unlink()
    write(tmp_path / "lod-meta.json", streamed("0_0"))  # into an empty folder; it has no environment
    assert (tmp_path / "env" / "x").read_bytes() == b"precious"


@pytest.mark.parametrize(
    "named",
    [
        {"filenames": ["precious/meta.json", "../0_0/meta.json", "/0_0/meta.json", "0_0/../x", "0_0/x.txt"]},
        {"filenames": ["0_0/meta.json"], "environment": "precious/meta.json"},
    ],
)
def test_a_hostile_manifest_cannot_have_other_files_removed(named: dict[str, object], tmp_path: Path) -> None:
    meta = json.dumps({"a": {"files": ["photo.jpg", "../photo.webp", "../x/means.webp", "/tmp/x.webp", "means.webp"]}})
    precious = dict.fromkeys(("precious/photo.jpg", "photo.webp", "x/means.webp", "precious/means.webp"), b"precious")
    precious["precious/meta.json"] = meta.encode()
    put_files(tmp_path, {"lod-meta.json": json.dumps({"lodLevels": 1, "tree": {"lods": {}}} | named).encode()})
    if "environment" in named:
        precious["0_0/photo.jpg"] = b"precious"
        put_files(tmp_path, {"0_0/meta.json": meta.encode()})
    put_files(tmp_path, precious)
    write(tmp_path / "lod-meta.json", new := streamed("0_0"), overwrite=True)
    assert held(tmp_path) == precious | new


@posix
def test_a_linked_folder_is_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "web" / "lod-meta.json"
    write(target, streamed("0_0", "1_0"))
    (tmp_path / "web" / "1_0").rename(tmp_path / "elsewhere")
    (tmp_path / "web" / "1_0").symlink_to(tmp_path / "elsewhere")
    before = held(tmp_path / "elsewhere")
    write(target, streamed("0_0"), overwrite=True)
    with pytest.raises(OutputError, match="1_0 exists"):
        write(target, streamed("0_0", "1_0"), overwrite=True)
    assert held(tmp_path / "elsewhere") == before
    assert (tmp_path / "web" / "1_0").is_symlink()


# --- Addresses --------------------------------------------------------------------------------------------------------


@pytest.fixture
def address() -> Any:
    pytest.importorskip("fsspec")
    return Address(f"memory://{uuid.uuid4().hex}") / "lod-meta.json"


def held_at(address: Address) -> Files:
    folder = address.parent
    return {name: (folder / name).read(0, (folder / name).size()) for name in folder.files()}


@pytest.mark.slow
def test_an_output_at_an_address_replaces_a_former_one_and_nothing_else(address: Address) -> None:
    old = streamed("0_0", "0_1", "env")
    assert write(address, old) == sum(map(len, old.values()))
    assert held_at(address) == old
    with pytest.raises(OutputError, match="exists, add --overwrite"):
        output(address)
    (address.parent / "0_1/notes").write([b"precious"])
    write(address, new := streamed("0_0", "1_0", mark="new"), overwrite=True)
    assert held_at(address) == new | {"0_1/notes": b"precious"}
    (address.parent / "2_0/meta.json").write([b"precious"])
    before = held_at(address)
    with pytest.raises(OutputError, match=r"2_0 exists, and lod-meta\.json there does not name it"):
        output(address, overwrite=True)
    assert held_at(address) == before


@pytest.mark.slow
def test_files_of_a_failed_output_at_an_address_are_removed(address: Address) -> None:
    def broken() -> Iterator[tuple[str, Iterable[bytes]]]:
        yield from list(pieces_of(streamed("0_0", "0_1")))[:-1]
        raise OSError(errno.EIO, "broken")

    with pytest.raises(OutputError, match=r"cannot write memory://.*: broken"):
        write_files(output(address), broken())
    assert held_at(address) == {}


@pytest.mark.slow
def test_an_output_at_an_address_is_read_by_its_manifest_and_by_its_folder(address: Address) -> None:
    golden = FIXTURES / "golden" / "sh1-streamed-sog"
    files = {path.relative_to(golden).as_posix(): path.read_bytes() for path in golden.rglob("*") if path.is_file()}
    write(address, files | {"lod-meta.json": files.pop("lod-meta.json")})
    for place in (address, address.parent):
        np.testing.assert_array_equal(read_scene(place).splats.center, read_scene(golden).splats.center)
    assert read_parts(address.parent).counts.tolist() == read_parts(golden).counts.tolist()
