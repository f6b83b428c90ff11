"""Reports as one self-contained page of HTML, without scripts and without access to a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from typing import Any

from .. import __version__
from ..figures.tree_plot import DescribedPicture
from ..model.scene import Scene
from ..tables.histograms import Histogram
from . import values
from .findings import CODES, ERROR, NOTE, WARNING
from .html_parts import (
    NONE,
    bar,
    children_groups,
    figure_of,
    histogram_chart,
    number_text,
    panel,
    size_text,
    table_of,
    text_of,
)
from .report import Report


def streamed_sog_panels(streamed: Mapping[str, Any]) -> str:
    """Return the panels, from `streamed_sog` of a report as JSON."""
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


def tile_panels(tiles: Mapping[str, Any]) -> str:
    """Return the panels, from `tiles` of a report as JSON."""
    most = max(level["splats"] for level in tiles["levels"]) or 1
    rows = []
    for number, level in enumerate(tiles["levels"]):
        errors = level["errors"] or {}
        cells = [number_text(level[name]) for name in ("splats", "tiles", "leaves")]
        cells += [size_text(level["bytes"]), *(number_text(errors.get(name)) for name in ("min", "p50", "max"))]
        rows.append([f"{number}", *cells, bar(level["splats"] / most)])
    head = ("Depth", "Splats", "Tiles", "Without children", "Size", "Geometric error, least", "Median", "Largest", "")
    levels = table_of(head, rows, "Depth 0 is the root tile. Tiles without children have full detail.")
    facts = [
        ["Tileset files", f"{number_text(tiles['tilesets'])}, {size_text(tiles['tileset_bytes'])}"],
        ["Tileset files and the root tile", size_text(tiles["first_bytes"])],
    ]
    if tiles["file_bytes"]:
        sizes = [size_text(tiles["file_bytes"][name]) for name in ("min", "median", "max")]
        facts.append(["Smallest, median and largest tile", ", ".join(sizes)])
    if tiles["georeference"]:
        place = tiles["georeference"]
        where = ", ".join(number_text(place[name]) for name in ("latitude", "longitude", "height", "heading"))
        facts.append(["Latitude, longitude, height and heading", where])
    if tiles["generator"]:
        facts.append(["Written by", text_of(tiles["generator"])])
    about = table_of(("3D Tiles", ""), facts, "As the tileset says.")
    return f"{panel('Tiles', levels)}\n{panel('Container', about)}"


#: Content security policy: only the style and the pictures inside the page, whatever the name of a file contains.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"

#: Fields of a header that the page shows, by name, and their titles.
HEADER = {"version": "Version", "fractional_bits": "Fractional bits"}

#: Severities, the worst first.
SEVERITIES = (ERROR, WARNING, NOTE)

#: Most findings of a file that are listed; checks have some forty kinds, but a file of expectations has no limit.
MAX_FINDINGS = 200


@dataclass(frozen=True)
class FileSection:
    """The part of a page about one file.

    Attributes:
        report: as for JSON (`report.Report.as_dict`); fields that are missing or None are left out.
        picture: of the structure of the scene.
        histograms: by the name of the quantity.
        thumbnail: of the scene as a viewer draws it.
    """

    report: Mapping[str, Any]
    picture: DescribedPicture | None = None
    histograms: Mapping[str, Histogram] = field(default_factory=dict)
    thumbnail: DescribedPicture | None = None


def section_of(
    report: Report, scene: Scene | None, picture: DescribedPicture | None, thumbnail: DescribedPicture | None = None
) -> FileSection:
    """Return the section about a file: its report, its pictures, and histograms of what was read of it."""
    drawn = {}
    if scene is not None and len(scene.splats):
        drawn = {name: values.histogram_of(scene.splats, name) for name in values.names_of(scene.splats)}
    return FileSection(report.as_dict(), picture, drawn, thumbnail)


def page(sections: Sequence[FileSection]) -> str:
    """Return the page about one or more files, as HTML to be written in UTF-8."""
    one = len(sections) == 1
    title = f"{text_of(sections[0].report.get('file', ''))} \u2013 sparklod inspect" if one else "sparklod inspect"
    style = files(__package__).joinpath("page.css").read_text("utf-8")
    contents = "" if one else _contents(sections)
    body = "\n".join(_section(section, f"file-{number}") for number, section in enumerate(sections, 1))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="sparklod {__version__}">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
<header class="page"><h1>Report on {"a splat file" if one else f"{len(sections)} splat files"}</h1></header>
<main>
{contents}{body}
</main>
<footer>Written by sparklod {__version__}.</footer>
</body>
</html>
"""


def _verdict(report: Mapping[str, Any]) -> str:
    """Return the worst severity of the findings, as a badge."""
    findings = report.get("findings")
    if findings is None:
        return '<span class="badge plain">not checked</span>'
    for severity in SEVERITIES:
        count = sum(found.get("severity") == severity for found in findings)
        if count:
            return f'<span class="badge {severity}">{count} {severity}{"s" if count > 1 else ""}</span>'
    return '<span class="badge good">no faults found</span>'


