"""Every planted fault is found by its code, and nothing else is cried; in good files nothing is."""

from __future__ import annotations

import gzip
import json
import zlib
from pathlib import Path

import numpy as np
import pytest

from fixtures import by_hand
from sparklod_cli.cli import run
from sparklod_cli.codecs.compression import PIECE
from sparklod_cli.codecs.formats import FORMATS
from sparklod_cli.commands.inspect import lines
from sparklod_cli.inspection.findings import CODES, ERROR
from sparklod_cli.inspection.report import Report, ReportSettings, inspect
from tests.conftest import FIXTURES, Capture, real_scene

FOLDER = FIXTURES / "faults"

#: The codes that each file must be given, and no others; `fixtures/README.md` says what is wrong with it.
FAULTS: dict[str, set[str]] = {
    "empty.spz": {"file.unreadable"},
    "web-page.spz": {"file.format"},
    "pointer.ply": {"file.format"},
    "points.ply": {"file.not-splats"},
    "other.gz": {"file.not-splats"},
    "pictures.zip": {"file.not-splats"},
    "spz-cut-header.spz": {"container.cut-short"},
    "spz-cut-stream.spz": {"container.cut-short"},
    "spz-cut-last-stream.spz": {"container.cut-short"},
    "spz-cut-trailer.spz": {"container.cut-short"},
    "spz-short-member.spz": {"container.cut-short"},
    "spz-too-long.spz": {"container.too-long"},
    "spz-promise.spz": {"container.promise"},
    "spz-version-9.spz": {"container.version"},
    "spz-degree-7.spz": {"container.version"},
    "spz-fractional-bits.spz": {"container.corrupt"},
    "spz-flipped-bit.spz": {"container.checksum"},
    "spz-isize.spz": {"container.checksum"},
    "spz-deflate.spz": {"container.corrupt"},
    "spz-two-files.spz": {"container.members"},
    "spz-two-members.spz": {"container.members"},
    "spz-trailing.spz": {"container.trailing"},
    "spz-flags.spz": {"container.flags"},
    "spz-reserved.spz": {"container.flags"},
    "spz-tree-flag-lost.spz": {"container.too-long"},
    "spz-tree-flag-made-up.spz": {"container.cut-short"},
    "spz4-cut-header.spz": {"container.cut-short"},
    "spz4-cut-table.spz": {"container.cut-short"},
    "spz4-cut-stream.spz": {"container.cut-short"},
    "spz4-promise.spz": {"container.promise"},
    "spz4-version-5.spz": {"container.version"},
    "spz4-degree-7.spz": {"container.version"},
    "spz4-few-streams.spz": {"container.corrupt"},
    "spz4-more-streams.spz": {"container.left-out"},
    "spz4-stream-size.spz": {"container.corrupt"},
    "spz4-long-frame.spz": {"container.too-long"},
    "spz4-short-frame.spz": {"container.cut-short"},
    "spz4-zstd.spz": {"container.corrupt"},
    "spz4-checksum.spz": {"container.checksum"},
    "spz4-trailing.spz": {"container.trailing"},
    "spz4-flags.spz": {"container.flags"},
    "spz4-reserved.spz": {"container.flags"},
    "spz4-degree-4.spz": {"container.left-out"},
    "ply-cut.ply": {"container.cut-short"},
    "ply-cut-header.ply": {"container.cut-short"},
    "ply-promise.ply": {"container.cut-short"},
    "ply-header.ply": {"container.corrupt"},
    "ply-sh-count.ply": {"container.corrupt"},
    "ply-degree-4.ply": {"container.left-out"},
    "ply-trailing.ply": {"container.trailing"},
    "compressed-cut.ply": {"container.cut-short"},
    "compressed-chunks.ply": {"container.corrupt"},
    "sog-crc.sog": {"container.checksum"},
    "sog-cut.sog": {"container.corrupt"},  # a zip's table of contents is at its end
    "sog-missing-image.sog": {"container.corrupt"},
    "sog-not-an-image.sog": {"container.corrupt"},
    "sog-lossy.sog": {"container.lossy"},
    "sog-version-3.sog": {"container.version"},
    "sog-promise.sog": {"container.promise"},
    "ksplat-cut.ksplat": {"container.cut-short"},
    "ksplat-level-7.ksplat": {"container.version"},
    "ksplat-trailing.ksplat": {"container.trailing"},
    "ksplat-count.ksplat": {"container.corrupt"},
    "glb-meshopt.glb": {"container.unsupported"},
    "splat-33-bytes.splat": {"container.cut-short"},
    "no-splats.ply": {"values.empty"},
    "no-splats.spz": {"values.empty"},
    "nan.ply": {"values.non-finite"},
    "nan.spz": {"values.non-finite"},
    "infinite-center.ply": {"values.non-finite"},
    "infinite-scale.ply": {"values.non-finite"},
    "zero-rotation.ply": {"values.non-finite"},
    "rotation-tag.sog": {"values.non-finite"},
    "negative-scale.splat": {"values.negative-scale"},
    "negative-scale.ksplat": {"values.negative-scale"},
    "all-transparent.spz": {"values.invisible"},
    "points-of-no-size.ply": {"values.invisible"},
    "small-scales.spz": {"values.scale-clamped"},
    "large-scales.spz": {"values.scale-clamped"},
    "clamped-centers.spz": {"values.center-clamped"},
    "far-center.ply": {"values.center-far"},
    "tree-range.spz": {"tree.range"},
    "tree-far-start.spz": {"tree.range", "tree.orphan"},
    "tree-order.spz": {"tree.order"},
    "tree-self-loop.spz": {"tree.order", "tree.unreachable"},
    "tree-cycle.spz": {"tree.order", "tree.unreachable"},
    "tree-root-is-a-child.spz": {"tree.root", "tree.order"},
    "tree-orphan.spz": {"tree.orphan"},
    "tree-skipped-child.spz": {"tree.orphan"},
    "tree-lost-branch.spz": {"tree.orphan"},
    "tree-no-links.spz": {"tree.orphan"},
    "tree-shared.spz": {"tree.shared"},
    "tree-leaf-start.spz": {"tree.leaf-start"},
    "tree-opaque-leaf.spz": {"tree.leaf-opacity"},
    "tree-single-child.spz": {"tree.single-child"},
    "tree-small-parent.spz": {"tree.size"},
    "tree-fine-first.spz": {"tree.coarse-first"},
    "tree-version-2.spz": {"tree.orphan"},
    "tree-version-4.spz": {"tree.orphan"},
}

