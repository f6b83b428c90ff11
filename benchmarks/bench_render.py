"""Measures drawing with the numba backend: `python benchmarks/bench_render.py --help`."""

from __future__ import annotations

import argparse
import math
import statistics
import time

import numpy as np
from bench_build import machine

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.render.rasterizer import draw
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.render.shading import ShadedSplats
from sparklod_cli.support import jit
from sparklod_cli.support.parallel import processors


def scattered(count: int, camera: Camera) -> ShadedSplats:
    """Scatters round splats over a picture, of 1.5 to 2.5 pixels of standard deviation and opacities of 0.1 to 1."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(2, 10, count)
    focal = camera.focal[0]
    x = rng.uniform(-0.5, 0.5, count) * camera.width / focal * depth
    y = rng.uniform(-0.5, 0.5, count) * camera.height / focal * depth
    size = rng.uniform(1.5, 2.5, count) * depth / focal
    return ShadedSplats(
        center=np.stack([x, y, -depth], axis=1).astype(np.float32),
        scale=np.repeat(size[:, None], 3, axis=1).astype(np.float32),
        quat_xyzw=np.tile(np.float32([0, 0, 0, 1]), (count, 1)),
        lod_opacity=rng.uniform(0.1, 1, count).astype(np.float32),
        rgb=rng.uniform(0, 1, (count, 3)).astype(np.float32),
    )


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--splats", type=int, nargs="*", default=[100_000, 500_000, 1_500_000], help="numbers of splats"
    )
    parser.add_argument("--size", type=int, nargs=2, default=[1280, 720], help="width and height in pixels")
    parser.add_argument("--runs", type=int, default=15, help="number of runs after the first; medians are printed")
    arguments = parser.parse_args()
    jit.use_threads(processors())
    width, height = arguments.size
    focal = height / (2 * math.tan(math.radians(30)))
    camera = Camera(np.eye(4), width, height, (focal, focal), (width / 2, height / 2))
    print(f"Machine: {machine()}. {width} x {height} pixels, medians of {arguments.runs} runs.\n")
    print("| splats | ms (min to max) | million splats/s |\n|---|---|---|")
    for count in arguments.splats:
        splats = scattered(count, camera)
        seconds = []
        for _ in range(arguments.runs + 1):
            start = time.perf_counter()
            draw(splats, camera, RasterSettings())
            seconds.append(time.perf_counter() - start)
        median = statistics.median(seconds[1:])
        spread = f"{1e3 * min(seconds[1:]):.0f} to {1e3 * max(seconds[1:]):.0f}"
        print(f"| {count:,} | {1e3 * median:.0f} ({spread}) | {count / median / 1e6:.1f} |", flush=True)


if __name__ == "__main__":
    main()
