"""Every planted fault is found by its code and no other; sound files have no findings; no bytes break the report."""

from __future__ import annotations

import copy
import gzip
import itertools
import json
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli
from fixtures import by_hand
from sparklod_cli.cli import run
from sparklod_cli.codecs import streamed_manifest, streamed_sog, tiles_3d, tileset
from sparklod_cli.codecs.compression import PIECE
from sparklod_cli.codecs.formats import FORMATS, PROFILES, WriteOptions
from sparklod_cli.codecs.rad import rad_header
from sparklod_cli.commands.inspect import lines
from sparklod_cli.inspection.findings import CODES, ERROR
from sparklod_cli.inspection.report import Report, ReportSettings, inspect
from sparklod_cli.io.reading import read_parts
from sparklod_cli.io.writing import parts_output
from sparklod_cli.lod import parts, quality, quick
from sparklod_cli.lod.tree_settings import DetailSettings, TileSettings
from sparklod_cli.system.errors import FormatError
from tests.conftest import FIXTURES, Capture, real_scene
from tests.inspection import rad_files, streamed_sog_files, tiles_files
from tests.inspection.test_schema import faults as schema_faults
from tests.inspection.test_schema import holder, places
from tests.scenes import random_splats, write_files

FOLDER = FIXTURES / "faults"

