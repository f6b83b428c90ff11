"""Measures decoding of each format, against splat-transform in one run: `python benchmarks/bench_decode.py --help`."""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from bench_sog import splat_transform
from performance.machine import machine
from performance.rows import Row, Table, figure, label, ratio
from scenes import load, tiled

import sparklod_cli as sparklod
from sparklod_cli import Splats

HERE = Path(__file__).resolve().parent

TABLE = Table(
    columns=(
        *(label("file"), label("format"), label("splats"), label("SH")),
        figure("file_bytes", "MB", 1, per=1e6),
        figure("read_s", "sparklod s", 3, spread=True),
        ratio("splats", "read_s", "million splats/s", 2, per=1e6),
        ratio("file_bytes", "read_s", "GB/s", 2, per=1e9),
        figure("transform_s", "splat-transform s", 3, spread=True),
        ratio("transform_s", "read_s", "splat-transform's / ours", unit="x"),
        ratio("peak_bytes", "decoded_bytes", "peak / decoded", 2),
        figure("peak_bytes", "peak MB", 0, per=1e6),
    ),
    key=("file",),
    judged=("read_s", "peak_bytes"),
)

#: Ends of the names of files that sparklod writes, with their SH degree: SOG is without SH, since clustering those of
#: millions of splats takes long.
OURS = {".ply": 3, ".splat": 0, ".rad": 3, "-v3.spz": 3, "-sh0.sog": 0}

#: The same of files that splat-transform writes from the first of them.
THEIRS = (".compressed.ply", "-v4.spz")

#: Those that have goals at sizes where the others take long to make.
LARGE = (".ply", ".splat", "-sh0.sog")

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


def made(splats: Splats, stem: str, folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yields a file of some splats in each of `OURS` and `THEIRS` that is asked for, and can be had."""
    for name in names:
        path = folder / f"{stem}{name}"
        if name in OURS:
            sparklod.write(path, sparklod.Scene(splats.with_max_sh(OURS[name])), overwrite=True)
            yield path
        elif "FOREIGN_DIR" in os.environ:
            splat_transform(folder / f"{stem}.ply", path)
            yield path


def rows(paths: Iterable[Path], transform: SplatTransform, runs: int) -> Iterator[Row]:
    """A row for each file, which both programs read in turns."""
    for path in paths:
        scene = sparklod.read(path)
        labels = {
            "file": path.name,
            "format": scene.format or "",
            "splats": len(scene),
            "SH": scene.splats.sh_degree,
            "file_bytes": _bytes_of(path),
            "decoded_bytes": sum(getattr(scene.splats, each.name).nbytes for each in dataclasses.fields(scene.splats)),
        }
        del scene
        known = transform.seconds(path) is not None
        turns = [(our_seconds(path), transform.seconds(path) if known else None) for _ in range(runs)]
        ours, theirs = [ours for ours, _ in turns], [theirs for _, theirs in turns if theirs is not None]
        yield Row(labels, {"read_s": ours, "transform_s": theirs, "peak_bytes": [peak(path)]})


def tiled_rows(
    source: Path, million: float, transform: SplatTransform, runs: int, names: Sequence[str] = (*OURS, *THEIRS)
) -> Iterator[Row]:
    """Rows of files of a scene tiled to a size, in all formats or in some."""
    splats = tiled(load(source), round(million * 1e6))
    with tempfile.TemporaryDirectory() as folder:
        files = made(splats, f"tiled-{million:g}M", Path(folder), names)
        yield from rows(files, transform, runs)


def _bytes_of(path: Path) -> int:
    """Of the file, or of all beside it if it only lists them."""
    files = path.parent.glob("*") if path.suffix == ".json" else [path]
    return sum(file.stat().st_size for file in files)


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files; --millions tiles the last")
    parser.add_argument("--millions", type=float, nargs="*", default=[], help="splats to tile to, in all formats")
    parser.add_argument("--runs", type=int, default=5, help="number of runs, in turns; medians are printed")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs.\n")
    transform = SplatTransform()
    TABLE.show(rows(arguments.scenes, transform, arguments.runs))
    for million in arguments.millions:
        for row in tiled_rows(arguments.scenes[-1], million, transform, arguments.runs):
            print(TABLE.line(row), flush=True)
    transform.close()


if __name__ == "__main__":
    main()
