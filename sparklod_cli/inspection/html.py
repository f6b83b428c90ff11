"""Reports as a self-contained page of HTML, laid out by their keys, without scripts and external resources."""

from __future__ import annotations

import base64
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from .. import __version__
from ..images.scene_plots import DescribedPicture
from ..model.scene import Scene
from ..system.units import count_of, format_size, percent_of
from ..tables.histograms import Histogram, edge_names
from . import values
from .findings import CODES, ERROR, NOTE, WARNING
from .report import Report

#: Content security policy: the page uses only its own style and pictures, whatever texts of files contain.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"

#: Severities, the worst first.
SEVERITIES = (ERROR, WARNING, NOTE)

#: Most findings of a file that are listed. Checks have some forty kinds, but expectations have no limit.
MAX_FINDINGS = 200

#: Titles of keys that would say too little by themselves; all other titles are the keys, with spaces.
LABELS = {
    "first_bytes": "Size needed for a first picture",
    "bytes": "Size",
    "file_bytes": "Sizes of the files",
    "palette": "Entries of the palette of SH",
    "box": "Box of all centres",
    "box_98": "Box of the centres, 1 % to 99 %",
    "region_edge": "Longest edge of the regions, world units",
    "non_finite": "Splats with a number that is not finite",
    "negative_scale": "Splats with a negative scale",
    "zero_opacity": "Splats of opacity 0",
    "zero_scale": "Splats of scale 0",
    "more_than_opaque": "Splats of opacity above 1",
}

#: Key figures of a report, from itself, its tree or its header, and their titles.
FIGURES = {"splats": "Splats", "bytes": "Size", "leaves": "Leaves", "inner": "Inner nodes", "growth": "Growth"}
FIGURES |= {"depth": "Depth", "chunks": "Chunks", "sh_degree": "SH degree", "antialiased": "Antialiased", "up": "Up"}
FIGURES |= {"version": "Version", "fractional_bits": "Fractional bits"}

#: Titles of the parts of a report, and titles and captions of the tables in them.
PARTS = {"rad": "RAD", "streamed_sog": "Streamed SOG", "tiles": "3D Tiles", "tree": "Tree", "values": "Unusual values"}
TABLES = {
    ("rad", "properties"): ("Properties", "As stored, in all chunks."),
    ("streamed_sog", "levels"): (
        "Detail levels",
        "Level 0 is full detail. Errors of regions, each weighted by its splats at level 0.",
    ),
    ("tiles", "levels"): ("Tiles", "Depth 0 is the root tile. Leaves are tiles without children, with full detail."),
    ("tree", "levels"): (
        "Nodes by depth",
        "Depth: edges from the root. Size: geometric mean of the feature sizes, world units.",
    ),
    ("values", "quantities"): ("Values", "Without numbers that are not finite."),
}

#: Width and height of a chart, of which labels below and the figure above take parts, in units of its view box.
WIDTH, HEIGHT, BELOW, ABOVE = 360, 150, 20, 16

#: Number of labels below a histogram.
LABELLED = 5

#: Numbers of children up to this one have a row each; beyond it, ranges double.
SINGLE_CHILDREN = 8

#: Replaces a missing value.
NONE = "\u2013"


@dataclass(frozen=True)
class FileSection:
    """Contents of the part of a page about one file.

    Attributes:
        report: `Report.as_dict`, some fields of which may be missing.
        picture: the structure of the scene.
        histograms: those of its quantities, by name.
        thumbnail: the scene as a viewer draws it.
    """

    report: Mapping[str, Any]
    picture: DescribedPicture | None = None
    histograms: Mapping[str, Histogram] = field(default_factory=dict)
    thumbnail: DescribedPicture | None = None


def section_of(
    report: Report, scene: Scene | None, picture: DescribedPicture | None, thumbnail: DescribedPicture | None = None
) -> FileSection:
    """Return the section about a file, with histograms if its splats were read."""
    drawn = {}
    if scene is not None and len(scene.splats):
        drawn = {name: values.histogram_of(scene.splats, name) for name in values.names_of(scene.splats)}
    return FileSection(report.as_dict(), picture, drawn, thumbnail)