#: Each file of the folder, which `fixtures/README.md` describes, the codes that it must be given and no others, and
#: the place of the fault: the splat or node that the finding names, or a part of its message.
FAULTS: list[tuple[str, str, int | str]] = [
    ("empty.spz", "file.unreadable", ""),
    ("web-page.spz", "file.format", ""),
    ("pointer.ply", "file.format", ""),
    ("points.ply", "file.not-splats", ""),
    ("other.gz", "file.not-splats", ""),
    ("pictures.zip", "file.not-splats", ""),
    ("spz-cut-header.spz", "container.cut-short", "header"),
    ("spz-cut-stream.spz", "container.cut-short", "0 of 6 colors"),
    ("spz-cut-last-stream.spz", "container.cut-short", "3 of 6 rotations"),
    ("spz-cut-trailer.spz", "container.cut-short", ""),
    ("spz-short-member.spz", "container.cut-short", ""),
    ("spz-too-long.spz", "container.too-long", ""),
    ("spz-promise.spz", "container.promise", ""),
    ("spz-version-9.spz", "container.version", ""),
    ("spz-degree-7.spz", "container.version", ""),
    ("spz-fractional-bits.spz", "container.corrupt", ""),
    ("spz-flipped-bit.spz", "container.checksum", ""),
    ("spz-isize.spz", "container.checksum", ""),
    ("spz-deflate.spz", "container.corrupt", ""),
    ("spz-two-files.spz", "container.members", ""),
    ("spz-two-members.spz", "container.members", ""),
    ("spz-trailing.spz", "container.trailing", "100 bytes"),
    ("spz-flags.spz", "container.flags", ""),
    ("spz-reserved.spz", "container.flags", ""),
    ("spz-tree-flag-lost.spz", "container.too-long", ""),
    ("spz-tree-flag-made-up.spz", "container.cut-short", "child_counts"),
    ("spz4-cut-header.spz", "container.cut-short", ""),
    ("spz4-cut-table.spz", "container.cut-short", "table of streams"),
    ("spz4-cut-stream.spz", "container.cut-short", "stream rotations"),
    ("spz4-promise.spz", "container.promise", ""),
    ("spz4-version-5.spz", "container.version", ""),
    ("spz4-degree-7.spz", "container.version", ""),
    ("spz4-few-streams.spz", "container.corrupt", ""),
    ("spz4-more-streams.spz", "container.left-out", ""),
    ("spz4-stream-size.spz", "container.corrupt", "stream colors"),
    ("spz4-long-frame.spz", "container.too-long", "stream alphas"),
    ("spz4-short-frame.spz", "container.cut-short", "5 of 6 alphas"),
    ("spz4-zstd.spz", "container.corrupt", "stream scales"),
    ("spz4-checksum.spz", "container.checksum", ""),
    ("spz4-trailing.spz", "container.trailing", ""),
    ("spz4-flags.spz", "container.flags", ""),
    ("spz4-reserved.spz", "container.flags", ""),
    ("spz4-degree-4.spz", "container.left-out", ""),
    ("ply-cut.ply", "container.cut-short", ""),
    ("ply-cut-header.ply", "container.cut-short", ""),
    ("ply-promise.ply", "container.cut-short", ""),
    ("ply-header.ply", "container.corrupt", ""),
    ("ply-sh-count.ply", "container.corrupt", ""),
    ("ply-degree-4.ply", "container.left-out", ""),
    ("ply-trailing.ply", "container.trailing", ""),
    ("compressed-cut.ply", "container.cut-short", ""),
    ("compressed-chunks.ply", "container.corrupt", ""),
    ("sog-crc.sog", "container.checksum", ""),
    ("sog-cut.sog", "container.corrupt", ""),  # a zip's table of contents is at its end
    ("sog-missing-image.sog", "container.corrupt", "scales.webp"),
    ("sog-not-an-image.sog", "container.corrupt", "quats.webp"),
    ("sog-lossy.sog", "container.lossy", "sh0.webp"),
    ("sog-version-3.sog", "container.version", ""),
    ("sog-promise.sog", "container.promise", ""),
    ("ksplat-cut.ksplat", "container.cut-short", ""),
    ("ksplat-level-7.ksplat", "container.version", ""),
    ("ksplat-trailing.ksplat", "container.trailing", ""),
    ("ksplat-count.ksplat", "container.corrupt", ""),
    ("glb-meshopt.glb", "container.unsupported", ""),
    ("splat-33-bytes.splat", "container.cut-short", ""),
    ("no-splats.ply", "values.empty", ""),
    ("no-splats.spz", "values.empty", ""),
    ("nan.ply", "values.non-finite", 0),
    ("nan.spz", "values.non-finite", ""),
    ("infinite-center.ply", "values.non-finite", ""),
    ("infinite-scale.ply", "values.non-finite", ""),
    ("zero-rotation.ply", "values.non-finite", ""),
    ("rotation-tag.sog", "values.non-finite", ""),
    ("negative-scale.splat", "values.negative-scale", 2),
    ("negative-scale.ksplat", "values.negative-scale", 2),
    ("all-transparent.spz", "values.invisible", ""),
    ("points-of-no-size.ply", "values.invisible", ""),
    ("small-scales.spz", "values.scale-clamped", 6),
    ("large-scales.spz", "values.scale-clamped", ""),
    ("clamped-centers.spz", "values.center-clamped", 1),
    ("far-center.ply", "values.center-far", ""),
    ("tree-range.spz", "tree.range", 3),
    ("tree-far-start.spz", "tree.range tree.orphan", ""),
    ("tree-order.spz", "tree.order", 4),
    ("tree-self-loop.spz", "tree.order tree.unreachable", 3),
    ("tree-cycle.spz", "tree.order tree.unreachable", ""),
    ("tree-root-is-a-child.spz", "tree.order tree.root", 0),
    ("tree-orphan.spz", "tree.orphan", 9),
    ("tree-skipped-child.spz", "tree.orphan", 1),
    ("tree-lost-branch.spz", "tree.orphan", 9),
    ("tree-no-links.spz", "tree.orphan", 1),
    ("tree-shared.spz", "tree.shared", 5),
    ("tree-leaf-start.spz", "tree.leaf-start", 2),
    ("tree-opaque-leaf.spz", "tree.leaf-opacity", 2),
    ("tree-single-child.spz", "tree.single-child", ""),
    ("tree-small-parent.spz", "tree.size", 1),
    ("tree-fine-first.spz", "tree.coarse-first", 553),
    ("tree-version-2.spz", "tree.orphan", ""),
    ("tree-version-4.spz", "tree.orphan", ""),
]

#: Codes that no file can be given: the decoders of all formats give opacities of 0 to 1 and rotations of length 1.
UNPLANTED = {"values.opacity", "values.rotation"}


def checked(path: Path, **settings: Any) -> Report:
    return inspect(path, ReportSettings(check=True, **settings))[0]


def codes(path: Path) -> list[str]:
    return [finding.code for finding in checked(path).findings or []]


