"""The page of `inspect --html` is well-formed, loads nothing, and has the figures of its report, whatever those are."""

from __future__ import annotations

import base64
import itertools
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from sparklod_cli.images.scene_plots import DescribedPicture
from sparklod_cli.inspection.html import FileSection, page
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.inspection.values import histogram_of, names_of
from sparklod_cli.tables.histograms import histogram
from tests.conftest import FIXTURES
from tests.scenes import random_splats

VOID = {"meta", "img", "link", "br", "hr", "input"}

LEVELS = [
    {"nodes": 1, "leaves": 0, "size": 4.5},
    {"nodes": 3, "leaves": 2, "size": None},
    {"nodes": 5000, "leaves": 5000, "size": 0.25},
]
TREE = {
    "leaves": 5002,
    "inner": 2,
    "growth": 1.0004,
    "depth": 2,
    "levels": LEVELS,
    "children": {"3": 1, "5000": 1},
    "more_than_opaque": 0.125,
    "chunks": 1,
    "chunks_of_coarse_cut": 1,
}

REPORT = {
    "schema_version": 1,
    "file": "scene-lod.spz",
    "bytes": 123_456,
    "format": "SPZ 3 LoD",
    "splats": 5004,
    "sh_degree": 2,
    "antialiased": False,
    "header": {"version": 3, "fractional_bits": 12, "flags": 128},
    "bytes_per_splat": 24.67,
    "compression_ratio": 6.1,
    "notes": [],
    "tree": TREE,
    "values": None,
    "findings": None,
}


