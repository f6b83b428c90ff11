"""Sizes of RAD files, and times to write and read them, beside LoD SPZ and Spark's own: `bench_rad.py --help`.

Spark's native program is built from its repository: `cargo build --release` in rust/build-lod.
"""

from __future__ import annotations

import argparse
import gc
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from performance.machine import machine
from performance.process import SPARKLOD, Took, in_turn, run, runs_of
from performance.rows import Row, Table, figure, label, ratio

import sparklod_cli as sparklod

#: Rounds of the palette's clustering in Spark, which its program has as its default.
SPARK_ROUNDS = 10


@dataclass(frozen=True)
class Way:
    """A way to bake a file.

    Attributes:
        name: in tables.
        options: of `sparklod build-lod`, or of Spark's program.
        suffix: of the output.
        peer: whether it is Spark's program that bakes.
    """

    name: str
    options: tuple[str, ...]
    suffix: str = ".rad"
    peer: bool = False


SPZ = Way("SPZ", ("--format", "spz"), ".spz")
RAD = Way("RAD", ("--format", "rad"))
CHUNKED = Way("RAD, chunked", ("--format", "rad-chunked"))
PALETTE = Way("RAD, palette", ("--format", "rad", "--cluster-sh"))
SPARK_SPZ = Way("Spark's SPZ", ("--spz",), ".spz", peer=True)
SPARK_RAD = Way("Spark's RAD", ("--rad",), peer=True)
SPARK_PALETTE = Way("Spark's RAD, palette", ("--rad", f"--cluster-sh-cpu={SPARK_ROUNDS}"), peer=True)
WAYS = (SPZ, RAD, CHUNKED, PALETTE, SPARK_SPZ, SPARK_RAD, SPARK_PALETTE)

#: The way of Spark's program that does the same work.
PEERS = {SPZ: SPARK_SPZ, RAD: SPARK_RAD, CHUNKED: SPARK_RAD, PALETTE: SPARK_PALETTE}

SIZES = Table(
    columns=(
        *(label("scene"), label("method"), label("SH"), label("nodes", "our nodes")),
        *(figure(f"{way.name} bytes", f"{way.name} MB", 2, per=1e6) for way in WAYS if way is not SPARK_PALETTE),
        ratio("RAD bytes", "SPZ bytes", "RAD / SPZ", 2),
        ratio("RAD bytes", "Spark's RAD bytes", "RAD / Spark's RAD", 2),
        ratio("RAD, palette bytes", "RAD bytes", "palette / RAD", 2),
    ),
    key=("scene", "method"),
)
TIMES = Table(
    columns=(
        *(label("scene"), label("method"), label("output")),
        figure("wall_s", "s", 2, spread=True),
        figure("cpu_s", "processors' s", 2),
        figure("peak_bytes", "peak MB", 0, per=1e6),
        figure("native_wall_s", "native s", 2, spread=True),
        figure("native_cpu_s", "native processors' s", 2),
        figure("native_peak_bytes", "native peak MB", 0, per=1e6),
        ratio("wall_s", "native_wall_s", "s / native s", 2),
        ratio("cpu_s", "native_cpu_s", "processors' s / native's", 2),
        figure("output_bytes", "MB", 2, per=1e6),
        ratio("output_bytes", "native_output_bytes", "MB / native MB", 2),
    ),
    key=("scene", "method", "output"),
    judged=("wall_s", "cpu_s", "peak_bytes", "output_bytes"),
)
READING = Table(
    columns=(
        *(label("scene"), label("method"), label("file"), label("nodes")),
        figure("read_s", "s", 3, spread=True),
        ratio("nodes", "read_s", "million nodes/s", 2, per=1e6),
    ),
    key=("scene", "method", "file"),
    judged=("read_s",),
)


@dataclass(frozen=True)
class Baked:
    """What a run gave.

    Attributes:
        path: of the file, or of the header of several.
        bytes: of all files of it.
        took: by the process.
    """

    path: Path
    bytes: int
    took: Took


@dataclass(frozen=True)
class Bakery:
    """Bakes a scene in a folder of its own, where Spark's program puts its outputs beside the input.

    Attributes:
        scene: a splat file.
        method: "quick" or "quality".
        folder: an empty one.
        peer: Spark's program; None to leave it out.
    """

    scene: Path
    method: str
    folder: Path
    peer: Path | None

    def bake(self, way: Way) -> Baked:
        """Bakes the scene once; its files stay until the same way is gone again."""
        folder = self.folder / f"{self.scene.name}-{self.method}-{way.name.replace(' ', '-')}"
        folder.mkdir(exist_ok=True)
        source = folder / self.scene.name
        if not source.exists():
            source.symlink_to(self.scene.resolve())
        output = folder / f"{source.stem}-lod{way.suffix}"
        if way.peer:
            command = [str(self.peer), f"--{self.method}", *way.options, source.name]
        else:
            command = [*SPARKLOD, "build-lod", source.name, "--method", self.method]
            command += ["-o", output.name, "--overwrite", "--quiet", *way.options]
        took = run(command, cwd=folder)
        return Baked(output, sum(file.stat().st_size for file in folder.glob(f"{source.stem}-lod*")), took)