@pytest.mark.parametrize(("name", "expected", "place"), FAULTS)
def test_each_fault_is_found_by_its_code_and_no_other(
    name: str, expected: str, place: int | str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(FOLDER)
    code = run(["inspect", "--check", name])
    out, err = capsys.readouterr()
    found = [line.split(": ", 3) for line in out.splitlines()]
    assert sorted(each[2] for each in found) == sorted(expected.split()), out  # a line a code
    assert all(each[0] == name and each[1] == CODES[each[2]][0] for each in found)
    assert f"{place:,}" in found[0][3] if isinstance(place, int) else place in found[0][3]
    assert code == (3 if any(CODES[each][0] == ERROR for each in expected.split()) else 0)
    assert err == ""
    if isinstance(place, int):
        assert (checked(Path(name)).findings or [])[0].index == place


def test_every_file_is_in_the_table_and_every_code_has_a_file() -> None:
    assert {path.name for path in FOLDER.iterdir()} == {name for name, _, _ in FAULTS}
    known = {code for code in CODES if code.startswith(("file.", "container.", "values.", "tree."))}
    assert known - {code for _, expected, _ in FAULTS for code in expected.split()} == UNPLANTED


#: Fixtures that are odd on purpose, and what is said of them.
ODD = {
    "points.ply": {"file.not-splats"},
    "sh1-disks.ply": {"container.left-out"},
    "huge.ply": {"values.center-far"},
    # Three splats of which one has the largest coordinate that the bytes can hold, and the least opacity and scale.
    "golden/hand-v1.spz": {"values.invisible", "values.scale-clamped"},
    "golden/hand-v2.spz": {"values.invisible", "values.scale-clamped", "values.center-clamped"},
    "golden/hand-v3.spz": {"values.invisible", "values.scale-clamped", "values.center-clamped"},
    "golden/hand-spz.glb": {"values.invisible", "values.scale-clamped", "values.center-clamped"},
    "golden/hand-v4.spz": {"values.invisible", "values.scale-clamped", "values.center-clamped"},
    "golden/hand-v4-sh4.spz": {
        *("values.invisible", "values.scale-clamped", "values.center-clamped", "container.left-out"),
    },
    "golden/huge-v2.spz": {"values.center-far", "values.scale-clamped"},
    "golden/huge-v3.spz": {"values.center-far", "values.scale-clamped"},
    "golden/sh1-streamed-sog/lod-meta.json": {"streamed-sog.coarsest"},
    "golden/sh1-tree.rad": {"rad.chunk-size"},
    "golden/sh3-rad/sh3.rad": {"rad.chunk-size"},
    # One of eight nodes has an opacity of 0.001, which is coded as 0.
    "golden/tree-v2.spz": {"values.invisible"},
    "golden/tree-v3.spz": {"values.invisible"},
}

SUFFIXES = {suffix for form in FORMATS for suffix in form.suffixes}

GOOD = sorted(
    path.relative_to(FIXTURES).as_posix()
    for path in FIXTURES.rglob("*")
    if path.suffix in SUFFIXES and not {FOLDER, FIXTURES / "cameras"} & set(path.parents)
)


@pytest.mark.parametrize("name", GOOD)
def test_good_files_give_no_finding(name: str) -> None:
    assert set(codes(FIXTURES / name)) == ODD.get(name, set())


def padded(member: bytes, size: int) -> bytes:
    """A gzip member of so many bytes: one with a name of its file, which may be of any length."""
    return member[:3] + b"\x08" + member[4:10] + b"n" * (size - len(member) - 1) + b"\0" + member[10:]


@pytest.mark.parametrize("size", [PIECE - 1, PIECE, PIECE + 1, 2 * PIECE])
def test_a_second_gzip_member_is_reported_wherever_it_begins(size: int, tmp_path: Path) -> None:
    """Files are read in pieces, and a member may end where a piece does."""
    whole, path = gzip.decompress((FOLDER / "spz-two-members.spz").read_bytes()), tmp_path / "scene.spz"
    for first, second in ((whole, whole), (whole[:70], whole[70:])):
        path.write_bytes(padded(by_hand.gzip_stored(first), size) + by_hand.gzip_stored(second))
        assert codes(path) == ["container.members"]
    path.write_bytes(padded(by_hand.gzip_stored(whole), size) + b"more")
    assert codes(path) == ["container.trailing"]


@pytest.mark.parametrize("size", [0, 100, 3 * PIECE])
def test_extensions_are_not_trailing_bytes(size: int, tmp_path: Path) -> None:
    whole, path = gzip.decompress((FOLDER / "spz-flags.spz").read_bytes()), tmp_path / "scene.spz"
    payload = np.random.default_rng(0).bytes(size)  # which deflate does not make smaller
    path.write_bytes(gzip.compress(whole[:14] + b"\x02" + whole[15:] + by_hand.spz_extension(0x12340001, payload)))
    (left_out,) = checked(path).findings or []
    assert left_out.code == "container.left-out"
    assert left_out.message == f"extension 0x12340001 ({size:,} bytes) is left out"


def changed(data: bytes, rng: np.random.Generator) -> bytes:
    """The data cut, or with a few bits flipped, or bytes set to what is likely to hurt."""
    if not data or rng.random() < 0.2:
        return data[: rng.integers(len(data) + 1)]
    new = bytearray(data)
    for at in rng.integers(len(data), size=rng.integers(1, 6)):
        new[at] = rng.choice([0, 0x7F, 0x80, 0xFF, new[at] ^ 1 << rng.integers(8)])
    return bytes(new)


SMALL = [path for path in [*FOLDER.iterdir(), *(FIXTURES / name for name in GOOD)] if path.is_file()]
SMALL = sorted(path for path in SMALL if path.stat().st_size < 20_000)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("path", SMALL, ids=lambda path: path.name)
def test_whatever_the_bytes_are_there_is_a_report(path: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(zlib.crc32(path.name.encode()))
    data = path.read_bytes()
    try:
        inside = gzip.decompress(data)  # behind the checksum, which would find nearly all of it
    except (OSError, EOFError, zlib.error):
        inside = None
    for attempt in range(12):
        broken = tmp_path / path.name
        deep = inside is not None and rng.random() < 0.8
        broken.write_bytes(by_hand.gzip_stored(changed(inside or b"", rng)) if deep else changed(data, rng))
        if attempt == 0:
            broken.write_bytes(data)
        for wanted in (ReportSettings(check=True), ReportSettings(values=True, all_quantities=True)):
            report, _ = inspect(broken, wanted)
            plain = json.loads(json.dumps(report.as_dict(), allow_nan=False))
            if report.format is not None:
                assert "\n".join(lines(path.name, plain))
            else:
                assert ERROR in [found["severity"] for found in plain["findings"]]


# --- RAD, Streamed SOG and 3D Tiles: formats of several parts ---------------------------------------------------------

#: Faults by format, with the function that writes the parts into a folder and the prefix of the codes.
IN_PARTS: dict[str, tuple[dict[str, Any], Callable[[Any, Path], Path], str]] = {
    "RAD": (rad_files.FAULTS, lambda rad, folder: rad.write(folder / "a.rad"), ""),
    "Streamed SOG": (streamed_sog_files.FAULTS, streamed_sog_files.Folder.write, "streamed-sog."),
    "3D Tiles": (tiles_files.FAULTS, tiles_files.write, "tiles."),
}
OF_PARTS = [(form, name) for form, (faults, *_) in IN_PARTS.items() for name in faults]


def broken(form: str, name: str, folder: Path) -> tuple[Path, set[str]]:
    """Write a file with a fault; return its path and the codes of the expected findings."""
    faults, write, prefix = IN_PARTS[form]
    parts, expected = faults[name]
    return write(parts, folder), {code if "." in code else prefix + code for code in expected}


@pytest.mark.parametrize(("form", "name"), OF_PARTS)
def test_each_fault_of_a_file_of_parts_is_found_by_its_code_and_no_other(
    form: str, name: str, tmp_path: Path, capsys: Capture
) -> None:
    path, expected = broken(form, name, tmp_path)
    report = checked(path)
    found = [finding.code for finding in report.findings or []]
    assert len(found) == len(set(found))  # one finding a code, however many chunks or tiles break the rule
    assert set(found) == expected, report.findings
    assert schema_faults(json.loads(json.dumps(report.as_dict(), allow_nan=False))) == []
    # Without --check, `inspect` fails where the other commands do, with errors among these codes.
    report, scene = inspect(path, ReportSettings())
    assert run(["inspect", str(path), "-q"]) == (1 if scene is None else 0)
    capsys.readouterr()
    if scene is None:
        findings = report.findings or []
        assert findings and {finding.code for finding in findings} <= expected
        assert {finding.severity for finding in findings} == {"error"}
    if scene is None and form == "Streamed SOG":
        with pytest.raises(FormatError) as refused:
            read_parts(path)
        assert refused.value.code in expected | {"streamed-sog.chunk-files"}


def test_every_code_of_the_rules_has_a_fault() -> None:
    planted = set[str]()
    for faults, _, prefix in IN_PARTS.values():
        planted |= {code if "." in code else prefix + code for _, expected in faults.values() for code in expected}
    known = [code for rules in (rad_header, streamed_manifest, tileset) for code in (*rules.ERRORS, *rules.WARNINGS)]
    assert set(known) - planted == {"tiles.large"}  # see below
    assert CODES.keys() >= set(known)


def test_large_tiles_have_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tileset, "LARGE", 29)
    assert codes(tiles_files.write(tiles_files.SOUND, tmp_path)) == ["tiles.large"]


SOUND_RAD = [rad_files.SMALL, rad_files.TWO, rad_files.SH, rad_files.PALETTE, rad_files.LATER]
SOUND_SOG = [
    *(streamed_sog_files.SOUND, streamed_sog_files.ALONE, streamed_sog_files.folder(sh_degree=1)),
    *(streamed_sog_files.folder(errors=False), streamed_sog_files.SOUND.having(environment=None)),
]
ON_EARTH = [*np.eye(4).ravel()[:12], 9e6, 0, 0, 1]
SOUND_TILES = [tiles_files.SOUND, tiles_files.folder(5, 6), tiles_files.root(transform=ON_EARTH)]


@pytest.mark.parametrize(
    ("form", "parts"),
    [
        *(("RAD", rad) for rad in SOUND_RAD),
        *(("RAD", replace(rad, stem="a")) for rad in SOUND_RAD),
        *(("Streamed SOG", folder) for folder in SOUND_SOG),
        *(("3D Tiles", files) for files in SOUND_TILES),
    ],
)
def test_sound_files_of_parts_have_no_findings(form: str, parts: Any, tmp_path: Path) -> None:
    path = IN_PARTS[form][1](parts, tmp_path)
    assert codes(path) == []
    assert form == "RAD" or codes(path.parent) == []


@pytest.mark.parametrize("name", ["rad/biker-spark.rad", "rad/playbot-125k-spark/p-lod.rad"])
def test_files_that_spark_wrote_have_no_findings(name: str) -> None:
    assert codes(real_scene(name)) == []


def test_streamed_sog_that_we_write_has_no_findings(tmp_path: Path) -> None:
    """Codes of SOG move splats within their bounds and out of their order."""
    division = 2_000, 2.0, 100
    settings = DetailSettings((0.3, 0.1), *division)
    scene = parts.make_levels(*quick.build(random_splats(3_000, sh_degree=0)), settings)
    errors = np.arange(3) * np.ones((scene.regions, 1))
    scene = replace(scene, errors=errors, environment=random_splats(50, sh_degree=0, seed=1))
    path = tmp_path / "lod-meta.json"
    write_files(parts_output(path, overwrite=False), streamed_sog.encode_files(scene, WriteOptions(), *division))
    assert checked(path).findings == []
    assert checked(path).value_at("streamed_sog.regions") > 3
    for name in ("scene.sog", "sog/meta.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        sparklod_cli.write(tmp_path / name, scene.scene())
        assert codes(tmp_path / name) == []


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("up", [None, "y", "-y", "z"])
def test_tiles_that_we_write_have_no_findings(up: str | None, profile: str, tmp_path: Path) -> None:
    settings = TileSettings(tile_splats=60, lat=-33, lon=151)
    made = replace(parts.make_tiles(*quality.build(random_splats(2_000, sh_degree=1), 2.0), settings), up=up)
    path = tmp_path / "tileset.json"
    files = tiles_3d.encode_files(made, WriteOptions(glb_profile=profile), most_tiles=40)
    size = write_files(parts_output(path, overwrite=False), files)
    report = checked(path)
    assert report.findings == []
    assert (report.bytes, report.up, report.splats) == (size, up, 2_000)
    assert report.value_at("tiles.tiles") == made.tiles and report.value_at("tiles.tilesets") > 1
    assert report.value_at("tiles.georeference.latitude") == pytest.approx(-33)
    assert report.value_at("tiles.levels.0.splats") == made.counts[0]
    assert schema_faults(report.as_dict()) == []


def test_a_finding_is_about_the_first_fault_and_counts_the_others(tmp_path: Path) -> None:
    rad = rad_files.tree(240, chunk=24)
    rad = replace(rad, chunks=tuple(rad_files.with_fields(chunk, splatEncoding=None) for chunk in rad.chunks))
    size, ranges = checked(rad.write(tmp_path / "a.rad")).findings or []
    assert size.code == "rad.chunk-size"
    assert ranges.message == "splatEncoding of chunk 0 is not that of the file (and 9 more like it)"

    def change(manifest: dict[str, Any]) -> None:
        for node in streamed_sog_files.regions(manifest):
            node["errors"] = [0, 0.2, 0.1]

    (decreasing,) = checked(streamed_sog_files.SOUND.changed(change).write(tmp_path)).findings or []
    assert decreasing.message == "tree.children[0].errors is [0, 0.2, 0.1], which decrease (and 1 more like it)"


def rounded(value: Any, digits: int) -> Any:
    """A value of JSON whose numbers have only so many digits."""
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {key: rounded(each, digits) for key, each in value.items()}
    return [rounded(each, digits) for each in value] if isinstance(value, list) else value


def test_bounds_of_seven_digits_are_no_fault(tmp_path: Path) -> None:
    """Bounds need not enclose splats to more digits than are written."""

    def change(manifest: dict[str, Any]) -> None:
        regions = streamed_sog_files.regions(manifest)
        for node in regions:
            node["bound"]["min"][0] += 1.23456789e-7
        manifest["tree"]["bound"]["min"][0] = regions[0]["bound"]["min"][0]
        manifest["tree"] = rounded(manifest["tree"], 7)

    assert codes(streamed_sog_files.SOUND.changed(change).write(tmp_path)) == []


#: What a stranger may put in place of any value.
HOSTILE = [None, True, -1, 2**53, 10**30, 1e308, float("nan"), -1e999, "", "../x", "\x1b[2J", [], [[]], {}, {"0": {}}]


def test_nothing_in_a_manifest_breaks_the_report(tmp_path: Path) -> None:
    """Any value may be anything: the report follows the schema, and readers raise nothing but format errors."""
    sound = streamed_sog_files.ALONE
    path = sound.write(tmp_path)
    some = list(itertools.product(places(sound.manifest), HOSTILE))[::4]  # all values at neighbouring places
    for number, (way, value) in enumerate(some):
        manifest = copy.deepcopy(sound.manifest)
        holder(manifest, way)[way[-1]] = value
        path.write_text(json.dumps(manifest))
        wanted = ReportSettings(headers_only=True) if number % 20 else ReportSettings(check=True)
        report = json.loads(json.dumps(inspect(path, wanted)[0].as_dict(), allow_nan=False))
        assert schema_faults(report) == [], (way, value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["golden/sh3-rad/sh3-0.radc"], "one chunk of a RAD file; give the .rad file"),
        (["-", "golden/sh3-rad/sh3.rad"], "standard input has no folder; give the path instead"),
        (["-", "golden/sh1-streamed-sog/lod-meta.json"], "standard input has no folder; give the path instead"),
    ],
)
def test_a_part_alone_is_refused(
    arguments: list[str], message: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (FIXTURES / arguments[-1]).open("rb") as file:
        monkeypatch.setattr("sys.stdin", type("Stdin", (), {"buffer": file, "isatty": lambda self: False})())
        assert run(["inspect", "-" if len(arguments) > 1 else str(FIXTURES / arguments[0])]) == 1
    assert message in capsys.readouterr().err


def test_a_manifest_that_is_too_large_is_refused(tmp_path: Path) -> None:
    sound = streamed_sog_files.SOUND
    path = streamed_sog_files.Folder(sound.manifest | {"more": " " * streamed_manifest.MAX_MANIFEST}).write(tmp_path)
    assert codes(path) == ["container.corrupt"]