#: Where the fault is: the splat or node that the finding names, or what its line says of the place.
PLACES: dict[str, int | str] = {
    "spz-cut-header.spz": "header",
    "spz-cut-stream.spz": "0 of 6 colors",
    "spz-cut-last-stream.spz": "3 of 6 rotations",
    "spz-tree-flag-made-up.spz": "child_counts",
    "spz-trailing.spz": "100 bytes",
    "spz4-cut-table.spz": "table of streams",
    "spz4-cut-stream.spz": "stream rotations",
    "spz4-stream-size.spz": "stream colors",
    "spz4-long-frame.spz": "stream alphas",
    "spz4-short-frame.spz": "5 of 6 alphas",
    "spz4-zstd.spz": "stream scales",
    "sog-missing-image.sog": "scales.webp",
    "sog-lossy.sog": "sh0.webp",
    "sog-not-an-image.sog": "quats.webp",
    "nan.ply": 0,
    "negative-scale.splat": 2,
    "negative-scale.ksplat": 2,
    "small-scales.spz": 6,
    "clamped-centers.spz": 1,
    "tree-range.spz": 3,
    "tree-order.spz": 4,
    "tree-self-loop.spz": 3,
    "tree-root-is-a-child.spz": 0,
    "tree-orphan.spz": 9,
    "tree-skipped-child.spz": 1,
    "tree-lost-branch.spz": 9,
    "tree-no-links.spz": 1,
    "tree-shared.spz": 5,
    "tree-leaf-start.spz": 2,
    "tree-opaque-leaf.spz": 2,
    "tree-small-parent.spz": 1,
    "tree-fine-first.spz": 553,
}

