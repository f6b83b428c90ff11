"""Measures `inspect` against mere decompression in one run: `python benchmarks/bench_inspect.py --help`."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from performance.machine import machine
from performance.process import SPARKLOD, in_turn, run, runs_of
from performance.rows import Row, Table, figure, label, ratio
from scenes import load, tiled

import sparklod_cli as sparklod
from sparklod_cli import Scene, Splats

#: Decompresses a file as the codec does and keeps nothing, which every way to inspect it has to do at least.
INFLATE = """
import sys
from sparklod_cli.codecs.compression import Inflate
with open(sys.argv[1], "rb") as file:
    data = Inflate(file)
    while data.read(1 << 20):
        pass
"""

#: Ways to inspect a file: a command, to which the file is added.
WAYS = {
    "inflate": (sys.executable, "-c", INFLATE),
    "--json": (*SPARKLOD, "inspect", "--json"),
    "--json --stats": (*SPARKLOD, "inspect", "--json", "--stats"),
    "--check": (*SPARKLOD, "inspect", "--check", "-q"),
}

TABLE = Table(
    columns=(
        label("SH"),
        label("leaves"),
        label("nodes"),
        figure("file_bytes", "MB", 1, per=1e6),
        label("way"),
        figure("wall_s", "s", 2, spread=True),
        figure("cpu_s", "processors' s", 2),
        ratio("nodes", "wall_s", "million nodes/s", 1, per=1e6),
        ratio("wall_s", "inflate_s", "x inflate"),
        figure("peak_bytes", "peak MB", 0, per=1e6),
        ratio("peak_bytes", "nodes", "bytes a node", 0),
    ),
    key=("SH", "nodes", "way"),
    judged=("wall_s", "cpu_s", "peak_bytes"),
)


def bake(source: Splats, nodes: int, path: Path) -> tuple[int, int]:
    """Tiles a scene and writes its tree of about `nodes` nodes; returns the numbers of leaves and of nodes."""
    sample = nodes // 4  # the ratio of nodes to leaves hardly depends on the number of leaves
    growth = len(sparklod.build_lod(Scene(tiled(source.with_max_sh(0), sample)))) / sample
    leaves = round(nodes / growth)
    tree = sparklod.build_lod(Scene(tiled(source, leaves)))
    sparklod.write(path, tree, overwrite=True)
    return leaves, len(tree)


def rows(source: Path, degrees: Iterable[int], millions: Iterable[float], runs: int) -> Iterator[Row]:
    """A row for each way, in turns, on LoD files of each SH degree and number of nodes of a tiled scene."""
    splats = load(source)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tree.spz"
        for degree in degrees:
            for million in millions:
                leaves, nodes = bake(splats.with_max_sh(degree), round(million * 1e6), path)
                found = in_turn(runs, [lambda way=way: run([*way, path], codes=(0, 3)) for way in WAYS.values()])
                took = {way: runs_of(each) for way, each in zip(WAYS, found, strict=True)}
                labels = {"SH": degree, "leaves": leaves, "nodes": nodes, "file_bytes": path.stat().st_size}
                for way, figures in took.items():
                    yield Row({**labels, "way": way}, {**figures, "inflate_s": took["inflate"]["wall_s"]})


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="splat file to tile and bake")
    parser.add_argument("--millions", type=float, nargs="*", default=[1, 5, 10], help="nodes of the files")
    parser.add_argument("--sh", type=int, nargs="*", default=[0, 2], help="SH degrees, none above the scene's")
    parser.add_argument("--runs", type=int, default=5, help="number of runs, in turns; medians are printed")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.\n")
    TABLE.show(rows(arguments.scene, arguments.sh, arguments.millions, arguments.runs))


if __name__ == "__main__":
    main()