def size_rows(bakeries: Sequence[Bakery], ways: Sequence[Way]) -> Iterator[Row]:
    """Sizes of every way; a row for each scene and builder. Scenes without SH have no palette."""
    for bakery in bakeries:
        tree = sparklod.read(bakery.bake(SPZ).path)
        labels = {"scene": bakery.scene.name, "method": bakery.method, "SH": tree.splats.sh_degree, "nodes": len(tree)}
        palettes = {PALETTE, SPARK_PALETTE} if not tree.splats.sh_degree else set()
        sizes = {f"{way.name} bytes": bakery.bake(way).bytes for way in ways if way not in palettes}
        yield Row({**labels, **sizes}, {})


def time_rows(bakeries: Sequence[Bakery], ways: Sequence[Way], runs: int) -> Iterator[Row]:
    """Times of whole processes of each of our ways, in turn with the same way of Spark's program."""
    for bakery in bakeries:
        ours = [way for way in ways if not way.peer]
        peers = {PEERS[way] for way in ours} & set(ways) if bakery.peer else set()
        every = [*ours, *(way for way in ways if way in peers)]
        found = in_turn(runs, [lambda way=way, bakery=bakery: bakery.bake(way) for way in every])
        baked = dict(zip(every, found, strict=True))
        for way in ours:
            labels = {"scene": bakery.scene.name, "method": bakery.method, "output": way.name}
            yield Row(labels, {**_figures(baked[way]), **_figures(baked.get(PEERS[way], []), "native_")})


def _figures(baked: Sequence[Baked], prefix: str = "") -> dict[str, list[float]]:
    """The runs of a row."""
    runs = runs_of([each.took for each in baked], prefix)
    return {**runs, f"{prefix}output_bytes": [each.bytes for each in baked]}


def read_rows(bakeries: Sequence[Bakery], ways: Sequence[Way], runs: int) -> Iterator[Row]:
    """Times of our reader with the files of every way."""
    for bakery in bakeries:
        paths = [bakery.bake(way).path for way in ways]
        seconds = in_turn(runs, [lambda path=path: _reading(path) for path in paths])
        for way, path, found in zip(ways, paths, seconds, strict=True):
            labels = {"scene": bakery.scene.name, "method": bakery.method, "file": way.name}
            yield Row({**labels, "nodes": len(sparklod.read(path))}, {"read_s": found})


def _reading(path: Path) -> float:
    """Seconds of one run of `read`, from the file to the columns of a tree."""
    gc.collect()
    start = time.perf_counter()
    sparklod.read(path)
    return time.perf_counter() - start


def main() -> None:
    """Prints Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files")
    parser.add_argument("--peer", type=Path, help="Spark's native build-lod; left out without")
    parser.add_argument("--methods", nargs="+", choices=("quick", "quality"), default=["quick"])
    parser.add_argument("--tables", nargs="+", choices=("sizes", "times", "reading"), default=["sizes", "times"])
    parser.add_argument("--runs", type=int, default=5, help="number of runs, in turns; medians are printed")
    parser.add_argument("--no-palette", action="store_true", help="leave out our palettes of spherical harmonics")
    parser.add_argument("--peer-palette", action="store_true", help="Spark's palettes, too, which take half an hour")
    arguments = parser.parse_args()
    left_out = {PALETTE} if arguments.no_palette else set()
    left_out |= set() if arguments.peer_palette else {SPARK_PALETTE}
    ways = [way for way in WAYS if way not in left_out and (arguments.peer or not way.peer)]
    peer = arguments.peer and arguments.peer.resolve()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.")
    with tempfile.TemporaryDirectory() as top:
        bakeries = [
            Bakery(scene, method, Path(top), peer) for scene in arguments.scenes for method in arguments.methods
        ]
        for table in arguments.tables:
            print()
            if table == "sizes":
                SIZES.show(size_rows(bakeries, ways))
            elif table == "times":
                TIMES.show(time_rows(bakeries, ways, arguments.runs))
            else:
                READING.show(read_rows(bakeries, [way for way in ways if way is not CHUNKED], arguments.runs))


if __name__ == "__main__":
    main()
