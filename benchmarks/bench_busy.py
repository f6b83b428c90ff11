"""Measures baking on an idle and on a busy machine, by how OpenMP's threads wait for each other.

    python benchmarks/bench_busy.py playbot.sog [--rounds 3] [--method quality]

Every round measures each way of waiting: one bake alone, one beside a process that keeps a processor busy, four one
after another, and four at once. Bakes are whole processes, from file to file, with a warm cache; medians are printed.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from sparklod_cli.lod.builders import METHODS
from sparklod_cli.support.jit import WAIT_SETTINGS

#: Environment variables and options of each way of waiting, by its name in the table: OpenMP's default, what sparklod
#: sets, two others, and one thread for comparison.
WAYS: dict[str, tuple[dict[str, str], list[str]]] = {
    "OpenMP's default": ({"GOMP_SPINCOUNT": "300000"}, []),  # libgomp's default
    "as shipped": ({}, []),
    "10,000 looks": ({"GOMP_SPINCOUNT": "10000"}, []),
    "passive": ({"OMP_WAIT_POLICY": "PASSIVE"}, []),
    "one thread": ({}, ["--threads", "1"]),
}

AT_ONCE = 4  # bakes at once


class Bakes:
    """Starts bakes of a scene, each as a process."""

    def __init__(self, scene: Path, method: str, folder: Path) -> None:
        self._line = [sys.executable, "-m", "sparklod_cli", "build-lod", str(scene), "--method", method, "-q"]
        self._folder = folder
        self._started = 0

    def start(self, way: str) -> subprocess.Popen[bytes]:
        settings, options = WAYS[way]
        clean = {name: value for name, value in os.environ.items() if name not in (*WAIT_SETTINGS, "OMP_WAIT_POLICY")}
        self._started += 1
        output = str(self._folder / f"{self._started}.spz")
        return subprocess.Popen([*self._line, *options, "-o", output], env={**clean, **settings})

    def run(self, way: str, count: int, *, at_once: bool) -> float:
        """Seconds that `count` bakes take, at once or one after the other."""
        start = time.perf_counter()
        running = []
        for _ in range(count):
            running.append(self.start(way))
            if not at_once:
                _finish(running[-1])
        for process in running:
            _finish(process)
        return time.perf_counter() - start


def _finish(process: subprocess.Popen[bytes]) -> None:
    if process.wait():
        raise SystemExit("a bake failed")


def beside_a_busy_process(bakes: Bakes, way: str) -> float:
    """Seconds of a bake while another process computes."""
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        return bakes.run(way, 1, at_once=False)
    finally:
        busy.kill()
        busy.wait()


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--method", choices=METHODS, default="quality")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    seconds: dict[str, list[tuple[float, ...]]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder:
        bakes = Bakes(arguments.scene, arguments.method, Path(folder))
        bakes.run("as shipped", 1, at_once=False)  # compiles kernels and fills the system's file cache
        for _ in range(arguments.rounds):
            for way, rows in seconds.items():
                rows.append(
                    (
                        bakes.run(way, 1, at_once=False),
                        beside_a_busy_process(bakes, way),
                        bakes.run(way, AT_ONCE, at_once=False),
                        bakes.run(way, AT_ONCE, at_once=True),
                    )
                )
    print(f"| threads wait | alone s | beside a busy process s | {AT_ONCE} in turn s | {AT_ONCE} at once s | ratio |")
    print("|---|---|---|---|---|---|")
    for way, rows in seconds.items():
        alone, beside, in_turn, at_once = map(statistics.median, zip(*rows, strict=True))
        print(f"| {way} | {alone:.2f} | {beside:.2f} | {in_turn:.1f} | {at_once:.1f} | {at_once / in_turn:.2f} |")


if __name__ == "__main__":
    main()
