"""Sizes of RAD files, and times to write and read them, beside LoD SPZ and Spark's own: `bench_rad.py --help`.

Spark's native program is built from its repository: `cargo build --release` in rust/build-lod.
"""

from __future__ import annotations

import argparse
import gc
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from bench_build import machine

import sparklod_cli as sparklod

T = TypeVar("T")

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


@dataclass(frozen=True)
class Baked:
    """What a run gave.

    Attributes:
        path: of the file, or of the header of several.
        bytes: of all files of it.
        seconds: of the process.
        busy: seconds of processors, on all threads.
    """

    path: Path
    bytes: int
    seconds: float
    busy: float


class Bakery:
    """Bakes a scene in a folder of its own, where Spark's program puts its outputs beside the input.

    Args:
        scene: a splat file.
        method: "quick" or "quality".
        folder: an empty one.
        peer: Spark's program; None to leave it out.
    """

    def __init__(self, scene: Path, method: str, folder: Path, peer: Path | None) -> None:
        self._scene, self._method, self._folder, self._peer = scene, method, folder, peer

    def bake(self, way: Way) -> Baked:
        """Bakes the scene once; its files stay until the same way is gone again."""
        folder = self._folder / way.name.replace(" ", "-")
        folder.mkdir(exist_ok=True)
        source = folder / self._scene.name
        if not source.exists():
            source.symlink_to(self._scene.resolve())
        output = folder / f"{source.stem}-lod{way.suffix}"
        if way.peer:
            command = [str(self._peer), f"--{self._method}", *way.options, source.name]
        else:
            command = [sys.executable, "-m", "sparklod_cli", "build-lod", source.name, "--method", self._method]
            command += ["-o", output.name, "--overwrite", "--quiet", *way.options]
        start, before = time.perf_counter(), busy()
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment())
        seconds, used = time.perf_counter() - start, busy() - before
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} failed: {done.stderr.strip()}")
        return Baked(output, sum(file.stat().st_size for file in folder.glob(f"{source.stem}-lod*")), seconds, used)


def busy() -> float:
    """Seconds of processors of all processes that were waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def environment() -> dict[str, str]:
    """That of this process, with the package found from another folder."""
    home = str(Path(sparklod.__file__).resolve().parents[1])
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (home, os.environ.get("PYTHONPATH"))))}


def in_turn(runs: int, jobs: Sequence[Callable[[], T]]) -> Iterator[list[T]]:
    """What the runs of each job return; they take turns, after one run of each that is not counted."""
    results: list[list[T]] = [[] for _ in jobs]
    for run in range(runs + 1):
        for job, found in zip(jobs, results, strict=True):
            result = job()
            if run:
                found.append(result)
    yield from results


def reading(path: Path) -> float:
    """Seconds of one run of `read`, from the file to the columns of a tree."""
    gc.collect()
    start = time.perf_counter()
    sparklod.read(path)
    return time.perf_counter() - start


def row(cells: Sequence[str]) -> None:
    """Prints a row in Markdown."""
    print("| " + " | ".join(cells) + " |", flush=True)


def head(cells: Sequence[str]) -> None:
    """Prints the head of a table in Markdown."""
    row(cells)
    print("|---" * len(cells) + "|")


def spread(seconds: list[float], digits: int) -> str:
    """A median and its range."""
    median, least, most = statistics.median(seconds), min(seconds), max(seconds)
    return f"{median:.{digits}f} ({least:.{digits}f} to {most:.{digits}f})"


def print_sizes(bakeries: dict[tuple[str, str], Bakery], ways: Sequence[Way]) -> None:
    """Sizes of every way, and those of our RAD beside those of Spark's and of our LoD SPZ."""
    ratios = [("RAD / SPZ", RAD, SPZ), ("RAD / Spark's", RAD, SPARK_RAD), ("palette / RAD", PALETTE, RAD)]
    ratios = [each for each in ratios if each[1] in ways and each[2] in ways]
    names = [f"{way.name} MB" for way in ways]
    head(["scene", "method", "SH", "our nodes", *names, *(name for name, _, _ in ratios)])
    for (scene, method), bakery in bakeries.items():
        sizes = {way: bakery.bake(way) for way in ways}
        tree = sparklod.read(sizes[SPZ].path)
        cells = [f"{size.bytes / 1e6:.2f}" for size in sizes.values()]
        cells += [f"{sizes[one].bytes / sizes[other].bytes:.2f}" for _, one, other in ratios]
        row([scene, method, str(tree.splats.sh_degree), f"{len(tree):,}", *cells])


def print_times(bakeries: dict[tuple[str, str], Bakery], ways: Sequence[Way], runs: int) -> None:
    """Times of whole processes of every way, and how many times as long Spark's RAD takes."""
    head(["scene", "method", "way", "s (min to max)", "processors' s", "Spark's RAD s / this"])
    for (scene, method), bakery in bakeries.items():
        jobs = [lambda way=way, bakery=bakery: bakery.bake(way) for way in ways]
        baked = dict(zip(ways, in_turn(runs, jobs), strict=True))
        seconds = {way: [one.seconds for one in found] for way, found in baked.items()}
        for way, found in baked.items():
            ratio = ""
            if SPARK_RAD in seconds:
                ratio = f"{statistics.median(seconds[SPARK_RAD]) / statistics.median(seconds[way]):.2f}x"
            used = statistics.median(one.busy for one in found)
            row([scene, method, way.name, spread(seconds[way], 2), f"{used:.2f}", ratio])


def print_reading(bakeries: dict[tuple[str, str], Bakery], ways: Sequence[Way], runs: int) -> None:
    """Times of our reader with the files of every way."""
    head(["scene", "method", "file", "nodes", "s (min to max)", "million nodes/s", "beside our SPZ"])
    for (scene, method), bakery in bakeries.items():
        paths = [bakery.bake(way).path for way in ways]
        seconds = list(in_turn(runs, [lambda path=path: reading(path) for path in paths]))
        base = statistics.median(seconds[0])
        for way, path, found in zip(ways, paths, seconds, strict=True):
            nodes, median = len(sparklod.read(path)), statistics.median(found)
            cells = [way.name, f"{nodes:,}", spread(found, 3), f"{nodes / median / 1e6:.2f}", f"{base / median:.2f}x"]
            row([scene, method, *cells])


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
    ways = [way for way in WAYS if arguments.peer or not way.peer]
    left_out = {PALETTE} if arguments.no_palette else set()
    left_out |= set() if arguments.peer_palette else {SPARK_PALETTE}
    ways = [way for way in ways if way not in left_out]
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.")
    with tempfile.TemporaryDirectory() as top:
        bakeries = {}
        for scene in arguments.scenes:
            for method in arguments.methods:
                folder = Path(top, f"{scene.name}-{method}")
                folder.mkdir()
                peer = arguments.peer and arguments.peer.resolve()
                bakeries[scene.name, method] = Bakery(scene, method, folder, peer)
        for table in arguments.tables:
            print()
            if table == "sizes":
                print_sizes(bakeries, ways)
            elif table == "times":
                print_times(bakeries, ways, arguments.runs)
            else:
                print_reading(bakeries, [way for way in ways if way is not CHUNKED], arguments.runs)


if __name__ == "__main__":
    main()
