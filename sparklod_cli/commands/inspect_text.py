"""A report of `sparklod inspect` as a person reads it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ..system.printable import MOST, printable, shortened
from ..system.units import format_size
from .console import count_of, rows

if TYPE_CHECKING:
    from ..inspection.findings import Finding
    from ..inspection.report import Report

#: Numbers of children that get a row of their own.
MOST_ROWS = 8

#: Characters of a comment that are shown; Spark's has 800.
MOST_COMMENT = 160

#: Depths that get a row of their own; a good tree has some twenty.
MOST_DEPTHS = 64


def lines(name: str, report: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a report on a file, given as its JSON."""
    from ..model.axes import line

    tree, values = report["tree"], report["values"]
    noun = "node" if tree else "splat"
    size = "" if report["bytes"] is None else f", {format_size(report['bytes'])}"
    yield f"{printable(name)}  {report['format']}{size}"
    about = [count_of(report["splats"], noun), f"SH {report['sh_degree']}"]
    about += ["antialiased"] * bool(report["antialiased"])
    about += [f"{report['up']} is up"] * bool(report["up"])
    if "fractional_bits" in report["header"]:
        about.append(f"{report['header']['fractional_bits']} fractional bits")
    yield from rows("holds", ", ".join(about))
    if report["bytes_per_splat"]:
        ratio = report["compression_ratio"]
        less = "" if ratio is None else f", {ratio:.1f} times less than as floats"
        yield from rows("takes", f"{report['bytes_per_splat']:.1f} bytes a {noun}{less}")
    for note in (*report["notes"], *line(report["up"], report["up_by"])):
        yield from rows("note", note)
    for hint in report["hints"]:
        yield from rows("hint", hint)
    if report["rad"]:
        yield from _rad(report["rad"])
    if report["streamed_sog"]:
        yield from _streamed_sog(report["streamed_sog"])
    if report["tiles"]:
        yield from _tiles(report["tiles"])
    if tree:
        yield from _tree(tree)
    if values:
        yield from _values(values)


def _rad(rad: dict[str, Any]) -> Iterator[str]:
    where = "files of their own" if rad["chunked"] else "one file"
    header, first = format_size(rad["header_bytes"]), format_size(rad["first_bytes"])
    yield from rows("stored", f"{where}, header {header}, with the first chunk {first}")
    if rad["chunk_bytes"]:
        least, median, most = (format_size(rad["chunk_bytes"][name]) for name in ("min", "median", "max"))
        yield from rows("chunks", f"{least} to {most}, median {median}, of {rad['chunk_size']:,} splats")
    if rad["palette"]:
        yield from rows("palette", count_of(rad["palette"], "entry", "entries") + " of SH")
    if rad["ranges"]:
        yield from rows("ranges", ", ".join(f"{name} {_ranged(value)}" for name, value in rad["ranges"].items()))
    if rad["properties"]:
        yield from rows("properties", f"{'encoding':<12} {'bytes':>13} {'share':>7}  range")
    for name, found in rad["properties"].items():
        ends = [f"{found[end]:g}" for end in ("min", "max") if found[end] is not None]
        share = f"{100 * found['share']:.1f} %"
        text = f"{found['encoding']:<12} {found['bytes']:>13,} {share:>7}  {' to '.join(ends)}"
        yield f"    {name:<12} {text}".rstrip()
    if rad["comment"]:
        yield from rows("comment", printable(rad["comment"], MOST_COMMENT))


def _streamed_sog(streamed: dict[str, Any]) -> Iterator[str]:
    first, manifest = format_size(streamed["first_bytes"]), format_size(streamed["manifest_bytes"])
    around = " and the environment" if streamed["environment"] else ""
    yield from rows("stored", f"manifest {manifest}, with the coarsest level{around} {first}")
    if streamed["file_bytes"]:
        least, median, most = (format_size(streamed["file_bytes"][name]) for name in ("min", "median", "max"))
        count = count_of(streamed["files"], "chunk file")
        yield from rows("files", f"{count} of {least} to {most}, median {median}")
    splats, edge = streamed["region_splats"], streamed["region_edge"]
    regions = count_of(streamed["regions"], "region")
    yield from rows("regions", f"{regions} in a tree of depth {streamed['depth']}")
    yield from rows(
        "", f"{splats['min']:,.0f} to {splats['max']:,.0f} splats of level 0 each, median {splats['p50']:,.0f}"
    )
    yield from rows("", f"{edge['min']:.4g} to {edge['max']:.4g} world units long, median {edge['p50']:.4g}")
    head = f"{'splats':>11} {'share':>7} {'regions':>7} {'files':>5} {'size':>8}"
    if any(level["errors"] for level in streamed["levels"]):
        head += f"{'err. p25':>9}{'p50':>8}{'p75':>8}"
    yield from rows("levels", head)
    for number, level in enumerate(streamed["levels"]):
        share = "" if level["share"] is None else f"{100 * level['share']:.1f} %"
        errors = (f"{level['errors'][name]:>8.2g}" for name in ("p25", "p50", "p75") if level["errors"])
        size = format_size(level["bytes"])
        counts = f"{level['splats']:>11,} {share:>7} {level['regions']:>7,} {level['files']:>5,} {size:>8}"
        yield f"    {number:<8} {counts} {''.join(errors)}".rstrip()
    if streamed["environment"]:
        around = streamed["environment"]
        yield from rows("environment", f"{count_of(around['splats'], 'splat')}, {format_size(around['bytes'])}")
    if streamed["generator"]:
        yield from rows("written by", streamed["generator"])


