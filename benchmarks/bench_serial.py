"""Measures the serial part of a bake, by stage: `python benchmarks/bench_serial.py scene.ply --methods quick quality`.

A bake runs on two threads in a process of its own. Processor time is counted, not seconds, so other work on the machine
matters little. Of a compiled loop that takes m seconds of the calling thread's processor time and p seconds of the
process's, 2 m - p are serial: there the second thread has nothing to do. Outside of compiled loops, all of the calling
thread's time counts as serial, though the threads of a pool may work meanwhile: serial parts are upper bounds.

"At 16" is the speed-up that 16 threads allow by Amdahl's law: total / (serial + (total - serial) / 16).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

#: Processors that speed-ups are given for.
MANY = 16


@dataclass
class Share:
    """Processor time of a stage, or of a compiled loop, in seconds; `serial` is that of one thread alone."""

    total: float = 0.0
    serial: float = 0.0

    @property
    def speedup(self) -> float:
        """Speed-up that `MANY` threads allow."""
        return self.total / max(self.serial + (self.total - self.serial) / MANY, 1e-9)


class Meter:
    """Sums up processor time by stage and by compiled loop."""

    def __init__(self) -> None:
        self.stages: dict[str, Share] = {}
        self.kernels: dict[str, Share] = {}
        self._begin = self._now()
        self._inside, self._serial_inside = 0.0, 0.0

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.thread_time(), time.process_time()

    def kernel(self, name: str, call: Callable[[], Any]) -> Any:
        """Call a kernel and count its time, unless a thread of a pool calls it."""
        if threading.current_thread() is not threading.main_thread():
            return call()
        main, process = self._now()
        try:
            return call()
        finally:
            own, total = (now - then for now, then in zip(self._now(), (main, process), strict=True))
            serial = max(2 * own - total, 0.0)
            self._inside += own
            self._serial_inside += serial
            share = self.kernels.setdefault(name, Share())
            share.total, share.serial = share.total + total, share.serial + serial

    def end_stage(self, name: str) -> None:
        """Count the time since the last stage as that of a stage."""
        main, process = self._now()
        outside = main - self._begin[0] - self._inside
        share = self.stages.setdefault(name, Share())
        share.total += process - self._begin[1]
        share.serial += outside + self._serial_inside
        self._begin = main, process
        self._inside = self._serial_inside = 0.0


def bake(arguments: list[str]) -> None:
    """Bake in this process and print what its stages and compiled loops took, as JSON."""
    meter = Meter()
    from sparklod_cli.bake.built_tree import BuiltTree
    from sparklod_cli.cli import main
    from sparklod_cli.system.jit import Kernel

    called, ended = Kernel.__call__, BuiltTree.end

    def call(kernel: Kernel, *values: Any) -> Any:
        module = kernel.py_func.__module__.rpartition(".")[2]
        return meter.kernel(f"{module}.{kernel.py_func.__name__}", lambda: called(kernel, *values))

    def end(tree: BuiltTree, stage: str) -> None:
        meter.end_stage(stage)
        ended(tree, stage)

    def begin(tree: BuiltTree, **values: Any) -> None:
        meter.end_stage("start")
        prepared(tree, **values)

    prepared = BuiltTree.__init__
    Kernel.__call__, BuiltTree.end, BuiltTree.__init__ = call, end, begin  # type: ignore[method-assign,assignment]
    sys.argv = ["sparklod", *arguments]
    try:
        main()
    except SystemExit as stop:
        if stop.code:
            raise
    found = {"stages": meter.stages, "kernels": meter.kernels}
    print(json.dumps({part: {name: asdict(share) for name, share in rows.items()} for part, rows in found.items()}))


def measured(scene: Path, method: str) -> dict[str, dict[str, Share]]:
    """Return the shares of the stages and of the compiled loops of a bake to RAD."""
    with tempfile.TemporaryDirectory() as folder:
        options = ["build-lod", str(scene), "--method", method, "--threads", "2", "-o", f"{folder}/out.rad", "--quiet"]
        command = [sys.executable, __file__, "--child", *options]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    found = json.loads(done.stdout.splitlines()[-1])
    return {part: {name: Share(**share) for name, share in rows.items()} for part, rows in found.items()}


def row(name: str, share: Share) -> str:
    """Return a row of the table."""
    return f"| {name} | {share.total:.2f} | {share.serial:.2f} | {share.speedup:.1f} |"


def main() -> None:
    """Print a table for each builder."""
    if sys.argv[1:2] == ["--child"]:
        bake(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="a splat file")
    parser.add_argument("--methods", nargs="+", default=["quick", "quality"], help="builders (default: both)")
    parser.add_argument("--kernels", type=int, default=0, help="compiled loops with the longest serial parts to list")
    arguments = parser.parse_args()
    subprocess.run([sys.executable, "-m", "sparklod_cli", "warmup", "--quiet"], check=True)
    for method in arguments.methods:
        found = measured(arguments.scene, method)
        stages = found["stages"]
        whole = Share(sum(share.total for share in stages.values()), sum(share.serial for share in stages.values()))
        print(f"\n{method}\n\n| stage | processor s | serial s | at {MANY} |\n|---|---|---|---|")
        for name, share in stages.items():
            print(row(name, share))
        print(row("whole process", whole))
        longest = sorted(found["kernels"].items(), key=lambda item: -item[1].serial)[: arguments.kernels]
        for name, share in longest:
            print(row(f"`{name}`", share))


if __name__ == "__main__":
    main()
