"""Tables and curves of what `bench_fidelity.py` measured.

python benchmarks/fidelity_report.py fidelity.json more.json --docs docs/fidelity.md --plot docs/images/fidelity.png
"""

from __future__ import annotations

import argparse
import json
import math
import re
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from fidelity_trees import METHODS, WAYS

#: What scenes that were decimated by splat-transform are called in tables.
NAMES = METHODS | {way: f"splat-transform --{way}" for way in WAYS}

#: Ours, and what each is held against.
PAIRS = (
    ("quick", "spark-tiny"),
    ("quality", "spark-quality"),
    ("refined", "spark-quality"),
    ("refined", "quality"),
)

#: What is added to the name of a set of cameras whose pictures have spherical harmonics.
WITH_SH = " SH"

#: Line and marker of each method in the plot.
STYLES = {
    "spark-tiny": "C1o--",
    "spark-quality": "C0o--",
    "quick": "C1s-",
    "quality": "C0s-",
    "refined": "C2D-",
    "decimate": "C3^:",
    "decimate-adaptive": "C4v:",
}

#: By scene and method, what `bench_fidelity.Measured.as_dict` has.
Found = dict[str, dict[str, dict[str, Any]]]

Rows = list[list[str]]


def line(cells: Sequence[str]) -> None:
    """Prints a row in Markdown."""
    print(_row(cells), flush=True)


def head(cells: Sequence[str]) -> None:
    """Prints the head of a table in Markdown."""
    print(_head(cells), flush=True)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _head(cells: Sequence[str]) -> str:
    return _row(cells) + "\n" + "|---" * len(cells) + "|"


def markdown(cells: Sequence[str], rows: Rows) -> str:
    """A table of a head and rows."""
    return "\n".join([_head(cells), *map(_row, rows)])


def _number(value: float | None, form: str = ".2f") -> str:
    return "" if value is None else format(value, form)


def _spelt(budgets: Sequence[str]) -> list[str]:
    return [budget.replace("%", " %") for budget in budgets]


def _of(measured: dict[str, Any], cameras: str, budget: str, name: str) -> float | None:
    """A figure; None where it was not measured."""
    value: float | None = measured["views"].get(cameras, {}).get(budget, {}).get(name)
    return value