def _tiles(tiles: dict[str, Any]) -> Iterator[str]:
    first, tileset = format_size(tiles["first_bytes"]), format_size(tiles["tileset_bytes"])
    nested = f" and {tiles['tilesets'] - 1:,} nested" if tiles["tilesets"] > 1 else ""
    yield from rows("stored", f"tileset.json{nested} {tileset}, with the root tile {first}")
    if tiles["file_bytes"]:
        least, median, most = (format_size(tiles["file_bytes"][name]) for name in ("min", "median", "max"))
        yield from rows("files", f"{count_of(tiles['tiles'], 'tile')} of {least} to {most}, median {median}")
    splats = tiles["tile_splats"]
    yield from rows("", f"{splats['min']:,.0f} to {splats['max']:,.0f} splats each, median {splats['p50']:,.0f}")
    if tiles["geometric_error"] is not None:
        yield from rows("error", f"{tiles['geometric_error']:.4g} where nothing is drawn")
    yield from rows(
        "depths", f"{'splats':>11} {'tiles':>6} {'leaves':>6} {'size':>9} {'err. min':>8} {'p50':>8} {'max':>8}"
    )
    for number, level in enumerate(tiles["levels"]):
        errors = [f"{level['errors'][name]:>8.3g}" for name in ("min", "p50", "max")] if level["errors"] else []
        counts = f"{level['splats']:>11,} {level['tiles']:>6,} {level['leaves']:>6,} {format_size(level['bytes']):>9}"
        yield f"    {number:<8} {' '.join([counts, *errors])}"
    if tiles["georeference"]:
        place = tiles["georeference"]
        where = f"latitude {place['latitude']:.7g}, longitude {place['longitude']:.7g}, height {place['height']:.6g} m"
        yield from rows("stands at", f"{where}, heading {place['heading']:.5g}")
    if tiles["generator"]:
        yield from rows("written by", tiles["generator"])


def _ranged(value: float | bool) -> str:
    return f"{value:g}" if not isinstance(value, bool) else "on" if value else "off"


def _tree(tree: dict[str, Any]) -> Iterator[str]:
    inner = count_of(tree["inner"], "inner node")
    leaves = count_of(tree["leaves"], "leaf", "leaves")
    yield from rows("tree", f"{leaves}, {inner}, growth {tree['growth']:.3f}, depth {tree['depth']}")
    if tree["more_than_opaque"] is not None:
        yield from rows("", f"{100 * tree['more_than_opaque']:.1f} % of the nodes have a LoD opacity above 1")
    chunks = count_of(tree["chunks"], "chunk")
    yield from rows(
        "", f"{chunks} of 65,536 nodes, {tree['chunks_of_coarse_cut']} of them for the coarsest cut of that many nodes"
    )
    if tree["split_siblings"]:
        yield from rows("", f"the children of {count_of(tree['split_siblings'], 'node')} lie in more than one chunk")
    counts = sorted(tree["children"].items(), key=lambda item: -item[1])
    shown = ", ".join(f"{children}: {count:,}" for children, count in counts[:MOST_ROWS])
    yield from rows(
        "children", shown + (f", and {len(counts) - MOST_ROWS} other numbers" if len(counts) > MOST_ROWS else "")
    )
    yield from rows("by depth", f"{'depth':>5} {'nodes':>12} {'leaves':>12} {'size':>10}")
    for depth, level in enumerate(tree["levels"][:MOST_DEPTHS]):
        size = "" if level["size"] is None else f"{level['size']:.4g}"
        yield from rows("", f"{depth:>5} {level['nodes']:>12,} {level['leaves']:>12,} {size:>10}")
    if tree["depth"] >= MOST_DEPTHS:
        yield from rows("", f"and {tree['depth'] + 1 - MOST_DEPTHS:,} more")


def _values(values: dict[str, Any]) -> Iterator[str]:
    for name, what in (("box", "box"), ("box_98", "98 %")):
        box = values[name]
        if box:
            low, high = (" ".join(f"{number:.4g}" for number in box[end]) for end in ("min", "max"))
            yield from rows(what, f"{low}  to  {high}")
    names = ("min", "p1", "p50", "p99", "max", "mean")
    yield from rows("values", " ".join(f"{name:>10}" for name in names))
    for quantity, summary in values["quantities"].items():
        cells = ("" if summary[name] is None else f"{summary[name]:.4g}" for name in names)
        yield from rows(quantity, " ".join(f"{cell:>10}" for cell in cells))
    counts = {
        "not finite": values["non_finite"],
        "of a negative scale": values["negative_scale"],
        "of opacity 0": values["zero_opacity"],
        "of scale 0": values["zero_scale"],
    }
    bad = ", ".join(f"{count:,} {what}" for what, count in counts.items() if count)
    if bad:
        yield from rows("degenerate", bad)


def verdict(report: Report) -> str:
    """Return the result of a check in a few words: how many findings there are of each severity."""
    findings = report.findings or []
    if not findings:
        noun = "node" if report.tree is not None else "splat"
        return f"OK: {count_of(report.splats or 0, noun)}, no problems found"
    return ", ".join(count_of(count, name) for name, count in Counter(each.severity for each in findings).items())


def finding_line(file: str, found: Finding, style: str) -> str:
    """Return a finding in a line, as text or as an annotation of GitHub Actions."""
    if style == "text":
        return f"{printable(file)}: {found.severity}: {found.code}: {printable(found.message, MOST)}"
    kind = {"note": "notice"}.get(found.severity, found.severity)
    return f"::{kind} file={_escaped(file, ':,')},title={found.code}::{_escaped(shortened(found.message, MOST))}"


def _escaped(text: str, more: str = "") -> str:
    """As workflow commands of GitHub Actions want it, which keep line ends; other marks cannot stay."""
    text = "".join(mark if mark in "\r\n" else printable(mark) for mark in text)
    for mark in "%\r\n" + more:
        text = text.replace(mark, f"%{ord(mark):02X}")
    return text
