"""What the bytes of LoD files are spent on, beside plain files of the same splats; `bench_size.py --help`.

Both have the same version, fractional bits and level. A stream is deflated by itself for its column, so columns add up
to nearly the file.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from scenes import load

import sparklod_cli as sparklod
from sparklod_cli.codecs import compression, spz
from sparklod_cli.codecs.compression import MIXED, Run
from sparklod_cli.codecs.options import DEFAULTS, WriteOptions
from sparklod_cli.codecs.rad import codec as rad
from sparklod_cli.codecs.spz_encoder import WAYS
from sparklod_cli.lod.builders import METHODS
from sparklod_cli.lod.chunk_order import arrange
from sparklod_cli.model.scene import Scene
from sparklod_cli.support.progress import silent

#: Streams of SPZ in file order; some scenes have no SH, and plain files no children.
STREAMS = ("positions", "alphas", "colors", "scales", "rotations", "sh", "child_counts", "child_starts")


def line(cells: list[str]) -> None:
    """Prints a row in Markdown."""
    print("| " + " | ".join(cells) + " |", flush=True)


def of_streams(scene: Scene, options: WriteOptions) -> dict[str, int]:
    """Bytes of each stream of an SPZ file, deflated by itself."""
    codes = spz.encoder(scene, options).encode(scene.splats, scene.tree, 0)
    level = options.compression_level
    return {
        name: sum(
            map(len, compression.gzip_member([column], [Run(column.nbytes, WAYS.get(name, MIXED))], level, 1, silent))
        )
        for name, column in codes.items()
    }


def measure(path: Path, method: str) -> None:
    """Prints the row of a scene."""
    plain = sparklod.Scene(load(path))
    tree = sparklod.build_lod(plain, method=method)
    options = spz.settled(tree, DEFAULTS)
    base = sum(map(len, spz.encode(plain, options)))
    whole = sum(map(len, spz.encode(tree, options)))
    streams = of_streams(tree, options)
    in_chunks = Scene(*arrange(tree.splats, tree.tree))
    rads = [sum(map(len, rad.encode(scene, rad.settled(in_chunks, DEFAULTS)))) for scene in (in_chunks, plain)]
    columns = [f"{streams[name] / base:.3f}" if name in streams else "" for name in STREAMS]
    ratios = [f"{len(tree) / len(plain):.3f}", f"{whole / base:.3f}", f"{rads[0] / rads[1]:.3f}"]
    line([path.name, method, f"{whole:,}", *ratios, *columns])


def main() -> None:
    """Prints a Markdown table; columns of SPZ are shares of the plain file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files without a tree")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="builders")
    arguments = parser.parse_args()
    heads = ["scene", "builder", "SPZ bytes", "nodes / leaves", "SPZ / plain", "RAD / plain", *STREAMS]
    line(heads)
    print("|---" * len(heads) + "|")
    for path in arguments.scenes:
        for method in arguments.methods:
            measure(path, method)


if __name__ == "__main__":
    main()