def _measured_from(found: Found, cameras: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Scene, method and what was measured of it with a set of cameras."""
    for scene, methods in found.items():
        for method in NAMES:
            if method in methods and cameras in methods[method]["views"]:
                yield scene, method, methods[method]


def builders(found: Found, budgets: Sequence[str], cameras: str) -> str:
    """PSNR of each tree, its nodes, and how long building it took."""
    rows = []
    for scene, method, measured in _measured_from(found, cameras):
        nodes, seconds = measured["nodes"], measured["seconds"]
        share = f"{nodes / measured['leaves']:.2f}" if nodes else ""
        psnr = [_number(_of(measured, cameras, budget, "psnr")) for budget in budgets]
        rows.append([scene, NAMES[method], share, *psnr, f"{statistics.median(seconds):.3f}" if seconds else ""])
    return markdown(["scene", "builder", "nodes / leaves", *_spelt(budgets), "build s"], rows)


def figures(found: Found, budgets: Sequence[str], cameras: str, name: str, form: str) -> str:
    """One figure of each tree by budget."""
    rows = [
        [scene, NAMES[method], *(_number(_of(measured, cameras, budget, name), form) for budget in budgets)]
        for scene, method, measured in _measured_from(found, cameras)
    ]
    return markdown(["scene", "builder", *_spelt(budgets)], rows)


def _gains(
    methods: dict[str, dict[str, Any]], budgets: Sequence[str], cameras: str
) -> Iterator[tuple[str, str, list[str]]]:
    """The methods of each pair, and how much closer the first is at each budget."""
    for mine, theirs in PAIRS:
        if all(method in methods and cameras in methods[method]["views"] for method in (mine, theirs)):
            both = ([_of(methods[method], cameras, budget, "psnr") for budget in budgets] for method in (mine, theirs))
            gains = ["" if a is None or b is None else f"{a - b:+.2f}" for a, b in zip(*both, strict=True)]
            yield mine, theirs, gains


def differences(found: Found, budgets: Sequence[str], cameras: str) -> str:
    """How much closer ours are than what they are held against, and how many times as long that took to build."""
    rows = []
    for scene, methods in found.items():
        for mine, theirs, gains in _gains(methods, budgets, cameras):
            took = [statistics.median(methods[method]["seconds"] or [0]) for method in (theirs, mine)]
            ratio = f"{took[0] / took[1]:.2f}x" if all(took) else ""
            rows.append([scene, f"{NAMES[mine]} - {NAMES[theirs]}", *gains, ratio])
    return markdown(["scene", "dB", *_spelt(budgets), "their build time / ours"], rows)


def other_cameras(found: Found, budgets: Sequence[str], every: Sequence[str]) -> str:
    """How much closer ours are, from one set of cameras after another."""
    rows = [
        [scene, cameras, f"{NAMES[mine]} - {NAMES[theirs]}", *gains]
        for scene, methods in found.items()
        for cameras in every
        for mine, theirs, gains in _gains(methods, budgets, cameras)
    ]
    return markdown(["scene", "cameras", "dB", *_spelt(budgets)], rows)


def popping(found: Found, budgets: Sequence[str], paths: Sequence[str]) -> str:
    """Popping along paths, mean and most."""
    rows = []
    for scene, methods in found.items():
        for method in NAMES:
            if method in methods and any(path in methods[method]["views"] for path in paths):
                cells = [
                    " / ".join(_number(_of(methods[method], path, budget, name)) for name in ("popping", "popping_max"))
                    for path in paths
                    for budget in budgets
                ]
                rows.append([scene, NAMES[method], *cells])
    return markdown(["scene", "builder", *(f"{path}, {each}" for path in paths for each in _spelt(budgets))], rows)


def tables(record: dict[str, Any]) -> dict[str, str]:
    """By the name that marks it in the page, each table that something was measured for."""
    found, budgets, of_paths = record["scenes"], record["budgets"], record["budgets_of_paths"]
    sets = {name for methods in found.values() for measured in methods.values() for name in measured["views"]}
    still = [name for name in record["cameras"] if name in sets and name not in record["moving"]]
    moving = [name for name in record["cameras"] if name in sets and name in record["moving"]]
    told = {}
    if still:
        first, *others = still
        told["builders"] = builders(found, budgets, first)
        told["differences"] = differences(found, budgets, first)
        told["edges"] = figures(found, budgets, first, "edge_psnr", ".2f")
        told["ssim"] = figures(found, budgets, first, "ssim", ".4f")
        if others:
            told["cameras"] = other_cameras(found, budgets, others)
        if first + WITH_SH in sets:
            told["sh"] = figures(found, budgets, first + WITH_SH, "psnr", ".2f")
            told["sh differences"] = other_cameras(found, budgets, [first + WITH_SH])
    if moving:
        told["popping"] = popping(found, of_paths, moving)
    return told


def put_into(page: Path, told: dict[str, str]) -> None:
    """Puts tables between their marks in a page; a mark without a table keeps what it has.

    Raises:
        SystemExit: a table has no mark.
    """
    text = page.read_text(encoding="utf-8")
    for name, table in told.items():
        marks = re.compile(rf"(?<=<!-- table: {re.escape(name)} -->\n).*?(?=<!-- end of table -->)", re.DOTALL)
        if not marks.search(text):
            raise SystemExit(f"{page} has no place for the table {name!r}: <!-- table: {name} --> and its end")
        text = marks.sub(lambda _, table=table: f"{table}\n", text, count=1)  # type: ignore[misc]
    page.write_text(text, encoding="utf-8")


def merged(files: Sequence[Path]) -> dict[str, Any]:
    """The records of several runs in one: of what was measured twice, the later run counts."""
    whole: dict[str, Any] = {}
    for file in files:
        record = json.loads(file.read_text(encoding="utf-8"))
        found = whole.get("scenes", {})
        for scene, methods in record["scenes"].items():
            mine = found.setdefault(scene, {})
            for method, measured in methods.items():
                views = mine.get(method, {}).get("views", {}) | measured["views"]
                mine[method] = measured | {"views": views}
        cameras = list(dict.fromkeys([*whole.get("cameras", []), *record["cameras"]]))
        whole = whole | record | {"scenes": found, "cameras": cameras}
    return whole


def plot(file: Path, record: dict[str, Any]) -> None:
    """Draws PSNR over the share of the leaves, a panel for each scene and a line for each builder."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    found, cameras = record["scenes"], record["cameras"][0]
    across = math.ceil(math.sqrt(len(found)))
    down = math.ceil(len(found) / across)
    figure = Figure(figsize=(6 * across, 4 * down), layout="constrained")
    for number, (scene, methods) in enumerate(found.items(), 1):
        axes = figure.add_subplot(down, across, number, title=scene, xlabel="share of the leaves", ylabel="PSNR, dB")
        for method in NAMES:
            views = methods.get(method, {}).get("views", {}).get(cameras, {})
            points = [(float(budget[:-1]), each["psnr"]) for budget, each in views.items() if budget.endswith("%")]
            if points:
                axes.plot(*zip(*sorted(points), strict=True), STYLES[method], markersize=4, label=NAMES[method])
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:g} %"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(file, dpi=100)


def report(record: dict[str, Any], docs: Path | None, drawn: Path | None) -> None:
    """Prints the tables, puts them into a page, and draws the curves."""
    told = tables(record)
    print(f"Machine: {record['machine']}. {record['size'][0]} x {record['size'][1]} pixels.")
    for name, table in told.items():
        print(f"\n{name}\n\n{table}", flush=True)
    if docs:
        put_into(docs, told)
    if drawn:
        plot(drawn, record)


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """The options that `bench_fidelity.py` has, too."""
    parser.add_argument("--docs", type=Path, help="page that gets the tables between its marks, docs/fidelity.md")
    parser.add_argument("--plot", type=Path, help="file for the curves, such as fidelity.png; needs matplotlib")


def main() -> None:
    """Prints the tables of some runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "results", nargs="+", type=Path, help="what bench_fidelity.py wrote with --json; later ones win"
    )
    add_outputs(parser)
    arguments = parser.parse_args()
    report(merged(arguments.results), arguments.docs, arguments.plot)


if __name__ == "__main__":
    main()
