"""What the bytes of LoD files are spent on, beside plain files of the same splats; `bench_size.py --help`.

Both have the same version, fractional bits and level. A stream is deflated by itself for its column, so columns add up
to nearly the file.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

from performance.rows import Row, Table, label, ratio
from scenes import load

import sparklod_cli as sparklod
from sparklod_cli.codecs import compression, spz
from sparklod_cli.codecs.compression import MIXED
from sparklod_cli.codecs.formats import DEFAULTS, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.spz import WAYS
from sparklod_cli.lod.chunk_order import arrange
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.progress import silent

#: Streams of SPZ in file order; some scenes have no SH, and plain files no children.
STREAMS = ("positions", "alphas", "colors", "scales", "rotations", "sh", "child_counts", "child_starts")

TABLE = Table(
    columns=(
        *(label("scene"), label("method"), label("spz_bytes", "SPZ bytes")),
        ratio("nodes", "leaves", "nodes / leaves", 3),
        ratio("spz_bytes", "plain_spz_bytes", "SPZ / plain", 3),
        ratio("rad_bytes", "plain_rad_bytes", "RAD / plain", 3),
    ),
    key=("scene", "method"),
)

#: The same, and the share of each stream in the plain SPZ.
STREAMS_TABLE = Table(
    columns=(*TABLE.columns, *(ratio(name, "plain_spz_bytes", name, 3) for name in STREAMS)), key=TABLE.key
)


def of_streams(scene: Scene, options: WriteOptions) -> dict[str, int]:
    """Bytes of each stream of an SPZ file, deflated by itself."""
    codes = spz.encoder(scene, options).encode(scene.splats, scene.tree, 0)
    level = options.compression_level
    return {
        name: sum(
            map(
                len,
                compression.gzip_member([column], [(column.nbytes, WAYS.get(name, MIXED))], level, 1, silent),
            )
        )
        for name, column in codes.items()
    }


def rows(paths: Iterable[Path], methods: Iterable[str]) -> Iterator[Row]:
    """A row for each scene and builder; sizes do not vary from run to run."""
    for path in paths:
        for method in methods:
            yield _row(path, method)


def _row(path: Path, method: str) -> Row:
    plain = sparklod.Scene(load(path))
    tree = sparklod.build_lod(plain, method=method)
    options = spz.settled(tree, DEFAULTS)
    in_chunks = Scene(*arrange(tree.splats, tree.tree))
    rad_options = rad.settled(in_chunks, DEFAULTS)
    return Row(
        {
            "scene": path.name,
            "method": method,
            "nodes": len(tree),
            "leaves": len(plain),
            "spz_bytes": sum(map(len, spz.encode(tree, options))),
            "plain_spz_bytes": sum(map(len, spz.encode(plain, options))),
            "rad_bytes": sum(map(len, rad.encode(in_chunks, rad_options))),
            "plain_rad_bytes": sum(map(len, rad.encode(plain, rad_options))),
            **of_streams(tree, options),
        },
        {},
    )


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files without a tree")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="builders")
    arguments = parser.parse_args()
    STREAMS_TABLE.show(rows(arguments.scenes, arguments.methods))


if __name__ == "__main__":
    main()
