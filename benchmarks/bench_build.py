"""Measures `build-lod` by stages, against Spark's own builder in one run: `python benchmarks/bench_build.py --help`."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from performance.machine import machine
from performance.process import SPARKLOD, Took, in_turn, run, runs_of
from performance.rows import Row, Table, figure, label, ratio
from scenes import load, tiled, write_ply

import sparklod_cli as sparklod
from sparklod_cli.lod.tree_settings import METHODS

HERE = Path(__file__).resolve().parent

TABLE = Table(
    columns=(
        *(label("scene"), label("splats"), label("nodes")),
        *(figure(f"{stage}_s", f"{stage} s", 2) for stage in ("read", "build", "write")),
        figure("wall_s", "process s", 2, spread=True),
        figure("cpu_s", "processors' s", 2),
        figure("peak_bytes", "peak MB", 0, per=1e6),
        ratio("peak_bytes", "input_bytes", "peak / input"),
        figure("output_bytes", "LoD MB", 1, per=1e6),
        ratio("output_bytes", "plain_bytes", "LoD / plain", 2),
        figure("warm_s", "warm build s", 3, spread=True),
        ratio("splats", "warm_s", "million splats/s", 2, per=1e6),
        figure("spark_s", "Spark's build s", 2),
        ratio("spark_s", "warm_s", "Spark's build / ours", unit="x"),
    ),
    key=("scene",),
    judged=("wall_s", "cpu_s", "peak_bytes", "output_bytes", "warm_s"),
)


def rows(paths: Iterable[Path], method: str, runs: int, *, spark_up_to: float = 0, warm: bool = True) -> Iterator[Row]:
    """A row for each scene.

    Args:
        paths: splat files.
        method: our builder; Spark's is always its tiny one.
        runs: of everything, but of Spark at most 3.
        spark_up_to: splats that Spark's builder gets at most.
        warm: also time the builder alone.
    """
    for path in paths:
        with tempfile.TemporaryDirectory() as folder:
            yield _row(path, Path(folder, "out.spz"), method, runs, spark_up_to, warm)


def _row(path: Path, output: Path, method: str, runs: int, spark_up_to: float, warm: bool) -> Row:
    (commands,) = in_turn(runs, [lambda: whole_command(path, output, method)])
    reports: list[dict[str, Any]] = [json.loads(took.output) for took in commands]
    splats = len(load(path))
    figures = {
        **runs_of(commands),
        **{f"{stage}_s": [report["seconds"][stage] for report in reports] for stage in ("read", "build", "write")},
        "warm_s": warm_build(path, method, runs) if warm else [],
        "spark_s": spark(path, min(runs, 3)) if splats <= spark_up_to else [],
    }
    labels = {
        "scene": path.name,
        "splats": splats,
        "nodes": int(reports[-1]["nodes"]),
        "input_bytes": path.stat().st_size,
        "plain_bytes": plain_bytes(path, int(reports[-1]["fractional_bits"])),
    }
    return Row(labels, {**figures, "output_bytes": [report["bytes"] for report in reports]})


def whole_command(path: Path, output: Path, method: str) -> Took:
    """Runs the command once, with its report in JSON."""
    return run([*SPARKLOD, "build-lod", path, "--method", method, "-o", output, "--overwrite", "--json"])


def warm_build(path: Path, method: str, runs: int) -> list[float]:
    """Times the builder alone, from decoded splats to final order; returns the seconds of each run after the first.

    The first run also touches the memory: on a virtual machine the first touch of a page is slow, since the host may
    take free pages back. In a long-running process that is not a cost of the builder.
    """
    scene = sparklod.Scene(load(path))
    seconds = []
    for turn in range(runs + 1):
        start = time.perf_counter()
        sparklod.build_lod(scene, method=method)
        if turn:
            seconds.append(time.perf_counter() - start)
    return seconds


def plain_bytes(path: Path, bits: int) -> int:
    """Size in bytes of a plain SPZ file of the same splats in their own order, with the same fractional bits."""
    with tempfile.TemporaryDirectory() as folder:
        return sparklod.write(Path(folder, "plain.spz"), sparklod.Scene(load(path)), fractional_bits=bits).bytes


def spark(path: Path, runs: int) -> list[float]:
    """Seconds of Spark's builder alone, for each run; empty if it cannot run."""
    if "SPARK_DIR" not in os.environ:
        return []
    command = ["node", str(HERE / "spark_build.mjs"), str(path), str(runs)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        print(f"Spark failed on {path.name}: {result.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
        return []
    return [json.loads(line)["build"] for line in result.stdout.splitlines()]


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files; the last is also tiled to larger sizes")
    parser.add_argument(
        "--method", choices=METHODS, default=METHODS[0], help="sparklod's builder; Spark's is always its tiny one"
    )
    parser.add_argument("--millions", type=float, nargs="*", default=[0.1, 0.5, 1, 2, 5], help="splats to tile to")
    parser.add_argument("--runs", type=int, default=5, help="number of runs; medians are printed")
    parser.add_argument("--spark-up-to", type=float, default=2, help="splats that Spark builds at most, in millions")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.\n")
    with tempfile.TemporaryDirectory() as folder:
        paths = list(arguments.scenes)
        source = load(paths[-1])
        for millions in arguments.millions:
            paths.append(Path(folder) / f"tiled-{millions:g}M.ply")
            write_ply(paths[-1], tiled(source, int(millions * 1e6)))
        del source
        TABLE.show(rows(paths, arguments.method, arguments.runs, spark_up_to=1e6 * arguments.spark_up_to))


if __name__ == "__main__":
    main()
