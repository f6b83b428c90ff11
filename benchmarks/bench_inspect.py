"""Measures `inspect` against mere decompression in one run: `python benchmarks/bench_inspect.py --help`."""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from bench_build import MEASURED, machine
from scenes import load, tiled

import sparklod_cli as sparklod
from sparklod_cli import Scene, Splats

#: Decompresses a file as the codec does and keeps nothing, which every way to inspect it has to do at least.
INFLATE = """
import re, sys
from pathlib import Path
from sparklod_cli.codecs.inflate import Inflate
with open(sys.argv[1], "rb") as file:
    data = Inflate(file)
    while data.read(1 << 20):
        pass
print(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
"""

#: Ways to inspect a file: a program and its arguments, to which the file is added.
WAYS = {
    "inflate": (INFLATE,),
    "--json": (MEASURED, "inspect", "--json"),
    "--json --stats": (MEASURED, "inspect", "--json", "--stats"),
    "--check": (MEASURED, "inspect", "--check", "-q"),
}

HEADINGS = (
    "SH",
    "leaves",
    "nodes",
    "MB",
    "way",
    "s (min to max)",
    "million nodes/s",
    "x inflate",
    "peak MB",
    "bytes a node",
)


class Run(NamedTuple):
    """Wall time of a process in s, and its peak resident memory in bytes."""

    seconds: float
    bytes: int


def run_of(way: str, path: Path) -> Run:
    """Runs one of `WAYS` on a file, whether or not `inspect` has findings."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", *WAYS[way], str(path)], capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode not in (0, 3):
        raise SystemExit(f"{way} failed on {path}: {done.stderr}")
    return Run(seconds, 1024 * int(done.stdout.splitlines()[-1]))


def bake(source: Splats, nodes: int, path: Path) -> tuple[int, int]:
    """Tiles a scene and writes its tree of about `nodes` nodes; returns the numbers of leaves and of nodes."""
    sample = nodes // 4  # the ratio of nodes to leaves hardly depends on the number of leaves
    growth = len(sparklod.build_lod(Scene(tiled(source.with_max_sh(0), sample)))) / sample
    leaves = round(nodes / growth)
    tree = sparklod.build_lod(Scene(tiled(source, leaves)))
    sparklod.write(path, tree, overwrite=True)
    return leaves, len(tree)


def rows(source: Splats, nodes: int, folder: Path, runs: int) -> None:
    """Measures all ways on one size of file, in turns, and prints a row for each."""
    path = folder / "tree.spz"
    leaves, nodes = bake(source, nodes, path)
    for way in WAYS:
        run_of(way, path)  # fills the caches of the operating system and of numba
    turns = [{way: run_of(way, path) for way in WAYS} for _ in range(runs)]
    medians = {way: statistics.median(turn[way].seconds for turn in turns) for way in WAYS}
    for way in WAYS:
        seconds = [turn[way].seconds for turn in turns]
        peak = statistics.median(turn[way].bytes for turn in turns)
        cells = [
            str(source.sh_degree),
            f"{leaves:,}",
            f"{nodes:,}",
            f"{path.stat().st_size / 1e6:.1f}",
            way,
            f"{medians[way]:.2f} ({min(seconds):.2f} to {max(seconds):.2f})",
            f"{nodes / medians[way] / 1e6:.1f}",
            f"{medians[way] / medians['inflate']:.1f}",
            f"{peak / 1e6:.0f}",
            f"{peak / nodes:.0f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)
    path.unlink()


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="splat file to tile and bake")
    parser.add_argument("--millions", type=float, nargs="*", default=[1, 5, 10], help="nodes of the files")
    parser.add_argument("--sh", type=int, nargs="*", default=[0, 2], help="SH degrees, none above the scene's")
    parser.add_argument("--runs", type=int, default=5, help="number of runs, in turns; medians are printed")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.\n")
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    scene = load(arguments.scene)
    with tempfile.TemporaryDirectory() as folder:
        for degree in arguments.sh:
            for millions in arguments.millions:
                rows(scene.with_max_sh(degree), int(millions * 1e6), Path(folder), arguments.runs)


if __name__ == "__main__":
    main()