def page(sections: Sequence[FileSection]) -> str:
    """Return the page about one or more files as HTML, for UTF-8."""
    one = len(sections) == 1
    title = f"{_text(sections[0].report.get('file', ''))} \u2013 sparklod inspect" if one else "sparklod inspect"
    contents = ""
    if not one:
        head = ("File", "Format", "Splats", "Size", "Findings")
        rows = []
        for number, report in enumerate((section.report for section in sections), 1):
            name = f'<a href="#file-{number}">{_text(report.get("file", number))}</a>'
            shown = (_shown(key, report.get(key)) for key in ("format", "splats", "bytes"))
            rows.append([name, *shown, _verdict(report)])
        contents = f'<nav class="panel" aria-label="Files">{_table(head, rows, "The files")}</nav>\n'
    body = "\n".join(_section(section, f"file-{number}") for number, section in enumerate(sections, 1))
    template = Template(files(__package__).joinpath("page.html").read_text("utf-8"))
    subject = "a splat file" if one else f"{len(sections)} splat files"
    return template.substitute(
        policy=escape(POLICY), version=__version__, title=title, subject=subject, contents=contents, body=body
    )


def _section(section: FileSection, anchor: str) -> str:
    report = section.report
    form = f'<span class="badge plain">{_text(report["format"])}</span>' if report.get("format") else ""
    name = _text(report.get("file", ""))
    parts = [
        f'<article id="{anchor}" aria-labelledby="{anchor}-name">',
        f'<div class="head"><h2 id="{anchor}-name">{name}</h2>{form}{_verdict(report)}</div>',
        _figures(report),
        _findings(report),
        _picture(section.thumbnail, small=True),
        _picture(section.picture),
        *(_part(key, report[key]) for key in PARTS if report.get(key)),
        _histograms(section.histograms),
        "</article>",
    ]
    return "\n".join(filter(None, parts))


def _verdict(report: Mapping[str, Any]) -> str:
    findings = report.get("findings")
    if findings is None:
        return '<span class="badge plain">not checked</span>'
    for severity in SEVERITIES:
        count = sum(found.get("severity") == severity for found in findings)
        if count:
            return f'<span class="badge {severity}">{count_of(count, severity)}</span>'
    return '<span class="badge good">no faults found</span>'


def _figures(report: Mapping[str, Any]) -> str:
    tree, header = report.get("tree") or {}, report.get("header") or {}
    noun = "node" if tree else "splat"
    each, ratio = report.get("bytes_per_splat"), report.get("compression_ratio")
    size = [f"{each:.1f} bytes a {noun}"] if each else []
    size += [f"{ratio:.1f} times smaller than as floats"] if ratio else []
    share = tree.get("more_than_opaque")
    small = {
        "bytes": ", ".join(size),
        "leaves": "splats of the scene",
        "inner": "" if share is None else f"{percent_of(share)} of all nodes have D &gt; 1",
        "growth": "nodes per leaf",
        "depth": "edges to the deepest node",
        "chunks": f"{_shown('', tree.get('chunks_of_coarse_cut'))} for a coarse cut",
        "up": "axis that points up",
    }
    values, items = {**report, "chunks": None, **tree, **header}, []
    for key, title in (FIGURES | {"splats": f"{noun.title()}s"}).items():
        if values.get(key) is not None or key in tree:
            more = f"<small>{small[key]}</small>" if small.get(key) else ""
            items.append(f"<div><dt>{title}</dt><dd>{_shown(key, values[key])}{more}</dd></div>")
    return f'<dl class="figures">{"".join(items)}</dl>' if items else ""


def _findings(report: Mapping[str, Any]) -> str:
    findings = report.get("findings")
    notes = "".join(f"<p>{_text(note)}</p>" for note in (*(report.get("notes") or ()), *(report.get("hints") or ())))
    if not findings:
        return _panel("Notes", notes)
    items = []
    worst_first = sorted(findings, key=lambda found: SEVERITIES.index(found["severity"]))
    for found in worst_first[:MAX_FINDINGS]:
        severity, code, message = (_text(found[name]) for name in ("severity", "code", "message"))
        meaning = _text(CODES[found["code"]][1]) if found["code"] in CODES else ""
        head = f'<b>{severity}</b><code>{code}</code> <span class="faint">{meaning}</span>'
        items.append(f'<li class="{severity}">{head}<p>{message}</p></li>')
    if len(findings) > MAX_FINDINGS:
        items.append(f"<li>{len(findings) - MAX_FINDINGS:,} more findings are not listed.</li>")
    return _panel("Findings", f'<ul class="findings">{"".join(items)}</ul>{notes}')


