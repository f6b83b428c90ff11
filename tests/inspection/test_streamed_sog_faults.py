"""Every promise of Streamed SOG that a folder breaks is found by its code, and by no other; sound ones have none."""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli
from fixtures.by_hand_sog import sog_files
from fixtures.by_hand_streamed_sog import joined
from sparklod_cli.codecs import streamed_sog as codec
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.streamed_manifest import ERRORS, WARNINGS
from sparklod_cli.inspection.report import Report, ReportSettings, inspect
from sparklod_cli.io.reading import read_parts
from sparklod_cli.io.writing import parts_output
from sparklod_cli.lod import parts, quick
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.system.errors import FormatError
from tests.inspection.streamed_sog_files import COUNTS, Folder, Node, folder, regions, splats
from tests.inspection.test_schema import faults as schema_faults
from tests.inspection.test_schema import places
from tests.outputs import write_files
from tests.scenes import random_splats

SOUND = folder()
#: One region, whose chunk files hold nothing else.
ALONE = folder(((40, 6),))


def checked(path: Path) -> Report:
    return inspect(path, ReportSettings(check=True))[0]


def codes(path: Path) -> list[str]:
    return [found.code.removeprefix("streamed-sog.") for found in checked(path).findings or []]


def leaf(number: int, /, **fields: Any) -> Folder:
    """A folder with other fields of one region; those that are None are left out."""

    def change(manifest: Node) -> None:
        node = regions(manifest)[number]
        node.update(fields)
        for name in [name for name, value in fields.items() if value is None]:
            del node[name]

    return SOUND.changed(change)


def run_of(number: int, level: int, /, **fields: Any) -> Folder:
    """A folder with other fields of a run."""
    return SOUND.changed(lambda manifest: regions(manifest)[number]["lods"][str(level)].update(fields))


def tree(change: Callable[[Node], Node]) -> Folder:
    """A folder with another tree."""
    return SOUND.changed(lambda manifest: manifest.update(tree=change(manifest["tree"])))


def root(**fields: Any) -> Folder:
    return tree(lambda node: node | fields)


def swapped(manifest: Node) -> None:
    """Two levels of a region, of as many splats, are in each other's files."""
    lods = regions(manifest)[1]["lods"]
    lods["1"], lods["2"] = lods["2"], lods["1"]


def squeezed(manifest: Node) -> None:
    """The bound of the last region, and so that of all, ends where its splats begin."""
    node = regions(manifest)[-1]
    node["bound"]["max"][0] = node["bound"]["min"][0]
    manifest["tree"]["bound"]["max"][0] = max(each["bound"]["max"][0] for each in regions(manifest))


def shuffled() -> dict[str, bytes | None]:
    """The chunk file of level 0, in which the splats of the first region are in no order."""
    columns = joined([splats(row[0], 3.0 * number) for number, row in enumerate(COUNTS)])
    count = COUNTS[0][0]
    columns["center"][:count] = columns["center"][77 * np.arange(count) % count]
    return {f"0_0/{name}": data for name, data in sog_files(**columns).items()}


def of_degree_1() -> dict[str, bytes | None]:
    """The chunk file of level 1, with spherical harmonics."""
    return {name: data for name, data in folder(sh_degree=1).files.items() if name.startswith("1_0/")}


def deep(depth: int) -> Node:
    """A tree of so many nodes on one way."""
    node: Node = {"bound": SOUND.manifest["tree"]["bound"], "lods": {}}
    for _ in range(depth):
        node = {"bound": node["bound"], "children": [node]}
    return node


