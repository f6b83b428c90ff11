"""Every promise of RAD that a file breaks is found by its code, and by no other; sound files have no findings."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.rad import rad_header as rad_promises
from sparklod_cli.inspection.findings import CODES
from sparklod_cli.inspection.report import Report, ReportSettings, inspect
from tests.conftest import FIXTURES, Capture, real_scene
from tests.inspection.rad_files import CHUNK, RANGES, Chunk, Rad, deflated, tree, with_chunk, with_fields

#: Files to damage: two chunks, and a palette for spherical harmonics. Of small ones, chunks of all nodes.
TWO, SMALL = tree(), tree(24)
SH, PALETTE = tree(24, max_sh=2), tree(24, max_sh=2, palette=True)
LATER = replace(tree(CHUNK + 8, max_sh=1, palette=True))


def checked(path: Path) -> Report:
    return inspect(path, ReportSettings(check=True))[0]


def codes(path: Path) -> list[str]:
    return [found.code for found in checked(path).findings or []]


def of(rad: Rad, number: int, change: Callable[[Chunk], Chunk]) -> Rad:
    return with_chunk(rad, number, change)


def column(rad: Rad, name: str, number: int = 0, /, **changes: object) -> Rad:
    """A file with one column of a chunk changed."""
    return of(rad, number, lambda chunk: chunk.changed(name, lambda each: replace(each, **changes)))  # type: ignore[arg-type]


def fields(rad: Rad, name: str, number: int = 0, /, **changes: object) -> Rad:
    """A file with wrong fields of one property of a chunk."""
    return of(rad, number, lambda chunk: chunk.changed(name, lambda each: with_fields(each, **changes)))


def moved(chunk: Chunk, name: str, after: str) -> Chunk:
    """A chunk with one column behind another one."""
    rest = [each for each in chunk.columns if each.name != name]
    at = 1 + next(number for number, each in enumerate(rest) if each.name == after)
    (found,) = (each for each in chunk.columns if each.name == name)
    return replace(chunk, columns=(*rest[:at], found, *rest[at:]))


def repeated(chunk: Chunk, name: str) -> Chunk:
    (found,) = (each for each in chunk.columns if each.name == name)
    return replace(chunk, columns=tuple(itertools.chain(chunk.columns, [found])))


def column_of(rad: Rad, name: str, number: int = 0) -> bytes:
    return next(each.data for each in rad.chunks[number].columns if each.name == name)


FAULTS: dict[str, tuple[Rad, set[str]]] = {
    "another type": (with_fields(SMALL, type="mesh"), {"file.not-splats"}),
    "another version": (with_fields(SMALL, version=2), {"container.version"}),
    "a degree that does not exist": (
        of(with_fields(SMALL, maxSh=4), 0, lambda chunk: with_fields(chunk, maxSh=4)),
        {"container.version"},
    ),
    "no count": (with_fields(SMALL, count=None), {"container.corrupt"}),
    "a chunk too many": (with_fields(SMALL, count=CHUNK + 1), {"rad.chunks"}),
    "a chunk too few": (with_fields(TWO, count=CHUNK), {"rad.chunks"}),
    "chunks of nothing": (with_fields(SMALL, chunkSize=0), {"rad.chunks"}),
    "chunks of another size": (tree(48, chunk=24), {"rad.chunk-size"}),
    "one splat less in the header": (with_fields(TWO, count=CHUNK + 7), {"rad.bases"}),
    "one splat less in a chunk": (of(TWO, 1, lambda chunk: with_fields(chunk, count=7)), {"rad.bases"}),
    "another base": (of(TWO, 1, lambda chunk: with_fields(chunk, base=0)), {"rad.bases"}),
    "chunks that overlap": (replace(TWO, entries={1: {"offset": 0}}), {"rad.offsets"}),
    "a gap between chunks": (replace(TWO, entries={1: {"offset": 1 << 20}}), {"rad.offsets"}),
    "an offset in a file of its own": (
        replace(SMALL, stem="a", entries={0: {"offset": 8}}),
        {"rad.offsets", "rad.chunk-files"},
    ),
    "another sum": (with_fields(TWO, allChunkBytes=1), {"rad.total"}),
    "bytes behind the last chunk": (replace(TWO, more=bytes(8)), {"container.trailing"}),
    "an entry that is too large": (
        replace(SMALL, entries={0: {"bytes": 1 << 20}}),
        {"container.cut-short", "rad.total"},
    ),
    "no file of a chunk": (replace(SMALL, entries={0: {"filename": "b.radc"}}), {"rad.chunk-files"}),
    "a file of a chunk elsewhere": (replace(SMALL, entries={0: {"filename": "../b.radc"}}), {"rad.chunk-files"}),
    "a short file of a chunk": (
        replace(SMALL, stem="a", entries={0: {"bytes": 1 << 20}}, fields=SMALL.fields | {"allChunkBytes": 1 << 20}),
        {"rad.chunk-files"},
    ),
    "another magic of a chunk": (of(TWO, 1, lambda chunk: replace(chunk, magic=b"RADX")), {"rad.chunk-header"}),
    "another version of a chunk": (of(TWO, 1, lambda chunk: with_fields(chunk, version=2)), {"rad.chunk-header"}),
    "a chunk without a base": (of(TWO, 1, lambda chunk: with_fields(chunk, base=None)), {"rad.chunk-header"}),
    "another degree in a chunk": (of(SH, 0, lambda chunk: with_fields(chunk, maxSh=1)), {"rad.kind"}),
    "a chunk without a tree": (of(SMALL, 0, lambda chunk: with_fields(chunk, lodTree=None)), {"rad.kind"}),
    "other ranges in a chunk": (
        of(SMALL, 0, lambda chunk: with_fields(chunk, splatEncoding=RANGES | {"rgbMax": 2.0})),
        {"rad.ranges"},
    ),
    "another size of the payload in JSON": (
        of(SMALL, 0, lambda chunk: with_fields(chunk, payloadBytes=8)),
        {"rad.sizes"},
    ),
    "another size before the payload": (of(SMALL, 0, lambda chunk: replace(chunk, payload_bytes=8)), {"rad.sizes"}),
    "bytes behind the properties": (of(SMALL, 0, lambda chunk: replace(chunk, more=bytes(16))), {"rad.sizes"}),
    "a property elsewhere": (fields(SMALL, "alpha", offset=0), {"rad.offsets"}),
    "a property that is unknown": (column(SMALL, "rgb", name="hue"), {"rad.properties"}),
    "a property less": (of(SMALL, 0, lambda chunk: chunk.without("rgb")), {"rad.properties"}),
    "no children": (
        of(SMALL, 0, lambda chunk: chunk.without("child_count")),
        {"rad.properties", "tree.orphan", "tree.leaf-start"},
    ),
    "no degree 2": (of(SH, 0, lambda chunk: chunk.without("sh2")), {"rad.properties"}),
    "a property twice": (of(SMALL, 0, lambda chunk: repeated(chunk, "rgb")), {"rad.properties"}),
    "a degree too many": (
        of(with_fields(SH, maxSh=1), 0, lambda chunk: with_fields(chunk, maxSh=1)),
        {"rad.properties"},
    ),
    "children without a tree": (
        of(with_fields(SMALL, lodTree=False), 0, lambda chunk: with_fields(chunk, lodTree=False)),
        {"rad.properties"},
    ),
    "another order": (of(SMALL, 0, lambda chunk: moved(chunk, "rgb", "scales")), {"rad.order"}),
    "an encoding of another property": (fields(SMALL, "center", encoding="s8"), {"rad.encoding"}),
    "an encoding that is unknown": (fields(SMALL, "center", encoding="f8"), {"rad.encoding"}),
    "a compression that is unknown": (fields(SMALL, "center", compression="br"), {"rad.encoding"}),
    "no end of a range": (fields(SMALL, "rgb", max=None), {"rad.encoding"}),
    "a range that is empty": (fields(SMALL, "rgb", max=0.0), {"rad.encoding"}),
    "a range of SH that is empty": (fields(SH, "sh1", max=0.0), {"rad.encoding"}),
    "a property that is too short": (column(SMALL, "rgb", data=bytes(3)), {"container.cut-short"}),
    "a property that is too long": (column(SMALL, "rgb", data=bytes(73)), {"container.too-long"}),
    "a property that is not deflated": (column(SMALL, "rgb", stored=b"\xff" * 9), {"container.corrupt"}),
    "a deflate stream that does not end": (
        column(SMALL, "rgb", stored=deflated(column_of(SMALL, "rgb"))[:-3]),
        {"container.cut-short"},
    ),
    "a palette of another size": (with_fields(PALETTE, shCodeCount=8), {"rad.palette"}),
    "a palette that is shorter": (column(PALETTE, "sh1_code", data=b"\x10" * 9 * 8), {"container.cut-short"}),
    "a palette in a later chunk": (
        of(LATER, 1, lambda chunk: replace(chunk, columns=(LATER.chunks[0].columns[5], *chunk.columns))),
        {"rad.palette", "rad.order"},
    ),
    "a label beyond the palette": (column(PALETTE, "sh_label", data=b"\x20\0" * 24), {"rad.palette"}),
    "no labels": (of(PALETTE, 0, lambda chunk: chunk.without("sh_label")), {"rad.palette", "rad.properties"}),
    "labels without a palette": (with_fields(PALETTE, shCodeCount=None), {"rad.palette"}),
    "labels and coefficients": (
        of(PALETTE, 0, lambda chunk: replace(chunk, columns=(*chunk.columns, SH.chunks[0].columns[5]))),
        {"rad.palette", "rad.order"},
    ),
    "a large header": (with_fields(SMALL, comment="c" * (1 << 16)), {"rad.header-large"}),
    "a header that is too large": (with_fields(SMALL, comment="c" * (1 << 20)), {"rad.header-limit"}),
    "opacities that are not of a tree": (
        of(
            with_fields(SMALL, splatEncoding=RANGES | {"lodOpacity": False}),
            0,
            lambda chunk: with_fields(chunk, splatEncoding=RANGES | {"lodOpacity": False}),
        ),
        {"rad.opacity"},
    ),
    "padding of the header": (replace(SMALL, pad=b"x"), {"rad.padding"}),
    "padding of a chunk": (of(SMALL, 0, lambda chunk: replace(chunk, pad=b"x")), {"rad.padding"}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found_by_its_code_and_no_other(name: str, tmp_path: Path) -> None:
    rad, expected = FAULTS[name]
    found = codes(rad.write(tmp_path / "a.rad"))
    assert len(found) == len(set(found))  # a finding a code, however many chunks it is about
    assert set(found) == expected, checked(tmp_path / "a.rad").findings


def test_every_code_of_the_promises_has_a_fault() -> None:
    planted = set.union(*(expected for _, expected in FAULTS.values()))
    assert {*rad_promises.ERRORS, *rad_promises.WARNINGS} <= planted
    assert CODES.keys() >= {*rad_promises.ERRORS, *rad_promises.WARNINGS}


@pytest.mark.parametrize("rad", [SMALL, TWO, SH, PALETTE, LATER], ids=["small", "two", "sh", "palette", "later"])
@pytest.mark.parametrize("chunked", [False, True])
def test_sound_files_have_no_findings(rad: Rad, chunked: bool, tmp_path: Path) -> None:
    path = replace(rad, stem="a" if chunked else None).write(tmp_path / "a.rad")
    assert codes(path) == []


@pytest.mark.parametrize("name", ["rad/biker-spark.rad", "rad/playbot-125k-spark/p-lod.rad"])
def test_files_that_spark_wrote_have_no_findings(name: str) -> None:
    assert codes(real_scene(name)) == []


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_fatal_is_an_error_and_the_reader_gives_the_same_code(
    name: str, tmp_path: Path, capsys: Capture
) -> None:
    """`inspect` without --check fails where the other commands do."""
    rad, expected = FAULTS[name]
    report, scene = inspect(rad.write(tmp_path / "a.rad"), ReportSettings())
    if scene is None:
        assert report.findings
        assert {found.code for found in report.findings} <= expected
        assert all(found.severity == "error" for found in report.findings)
    assert run(["inspect", str(tmp_path / "a.rad"), "-q"]) == (1 if scene is None else 0)
    capsys.readouterr()


def test_a_finding_is_about_the_first_chunk_and_counts_the_others(tmp_path: Path) -> None:
    rad = tree(240, chunk=24)
    rad = replace(rad, chunks=tuple(with_fields(chunk, splatEncoding=None) for chunk in rad.chunks))
    (size, ranges) = checked(rad.write(tmp_path / "a.rad")).findings or []
    assert size.code == "rad.chunk-size"
    assert ranges.message == "splatEncoding of chunk 0 is not that of the file (and 9 more like it)"


def test_a_chunk_alone_is_refused_with_what_to_give(capsys: Capture) -> None:
    assert run(["inspect", str(FIXTURES / "golden" / "sh3-rad" / "sh3-0.radc")]) == 1
    assert "one chunk of a RAD file; give the .rad file" in capsys.readouterr().err


def test_a_header_without_its_chunks_is_refused_on_standard_input(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = replace(SMALL, stem="a").write(tmp_path / "a.rad")
    with path.open("rb") as file:
        monkeypatch.setattr("sys.stdin", type("Stdin", (), {"buffer": file, "isatty": lambda self: False})())
        assert run(["inspect", "-"]) == 1
    assert "standard input has no folder; give the path instead" in capsys.readouterr().err