#: Codes that no file can be given: the decoders of all formats give opacities of 0 to 1 and rotations of length 1.
UNPLANTED = {"values.opacity", "values.rotation"}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found_by_its_code_and_no_other(
    name: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(FOLDER)
    code = run(["inspect", "--check", name])
    out, err = capsys.readouterr()
    found = [line.split(": ", 3) for line in out.splitlines()]
    assert {each[2] for each in found} == FAULTS[name], out
    assert all(each[0] == name and each[1] == CODES[each[2]][0] for each in found)
    assert len(found) == len(FAULTS[name])  # a line a code, however many splats it is about
    assert code == (3 if any(CODES[each][0] == ERROR for each in FAULTS[name]) else 0)
    assert err == ""


@pytest.mark.parametrize("name", PLACES)
def test_a_finding_says_where_the_fault_is(name: str) -> None:
    found = checked(FOLDER / name).findings or []
    place = PLACES[name]
    if isinstance(place, int):
        assert found[0].index == place
        assert f"{place:,}" in found[0].message
    else:
        assert place in found[0].message


def test_every_file_is_in_the_table_and_every_code_has_a_file() -> None:
    assert {path.name for path in FOLDER.iterdir()} == FAULTS.keys()
    groups = ("file.", "container.", "values.", "tree.")
    codes = {code for code in CODES if code.startswith(groups)}
    assert codes - set.union(*FAULTS.values()) == UNPLANTED


def checked(path: Path) -> Report:
    return inspect(path, ReportSettings(check=True))[0]


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
    findings = checked(FIXTURES / name).findings or []
    assert {found.code for found in findings} == ODD.get(name, set()), findings


#: What is said of trees of scenes that SPZ does not hold, or hardly.
ODD_TREES = {"huge.ply": {"values.center-far", "values.scale-clamped"}}
SCENES = [
    *(f"sh{degree}.ply" for degree in range(4)),
    *("flat.ply", "needle.ply", "coincident.ply", "one.ply", "demo.ply"),
    *ODD_TREES,
]


def bake(source: Path, output: Path, *options: object) -> Path:
    assert run(["build-lod", str(source), "-o", str(output), "-q", *map(str, options)]) == 0
    return output


@pytest.mark.parametrize("base", [1.1, 1.5, 2.0])
@pytest.mark.parametrize("name", SCENES)
def test_baked_trees_give_no_finding(name: str, base: float, tmp_path: Path) -> None:
    for version in (2, 3):
        report = checked(bake(FIXTURES / name, tmp_path / f"{version}.spz", "--base", base, "--spz-version", version))
        assert report.tree is not None
        assert {found.code for found in report.findings or []} == ODD_TREES.get(name, set()), report.findings


@pytest.mark.parametrize("base", [1.1, 2.0])
@pytest.mark.parametrize("name", ["biker.ply", "biker.spz", "playbot-125k.ply", "meadow.sog"])
def test_baked_trees_of_real_scenes_give_no_finding(name: str, base: float, tmp_path: Path) -> None:
    source = real_scene(name)
    assert checked(source).findings == []
    report = checked(bake(source, tmp_path / "out.spz", "--base", base))
    assert report.findings == []


def padded(member: bytes, size: int) -> bytes:
    """A gzip member of so many bytes: one with a name of its file, which may be of any length."""
    return member[:3] + b"\x08" + member[4:10] + b"n" * (size - len(member) - 1) + b"\0" + member[10:]


@pytest.mark.parametrize("size", [PIECE - 1, PIECE, PIECE + 1, 2 * PIECE])
def test_a_second_member_is_told_wherever_it_begins(size: int, tmp_path: Path) -> None:
    """Files are read in pieces, and a member may end where a piece does."""
    whole, path = gzip.decompress((FOLDER / "spz-two-members.spz").read_bytes()), tmp_path / "scene.spz"
    for first, second in ((whole, whole), (whole[:70], whole[70:])):
        path.write_bytes(padded(by_hand.gzip_stored(first), size) + by_hand.gzip_stored(second))
        assert [found.code for found in checked(path).findings or []] == ["container.members"]
    path.write_bytes(padded(by_hand.gzip_stored(whole), size) + b"more")
    assert [found.code for found in checked(path).findings or []] == ["container.trailing"]


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


SMALL = [path for path in [FOLDER / name for name in FAULTS] + [FIXTURES / name for name in GOOD] if path.is_file()]
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
