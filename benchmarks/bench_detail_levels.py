"""How far detail levels are from full detail, beside decimations: `python benchmarks/bench_detail_levels.py --help`."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

from bench_build import machine
from bench_fidelity import Image, cameras_around, difference, head, line

import sparklod_cli as sparklod
from sparklod_cli.lod import quality
from sparklod_cli.lod.detail_levels import make
from sparklod_cli.lod.detail_settings import DetailSettings
from sparklod_cli.model.splats import Splats

#: Percent of the splats, the ways of splat-transform to get there, and the growth of our tree.
SHARES, WAYS, GROWTH = (50, 25, 10, 5), ("decimate", "decimate-adaptive"), 2.0


class FullDetail:
    """Pictures of a scene from the cameras of `bench_fidelity`, and how far others are from them."""

    def __init__(self, splats: Splats) -> None:
        scene = sparklod.Scene(splats)
        self._cameras = cameras_around(scene)
        self._pictures: list[Image] = [sparklod.render(scene, camera) for camera in self._cameras]

    def psnr(self, splats: Splats) -> float:
        """PSNR in dB, mean of cameras and backgrounds."""
        scene, pictures = sparklod.Scene(splats), zip(self._cameras, self._pictures, strict=True)
        return statistics.mean(difference(sparklod.render(scene, camera), full) for camera, full in pictures)


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


def times(folder: Path) -> dict[tuple[str, str, int], float]:
    """Seconds that splat-transform took, by scene, way and percent: the lines of times.txt."""
    file = folder / "times.txt"
    rows = [row.split() for row in file.read_text(encoding="utf-8").splitlines()] if file.is_file() else []
    return {(scene, way, int(share)): float(seconds) for scene, way, share, seconds in rows}


def decimated(folder: Path, name: str) -> Iterator[tuple[str, list[Splats]]]:
    """Each way of splat-transform whose files are all there, and their splats."""
    for way in WAYS:
        files = [folder / f"{name}-{way}-{share}.ply" for share in SHARES]
        if all(file.is_file() for file in files):
            yield way, [sparklod.read(file).splats.with_max_sh(0) for file in files]


def main() -> None:
    """Prints Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files")
    text = "folder of NAME-decimate-50.ply and so on, made by splat-transform, and times.txt: scene, way, percent, s"
    parser.add_argument("--decimated", type=Path, required=True, help=text)
    parser.add_argument("--runs", type=int, default=3, help="runs of our builder; the median is printed")
    arguments = parser.parse_args()
    theirs = times(arguments.decimated)
    print(f"Machine: {machine()}. PSNR in dB, and seconds.\n")
    head(["scene", "levels", *(f"{share} %" for share in SHARES), "s"])
    for path in arguments.scenes:
        splats, levels, seconds = ours(path, arguments.runs)
        full = FullDetail(splats)
        own = [full.psnr(level) for level in levels]
        line([path.stem, "ours", *(f"{psnr:.2f}" for psnr in own), f"{seconds:.1f} for all"])
        best, least = [0.0] * len(SHARES), []
        for way, scenes in decimated(arguments.decimated, path.stem):
            for share, one, level in zip(SHARES, scenes, levels, strict=True):
                if abs(len(one) / len(level) - 1) > 0.01:
                    raise SystemExit(f"{path.stem}: {len(one):,} and {len(level):,} splats at {share} %")
            psnr = [full.psnr(one) for one in scenes]
            took = [theirs[path.stem, way, share] for share in SHARES if (path.stem, way, share) in theirs]
            line([path.stem, f"--{way}", *(f"{one:.2f}" for one in psnr), ", ".join(f"{one:.1f}" for one in took)])
            best = [max(pair) for pair in zip(best, psnr, strict=True)]
            least += took
        if all(best):
            ratio = f"{seconds / min(least):.2f} of the least" if least else ""
            line([path.stem, "ours - the better", *(f"{a - b:+.2f}" for a, b in zip(own, best, strict=True)), ratio])


if __name__ == "__main__":
    main()
