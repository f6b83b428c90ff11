"""Looking at LoD files, beside inflating them alone in one run: `python benchmarks/bench_inspect.py --help`."""

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

#: What no way to look at a file can do without: inflating all of it, as the codec does, and keeping nothing.
INFLATE = """
import re, sys
from pathlib import Path
from sparklod_cli.codecs.compression import Inflate
with open(sys.argv[1], "rb") as file:
    data = Inflate(file)
    while data.read(1 << 20):
        pass
print(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
"""

#: Programs and arguments, to which the file is added.
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
    """One process: its wall time, and its peak memory as the kernel saw it."""

    seconds: float
    bytes: int


def run_of(way: str, path: Path) -> Run:
    """Runs a way to look at a file; whether something is found does not matter."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", *WAYS[way], str(path)], capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode not in (0, 3):
        raise SystemExit(f"{way} failed on {path}: {done.stderr}")
    return Run(seconds, 1024 * int(done.stdout.splitlines()[-1]))


def bake(source: Splats, nodes: int, path: Path) -> tuple[int, int]:
    """Writes the tree of a scene that is tiled to about so many nodes; its leaves and its nodes."""
    sample = nodes // 4  # how much a tree grows over its leaves hardly depends on their number
    growth = len(sparklod.build_lod(Scene(tiled(source.with_max_sh(0), sample)))) / sample
    leaves = round(nodes / growth)
    tree = sparklod.build_lod(Scene(tiled(source, leaves)))
    sparklod.write(path, tree, overwrite=True)
    return leaves, len(tree)


def rows(source: Splats, nodes: int, folder: Path, runs: int) -> None:
    """Measures one size of file in every way, in turns, and prints a row for each."""
    path = folder / "tree.spz"
    leaves, nodes = bake(source, nodes, path)
    for way in WAYS:
        run_of(way, path)  # fills caches, the operating system's and numba's
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
    parser.add_argument("scene", type=Path, help="splat file that is tiled and baked")
    parser.add_argument("--millions", type=float, nargs="*", default=[1, 5, 10], help="nodes of the files")
    parser.add_argument("--sh", type=int, nargs="*", default=[0, 2], help="SH degrees, none above the scene's")
    parser.add_argument("--runs", type=int, default=5, help="runs of each, in turns; medians are printed")
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