FAULTS: dict[str, tuple[Folder, set[str]]] = {
    "another version": (SOUND.having(version=2), {"container.version"}),
    "a version that is a text": (SOUND.having(version="1"), {"container.version"}),
    "no levels": (SOUND.having(lodLevels=0), {"container.corrupt"}),
    "very many levels": (SOUND.having(lodLevels=10**18), {"container.corrupt"}),
    "levels in words": (SOUND.having(lodLevels="three"), {"container.corrupt"}),
    "filenames that are numbers": (SOUND.having(filenames=[1, 2, 3]), {"container.corrupt"}),
    "no tree": (SOUND.having(tree=None), {"container.corrupt"}),
    "a tree that is a list": (SOUND.having(tree=[]), {"container.corrupt"}),
    "a run at a level beyond": (leaf(0, lods={"3": {"file": 0, "offset": 0, "count": 1}}), {"container.corrupt"}),
    "a run at level 01": (leaf(0, lods={"01": {"file": 0, "offset": 0, "count": 1}}), {"container.corrupt"}),
    "a run in no file": (run_of(0, 0, file=99), {"container.corrupt"}),
    "a run before its file": (run_of(0, 0, offset=-1), {"container.corrupt"}),
    "a run of half a splat": (run_of(0, 0, count=1.5), {"container.corrupt"}),
    "a run of very many splats": (run_of(0, 0, count=2**63), {"container.corrupt"}),
    "an environment that is a number": (SOUND.having(environment=1), {"container.corrupt"}),
    "a tree that is too deep": (SOUND.having(tree=deep(300)), {"container.corrupt"}),
    "no version": (SOUND.having(version=None, count=None, counts=None), {"old"}),
    "one child": (tree(lambda node: {"bound": node["bound"], "children": [node]}), {"nodes"}),
    "a long way of single children": (
        SOUND.having(tree=deep(100)),
        {"nodes", "unused", "counts", "full-detail", "coarsest", "lod-errors", "decreasing"},
    ),
    "three children": (
        tree(lambda node: node | {"children": [*node["children"], node["children"][0] | {"lods": {}}]}),
        {"nodes", "full-detail", "coarsest"},
    ),
    "children and runs": (root(lods={}), {"nodes"}),
    "neither children nor runs": (
        tree(lambda node: {"bound": node["bound"], "children": [node, {"bound": node["bound"]}]}),
        {"nodes"},
    ),
    "no bound": (leaf(0, bound=None), {"bounds"}),
    "a bound with null": (leaf(0, bound={"min": [0, 0, None], "max": [1, 1, 1]}), {"bounds"}),
    "an endless bound": (leaf(0, bound={"min": [0, 0, -1e999], "max": [1, 1, 1]}), {"bounds"}),
    "a bound without a number": (leaf(0, bound={"min": [0, 0, float("nan")], "max": [1, 1, 1]}), {"bounds"}),
    "a bound the wrong way round": (leaf(0, bound={"min": [9, 9, 9], "max": [1, 1, 1]}), {"bounds"}),
    "a bound of all that is too large": (root(bound={"min": [-99, -99, -99], "max": [99, 99, 99]}), {"union"}),
    "a bound that is too small": (SOUND.changed(squeezed), {"extents"}),
    "too few errors": (leaf(0, errors=[0, 0.1]), {"errors"}),
    "an error below 0": (leaf(0, errors=[0, -0.1, 0.1]), {"errors"}),
    "an error that is null": (leaf(0, errors=[0, None, 0.1]), {"errors"}),
    "an endless error": (leaf(0, errors=[0, 0.1, 1e999]), {"errors"}),
    "errors in words": (leaf(0, errors="none"), {"errors"}),
    "an error at level 0": (leaf(0, errors=[0.1, 0.1, 0.1]), {"errors"}),
    "errors that decrease": (leaf(0, errors=[0, 0.2, 0.1]), {"errors"}),
    "errors of one region only": (leaf(0, errors=None), {"lod-errors"}),
    "errors that the head denies": (SOUND.having(lodErrors=False), {"lod-errors"}),
    "errors that are not there": (folder(errors=False).having(lodErrors=True), {"lod-errors"}),
    "another sum": (SOUND.having(count=1), {"counts"}),
    "another sum of a level": (SOUND.having(counts=[224, 18, 13]), {"counts"}),
    "sums of fewer levels": (SOUND.having(counts=[224, 18]), {"counts"}),
    "a sum in words": (SOUND.having(count="many"), {"counts"}),
    "a file elsewhere": (SOUND.having(filenames=["../0_0/meta.json", "1_0/meta.json", "2_0/meta.json"]), {"filenames"}),
    "a file at the root": (SOUND.having(filenames=["/0_0/meta.json", "1_0/meta.json", "2_0/meta.json"]), {"filenames"}),
    "a file on a server": (
        SOUND.having(filenames=["https://a.example/0_0", "1_0/meta.json", "2_0/meta.json"]),
        {"filenames"},
    ),
    "a file twice": (SOUND.having(filenames=[*SOUND.manifest["filenames"], "0_0/meta.json"]), {"filenames", "unused"}),
    "no file": (SOUND.with_files({"1_0/meta.json": None}), {"chunk-files"}),
    "a file that is no SOG": (SOUND.with_files({"1_0/meta.json": b"[]"}), {"chunk-files"}),
    "a file without an image": (SOUND.with_files({"1_0/quats.webp": None}), {"chunk-files"}),
    "an image that is cut short": (
        SOUND.with_files({"0_0/quats.webp": SOUND.files["0_0/quats.webp"][:-40]}),
        {"chunk-files"},
    ),
    "an image of a coarse level that is cut short": (
        SOUND.with_files({"2_0/quats.webp": SOUND.files["2_0/quats.webp"][:-40]}),
        {"chunk-files"},
    ),
    "a file of two levels": (SOUND.changed(swapped), {"mixed"}),
    "runs that overlap": (run_of(1, 0, offset=199), {"runs"}),
    "a gap between runs": (run_of(1, 0, offset=201), {"runs"}),
    "a run that is too short": (run_of(1, 0, count=23), {"runs", "counts"}),
    "a run that is too long": (run_of(1, 0, count=25), {"runs", "counts"}),
    "a file that no region has": (SOUND.having(filenames=[*SOUND.manifest["filenames"], "env/meta.json"]), {"unused"}),
    "no environment": (SOUND.with_files({"env/meta.json": None}), {"environment"}),
    "an environment elsewhere": (SOUND.having(environment="../env/meta.json"), {"environment"}),
    "a region without full detail": (folder(((40, 12, 6), (0, 6, 6))), {"full-detail"}),
    "a region that disappears": (folder(((40, 12, 6), (24, 6, 0))), {"coarsest"}),
    "a level that is as large": (folder(((40, 12, 12), (24, 6, 6))), {"decreasing"}),
    "another degree": (SOUND.with_files(of_degree_1()), {"kind"}),
    "no order": (SOUND.with_files(shuffled()), {"order"}),
    "rotations of a coarse level that are none": (
        ALONE.with_files({"1_0/quats.webp": ALONE.files["1_0/sh0.webp"]}),
        {"values.non-finite"},
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found_by_its_code_and_no_other(name: str, tmp_path: Path) -> None:
    broken, expected = FAULTS[name]
    found = codes(broken.write(tmp_path))
    assert len(found) == len(set(found))  # a finding a code, however many regions it is about
    assert set(found) == expected, checked(tmp_path).findings


def test_every_code_of_the_promises_has_a_fault() -> None:
    planted = {f"streamed-sog.{code}" for _, expected in FAULTS.values() for code in expected}
    assert {*ERRORS, *WARNINGS} <= planted


@pytest.mark.parametrize(
    "sound", [SOUND, ALONE, folder(sh_degree=1), folder(errors=False), SOUND.having(environment=None)]
)
def test_sound_folders_have_no_findings(sound: Folder, tmp_path: Path) -> None:
    assert codes(sound.write(tmp_path)) == []
    assert codes(tmp_path) == []


def test_what_we_write_has_no_findings(tmp_path: Path) -> None:
    """Neither as Streamed SOG, whose codes move splats within their bounds and out of their order, nor as SOG."""
    settings = DetailSettings((0.3, 0.1), chunk_splats=2_000, extent=2, min_splats=100)
    scene = parts.make_levels(*quick.build(random_splats(3_000, sh_degree=0)), settings)
    errors = np.arange(3) * np.ones((scene.regions, 1))
    scene = replace(scene, errors=errors, environment=random_splats(50, sh_degree=0, seed=1))
    path = tmp_path / "lod-meta.json"
    write_files(parts_output(path, overwrite=False), codec.encode_files(scene, WriteOptions(), settings))
    assert checked(path).findings == []
    assert checked(path).value_at("streamed_sog.regions") > 3
    for name in ("scene.sog", "sog/meta.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        sparklod_cli.write(tmp_path / name, scene.scene())
        assert checked(tmp_path / name).findings == []


def rounded(value: Any, digits: int) -> Any:
    """A value of JSON whose numbers have only so many digits."""
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {key: rounded(each, digits) for key, each in value.items()}
    return [rounded(each, digits) for each in value] if isinstance(value, list) else value


def test_numbers_with_seven_digits_are_no_fault(tmp_path: Path) -> None:
    """Bounds need not enclose splats to more digits than are written."""

    def moved(manifest: Node) -> None:
        for node in regions(manifest):
            node["bound"]["min"][0] += 1.23456789e-7
        manifest["tree"]["bound"]["min"][0] = regions(manifest)[0]["bound"]["min"][0]
        manifest["tree"] = rounded(manifest["tree"], 7)

    assert codes(SOUND.changed(moved).write(tmp_path)) == []


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_fatal_is_an_error_and_the_reader_gives_the_same_code(name: str, tmp_path: Path) -> None:
    """`inspect` without --check fails where the other commands do."""
    broken, expected = FAULTS[name]
    path = broken.write(tmp_path)
    report, scene = inspect(path, ReportSettings())
    if scene is None:
        found = {finding.code.removeprefix("streamed-sog.") for finding in report.findings or []}
        assert found and found <= expected
        assert all(finding.severity == "error" for finding in report.findings or [])
        with pytest.raises(FormatError) as refused:
            read_parts(path)
        assert refused.value.code.removeprefix("streamed-sog.") in expected | {"chunk-files"}


def test_a_finding_is_about_the_first_region_and_counts_the_others(tmp_path: Path) -> None:
    def change(manifest: Node) -> None:
        for node in regions(manifest):
            node["errors"] = [0, 0.2, 0.1]

    (found,) = checked(SOUND.changed(change).write(tmp_path)).findings or []
    assert found.message == ("tree.children[0].errors is [0, 0.2, 0.1], which decrease (and 1 more like it)")


def test_all_that_is_broken_is_told_at_once(tmp_path: Path) -> None:
    broken = SOUND.having(count=1, environment="/env", lodErrors=False).with_files({"2_0/meta.json": None})
    assert set(codes(broken.write(tmp_path))) == {"counts", "environment", "lod-errors", "chunk-files"}


#: What a stranger may put in place of any value.
HOSTILE = [None, True, -1, 2**53, 10**30, 1e308, float("nan"), -1e999, "", "../x", "\x1b[2J", [], [[]], {}, {"0": {}}]


def test_nothing_in_a_manifest_breaks_the_report(tmp_path: Path) -> None:
    """Any value may be anything: the report follows the schema, and readers raise nothing but format errors."""
    path = ALONE.write(tmp_path)
    some = list(itertools.product(places(ALONE.manifest), HOSTILE))[::4]  # all values at neighbouring places
    for number, (way, value) in enumerate(some):
        manifest = copy.deepcopy(ALONE.manifest)
        held: Any = manifest
        for key in way[:-1]:
            held = held[key]
        held[way[-1]] = value
        path.write_text(json.dumps(manifest))
        wanted = ReportSettings(headers_only=True) if number % 20 else ReportSettings(check=True)
        report = json.loads(json.dumps(inspect(path, wanted)[0].as_dict(), allow_nan=False))
        assert schema_faults(report) == [], (way, value)