def _part(name: str, part: Mapping[str, Any]) -> str:
    """Return the panels of a part of a report: a table for each list or group in it, and one for its other values."""
    wide: list[str] = []
    panels: list[str] = []
    facts = []
    beside = panels if name in ("rad", "tree") else wide
    for key, value in part.items():
        title, caption = TABLES.get((name, key), (_label(key), ""))
        if (name, key) == ("tree", "levels") and part.get("levels_left_out"):
            caption += f" {part['levels_left_out']:,} greater depths are not listed."
        if not value and not isinstance(value, int):
            continue
        if isinstance(value, list):
            beside.append(_panel(title, _rows(((str(at), row) for at, row in enumerate(value)), caption)))
        elif key == "children":
            groups = children_groups(value)
            most = max(count for _, count in groups)
            rows = [[group, f"{count:,}", _bar(count / most)] for group, count in groups]
            head = ("Children", "Inner nodes", "")
            panels.append(_panel(title, _table(head, rows, "Inner nodes by number of children.")))
        elif key in ("box", "box_98", "bound"):
            edges = [high - low for low, high in zip(value["min"], value["max"], strict=True)]
            ends = {"from": value["min"], "to": value["max"], "extent": edges}.items()
            rows = [[end, *(_shown("", float(number)) for number in numbers)] for end, numbers in ends]
            panels.append(_panel(title, _table(("", "x", "y", "z"), rows, "World units.")))
        elif isinstance(value, Mapping) and all(isinstance(each, Mapping) for each in value.values()):
            beside.append(_panel(title, _rows(value.items(), caption)))
        elif name != "tree":  # its values are among the key figures
            facts.append([_label(key), _shown(key, value)])
    if facts:
        panels.append(_panel(PARTS[name], _table(("", ""), facts, "")))
    return "\n".join([*wide, f'<div class="two">{"".join(panels)}</div>' if panels else ""])


def _rows(rows: Iterable[tuple[str, Mapping[str, Any]]], caption: str) -> str:
    """Return a table of named rows with a column for each key, and bars of shares or counts."""
    rows = list(rows)
    counted = "nodes" if "nodes" in rows[0][1] else "splats"
    most = max(row.get(counted, 0) for _, row in rows) or 1
    cells: list[dict[str, str]] = []
    bars: list[str] = []
    for _, row in rows:
        flat: dict[str, str] = {}
        for key, value in row.items():
            inner = value if isinstance(value, Mapping) else {"": value}
            flat |= {f"{key} {end}".strip(): _shown(key, each) for end, each in inner.items() if each is not None}
        shares = [row["share"]] if row.get("share") is not None else []
        if counted in row:
            leaves = row["leaves"] if counted == "nodes" else 0
            shares = [(row[counted] - leaves) / most, leaves / most]
        cells.append(flat)
        bars.append(_bar(*shares) if shares else "")
    columns = list(dict.fromkeys(name for flat in cells for name in flat))
    key = '<span class="key">inner</span> <span class="key soft">leaves</span>' if counted == "nodes" else ""
    ends = [[each] if any(bars) else [] for each in bars]
    body = [
        [_text(name), *(flat.get(column, NONE) for column in columns), *end]
        for (name, _), flat, end in zip(rows, cells, ends, strict=True)
    ]
    return _table(("", *map(_label, columns), *([key] if any(bars) else [])), body, caption)


def _label(key: str) -> str:
    return LABELS.get(key) or _text(key[:1].upper() + key[1:].replace("_", " "))


def _shown(key: str, value: Any) -> str:
    """Return a value of a report as HTML; its key tells sizes and shares."""
    if value is None:
        return NONE
    if isinstance(value, Mapping):
        parts = {end: _shown(end if end.endswith("bytes") else key, each) for end, each in value.items()}
        return ", ".join(f"{_text(end)} {part}" for end, part in parts.items())
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key.endswith("bytes"):
        return format_size(value)
    if key == "share":
        return percent_of(value)
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:,.4g}" if abs(value) < 1e6 else f"{value:.4g}"


def _text(value: object) -> str:
    """Escape a text for a page; characters that HTML or UTF-8 cannot hold are replaced."""
    plain = str(value).encode("utf-8", "replace").decode("utf-8")
    return escape("".join(mark if mark.isprintable() or mark in "\n\t" else "\ufffd" for mark in plain))


