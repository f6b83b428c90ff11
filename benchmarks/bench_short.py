"""Measures short jobs as whole processes: `python benchmarks/bench_short.py --help`.

From the start of the interpreter to its end, with kernels in the cache; for bakes see also `bench_rad.py`, which has
Spark's native program beside them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from performance.machine import machine
from performance.process import SPARKLOD, in_turn, run, runs_of
from performance.rows import Row, Table, figure, label

TABLE = Table(
    columns=(
        label("command"),
        figure("wall_s", "s", 3, spread=True),
        figure("cpu_s", "processors' s", 3),
        figure("peak_bytes", "peak MB", 0, per=1e6),
    ),
    key=("command",),
    judged=("wall_s", "cpu_s", "peak_bytes"),
)


def rows(scene: Path, runs: int) -> Iterator[Row]:
    """A row for each command, which take turns."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder, "tree.spz")
        commands = {
            "python -c pass": [sys.executable, "-c", "pass"],
            "build-lod --help": [*SPARKLOD, "build-lod", "--help"],
            f"build-lod {scene.name}": [*SPARKLOD, "build-lod", scene, "-o", tree, "--overwrite", "-q"],
            "inspect --json": [*SPARKLOD, "inspect", tree, "--json"],
            "traverse --orbit 24": [*SPARKLOD, "traverse", tree, "--orbit", "24", "--budget", "50000", "--json"],
        }
        found = in_turn(runs, [lambda command=command: run(command, codes=(0, 3)) for command in commands.values()])
        for name, took in zip(commands, found, strict=True):
            yield Row({"command": name}, runs_of(took))


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="splat file without a tree")
    parser.add_argument("--runs", type=int, default=7, help="number of runs, in turns; medians are printed")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.\n")
    TABLE.show(rows(arguments.scene, arguments.runs))


if __name__ == "__main__":
    main()
