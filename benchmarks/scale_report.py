"""Tables, figures and the model of more machines, of what `bench_scale.py` measured.

python benchmarks/scale_report.py results.json --plot docs/images/scale.png
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

#: Workers that the model is asked for.
WORKERS = (1, 2, 8, 64)

#: Colour of a method and line of a way, as matplotlib has them.
COLORS = {"quick": "C1", "quality": "C0"}
LINES = {"memory": "o--", "scratch": "s-"}
TOLD = {
    "memory": "in memory",
    "scratch": "out of core",
    "scratch-1": "out of core, 1 thread",
    "dask-1": "Dask, 1 worker",
    "dask-2": "Dask, 2 workers",
}

HEADINGS = (
    *("splats", "SH", "builder", "way", "s", "us a splat", "peak GB", "bytes a splat"),
    *("most scratch GB", "written GB", "read GB", "nodes", "RAD GB"),
)


def parts_of(name: str) -> tuple[float, int, str, str]:
    """Millions of splats, SH degree, method and way of the name of a run."""
    millions, degree, method, way = name.split()
    return float(millions.rstrip("M")), int(degree[2:]), method, way


def table(runs: dict[str, Any]) -> str:
    """A Markdown table with a row for each run."""
    lines = ["| " + " | ".join(HEADINGS) + " |", "|---" * len(HEADINGS) + "|"]
    for name, run in sorted(runs.items(), key=lambda each: (parts_of(each[0])[1:], parts_of(each[0])[0])):
        millions, degree, method, way = parts_of(name)
        cells = [f"{millions:g} million", degree, method, TOLD[way]]
        if "error" in run:
            cells += [f"{run['error']}", *[""] * 8]
        else:
            peak = sum(run["peaks"])
            cells += [f"{run['seconds']:.1f}", f"{run['seconds'] / millions:.2f}", f"{peak / 1e9:.2f}"]
            cells += [f"{peak / millions / 1e6:.0f}", f"{run['scratch'] / 1e9:.1f}"]
            cells += [f"{run['written'] / 1e9:.1f}", f"{run['read'] / 1e9:.1f}"]
            cells += [f"{run['report']['nodes']:,}", f"{run['bytes'] / 1e9:.2f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def goals(runs: dict[str, Any]) -> str:
    """A Markdown table of the goals, and what was reached of each."""
    lines = ["| goal | reached |", "|---|---|"]

    def add(goal: str, limit: float, figures: dict[str, float]) -> None:
        told = [f"{name}: {value:.2f}{'' if value <= limit else ' **missed**'}" for name, value in figures.items()]
        lines.append(f"| {goal} | {'; '.join(told) or 'not measured'} |")

    ended = {parts_of(name): run for name, run in runs.items() if "error" not in run}
    within = {
        f"{millions:g} million, SH {degree}, {method}": max(run["peaks"]) / run["limit"]
        for (millions, degree, method, way), run in ended.items()
        if millions >= 30 and way == "scratch"
    }
    add("30 and 100 million splats within the limit on memory (peak over limit)", 1, within)
    add("out of core within 2.5 times the time in memory, 10 million", 2.5, _ratios(ended, "scratch", "memory", 10))
    add("one Dask worker within 1.15 times the time of one process", 1.15, _ratios(ended, "dask-1", "scratch"))
    for method, most in (("quick", 2.5), ("quality", 3.5)):
        slopes = {}
        for (degree, of, way), series in series_of(runs).items():
            (few, first), (many, last) = series[0], series[-1]
            if (of, way) == (method, "memory") and many > few:
                each = (last["peaks"][0] - first["peaks"][0]) / (many - few) / 1e6
                slopes[f"SH {degree}, {few:g} to {many:g} million"] = each / (4 * (14 + 3 * ((degree + 1) ** 2 - 1)))
        add(f"{method} in memory: a splat more takes at most {most} times its decoded bytes", most, slopes)
    return "\n".join(lines)


def _ratios(ended: dict[Any, Any], one: str, other: str, millions: float | None = None) -> dict[str, float]:
    """Seconds of one way over those of another, of the scenes that have both."""
    return {
        f"{key[0]:g} million, SH {key[1]}, {key[2]}": run["seconds"] / ended[(*key[:3], other)]["seconds"]
        for key, run in sorted(ended.items())
        if key[3] == one and (*key[:3], other) in ended and millions in (None, key[0])
    }


def looks(runs: dict[str, Any]) -> str:
    """A Markdown table of the commands that looked at the trees."""
    lines = ["| tree | nodes | command | s | peak GB | bytes a node | read GB |", "|---|---|---|---|---|---|---|"]
    for name, run in runs.items():
        for command, found in run.get("looks", {}).items():
            nodes = run["report"]["nodes"]
            cells = [name.rpartition(" ")[0], f"{nodes:,}", f"`{command}`", found.get("error")]
            if "error" not in found:
                cells[3:] = [f"{found['seconds']:.1f}", f"{found['peak'] / 1e9:.2f}"]
                cells += [f"{found['peak'] / nodes:.0f}", f"{found['read'] / 1e9:.2f}"]
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def growth(runs: dict[str, Any]) -> str:
    """How time and memory grow from the smallest to the largest size of each series."""
    lines = []
    for (degree, method, way), series in series_of(runs).items():
        (few, first), (many, last) = series[0], series[-1]
        if many < 2 * few:
            continue
        decades = math.log10(many / few)
        rise = (last["seconds"] / first["seconds"] / (many / few)) ** (1 / decades)
        lines.append(
            f"SH {degree}, {method}, {TOLD[way]}, {few:g} to {many:g} million: time a splat grows {rise:.2f} times a"
            f" decade, peak {first['peaks'][0] / 1e9:.2f} to {last['peaks'][0] / 1e9:.2f} GB"
        )
    return "\n".join(lines)


def series_of(runs: dict[str, Any]) -> dict[tuple[int, str, str], list[tuple[float, Any]]]:
    """By SH degree, method and way, (millions, run) of those runs that ended, ascending."""
    series: dict[tuple[int, str, str], list[tuple[float, Any]]] = {}
    for name, run in sorted(runs.items(), key=lambda each: parts_of(each[0])[0]):
        millions, *kind = parts_of(name)
        if "error" not in run:
            series.setdefault((kind[0], kind[1], kind[2]), []).append((millions, run))
    return series


def makespan(tasks: Sequence[dict[str, Any]], workers: int) -> float:
    """Seconds that so many workers take for tasks that each begin when a worker is free and what they need is done.

    Workers share nothing that would slow them down: no disk, no network, no scheduler.
    """
    seconds = {task["name"]: task["seconds"] for task in tasks}
    needs = {task["name"]: {need for need in task["needs"] if need in seconds} for task in tasks}
    follow: dict[str, list[str]] = {name: [] for name in seconds}
    for name, before in needs.items():
        for need in before:
            follow[need].append(name)
    order = {task["name"]: number for number, task in enumerate(tasks)}
    ready = [(order[name], name) for name, before in needs.items() if not before]
    heapq.heapify(ready)
    running: list[tuple[float, str]] = []
    now = 0.0
    while ready or running:
        while ready and len(running) < workers:
            _, name = heapq.heappop(ready)
            heapq.heappush(running, (now + seconds[name], name))
        now, done = heapq.heappop(running)
        for name in follow[done]:
            needs[name].discard(done)
            if not needs[name]:
                heapq.heappush(ready, (order[name], name))
    return now


def model(runs: dict[str, Any]) -> str:
    """What more machines would take, of the tasks of bakes on one thread; what is in no task stays on one machine."""
    lines = ["| scene | in tasks s | elsewhere s | " + " | ".join(f"{each} workers s" for each in WORKERS) + " |"]
    lines.append("|---" * (3 + len(WORKERS)) + "|")
    for name, run in runs.items():
        if "error" in run or not run["tasks"] or parts_of(name)[3] != "scratch-1":
            continue
        inside = sum(task["seconds"] for task in run["tasks"])
        outside = run["seconds"] - inside
        rounds = [list(each) for _, each in itertools.groupby(run["tasks"], lambda task: task["round"])]
        times = [outside + sum(makespan(each, workers) for each in rounds) for workers in WORKERS]
        cells = [name, f"{inside:.0f}", f"{outside:.0f}"]
        cells += [f"{each:.0f} ({times[0] / each:.1f}x)" for each in times]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(file: Path, runs: dict[str, Any]) -> None:
    """Draws time and memory over size, a panel each for each SH degree."""
    from matplotlib.figure import Figure

    series = series_of(runs)
    degrees = sorted({degree for degree, _, _ in series})
    figure = Figure(figsize=(5.5 * len(degrees), 7), layout="constrained")
    panels = (("minutes", lambda run: run["seconds"] / 60), ("peak of memory, GB", lambda run: sum(run["peaks"]) / 1e9))
    for down, (label, value) in enumerate(panels):
        for across, degree in enumerate(degrees):
            axes = figure.add_subplot(2, len(degrees), 1 + down * len(degrees) + across, xlabel="million splats")
            axes.set_title(f"SH {degree}")
            axes.set_ylabel(label)
            for (of_degree, method, way), found in series.items():
                if of_degree == degree and way in LINES:
                    points = [(millions, value(run)) for millions, run in found]
                    style = COLORS[method] + LINES[way]
                    axes.plot(*zip(*points, strict=True), style, markersize=4, label=f"{method}, {TOLD[way]}")
            axes.set_xscale("log")
            axes.set_yscale("log" if not down else "linear")
            axes.set_ylim(bottom=None if not down else 0)
            axes.xaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.grid(alpha=0.3, which="both")
            axes.legend(fontsize=8)
    figure.savefig(file, dpi=100)


def main() -> None:
    """Prints Markdown, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--plot", type=Path, help="file of the figure, such as scale.png; needs matplotlib")
    arguments = parser.parse_args()
    results = json.loads(arguments.results.read_text())
    print(f"Machine: {results['machine']}.\n")
    for part in (goals, table, growth, looks, model):
        print(part(results["runs"]) + "\n")
    if arguments.plot is not None:
        plot(arguments.plot, results["runs"])


if __name__ == "__main__":
    main()
