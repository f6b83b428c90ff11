"""Measures `build-lod` by stages, against Spark's own builder in one run: `python benchmarks/bench_build.py --help`."""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scenes import load, tiled, write_ply

import sparklod_cli as sparklod
from sparklod_cli.lod.builders import METHODS
from sparklod_cli.support.parallel import processors

HERE = Path(__file__).resolve().parent

HEADINGS = (
    *("scene", "splats", "nodes", "read s", "build s", "write s", "process s", "peak MB", "peak / input", "LoD MB"),
    *("LoD / plain", "warm build s", "million splats/s (min to max)", "Spark's build s", "ratio"),
)

#: Runs a command and prints the peak of its resident memory in kB. It asks the kernel itself, since the figure that a
#: parent process gets includes the parent's own memory before exec.
MEASURED = """
import re, sys
from pathlib import Path
from sparklod_cli.cli import run
code = run(sys.argv[1:])
print(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
sys.exit(code)
"""


def machine() -> str:
    """Describes this machine, for tables."""
    info = Path("/proc/cpuinfo")
    models = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
    return (
        f"{models[0] if models else platform.processor()}, {processors()} threads, Python {platform.python_version()}"
    )


def warm_build(path: Path, method: str, runs: int) -> list[float]:
    """Times the builder alone, from decoded splats to final order; returns the seconds of each run after the first."""
    scene = sparklod.Scene(load(path))
    # Touch memory first: on a virtual machine the first touch of a page is slow, since the host may take free pages
    # back. That would be measured as a cost of the builder, which in a long-running process it is not.
    np.zeros(1 << 30, np.float64)[::512] = 1
    seconds = []
    for run in range(runs + 1):
        start = time.perf_counter()
        sparklod.build_lod(scene, method=method)
        if run:
            seconds.append(time.perf_counter() - start)
    return seconds


def whole_command(path: Path, output: Path, method: str) -> dict[str, float]:
    """Runs the command once; returns the seconds of its stages, its wall time, and the peak memory of the process."""
    options = ["--method", method, "-o", str(output), "--overwrite", "--json"]
    command = [sys.executable, "-c", MEASURED, "build-lod", str(path), *options]
    start = time.perf_counter()
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    wall = time.perf_counter() - start
    record, peak = map(json.loads, result.stdout.splitlines())
    return {
        **record["seconds"],
        "wall": wall,
        "peak": peak * 1024,
        "nodes": record["nodes"],
        "bytes": record["bytes"],
        "bits": record["fractional_bits"],
    }


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
    """Prints Markdown tables."""
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
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    with tempfile.TemporaryDirectory() as folder:
        paths = list(arguments.scenes)
        source = load(paths[-1])
        for millions in arguments.millions:
            path = Path(folder) / f"tiled-{millions:g}M.ply"
            if not path.exists():
                write_ply(path, tiled(source, int(millions * 1e6)))
            paths.append(path)
        del source
        for path in paths:
            row(path, Path(folder) / "out.spz", arguments)


def row(path: Path, output: Path, arguments: argparse.Namespace) -> None:
    """Measures one scene and prints its row."""
    whole_command(path, output, arguments.method)  # fills the caches of the operating system and of numba
    commands = [whole_command(path, output, arguments.method) for _ in range(arguments.runs)]
    median = {key: statistics.median(run[key] for run in commands) for key in commands[0]}
    warm = warm_build(path, arguments.method, arguments.runs)
    splats = len(load(path))
    theirs = spark(path, 3) if splats <= arguments.spark_up_to * 1e6 else []
    ratio = median["bytes"] / plain_bytes(path, int(median["bits"]))
    rates = [splats / seconds / 1e6 for seconds in warm]
    cells = [
        path.name,
        f"{splats:,}",
        f"{median['nodes']:,.0f}",
        *(f"{median[stage]:.2f}" for stage in ("read", "build", "write", "wall")),
        f"{median['peak'] / 1e6:.0f}",
        f"{median['peak'] / path.stat().st_size:.1f}",
        f"{median['bytes'] / 1e6:.1f}",
        f"{ratio:.2f}",
        f"{statistics.median(warm):.3f}",
        f"{statistics.median(rates):.2f} ({min(rates):.2f} to {max(rates):.2f})",
        f"{statistics.median(theirs):.2f}" if theirs else "",
        f"{statistics.median(theirs) / statistics.median(warm):.1f}x" if theirs else "",
    ]
    print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