def _contents(sections: Sequence[FileSection]) -> str:
    rows = []
    for number, report in enumerate((section.report for section in sections), 1):
        name = f'<a href="#file-{number}">{text_of(report.get("file", number))}</a>'
        size = report.get("bytes")
        rows.append(
            [
                name,
                text_of(report.get("format") or NONE),
                number_text(report.get("splats")),
                NONE if size is None else size_text(size),
                _verdict(report),
            ]
        )
    head = ("File", "Format", "Splats", "Size", "Findings")
    return f'<nav class="panel" aria-label="Files">{table_of(head, rows, "The files")}</nav>\n'


def _section(section: FileSection, anchor: str) -> str:
    report = section.report
    form = f'<span class="badge plain">{text_of(report["format"])}</span>' if report.get("format") else ""
    name = text_of(report.get("file", ""))
    parts = [
        f'<article id="{anchor}" aria-labelledby="{anchor}-name">',
        f'<div class="head"><h2 id="{anchor}-name">{name}</h2>{form}{_verdict(report)}</div>',
        _figures(report),
        _findings(report),
        figure_of(section.thumbnail, small=True),
        figure_of(section.picture),
    ]
    if report.get("rad"):
        parts.append(_rad(report["rad"]))
    if report.get("streamed_sog"):
        parts.append(streamed_sog_panels(report["streamed_sog"]))
    if report.get("tiles"):
        parts.append(tile_panels(report["tiles"]))
    if report.get("tree"):
        parts.append(_tree(report["tree"]))
    if report.get("values"):
        parts.append(_values(report["values"]))
    parts.append(_histograms(section.histograms))
    return "\n".join(part for part in [*parts, "</article>"] if part)


def _figures(report: Mapping[str, Any]) -> str:
    """Return the key figures, as cards."""
    tree, header = report.get("tree") or {}, report.get("header") or {}
    noun = "node" if tree else "splat"
    cards: list[tuple[str, str, str]] = []
    if report.get("splats") is not None:
        cards.append((f"{noun.title()}s", number_text(report["splats"]), ""))
    if report.get("bytes") is not None:
        each, ratio = report.get("bytes_per_splat"), report.get("compression_ratio")
        of_each = f"{each:.1f} bytes a {noun}" if each else ""
        of_ratio = f"{ratio:.1f} times smaller than as floats" if ratio else ""
        cards.append(("Size", size_text(report["bytes"]), ", ".join(filter(None, (of_each, of_ratio)))))
    if tree:
        share, needed = tree.get("more_than_opaque"), number_text(tree.get("chunks_of_coarse_cut"))
        opaque = "" if share is None else f"{100 * share:.1f} % of all nodes have D &gt; 1"
        cards += [
            ("Leaves", number_text(tree.get("leaves")), "splats of the scene"),
            ("Inner nodes", number_text(tree.get("inner")), opaque),
            ("Growth", number_text(tree.get("growth")), "nodes per leaf"),
            ("Depth", number_text(tree.get("depth")), "edges to the deepest node"),
            ("Chunks", number_text(tree.get("chunks")), f"{needed} for a coarse cut"),
        ]
    if report.get("sh_degree") is not None:
        cards.append(("SH degree", number_text(report["sh_degree"]), ""))
    if report.get("antialiased") is not None:
        cards.append(("Antialiased", "yes" if report["antialiased"] else "no", ""))
    if report.get("up") is not None:
        cards.append(("Up", text_of(report["up"]), "axis that points up"))
    cards += [(title, number_text(header[name]), "") for name, title in HEADER.items() if name in header]
    items = []
    for title, value, small in cards:
        more = f"<small>{small}</small>" if small else ""
        items.append(f"<div><dt>{title}</dt><dd>{value}{more}</dd></div>")
    return f'<dl class="figures">{"".join(items)}</dl>' if cards else ""


def _findings(report: Mapping[str, Any]) -> str:
    findings = report.get("findings")
    notes = "".join(f"<p>{text_of(note)}</p>" for note in (*(report.get("notes") or ()), *(report.get("hints") or ())))
    if not findings:
        return panel("Notes", notes)
    items = []
    worst_first = sorted(findings, key=lambda found: SEVERITIES.index(found["severity"]))
    for found in worst_first[:MAX_FINDINGS]:
        severity, code, message = (text_of(found[name]) for name in ("severity", "code", "message"))
        meaning = text_of(CODES[found["code"]][1]) if found["code"] in CODES else ""
        head = f'<b>{severity}</b><code>{code}</code> <span class="faint">{meaning}</span>'
        items.append(f'<li class="{severity}">{head}<p>{message}</p></li>')
    if len(findings) > MAX_FINDINGS:
        items.append(f"<li>{number_text(len(findings) - MAX_FINDINGS)} more findings are not listed.</li>")
    return panel("Findings", f'<ul class="findings">{"".join(items)}</ul>{notes}')


