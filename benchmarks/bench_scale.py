"""Measures baking over the size of scenes, in memory and out of core: `python benchmarks/bench_scale.py --help`.

Scenes are tiled from a real one. Each bake runs in a process of its own, those out of core with a limit on the memory
that it may ask for (RLIMIT_DATA). Results are added to a JSON file run by run; a run that it has is not repeated.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from performance.machine import machine
from scale_scenes import bytes_of, write_tiled
from scenes import load

from sparklod_cli import Splats
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.system.units import parse_size

HERE = Path(__file__).resolve().parent

#: Ways of baking, by their options: in memory, out of core in one process, and with so many workers of a local Dask
#: cluster, which share the threads. Those of one thread tell what tasks cost, for the model of more machines.
WAYS = {
    "memory": {"threads": 2},
    "scratch": {"threads": 2},
    "scratch-1": {"threads": 1},
    "dask-1": {"threads": 2, "workers": 1},
    "dask-2": {"threads": 2, "workers": 2},
}

#: Commands that look at what was baked out of core, and their options.
LOOKS = {
    "inspect": ["--check", "--json"],
    "traverse": ["--orbit", "8", "--budget", "1M", "--json"],
    "render": ["--budget", "1M", "--overwrite", "--quiet", "-o", "picture.png"],
}

#: Seconds between looks at the memory of processes and the size of the scratch folder.
PERIOD = 0.25


class Watch:
    """Looks at a process and its children, and at a folder, as long as they are there.

    Attributes:
        peaks: the most memory of each process, bytes, by its id.
        scratch: the largest size of the folder, bytes.
    """

    def __init__(self, pid: int, folder: Path) -> None:
        self.peaks: dict[int, int] = {}
        self.scratch = 0
        self._pid, self._folder = pid, folder
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Stops looking."""
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._done.wait(PERIOD):
            for pid in self._family(self._pid):
                with contextlib.suppress(OSError, IndexError):
                    line = Path(f"/proc/{pid}/status").read_text().partition("VmHWM:")[2]
                    self.peaks[pid] = 1024 * int(line.split()[0])
            self.scratch = max(self.scratch, size_of(self._folder))

    def _family(self, pid: int) -> Iterator[int]:
        yield pid
        with contextlib.suppress(OSError):
            for thread in Path(f"/proc/{pid}/task").iterdir():
                for child in (thread / "children").read_text().split():
                    yield from self._family(int(child))


def size_of(folder: Path) -> int:
    """Bytes of all files in a folder; those that vanish meanwhile do not count."""
    total = 0
    for inside, _, files in os.walk(folder):  # which passes over folders that vanish
        for name in files:
            with contextlib.suppress(OSError):
                total += Path(inside, name).stat().st_size
    return total


def bake(scene: Path, folder: Path, method: str, way: str, limit: int, hours: float) -> dict[str, Any]:
    """Bakes a scene and returns what that took; "error" says why it failed."""
    scratch, output, settings = folder / "scratch", folder / "out.rad", WAYS[way]
    scratch.mkdir(exist_ok=True)
    options = ["build-lod", str(scene), "-o", str(output), "--method", method, "--overwrite", "--json"]
    options += [f"--{name}={value}" for name, value in settings.items()]
    if way != "memory":
        options += ["--memory", f"{limit}B", "--scratch-dir", str(scratch)]
    command = [sys.executable, str(HERE / "scale_child.py"), str(0 if way == "memory" else limit), *options]
    start = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        watch = Watch(child.pid, scratch)
        try:
            out, errors = child.communicate(timeout=3600 * hours)
        except subprocess.TimeoutExpired:
            child.kill()
            out, errors = "", f"it took more than {hours:g} hours"
        watch.end()
    wall = time.perf_counter() - start
    result: dict[str, Any] = {"wall": round(wall, 2), "limit": 0 if way == "memory" else limit}
    lines = [line for line in out.splitlines() if line.startswith("{")]
    if child.returncode or len(lines) < 2 or not output.exists():
        result["error"] = errors.strip().splitlines()[-1:] or [f"exit status {child.returncode}"]
    else:
        report, figures = map(json.loads, lines[-2:])
        result |= figures | {"report": report, "bytes": output.stat().st_size}
        result["peaks"] = sorted(watch.peaks.values(), reverse=True)
        result["scratch"] = watch.scratch
        if way == "scratch":
            result["looks"] = {name: look(output, name) for name in LOOKS}
    shutil.rmtree(scratch)
    output.unlink(missing_ok=True)
    return result


