"""`inspect --json` prints what `schema.json` and the pages of `inspect` describe."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from sparklod_cli.cli import run
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.formats import FORMATS, WriteOptions
from sparklod_cli.inspection import values
from sparklod_cli.inspection.findings import CODES
from sparklod_cli.inspection.report import CHUNK_COLUMNS, SCHEMA_VERSION, ReportSettings, inspect, value_at
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import MAX_CHILDREN, LodTree
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES, ROOT, Capture
from tests.scenes import random_splats

SCHEMA = json.loads(files("sparklod_cli.inspection").joinpath("schema.json").read_text(encoding="utf-8"))
VALIDATOR = Draft202012Validator(SCHEMA)
SUFFIXES = {suffix for form in FORMATS for suffix in form.suffixes}
FILES = sorted(path for path in FIXTURES.rglob("*") if path.suffix in SUFFIXES)
SMALL = [path for path in FILES if path.stat().st_size < 100_000 and "faults" not in path.parts]

WAYS = {
    "plain": ReportSettings(),
    "values": ReportSettings(values=True),
    "stats": ReportSettings(values=True, all_quantities=True),
    "check": ReportSettings(check=True),
    "all": ReportSettings(chunks=True, values=True, all_quantities=True, check=True),
}

Report = dict[str, Any]


def name_of(value: Any) -> str | None:
    """The name of a test of a fixture."""
    return value.relative_to(FIXTURES).as_posix() if isinstance(value, Path) else None


def report_of(path: Path, wanted: ReportSettings) -> Report:
    """A report as it comes back from JSON, which does not take a NaN."""
    report: Report = json.loads(json.dumps(inspect(path, wanted)[0].as_dict(), allow_nan=False))
    return report


def faults(report: Report) -> list[str]:
    """Places where a report does not follow the schema."""
    return [f"{error.json_path}: {error.message}" for error in VALIDATOR.iter_errors(report)]


@pytest.fixture
def lod(tmp_path: Path) -> Path:
    """A tree of SH degree 3."""
    path = tmp_path / "tree.spz"
    path.write_bytes(b"".join(spz.encode(Scene(*quick.build(random_splats(300, sh_degree=3))))))
    return path


def broken(path: Path) -> Iterator[tuple[str, bytes]]:
    """Damaged copies of a file, by name of the damage."""
    data = path.read_bytes()
    yield "empty", b""
    for share in (0.01, 0.3, 0.9, 0.999):
        yield f"cut at {share}", data[: int(share * len(data))]
    for share in (0.001, 0.2, 0.6, 0.95):
        at = int(share * len(data))
        yield f"changed at {share}", data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :]
    yield "longer", data + b"more"
    yield "twice", data + data


@pytest.mark.parametrize("wanted", WAYS.values(), ids=WAYS.keys())
@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_reports_of_the_fixtures_follow_the_schema(path: Path, wanted: ReportSettings) -> None:
    assert faults(report_of(path, wanted)) == []


@pytest.mark.parametrize("wanted", WAYS.values(), ids=WAYS.keys())
@pytest.mark.parametrize("path", SMALL, ids=name_of)
@pytest.mark.slow
def test_reports_of_broken_files_follow_the_schema(tmp_path: Path, path: Path, wanted: ReportSettings) -> None:
    for name, data in broken(path):
        file = tmp_path / f"broken{path.suffix}"
        file.write_bytes(data)
        assert faults(report_of(file, wanted)) == [], name


@pytest.mark.parametrize("most", [1, 3, MAX_CHILDREN])
@pytest.mark.parametrize("count", [1, 2, 5, 300])
@pytest.mark.slow
def test_reports_of_broken_trees_follow_the_schema(tmp_path: Path, count: int, most: int) -> None:
    """Links that lead anywhere, and splats that are nowhere to be seen."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        splats = random_splats(count, seed=seed)
        splats.scale[rng.random(count) < 0.2] = 0
        splats.opacity[rng.random(count) < 0.2] = rng.choice([0, 1, 900])
        tree = LodTree(
            rng.integers(0, most + 1, count).astype(np.uint16), rng.integers(0, count + 2, count).astype(np.uint32)
        )
        path = tmp_path / "tree.spz"
        path.write_bytes(b"".join(spz.encode(Scene(splats, tree), WriteOptions(fractional_bits=12))))
        for name, wanted in WAYS.items():
            assert faults(report_of(path, wanted)) == [], (seed, name)


@pytest.mark.parametrize("wanted", WAYS.values(), ids=WAYS.keys())
@pytest.mark.parametrize("path", ["missing.spz", "."])
def test_reports_of_unreadable_files_follow_the_schema(tmp_path: Path, path: str, wanted: ReportSettings) -> None:
    report = report_of(tmp_path / path, wanted)
    assert faults(report) == []
    assert report["findings"][0]["code"] == "file.unreadable"


def test_reports_that_the_command_prints_follow_the_schema(lod: Path, capsys: Capture) -> None:
    """With findings of expectations, too; many files give JSON lines."""
    options = ["--json", "--stats", "--check"]
    options += [part for text in ("bytes<=1", "sh==0", "growth<=1") for part in ("--assert", text)]
    assert run(["inspect", str(lod), "missing.spz", str(FIXTURES / "sh2.ply"), *options]) == 3
    reports = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [faults(report) for report in reports] == [[], [], []]
    assert [found["code"] for found in reports[0]["findings"]] == ["expect.bytes", "expect.sh", "expect.growth"]
    assert reports[1]["findings"][0]["code"] == "file.unreadable"


# --- The schema is strict ---------------------------------------------------------------------------------------------