def _rad(rad: Mapping[str, Any]) -> str:
    rows = []
    for name, found in (rad.get("properties") or {}).items():
        ends = [number_text(found[end]) for end in ("min", "max") if found.get(end) is not None]
        share = f"{100 * found['share']:.1f} %"
        cells = [text_of(found["encoding"]), size_text(found["bytes"]), share, " to ".join(ends)]
        rows.append([text_of(name), *cells, bar(found["share"])])
    head = ("Property", "Encoding", "Size", "Share", "Range", "")
    properties = table_of(head, rows, "As stored, in all chunks.") if rows else ""
    facts = [
        ["Chunks", "files of their own" if rad.get("chunked") else "in one file"],
        ["Header", size_text(rad["header_bytes"])],
        ["Header and first chunk", size_text(rad["first_bytes"])],
    ]
    if rad.get("chunk_bytes"):
        sizes = [size_text(rad["chunk_bytes"][name]) for name in ("min", "median", "max")]
        facts.append(["Smallest, median and largest chunk", ", ".join(sizes)])
    if rad.get("palette"):
        facts.append(["Palette of SH", f"{number_text(rad['palette'])} entries"])
    facts += [[text_of(name), text_of(value)] for name, value in (rad.get("ranges") or {}).items()]
    comment = f"<p>{text_of(rad['comment'])}</p>" if rad.get("comment") else ""
    stored = table_of(("RAD", ""), facts, "As its header says.")
    return f'<div class="two">{panel("Properties", properties)}{panel("Container", stored + comment)}</div>'


def _tree(tree: Mapping[str, Any]) -> str:
    levels = tree.get("levels") or ()
    most = max((level["nodes"] for level in levels), default=0) or 1
    rows = []
    for number, level in enumerate(levels):
        bars = bar((level["nodes"] - level["leaves"]) / most, level["leaves"] / most)
        rows.append([f"{number}", *(number_text(level[name]) for name in ("nodes", "leaves", "size")), bars])
    key = '<span class="key">inner</span> <span class="key soft">leaves</span>'
    caption = "Depth: edges from the root. Size: geometric mean of the feature sizes, world units."
    if tree.get("levels_left_out"):
        caption += f" {number_text(tree['levels_left_out'])} greater depths are not listed."
    table = table_of(("Depth", "Nodes", "Leaves", "Size", key), rows, caption) if rows else ""
    groups = children_groups(tree.get("children") or {})
    most = max((count for _, count in groups), default=0) or 1
    rows = [[name, number_text(count), bar(count / most)] for name, count in groups]
    children = table_of(("Children", "Inner nodes", ""), rows, "Inner nodes by number of children.") if rows else ""
    return f'<div class="two">{panel("Nodes by depth", table)}{panel("Children", children)}</div>'


def _values(values: Mapping[str, Any]) -> str:
    quantities = values.get("quantities") or {}
    columns = list(dict.fromkeys(name for summary in quantities.values() for name in summary))
    rows = [[text_of(name), *(number_text(row.get(column)) for column in columns)] for name, row in quantities.items()]
    table = table_of(["", *map(text_of, columns)], rows, "Without numbers that are not finite.") if rows else ""
    boxes = []
    for name, what in (("box", "all centres"), ("box_98", "1 % to 99 %")):
        box = values.get(name)
        if box:
            edges = [high - low for low, high in zip(box["min"], box["max"], strict=True)]
            for end, numbers in (("from", box["min"]), ("to", box["max"]), ("extent", edges)):
                boxes.append([f"{what}, {end}", *(number_text(float(number)) for number in numbers)])
    extent = table_of(("", "x", "y", "z"), boxes, "World units.") if boxes else ""
    counts = (
        ("with a number that is not finite", "non_finite"),
        ("with a negative scale", "negative_scale"),
        ("of opacity 0", "zero_opacity"),
        ("of scale 0", "zero_scale"),
        ("of opacity above 1", "more_than_opaque"),
    )
    degenerate = [[what, number_text(values[name])] for what, name in counts if name in values]
    out_of_range = table_of(("Splats", "Count"), degenerate, "Among all splats or nodes.") if degenerate else ""
    side = f"{panel('Box', extent)}{panel('Unusual values', out_of_range)}"
    return f'{panel("Values", table)}\n<div class="two">{side}</div>'


def _histograms(histograms: Mapping[str, Histogram]) -> str:
    parts = []
    for name, counted in histograms.items():
        chart = histogram_chart(counted, name)
        beyond = ((counted.below, "below"), (counted.above, "above"), (counted.not_finite, "not finite"))
        remarks = ["bins of equal ratios"] * counted.log + [f"{count:,} {where}" for count, where in beyond if count]
        meaning = values.QUANTITIES[name].meaning if name in values.QUANTITIES else ""
        said = "; ".join(filter(None, [meaning, *remarks]))
        head = f'<h4>{text_of(name)}</h4><p class="faint">{text_of(said)}</p>'
        parts.append(f"<div>{head}{chart or '<p>no numbers</p>'}</div>")
    return panel("Histograms", f'<div class="charts">{"".join(parts)}</div>' if parts else "")
