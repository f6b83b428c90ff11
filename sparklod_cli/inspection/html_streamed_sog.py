"""The part of a page about a Streamed SOG: its detail levels, its regions and its files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..figures.svg import bar, text_of
from .html_parts import NONE, number_text, panel, size_text, table_of


def streamed_sog_panels(streamed: Mapping[str, Any]) -> str:
    """The panels, from `streamed_sog` of a report as JSON."""
    levels = panel("Detail levels", _levels(streamed["levels"]))
    return f'{levels}\n<div class="two">{panel("Container", _container(streamed))}{_regions(streamed)}</div>'


def _levels(levels: list[Mapping[str, Any]]) -> str:
    most = max(level["splats"] for level in levels) or 1
    rows = []
    for number, level in enumerate(levels):
        share = NONE if level["share"] is None else f"{100 * level['share']:.1f} %"
        errors = level["errors"] or {}
        cells = [number_text(level["splats"]), share, number_text(level["regions"]), number_text(level["files"])]
        cells += [size_text(level["bytes"]), *(number_text(errors.get(name)) for name in ("p25", "p50", "p75"))]
        rows.append([f"{number}", *cells, bar(level["splats"] / most)])
    head = ("Level", "Splats", "Share", "Regions", "Files", "Size", "Error, 25 %", "Median", "75 %", "")
    caption = "Level 0 is full detail. Errors of regions, each weighted by its splats at level 0."
    return table_of(head, rows, caption)


def _container(streamed: Mapping[str, Any]) -> str:
    facts = [
        ["Manifest", size_text(streamed["manifest_bytes"])],
        ["Manifest, coarsest level and environment", size_text(streamed["first_bytes"])],
        ["Chunk files", number_text(streamed["files"])],
    ]
    if streamed["file_bytes"]:
        sizes = [size_text(streamed["file_bytes"][name]) for name in ("min", "median", "max")]
        facts.append(["Smallest, median and largest chunk file", ", ".join(sizes)])
    if streamed["environment"]:
        around = streamed["environment"]
        facts.append(["Environment", f"{number_text(around['splats'])} splats, {size_text(around['bytes'])}"])
    if streamed["generator"]:
        facts.append(["Written by", text_of(streamed["generator"])])
    return table_of(("Streamed SOG", ""), facts, "As its manifest says.")


def _regions(streamed: Mapping[str, Any]) -> str:
    names = ("min", "p25", "p50", "p75", "max", "mean")
    rows = [
        [what, *(number_text(streamed[field][name]) for name in names)]
        for what, field in (("Splats at level 0", "region_splats"), ("Longest edge, world units", "region_edge"))
    ]
    caption = f"{number_text(streamed['regions'])} regions; depth of their tree: {number_text(streamed['depth'])}."
    return panel("Regions", table_of(("", *names), rows, caption))