def places(report: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The ways to every value of a report."""
    for key, value in report.items() if isinstance(report, dict) else enumerate(report):
        yield (*way, key)
        if isinstance(value, (dict, list)):
            yield from places(value, (*way, key))


def holder(report: Any, way: tuple[Any, ...]) -> Any:
    for key in way[:-1]:
        report = report[key]
    return report


@pytest.fixture
def full(lod: Path) -> Report:
    """A report in which nothing is null that need not be."""
    report = report_of(lod, ReportSettings(chunks=True, values=True, all_quantities=True, check=True))
    report["chunks"][0]["bytes"] = 1
    finding = {"severity": "error", "code": "tree.size", "message": "node 3", "index": 3, "count": 1}
    rad = report_of(FIXTURES / "golden" / "sh1-tree.rad", ReportSettings())["rad"]
    streamed = report_of(FIXTURES / "golden" / "sh1-streamed-sog", ReportSettings())["streamed_sog"]
    tiles = report_of(FIXTURES / "golden" / "sh1-tiles", ReportSettings())["tiles"]
    place = {"latitude": 47.0, "longitude": 8.0, "height": 400.0, "heading": 90.0}
    tiles |= {"generator": "by hand", "georeference": place}
    facts = {"rad": rad, "streamed_sog": streamed, "tiles": tiles}
    report = report | {"findings": [finding], "notes": ["a note"]} | facts
    assert faults(report) == []
    return report


@pytest.mark.parametrize(
    "field, value", [("code", "tree.ghost"), ("severity", "fatal"), ("index", -1), ("count", 0), ("message", None)]
)
def test_an_unknown_code_of_a_finding_is_noticed(full: Report, field: str, value: object) -> None:
    full["findings"][0][field] = value
    assert faults(full)


def test_reports_of_unread_files_have_no_figures(full: Report) -> None:
    assert faults(full | {"format": None})
    report = report_of(Path("missing.spz"), ReportSettings())
    assert faults(report | {"findings": []})
    assert faults(report | {"splats": 3})
    assert faults(report | {"format": "PLY"})


def schemas(schema: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Every object in the schema that has properties, by name."""
    if isinstance(schema, list):
        for each in schema:
            yield from schemas(each, name)
    elif isinstance(schema, dict):
        if "properties" in schema and name not in ("if", "then", "else"):
            yield name, schema
        for key, each in schema.items():
            yield from schemas(each, key)


def test_the_schema_is_strict_and_describes_every_field() -> None:
    Draft202012Validator.check_schema(SCHEMA)
    found = [(name, schema) for name, schema in schemas(SCHEMA) if "type" in schema]
    assert len(found) > 20
    for name, schema in found:
        assert schema["additionalProperties"] is False, name
        assert all(each["description"].endswith(".") for each in schema["properties"].values()), name
        if name not in ("header", "quantities"):  # whose fields depend on the file
            assert schema["required"] == list(schema["properties"]), name
    assert all(schema["description"] for schema in SCHEMA["$defs"].values())


def test_the_schema_has_the_fields_of_the_code() -> None:
    assert SCHEMA["properties"]["schema_version"]["const"] == SCHEMA_VERSION
    finding = SCHEMA["$defs"]["finding"]["properties"]
    assert finding["code"]["enum"] == list(CODES)
    assert set(finding["severity"]["enum"]) == {severity for severity, _ in CODES.values()}
    quantities = SCHEMA["$defs"]["values"]["properties"]["quantities"]
    assert list(quantities["properties"]) == list(values.QUANTITIES)
    assert quantities["required"] == list(values.MAIN)
    assert list(SCHEMA["$defs"]["summary"]["properties"]) == [*values.LEVELS, "mean"]


def test_every_header_field_occurs_in_a_fixture() -> None:
    seen: set[str] = set()
    for path in FILES:
        seen |= report_of(path, ReportSettings())["header"].keys()
    assert seen == SCHEMA["properties"]["header"]["properties"].keys()


# --- The pages --------------------------------------------------------------------------------------------------------

#: The pages of `inspect`, one after the other.
PAGES = "\n".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").glob("inspect*.md")))


def rows(heading: str) -> list[list[str]]:
    """Return the cells, without their marks, of the first table below each heading of this text."""
    tables = re.findall(rf"^#+ {re.escape(heading)}\n(?:(?!#).*\n)*?\| ---.*\n((?:\|.*\n)+)", PAGES, re.MULTILINE)
    lines = "".join(tables).splitlines()
    return [[cell.strip().strip("`") for cell in line.strip("|").split(" | ")] for line in lines]


def test_the_pages_have_every_field_once(full: Report) -> None:
    named = [row[0] for row in rows("Fields")]
    assert len(set(named)) == len(named)
    for way in named:
        way = re.sub(r"\bN\b", "0", way).replace("NAME", "opacity").replace("CHILDREN", "2")
        value_at(full, way.replace("KEY", "rgbMax").replace("PROPERTY", "center"))
    tops = {way.split(".")[0] for way in named}
    assert tops == SCHEMA["properties"].keys()
    for name in ("rad", "streamed_sog", "tiles", "tree", "values"):
        assert {way.split(".")[1] for way in named if way.startswith(f"{name}.")} == full[name].keys()
    assert {way.split(".")[2] for way in named if way.startswith("chunks.")} == {each.name for each in CHUNK_COLUMNS}
    assert {way.split(".")[2] for way in named if way.startswith("findings.")} == full["findings"][0].keys()


def test_the_pages_have_every_quantity() -> None:
    assert [row[0] for row in rows("Quantities")] == list(values.QUANTITIES)