def look(tree: Path, command: str) -> dict[str, Any]:
    """What a command on a tree took; only its nodes that are read take memory, though it asks for room for all."""
    arguments = [sys.executable, str(HERE / "scale_child.py"), "0", command, str(tree), *LOOKS[command]]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False, cwd=tree.parent)
    if done.returncode:
        return {"error": done.stderr.strip().splitlines()[-1:]}
    figures = json.loads(done.stdout.splitlines()[-1])
    return {name: figures[name] for name in ("code", "seconds", "peak", "read")}


def scenes_of(arguments: argparse.Namespace, source: Splats) -> Iterator[tuple[str, Path]]:
    """Writes one scene after the other, and removes each when it is no longer needed; their keys, such as "10M sh0"."""
    for degree in arguments.sh:
        for millions in arguments.millions:
            count = round(1e6 * millions)
            path = arguments.folder / f"tiled-{millions:g}M-sh{degree}.ply"
            if not path.exists() or path.stat().st_size != bytes_of(count, degree):
                free, needed = shutil.disk_usage(arguments.folder).free, 4 * bytes_of(count, degree)
                if free < needed:
                    print(f"{path.name}: skipped, {needed >> 30} GB of disk are needed", file=sys.stderr)
                    continue
                write_tiled(path, source.with_max_sh(degree), count)
            yield f"{millions:g}M sh{degree}", path
            if not arguments.keep:
                path.unlink()


def main() -> None:
    """Runs what the file of results lacks, and prints a line for each run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, help="splat file that scenes are tiled from, with SH of degree 2 or more")
    parser.add_argument("--folder", type=Path, required=True, help="where scenes, scratch and outputs go")
    parser.add_argument("--results", type=Path, required=True, help="JSON file that results are added to")
    parser.add_argument("--millions", type=float, nargs="+", default=[1, 3, 10, 30], help="splats of the scenes")
    parser.add_argument("--sh", type=int, nargs="+", choices=range(4), default=[0, 2], help="SH degrees of the scenes")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=["memory", "scratch"])
    parser.add_argument("--limit", default="4G", help="memory that a bake out of core may ask for (default: 4G)")
    parser.add_argument("--memory-up-to", type=float, default=10, help="millions of splats that are baked in memory")
    parser.add_argument("--hours", type=float, default=3, help="the longest that a bake may take")
    parser.add_argument("--keep", action="store_true", help="keep the scenes")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    limit = parse_size(arguments.limit)
    results = json.loads(arguments.results.read_text()) if arguments.results.exists() else {"runs": {}}
    results["machine"] = machine()
    subprocess.run([sys.executable, "-m", "sparklod_cli", "warmup", "--quiet"], check=True)
    for key, path in scenes_of(arguments, load(arguments.source)):
        for method in arguments.methods:
            for way in arguments.ways:
                name = f"{key} {method} {way}"
                if name in results["runs"] and "error" not in results["runs"][name]:
                    continue
                if way == "memory" and float(key.partition("M")[0]) > arguments.memory_up_to:
                    continue
                found = bake(path, arguments.folder, method, way, limit, arguments.hours)
                results["runs"][name] = found
                arguments.results.write_text(json.dumps(results, indent=1))
                told = (
                    found.get("error") or f"peak {found['peaks'][0] / 1e9:.2f} GB, scratch {found['scratch'] / 1e9:.1f}"
                )
                print(f"{name}: {found['wall']:.1f} s, {told}", flush=True)


if __name__ == "__main__":
    main()
