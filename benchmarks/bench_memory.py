"""Measures what `bake.estimate` estimates: peaks of memory and of scratch, in bytes a splat.

python benchmarks/bench_memory.py scene.ply --splats 1000000
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from scenes import load, ply_header, ply_rows, tiled

from sparklod_cli.bake import estimate
from sparklod_cli.bake.settings import BakeSettings as Settings
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.sh import COEFFICIENTS

#: Bakes, and prints the peak of resident memory in kB and that of the scratch folder in bytes.
CHILD = """
import json, re, sys, threading, time
from pathlib import Path
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import BakeSettings, Resources
source, target, method, blocks = sys.argv[1:]
target, most, done = Path(target), 0, threading.Event()
scratch = target.with_name("scratch")
def watch():
    global most
    while not done.wait(0.05):
        held = 0
        for path in scratch.rglob("*"):
            try: held += path.stat().st_size if path.is_file() else 0
            except OSError: pass
        most = max(most, held)
threading.Thread(target=watch).start()
resources = Resources(memory=1 << 60, scratch_dir=scratch, block_splats=int(blocks) or None)
try:
    made = bake(Path(source), target, BakeSettings(method=method, suffix=target.suffix), overwrite=True, threads=2,
                resources=resources)
finally:
    done.set()
peak = int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024
print(json.dumps({"peak": peak, "scratch": most, "nodes": made.nodes, "blocks": made.blocks,
                  "seconds": sum(made.seconds.values())}))
"""


def measured(source: Path, target: Path, method: str, block_splats: int) -> dict[str, float]:
    """A bake in a process of its own; in memory where `block_splats` is 0."""
    command = [sys.executable, "-c", CHILD, str(source), str(target), method, str(block_splats)]
    found: dict[str, float] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return found


def main() -> None:
    """Prints a line for each bake."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="a scene with SH, which is tiled")
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--degrees", type=int, nargs="*", default=[0, 2])
    parser.add_argument("--blocks", type=int, nargs="*", default=[0, 1 << 17, 1 << 18])
    parser.add_argument("--suffixes", nargs="*", default=[".spz", ".rad"])
    parser.add_argument("--methods", nargs="*", default=METHODS)
    asked = parser.parse_args()
    splats = tiled(load(asked.scene), asked.splats)
    print("| method | SH | output | blocks | peak MB | estimate MB | B a splat | scratch B a splat | estimate | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for degree in asked.degrees:
            source = Path(folder) / f"sh{degree}.ply"
            with source.open("wb") as file:
                file.write(ply_header(len(splats), COEFFICIENTS[degree]))
                file.write(ply_rows(splats.with_max_sh(degree)))
            for method in asked.methods:
                for suffix in asked.suffixes:
                    for size in asked.blocks:
                        found = measured(source, Path(folder) / f"out{suffix}", method, size)
                        report(found, method, degree, suffix, len(splats), size)


def report(found: dict[str, float], method: str, degree: int, suffix: str, count: int, size: int) -> None:
    """Prints a line."""
    if size:
        guess = estimate.out_of_core_bytes(method, count, degree, size, in_chunks=suffix == ".rad")
    else:
        guess = estimate.in_memory_bytes(Settings(method), count, degree)
    each = (found["peak"] - estimate.PROCESS) / (size or count)
    scratch, of_scratch = found["scratch"] / count, estimate.scratch_bytes(method, count, degree) / count
    print(
        f"| {method} | {degree} | {suffix} | {found['blocks']} | {found['peak'] / 1e6:,.0f} | {guess / 1e6:,.0f} |"
        f" {each:.0f} | {scratch:.0f} | {of_scratch:.0f} | {found['seconds']:.1f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