def _panel(title: str, content: str) -> str:
    return f'<section class="panel"><h3>{title}</h3>\n{content}\n</section>' if content else ""


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], caption: str) -> str:
    """Return a table of cells of HTML; the first cell of each row is its heading."""
    columns = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    lines = (f'<tr><th scope="row">{row[0]}</th>{"".join(map(_cell, row[1:]))}</tr>' for row in rows)
    body = "\n".join(lines)
    return (
        f'<div class="scroll" tabindex="0"><table><caption>{caption}</caption>\n<thead><tr>{columns}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def _cell(content: str) -> str:
    return f'<td class="wide">{content}</td>' if content.startswith('<div class="track"') else f"<td>{content}</td>"


def _bar(*shares: float) -> str:
    """Return bars of shares, 0..1, side by side, for a cell of a table with the numbers in other cells."""
    parts = "".join(
        f'<i class="of{n}" style="width:{100 * share:.2f}%"></i>' for n, share in enumerate(shares) if share
    )
    return f'<div class="track" aria-hidden="true">{parts}</div>'


def _picture(picture: DescribedPicture | None, *, small: bool = False) -> str:
    if picture is None:
        return ""
    data, words = base64.b64encode(picture.png).decode("ascii"), picture.description
    image = f'<img alt="Drawing of {_text(words.partition(";")[0])}" src="data:image/png;base64,{data}">'
    kind = ' class="small"' if small else ""
    return f"<figure{kind}>{image}<figcaption>{_text(words)}</figcaption></figure>"


def _histograms(histograms: Mapping[str, Histogram]) -> str:
    parts = []
    for name, counted in histograms.items():
        beyond = ((counted.below, "below"), (counted.above, "above"), (counted.not_finite, "not finite"))
        remarks = ["bins of equal ratios"] * counted.log + [f"{count:,} {where}" for count, where in beyond if count]
        said = "; ".join([values.QUANTITIES[name].meaning, *remarks])
        head = f'<h4>{_text(name)}</h4><p class="faint">{_text(said)}</p>'
        parts.append(f"<div>{head}{_chart(counted, name) or '<p>no numbers</p>'}</div>")
    return _panel("Histograms", f'<div class="charts">{"".join(parts)}</div>' if parts else "")


def _chart(histogram: Histogram, name: str) -> str:
    """Return a histogram as a bar chart; empty without numbers."""
    counts = [int(count) for count in histogram.counts]
    if not counts:
        return ""
    names = edge_names(histogram.edges)
    tooltips = [f"{low} to {high}: {count:,}" for low, high, count in zip(names, names[1:], counts, strict=False)]
    at = np.unique(np.linspace(0, len(counts), LABELLED).round().astype(int))
    labels = [(float(place), f"{histogram.edges[place]:.3g}") for place in at] if len(counts) > 1 else [(0.5, names[0])]
    most, base, room, step = max(counts), HEIGHT - BELOW, HEIGHT - ABOVE - BELOW, WIDTH / len(counts)
    gap, peak = min(2.0, step / 5), tooltips[int(np.argmax(counts))]
    summary = f"Histogram of {name}: {sum(counts):,} numbers from {names[0]} to {names[-1]}, most at {peak}"
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{_text(summary)}">',
        f'<text class="faint" x="0" y="{ABOVE - 5}">{most:,}</text>',
        f'<line class="line" x1="0" y1="{ABOVE}" x2="{WIDTH}" y2="{ABOVE}"/>',
    ]
    for number, (count, tooltip) in enumerate(zip(counts, tooltips, strict=True)):
        height = max(1.0, room * count / most) if count else 0.0  # a count above 0 has a visible bar
        x, y = number * step + gap / 2, base - height
        parts.append(f'<g class="bar"><title>{_text(tooltip)}</title>')
        parts.append(f'<rect class="hit" x="{number * step:.2f}" y="{ABOVE}" width="{step:.2f}" height="{room}"/>')
        parts.append(f'<rect x="{x:.2f}" y="{y:.2f}" width="{step - gap:.2f}" height="{height:.2f}"/></g>')
    parts.append(f'<line class="base" x1="0" y1="{base}" x2="{WIDTH}" y2="{base}"/>')
    for place, text in labels:
        x = place * step
        anchor = "start" if x < 0.06 * WIDTH else "end" if x > 0.94 * WIDTH else "middle"
        parts.append(f'<text class="faint" x="{x:.1f}" y="{HEIGHT - 4}" text-anchor="{anchor}">{_text(text)}</text>')
    return "".join([*parts, "</svg>"])


def children_groups(children: Mapping[str, int]) -> list[tuple[str, int]]:
    """Count nodes by their number of children: single numbers first, then ranges that double."""
    most = max(map(int, children))
    ends = [*range(1, min(SINGLE_CHILDREN, most) + 1)]
    while ends[-1] < most:
        ends.append(2 * ends[-1])
    counts = dict.fromkeys(ends, 0)
    for number, count in children.items():
        counts[ends[bisect_left(ends, int(number))]] += count
    return [
        (f"{end}" if end <= SINGLE_CHILDREN else f"{end // 2 + 1:,} to {end:,}", count) for end, count in counts.items()
    ]
