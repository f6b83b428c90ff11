"""Tables and curves of the records of `bench_fidelity.py`.

python benchmarks/fidelity_report.py fidelity.json more.json --docs docs --plot docs/images/fidelity.png
"""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fidelity_trees import METHODS

#: Our builders and those of Spark that do the same work.
PAIRS = (("quick", "spark-tiny"), ("quality", "spark-quality"))

#: Variants of our quality builder.
VARIANTS = ("refined", "blocks")

#: Scenes of thin things, where our quality builder is compared with the better of Spark's two.
THIN_SCENES = ("fine-structure", "foliage-cards", "single-floor", "cables", "text-wall")

#: Suffix of the names of sets of cameras whose pictures have spherical harmonics.
WITH_SH = " SH"

#: Line and marker of each method in the plot.
STYLES = {
    "spark-tiny": "C1o--",
    "spark-quality": "C0o--",
    "quick": "C1s-",
    "quality": "C0s-",
    "refined": "C2D-",
}

#: Figures by scene and method, each a `bench_fidelity.Measured` as a dictionary.
Scenes = dict[str, dict[str, dict[str, Any]]]

Rows = list[list[str]]


def line(cells: Sequence[str]) -> None:
    """Print a row in Markdown."""
    print(_row(cells), flush=True)


def head(cells: Sequence[str]) -> None:
    """Print the head of a table in Markdown."""
    print(_head(cells), flush=True)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _head(cells: Sequence[str]) -> str:
    return _row(cells) + "\n" + "|---" * len(cells) + "|"


def markdown(cells: Sequence[str], rows: Rows) -> str:
    """Return a table of a head and rows."""
    return "\n".join([_head(cells), *map(_row, rows)])


def _number(value: float | None, form: str = ".2f") -> str:
    return "" if value is None else format(value, form)


def columns(budgets: Sequence[str]) -> list[str]:
    """Return the heads of the columns of budgets."""
    return [budget.replace("%", " %") for budget in budgets]


def _figure(measured: dict[str, Any], cameras: str, budget: str, name: str) -> float | None:
    """Return a figure; None where it was not measured."""
    value: float | None = measured["views"].get(cameras, {}).get(budget, {}).get(name)
    return value


def _with(methods: dict[str, dict[str, Any]], cameras: str) -> list[str]:
    """Return the methods that were measured with a set of cameras."""
    return [method for method in METHODS if method in methods and cameras in methods[method]["views"]]


def builders(scenes: Scenes, budgets: Sequence[str], cameras: str) -> str:
    """Return the table of the PSNR of each tree, and of its nodes."""
    rows = []
    for scene, methods in scenes.items():
        for method in _with(methods, cameras):
            measured = methods[method]
            psnr = [_number(_figure(measured, cameras, budget, "psnr")) for budget in budgets]
            rows.append([scene, METHODS[method], f"{measured['nodes'] / measured['leaves']:.2f}", *psnr])
    return markdown(["scene", "builder", "nodes / leaves", *columns(budgets)], rows)


def figures(scenes: Scenes, budgets: Sequence[str], cameras: str, name: str, form: str = ".2f") -> str:
    """Return the table of one figure of each tree by budget."""
    rows = [
        [scene, METHODS[method], *(_number(_figure(methods[method], cameras, each, name), form) for each in budgets)]
        for scene, methods in scenes.items()
        for method in _with(methods, cameras)
    ]
    return markdown(["scene", "builder", *columns(budgets)], rows)


def _gains(
    methods: dict[str, dict[str, Any]],
    mine: str,
    theirs: Sequence[str],
    cameras: str,
    budgets: Sequence[str],
    name: str,
) -> list[str] | None:
    """Return how much greater a figure of one method is than the best of others at each budget, if it was measured."""
    if not {mine, *theirs} <= set(_with(methods, cameras)):
        return None
    cells = []
    for budget in budgets:
        own = _figure(methods[mine], cameras, budget, name)
        others = [_figure(methods[method], cameras, budget, name) for method in theirs]
        numbers = [other for other in others if other is not None]
        cells.append("" if own is None or not numbers else f"{own - max(numbers):+.2f}")
    return cells


def differences(scenes: Scenes, budgets: Sequence[str], sets: Sequence[str]) -> str:
    """Return the table of how much closer ours are than Spark's, from one set of cameras after another."""
    rows = [
        [scene, *([cameras] if len(sets) > 1 else []), f"{METHODS[mine]} - {METHODS[theirs]}", *gains]
        for scene, methods in scenes.items()
        for cameras in sets
        for mine, theirs in PAIRS
        if (gains := _gains(methods, mine, [theirs], cameras, budgets, "psnr"))
    ]
    return markdown(["scene", *(["cameras"] if len(sets) > 1 else []), "dB", *columns(budgets)], rows)


def thin(scenes: Scenes, budgets: Sequence[str], cameras: str) -> str:
    """Return the table of our quality builder less the better of Spark's, on scenes of thin things."""
    rows = [
        [scene, pixels, *gains]
        for scene, methods in scenes.items()
        if Path(scene).stem in THIN_SCENES
        for pixels, name in (("all", "psnr"), ("edges", "edge_psnr"))
        if (gains := _gains(methods, "quality", ["spark-tiny", "spark-quality"], cameras, budgets, name))
    ]
    return markdown(["scene", "pixels", *columns(budgets)], rows)


def variant(scenes: Scenes, budgets: Sequence[str], sets: Sequence[str], method: str) -> str:
    """Return the table of what a variant of our quality builder gains over it."""
    rows = [
        [scene, cameras, pixels, *gains]
        for scene, methods in scenes.items()
        for cameras in sets
        for pixels, name in (("all", "psnr"), ("edges", "edge_psnr"))
        if (gains := _gains(methods, method, ["quality"], cameras, budgets, name))
    ]
    return markdown(["scene", "cameras", "pixels", *columns(budgets)], rows)


