"""Measures baking on an idle and on a busy machine, on all threads and on one.

    python benchmarks/bench_busy.py playbot.sog [--rounds 3] [--method quality]

Every round measures for each number of threads: one bake alone, one beside a process that keeps a processor busy, four
one after another, and four at once. Bakes are whole processes, from file to file, with a warm cache; medians are
printed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from performance.process import SPARKLOD, environment
from performance.rows import Row, Table, figure, label, ratio

from sparklod_cli.lod.tree_settings import METHODS

#: Options by the name of a row.
WAYS: dict[str, list[str]] = {"all": [], "one": ["--threads", "1"]}

AT_ONCE = 4  # bakes at once

TABLE = Table(
    columns=(
        label("way", "threads"),
        figure("alone_s", "alone s", 2),
        figure("beside_s", "beside a busy process s", 2),
        figure("in_turn_s", f"{AT_ONCE} in turn s", 1),
        figure("at_once_s", f"{AT_ONCE} at once s", 1),
        ratio("at_once_s", "in_turn_s", "at once / in turn", 2),
    ),
    key=("way",),
    judged=("alone_s", "beside_s", "in_turn_s", "at_once_s"),
)


class Bakes:
    """Starts bakes of a scene, each as a process."""

    def __init__(self, scene: Path, method: str, folder: Path) -> None:
        self._line = [*SPARKLOD, "build-lod", str(scene), "--method", method, "-q"]
        self._folder = folder
        self._started = 0

    def start(self, way: str) -> subprocess.Popen[bytes]:
        self._started += 1
        output = str(self._folder / f"{self._started}.spz")
        return subprocess.Popen([*self._line, *WAYS[way], "-o", output], env=environment())

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


def rows(scene: Path, method: str, ways: Iterable[str], rounds: int) -> list[Row]:
    """A row for each of WAYS; they take turns, so that there is no row before the last round."""
    runs: dict[str, list[dict[str, float]]] = {way: [] for way in ways}
    with tempfile.TemporaryDirectory() as folder:
        bakes = Bakes(scene, method, Path(folder))
        bakes.run("all", 1, at_once=False)  # compiles kernels and fills the system's file cache
        for _ in range(rounds):
            for way, found in runs.items():
                found.append(
                    {
                        "alone_s": bakes.run(way, 1, at_once=False),
                        "beside_s": beside_a_busy_process(bakes, way),
                        "in_turn_s": bakes.run(way, AT_ONCE, at_once=False),
                        "at_once_s": bakes.run(way, AT_ONCE, at_once=True),
                    }
                )
    return [Row({"way": way}, {name: [run[name] for run in found] for name in found[0]}) for way, found in runs.items()]


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--method", choices=METHODS, default="quality")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    TABLE.show(rows(arguments.scene, arguments.method, WAYS, arguments.rounds))


if __name__ == "__main__":
    main()
