"""How far detail levels are from full detail, beside decimations: `python benchmarks/bench_detail_levels.py --help`."""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

from fidelity_report import markdown
from fidelity_trees import SHARES, decimated, seconds_of_decimations
from fidelity_views import FullDetail, cameras_of
from performance.machine import machine

import sparklod_cli as sparklod
from sparklod_cli.lod import quality
from sparklod_cli.lod.detail_levels import make
from sparklod_cli.lod.detail_rule import DetailSettings
from sparklod_cli.model.splats import Splats

#: The growth of our tree.
GROWTH = 2.0


def ours(path: Path, runs: int) -> tuple[Splats, list[Splats], float]:
    """Full detail, its coarser levels, and the median time for all of them, reading included, in seconds."""
    settings, seconds = DetailSettings(tuple(share / 100 for share in SHARES)), []
    for _ in range(runs + 1):
        start = time.perf_counter()
        splats = sparklod.read(path).splats
        made = make(*quality.build(splats, GROWTH), settings)
        seconds.append(time.perf_counter() - start)
    levels = [made.splats.take(made.level(level)).with_max_sh(0) for level in range(1, made.levels)]
    return splats.with_max_sh(0), levels, statistics.median(seconds[1:])  # the first may have to compile


def main() -> None:
    """Prints Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files")
    text = "folder of NAME-decimate-50.ply and so on, made by splat-transform, and times.txt: scene, way, percent, s"
    parser.add_argument("--decimated", type=Path, required=True, help=text)
    parser.add_argument("--runs", type=int, default=3, help="runs of our builder; the median is printed")
    arguments = parser.parse_args()
    theirs = seconds_of_decimations(arguments.decimated)
    print(f"Machine: {machine()}. PSNR in dB, and seconds.\n")
    rows = []
    for path in arguments.scenes:
        splats, levels, seconds = ours(path, arguments.runs)
        scene = sparklod.Scene(splats)
        full = FullDetail(scene, cameras_of("around", scene))
        own = [full.of_scene(sparklod.Scene(level)).psnr for level in levels]
        rows.append([path.stem, "ours", *(f"{psnr:.2f}" for psnr in own), f"{seconds:.1f} for all"])
        best, least = [0.0] * len(SHARES), []
        for way, scenes in decimated(arguments.decimated, path.stem):
            for share, one, level in zip(SHARES, scenes, levels, strict=True):
                if abs(len(one) / len(level) - 1) > 0.01:
                    raise SystemExit(f"{path.stem}: {len(one):,} and {len(level):,} splats at {share} %")
            psnr = [full.of_scene(one).psnr for one in scenes]
            took = [theirs[path.stem, way, share] for share in SHARES if (path.stem, way, share) in theirs]
            rows.append(
                [path.stem, f"--{way}", *(f"{one:.2f}" for one in psnr), ", ".join(f"{one:.1f}" for one in took)]
            )
            best = [max(pair) for pair in zip(best, psnr, strict=True)]
            least += took
        if all(best):
            ratio = f"{seconds / min(least):.2f} of the least" if least else ""
            gains = (f"{a - b:+.2f}" for a, b in zip(own, best, strict=True))
            rows.append([path.stem, "ours - the better", *gains, ratio])
    print(markdown(["scene", "levels", *(f"{share} %" for share in SHARES), "s"], rows))


if __name__ == "__main__":
    main()
