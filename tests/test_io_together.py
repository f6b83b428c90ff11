"""A header and its chunks, as outputs: where they go, what is refused, what is removed."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from sparklod_cli.codecs import formats
from sparklod_cli.codecs.rad import rad_header
from sparklod_cli.codecs.rad.rad_header import RadChunkEntry, RadHeader
from sparklod_cli.io.local_files import companions
from sparklod_cli.io.writing import siblings_of
from sparklod_cli.system.errors import OutputError
from sparklod_cli.system.output import Output
from tests.conftest import IS_ROOT
from tests.outputs import write_files

posix = pytest.mark.skipif(os.name != "posix", reason="POSIX only")


def files(count: int, stem: str = "x") -> Iterator[tuple[str, Iterable[bytes]]]:
    """What a codec writes: chunks, and their header last."""
    for number in range(count):
        yield formats.rad_chunk_name(stem, number), [b"chunk ", str(number).encode()]
    yield f"{stem}.rad", [b"header"]


def output(path: Path, *, overwrite: bool) -> Output:
    return Output(path, overwrite=overwrite, siblings=siblings_of(path))


def write_set(path: Path, content: Iterable[tuple[str, Iterable[bytes]]], *, overwrite: bool) -> int:
    return write_files(output(path, overwrite=overwrite), content)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", ["x.rad", "x.RAD", "x"])
def test_chunks_stand_beside_the_header(name: str, tmp_path: Path) -> None:
    target = tmp_path / "new" / name
    assert write_set(target, files(12), overwrite=False) == 10 * 7 + 2 * 8 + 6
    assert target.read_bytes() == b"header"
    chunks = [f"x-{number}.radc" for number in range(12)]
    assert names(target.parent) == sorted([name, *chunks])
    assert siblings_of(target).existing(target) == chunks
    assert (target.parent / "x-11.radc").read_bytes() == b"chunk 11"


def test_names_that_are_not_of_chunks_are_told_apart() -> None:
    assert [formats.rad_chunk_number(formats.rad_chunk_name("x-lod", number), "x-lod") for number in (0, 7, 12345)] == [
        *(0, 7, 12345)
    ]
    for name in ("x-lod.rad", "x-lod-01.radc", "x-lod-.radc", "x-lod--1.radc", "x-lod-1.rad", "x-lod-1-1.radc"):
        assert formats.rad_chunk_number(name, "x-lod") is None
    for name in ("y-lod-1.radc", "1.radc", "x-lod1.radc", "x-lod-1.radc.bak", "x-lod-1.RADC", "x-lod-٣.radc"):
        assert formats.rad_chunk_number(name, "x-lod") is None


def test_chunks_of_a_longer_output_are_removed_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "x.rad"
    write_set(target, files(12), overwrite=False)
    others = ["x-01.radc", "x-7-lod.rad", "x-lod-11.radc", "y-11.radc", "x-11.radc.bak", "x-11.spz"]
    for name in others:
        (tmp_path / name).write_bytes(b"precious")
    write_set(target, files(2), overwrite=True)
    assert names(tmp_path) == sorted([*others, "x.rad", "x-0.radc", "x-1.radc"])


@pytest.mark.parametrize("taken", ["x.rad", "x-0.radc", "x-1.radc", "x-40.radc"])
def test_an_existing_file_is_refused_before_any_work(taken: str, tmp_path: Path) -> None:
    (tmp_path / taken).write_bytes(b"precious")
    with pytest.raises(OutputError, match=rf"{taken} exists, add --overwrite to replace it"):
        output(tmp_path / "x.rad", overwrite=False)
    with pytest.raises(OutputError, match="exists"):
        write_set(tmp_path / "x.rad", files(2), overwrite=False)
    assert names(tmp_path) == [taken]
    assert (tmp_path / taken).read_bytes() == b"precious"


def test_a_chunk_that_appears_meanwhile_is_named_by_the_error(tmp_path: Path) -> None:
    def some() -> Iterator[tuple[str, Iterable[bytes]]]:
        yield from files(2)
        (tmp_path / "x-1.radc").write_bytes(b"another's")

    with pytest.raises(OutputError, match=r"x-1\.radc exists, add --overwrite"):
        write_set(tmp_path / "x.rad", some(), overwrite=False)
    assert names(tmp_path) == ["x-1.radc"]


def test_folders_and_pipes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x-1.radc").mkdir()
    with pytest.raises(OutputError, match=r"x-1\.radc is not a file; move it away"):
        output(tmp_path / "x.rad", overwrite=True)
    with pytest.raises(OutputError, match="is a directory"):
        output(tmp_path, overwrite=True)
    with pytest.raises(OutputError, match="standard output cannot take several files"):
        output(Path("-"), overwrite=True)
    with pytest.raises(OutputError, match="is a pipe or a device"):
        output(Path(os.devnull), overwrite=True)
    with pytest.raises(OutputError, match="file name too long"):
        write_set(tmp_path / ("n" * 249 + ".rad"), files(1, "n" * 249), overwrite=True)
    assert names(tmp_path) == ["x-1.radc"]


@posix
def test_where_a_link_leads_all_files_are_together(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    link = tmp_path / "link.rad"
    link.symlink_to(tmp_path / "store" / "x.rad")
    write_set(link, files(2), overwrite=False)
    assert names(tmp_path / "store") == ["x-0.radc", "x-1.radc", "x.rad"]
    assert link.is_symlink()
    assert len(siblings_of(link).existing(link.resolve())) == 2


def test_images_of_a_sog_are_those_of_its_names(tmp_path: Path) -> None:
    for name in ("shN_labels.webp", "means_l.webp", "other.webp", "meta-0.radc", "meta.json"):
        (tmp_path / name).write_bytes(b"x")
    target = tmp_path / "meta.json"
    assert siblings_of(target).existing(target) == ["means_l.webp", "shN_labels.webp"]
    some = [("quats.webp", [b"image"]), ("meta.json", [b"{", b"}"])]
    with pytest.raises(OutputError, match=r"meta\.json exists"):
        write_set(tmp_path / "meta.json", some, overwrite=False)
    assert write_set(tmp_path / "meta.json", some, overwrite=True) == 7
    assert names(tmp_path) == ["meta-0.radc", "meta.json", "other.webp", "quats.webp"]


def test_a_full_disk_is_an_error_that_names_the_header(tmp_path: Path) -> None:
    def full() -> Iterator[bytes]:
        yield b"chunk"
        raise OSError(errno.ENOSPC, "No space left on device")

    some = [("x-0.radc", [b"chunk"]), ("x-1.radc", full()), ("x.rad", [b"header"])]
    with pytest.raises(OutputError, match=r"cannot write .*x\.rad: no space left on device"):
        write_set(tmp_path / "x.rad", some, overwrite=False)
    assert names(tmp_path) == []


@pytest.mark.skipif(IS_ROOT, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_to(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(0o500)
    with pytest.raises(OutputError, match=r"cannot write .*x\.rad: permission denied"):
        write_set(closed / "x.rad", files(1), overwrite=False)
    assert names(closed) == []
    closed.chmod(0o700)


def test_chunks_that_a_header_names_are_its_companions(tmp_path: Path) -> None:
    entries = tuple(RadChunkEntry(0, 8, name) for name in ("y-0.radc", "../away.radc", "missing.radc", "y-1.radc"))
    data = rad_header.pack_header(RadHeader(100, 0, True, 65536, 32, entries))
    header = tmp_path / "sub" / "x.rad"
    header.parent.mkdir()
    for path in (header.with_name("y-0.radc"), header.with_name("y-1.radc"), tmp_path / "away.radc"):
        path.write_bytes(b"precious")
    header.write_bytes(data)
    assert [path.name for path in companions(header, [])] == ["y-0.radc", "y-1.radc"]
    for cut in (4, 8, 100):
        header.write_bytes(data[:cut])
        assert companions(header, []) == []
