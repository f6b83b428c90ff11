"""Measures compiling: commands that start with an empty cache: `python benchmarks/bench_compile.py --help`."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from performance.machine import machine
from performance.process import SPARKLOD, run
from performance.rows import Row, Table, figure, label

TABLE = Table(
    columns=(
        *(label("command"), label("cache", "cache before")),
        figure("wall_s", "s", 1, spread=True),
        figure("cpu_s", "processors' s", 1),
        figure("peak_bytes", "peak MB", 0, per=1e6),
    ),
    key=("command",),
    judged=("wall_s", "cpu_s", "peak_bytes"),
)

#: The command that stands for all those before `warmup`, one after another.
ALL = "all of these"


def rows(scene: Path, runs: int, *, brief: bool = False) -> list[Row]:
    """A row for each command; each finds in the cache what those before it compiled, but `warmup` finds none.

    Args:
        scene: a splat file.
        runs: of all commands.
        brief: only of the first command.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            _turn(scene, Path(folder), found, brief)
    return [Row({"command": name, "cache": _before(name)}, figures) for name, figures in found.items()]


def _before(name: str) -> str:
    return "empty" if name in ("build-lod", "warmup", ALL) else "of those above"


def _turn(scene: Path, folder: Path, found: dict[str, dict[str, list[float]]], brief: bool) -> None:
    """One run of every command."""
    tree = folder / "tree.spz"
    bake = [*SPARKLOD, "build-lod", scene, "-o", tree, "--overwrite", "-q"]
    commands = {
        "build-lod": bake,
        "build-lod --method quality": [*bake, "--method", "quality"],
        "inspect": [*SPARKLOD, "inspect", tree, "--json"],
        "traverse": [*SPARKLOD, "traverse", tree, "--orbit", "4", "--json"],
        "render": [*SPARKLOD, "render", tree, "-o", folder / "view.png", "-q"],
    }
    if brief:
        commands = {"build-lod": bake}
    total = {"wall_s": 0.0, "cpu_s": 0.0}
    for name, command in commands.items():
        took = run(command, variables={"NUMBA_CACHE_DIR": str(folder / "one")}, codes=(0, 3))
        _add(found, name, wall_s=took.wall_s, cpu_s=took.cpu_s, peak_bytes=took.peak_bytes)
        total["wall_s"] += took.wall_s
        total["cpu_s"] += took.cpu_s
    if brief:
        return
    _add(found, ALL, **total)
    took = run([*SPARKLOD, "warmup"], variables={"NUMBA_CACHE_DIR": str(folder / "other")})
    _add(found, "warmup", wall_s=took.wall_s, cpu_s=took.cpu_s, peak_bytes=took.peak_bytes)


def _add(found: dict[str, dict[str, list[float]]], name: str, **figures: float) -> None:
    for each, value in figures.items():
        found.setdefault(name, {}).setdefault(each, []).append(value)


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="splat file without a tree")
    parser.add_argument("--runs", type=int, default=1, help="number of runs; medians are printed")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.\n")
    TABLE.show(rows(arguments.scene, arguments.runs))


if __name__ == "__main__":
    main()