class Reader(HTMLParser):
    """Checks that elements are nested as they should be, and remembers them."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len({name for name, _ in attrs}) == len(attrs)
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.text.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def read(text: str) -> Reader:
    """Parse a page and check what is true of every page: nothing runs, nothing is loaded, every link has a target."""
    assert text.startswith("<!DOCTYPE html>")
    assert "default-src &#x27;none&#x27;" in text
    text.encode("utf-8")
    reader = Reader()
    reader.feed(text)
    reader.close()
    assert reader.open == []
    assert not {tag for tag, _ in reader.elements} & {"script", "link", "iframe", "object", "embed", "form", "base"}
    for _, attributes in reader.elements:
        assert not [name for name in attributes if name.startswith("on")]
        assert (attributes.get("href") or "#").startswith("#")
        assert (attributes.get("src") or "data:image/png;base64,").startswith("data:image/png;base64,")
    assert not re.search(r"url\(|@import|https?:", text)
    ids = [attributes["id"] for _, attributes in reader.elements if "id" in attributes]
    assert len(set(ids)) == len(ids)
    targets = {attributes.get(name) for _, attributes in reader.elements for name in ("aria-labelledby", "href")}
    assert {str(target).lstrip("#") for target in targets - {None}} <= set(ids)
    assert all(image.get("alt") for image in reader.all("img"))
    assert all(chart.get("aria-label") for chart in reader.all("svg"))
    assert {table["scope"] for table in reader.all("th")} <= {"col", "row"}
    levels = [int(tag[1]) for tag, _ in reader.elements if re.fullmatch(r"h[1-6]", tag)]
    assert (levels[0], levels.count(1)) == (1, 1)
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    assert reader.all("html") == [{"lang": "en"}]
    return reader


def words(section: FileSection) -> str:
    return " ".join(" ".join(read(page([section])).text).split())


def test_a_page_has_the_figures_of_its_report() -> None:
    text = words(FileSection(REPORT))
    for part in (
        *("scene-lod.spz", "SPZ 3 LoD", "5,004", "0.1 MB", "24.7 bytes a node", "12.5 %", "Growth 1 nodes per leaf"),
        *("not checked", "Fractional bits 12"),
        "4,097 to 8,192 1",  # children
    ):
        assert part in text


def test_levels_have_bars_of_their_shares() -> None:
    text = page([FileSection(REPORT)])
    rows = re.findall(r'<tr><th scope="row">(\d)</th>.*?<div class="track"[^>]*>(.*?)</div>', text)
    widths = {level: re.findall(r'class="of(\d)" style="width:([\d.]+)%', bars) for level, bars in rows[:3]}
    assert widths == {"0": [("0", "0.02")], "1": [("0", "0.02"), ("1", "0.04")], "2": [("1", "100.00")]}


@pytest.mark.parametrize("name", ["<script>alert(1)</script>.spz", "a\"b'c&d.spz", "\udcff\x00\n.spz", "\u202egnp.spz"])
def test_names_on_the_page_are_escaped(name: str) -> None:
    finding = {"severity": "error", "code": name, "message": name, "index": None, "count": None}
    report = REPORT | {"file": name, "format": name, "notes": [name], "findings": [finding]}
    picture = DescribedPicture(b"png", f"{name}; {name}")
    section = FileSection(report, picture, {"x": histogram(np.arange(5, dtype=np.float32))})
    text = page([section, section])
    read(text)
    assert "<script" not in text
    if name.isprintable():
        assert name in words(section)


@pytest.mark.parametrize(
    "report",
    [
        {},
        {"file": "x.spz", "bytes": None, "format": None, "splats": None, "tree": None, "values": None, "findings": []},
        REPORT | {"tree": None},
        REPORT | {"tree": {}, "values": {}},
        REPORT | {"tree": TREE | {"levels": [], "children": {}}, "header": {}},
        {"file": "x.ply", "values": {"box": None, "box_98": None, "non_finite": 3, "quantities": {"x": {"p1": None}}}},
    ],
)
def test_missing_figures_are_left_out(report: dict[str, Any]) -> None:
    words(FileSection(report))


def test_findings_come_worst_first() -> None:
    findings = [
        {"severity": "note", "code": "tree.coarse-first", "message": "the note", "index": 1, "count": 2},
        {"severity": "error", "code": "tree.range", "message": "the error", "index": None, "count": None},
        {"severity": "warning", "code": "tree.size", "message": "the warning", "index": 1, "count": 2},
        {"severity": "error", "code": "tree.order", "message": "another error", "index": None, "count": None},
    ]
    text = words(FileSection(REPORT | {"findings": findings}))
    places = [text.index(message) for message in ("the error", "another error", "the warning", "the note")]
    assert places == sorted(places)
    assert "2 errors" in text
    assert "a node has children beyond the last node" in text
    assert "1 warning" in words(FileSection(REPORT | {"findings": findings[2:3]}))
    assert "no faults found" in words(FileSection(REPORT | {"findings": []}))


@pytest.mark.parametrize("count", [200, 201, 5000])
def test_findings_are_bounded_and_the_worst_are_kept(count: int) -> None:
    finding = {"code": "expect.value", "message": "x", "index": None, "count": None}
    findings = [finding | {"severity": "note"}] * (count - 1) + [finding | {"severity": "error", "message": "worst"}]
    text = page([FileSection(REPORT | {"findings": findings})])
    assert read(text).all("li")[0]["class"] == "error"
    assert "worst" in text
    assert (f"{count - 200:,} more findings are not listed" in text) == (count > 200)
    assert len(text) < 100_000


def test_a_picture_is_inside_the_page() -> None:
    section = FileSection(REPORT, DescribedPicture(b"\x89PNG bytes", "Level 3 of 9: 14 nodes; coloured by level"))
    (image,) = read(page([section])).all("img")
    assert image["alt"] == "Drawing of Level 3 of 9: 14 nodes"
    assert base64.b64decode(str(image["src"]).partition(",")[2]) == b"\x89PNG bytes"
    assert "coloured by level" in words(section)


def test_a_page_draws_every_histogram_that_has_bins() -> None:
    splats = random_splats(300, sh_degree=1)
    values = np.array([np.nan, 1, 2, 3, 1e9, -1e9] + [2] * 2000, np.float32)
    counted = {name: histogram_of(splats, name) for name in names_of(splats)}
    counted |= {"x": histogram(values), "y": histogram(values[:1]), "z": histogram(values[8:])}
    reader = read(page([FileSection(REPORT, histograms=counted)]))
    assert len(reader.all("svg")) == len(counted) - 1
    text = " ".join(reader.text)
    assert "no numbers" in text
    assert "1 not finite" in text
    assert all(0 <= float(str(rect["height"])) <= 150 for rect in reader.all("rect"))


def test_many_files_are_listed() -> None:
    reader = read(page([FileSection(REPORT | {"file": f"{name}.spz"}) for name in "abc"]))
    assert [link["href"] for link in reader.all("a")] == ["#file-1", "#file-2", "#file-3"]
    assert len(reader.all("article")) == 3
    assert "Report on 3 splat files" in " ".join(reader.text)


@pytest.mark.parametrize(
    "name", ["golden/tree-v3.spz", "golden/sh3-v2.sog", "golden/sh1-streamed-sog", "sh1.ply", "points.ply"]
)
def test_a_page_of_a_real_file_says_what_its_report_says(name: str) -> None:
    settings = ReportSettings(values=True, all_quantities=True, check=True, at_once=True)
    report, scene = inspect(FIXTURES / name, settings)
    counted = {} if scene is None else {name: histogram_of(scene.splats, name) for name in names_of(scene.splats)}
    text = words(FileSection(report.as_dict(), histograms=counted))
    assert name in text
    assert ("Nodes by depth" in text) == (report.tree is not None)
    assert ("Detail levels" in text) == (report.streamed_sog is not None)
    assert ("anisotropy" in text) == (scene is not None)