def popping(scenes: Scenes, budgets: Sequence[str], paths: Sequence[str]) -> str:
    """Return the table of popping along paths, mean and most."""
    rows = []
    for scene, methods in scenes.items():
        for method in METHODS:
            if method in methods and any(path in methods[method]["views"] for path in paths):
                cells = [
                    " / ".join(
                        _number(_figure(methods[method], path, budget, name)) for name in ("popping", "popping_max")
                    )
                    for path in paths
                    for budget in budgets
                ]
                rows.append([scene, METHODS[method], *cells])
    return markdown(["scene", "builder", *(f"{path}, {each}" for path in paths for each in columns(budgets))], rows)


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return each table that something was measured for, by the name of its mark in a page."""
    scenes, budgets, of_paths = record["scenes"], record["budgets"], record["budgets_of_paths"]
    sets = {name for methods in scenes.values() for measured in methods.values() for name in measured["views"]}
    still = [name for name in record["cameras"] if name in sets and name not in record["moving"]]
    moving = [name for name in record["cameras"] if name in sets and name in record["moving"]]
    made = {}
    if still:
        first, *others = still
        made["differences"] = differences(scenes, budgets, [first])
        made["thin"] = thin(scenes, budgets, first)
        made |= {method: variant(scenes, budgets, still, method) for method in VARIANTS}
        made["builders"] = builders(scenes, budgets, first)
        made["edges"] = figures(scenes, budgets, first, "edge_psnr")
        made["ssim"] = figures(scenes, budgets, first, "ssim", ".4f")
        if others:
            made["cameras"] = differences(scenes, budgets, others)
        if first + WITH_SH in sets:
            made["sh"] = figures(scenes, budgets, first + WITH_SH, "psnr")
    if moving:
        made["popping"] = popping(scenes, of_paths, moving)
    return {name: table for name, table in made.items() if table.count("\n") > 1}


def put_into(docs: Path, made: dict[str, str]) -> None:
    """Put tables between their marks in the pages of a folder; a mark without a table keeps what it has.

    Raises:
        SystemExit: a table has no mark.
    """
    texts = {page: page.read_text(encoding="utf-8") for page in docs.glob("*.md")}
    for name, table in made.items():
        marks = re.compile(rf"(?<=<!-- table: {re.escape(name)} -->\n).*?(?=<!-- end of table -->)", re.DOTALL)
        place = next((page for page, text in texts.items() if marks.search(text)), None)
        if place is None:
            raise SystemExit(f"{docs}: no page with a place for the table {name!r}: <!-- table: {name} --> and its end")
        texts[place] = marks.sub(lambda _, table=table: f"{table}\n", texts[place], count=1)  # type: ignore[misc]
    for page, text in texts.items():
        page.write_text(text, encoding="utf-8")


def merged(files: Sequence[Path]) -> dict[str, Any]:
    """Return the records of several runs in one: of what was measured twice, the later run counts."""
    whole: dict[str, Any] = {}
    for file in files:
        record = json.loads(file.read_text(encoding="utf-8"))
        scenes = whole.get("scenes", {})
        for scene, methods in record["scenes"].items():
            mine = scenes.setdefault(scene, {})
            for method, measured in methods.items():
                views = mine.get(method, {}).get("views", {}) | measured["views"]
                mine[method] = measured | {"views": views}
        cameras = list(dict.fromkeys([*whole.get("cameras", []), *record["cameras"]]))
        whole = whole | record | {"scenes": scenes, "cameras": cameras}
    return whole


def plot(file: Path, record: dict[str, Any]) -> None:
    """Draw PSNR over the share of the leaves, a panel for each scene and a line for each builder."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    scenes, cameras = record["scenes"], record["cameras"][0]
    across = math.ceil(math.sqrt(len(scenes)))
    down = math.ceil(len(scenes) / across)
    figure = Figure(figsize=(6 * across, 4 * down), layout="constrained")
    for number, (scene, methods) in enumerate(scenes.items(), 1):
        axes = figure.add_subplot(down, across, number, title=scene, xlabel="share of the leaves", ylabel="PSNR, dB")
        for method in STYLES:
            views = methods.get(method, {}).get("views", {}).get(cameras, {})
            points = [(float(budget[:-1]), each["psnr"]) for budget, each in views.items() if budget.endswith("%")]
            if points:
                axes.plot(*zip(*sorted(points), strict=True), STYLES[method], markersize=4, label=METHODS[method])
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:g} %"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(file, dpi=100)


def report(record: dict[str, Any], docs: Path | None, curves: Path | None) -> None:
    """Print the tables, put them into pages, and draw the curves."""
    made = tables(record)
    print(f"{record['size'][0]} x {record['size'][1]} pixels.")
    for name, table in made.items():
        print(f"\n{name}\n\n{table}", flush=True)
    if docs:
        put_into(docs, made)
    if curves:
        plot(curves, record)


def add_docs(parser: argparse.ArgumentParser) -> None:
    """Add the option `--docs`."""
    parser.add_argument("--docs", type=Path, help="folder of the pages that get tables between their marks, docs")


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """Add the options that `bench_fidelity.py` has, too."""
    add_docs(parser)
    parser.add_argument("--plot", type=Path, help="file for the curves, such as fidelity.png; needs matplotlib")


def main() -> None:
    """Print the tables of several runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="+", type=Path, help="JSONs of bench_fidelity.py; later ones win")
    add_outputs(parser)
    arguments = parser.parse_args()
    report(merged(arguments.results), arguments.docs, arguments.plot)


if __name__ == "__main__":
    main()
