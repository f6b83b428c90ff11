"""Measures decoding of each format, against splat-transform in one run: `python benchmarks/bench_decode.py --help`."""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench_build import machine
from scenes import load, tiled

import sparklod_cli as sparklod

HERE = Path(__file__).resolve().parent

HEADINGS = (
    *("file", "format", "splats", "SH", "MB", "sparklod s", "million splats/s (min to max)", "splat-transform s"),
    *("million splats/s", "ratio", "peak / decoded"),
)

#: Decodes a file and prints its peak resident memory in kB, less that of the interpreter and the codecs before.
MEASURED = """
import re, sys
from pathlib import Path
import sparklod_cli as sparklod
from sparklod_cli.codecs.formats import FORMATS
def memory(what):
    return int(re.search(what + r":\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
for form in FORMATS:
    form.codec()
read, before = sparklod.read, memory("VmRSS")
scene = read(Path(sys.argv[1]))
print(memory("VmHWM") - before)
"""


class SplatTransform:
    """splat-transform's library in a Node process; answers None if FOREIGN_DIR is not set."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        if "FOREIGN_DIR" in os.environ:
            command = ["node", "--expose-gc", "--max-old-space-size=8192", str(HERE / "transform_read.mjs")]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )

    def ask(self, **request: Any) -> dict[str, Any] | None:
        """Returns the answer to a request; None, with a message on stderr, if it failed."""
        if self._process is None:
            return None
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline() or '{"error": "the process ended"}')
        if "error" in answer:
            print(f"splat-transform failed on {request}: {answer['error']}", file=sys.stderr)
            return None
        return dict(answer)

    def seconds(self, path: Path) -> float | None:
        """Seconds of one run of its reader."""
        answer = self.ask(read=str(path))
        return None if answer is None else float(answer["seconds"])

    def close(self) -> None:
        if self._process is not None:
            self._process.communicate()


def our_seconds(path: Path) -> float:
    """Seconds of one run of `read`, from the file to the columns of `Splats`."""
    gc.collect()
    start = time.perf_counter()
    sparklod.read(path)
    return time.perf_counter() - start


def peak(path: Path) -> int:
    """Peak memory of a process that decodes a file, in bytes, less what it has at its start."""
    result = subprocess.run([sys.executable, "-c", MEASURED, str(path)], capture_output=True, text=True, check=True)
    return int(result.stdout) * 1024


def made(source: Path, millions: float, folder: Path, transform: SplatTransform) -> Iterator[Path]:
    """Tiles a scene to a size and yields a file of it in every format that sparklod or splat-transform writes.

    SOG is written without SH: without a GPU, splat-transform takes hours to cluster those of a million splats.
    """
    splats = tiled(load(source), int(millions * 1e6))
    stem = f"tiled-{millions:g}M"
    plain, bare = folder / f"{stem}.ply", folder / f"{stem}-sh0.ply"
    for path, degree in ((plain, 3), (bare, 0), (folder / f"{stem}.splat", 0), (folder / f"{stem}.rad", 3)):
        sparklod.write(path, sparklod.Scene(splats.with_max_sh(degree)), overwrite=True)
        if path != bare:
            yield path
    del splats
    for name, origin, options in (
        (f"{stem}.compressed.ply", plain, {}),
        (f"{stem}-v3.spz", plain, {"spzVersion": 3}),
        (f"{stem}-v4.spz", plain, {"spzVersion": 4}),
        (f"{stem}-sh0.sog", bare, {}),
    ):
        if transform.ask(write=str(folder / name), source=str(origin), options=options) is not None:
            yield folder / name


def row(path: Path, transform: SplatTransform, runs: int) -> None:
    """Measures one file and prints its row."""
    scene = sparklod.read(path)
    splats, degree, form = len(scene.splats), scene.splats.sh_degree, scene.format
    decoded = sum(getattr(scene.splats, field.name).nbytes for field in dataclasses.fields(scene.splats))
    del scene
    transform.seconds(path)
    ours, theirs = [], []
    for _ in range(runs):
        ours.append(our_seconds(path))
        theirs.append(transform.seconds(path))
    median = statistics.median(ours)
    rates = [splats / seconds / 1e6 for seconds in ours]
    known = [seconds for seconds in theirs if seconds is not None]
    other = statistics.median(known) if known else None
    size = sum(file.stat().st_size for file in path.parent.glob("*")) if path.suffix == ".json" else path.stat().st_size
    cells = [
        path.name,
        form,
        f"{splats:,}",
        str(degree),
        f"{size / 1e6:.1f}",
        f"{median:.3f}",
        f"{statistics.median(rates):.2f} ({min(rates):.2f} to {max(rates):.2f})",
        f"{other:.3f}" if other else "",
        f"{splats / other / 1e6:.2f}" if other else "",
        f"{other / median:.1f}x" if other else "",
        f"{peak(path) / decoded:.2f}",
    ]
    print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files; --millions tiles the last")
    parser.add_argument("--millions", type=float, nargs="*", default=[], help="splats to tile to, in all formats")
    parser.add_argument("--runs", type=int, default=5, help="number of runs, in turns; medians are printed")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.\n")
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    transform = SplatTransform()
    for path in arguments.scenes:
        row(path, transform, arguments.runs)
    for millions in arguments.millions:
        with tempfile.TemporaryDirectory() as folder:
            for path in made(arguments.scenes[-1], millions, Path(folder), transform):
                row(path, transform, arguments.runs)
    transform.close()


if __name__ == "__main__":
    main()
