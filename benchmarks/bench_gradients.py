"""Measures pictures and their gradients on one thread: `python benchmarks/bench_gradients.py --help`.

Times are those of the processor, which other work on the machine changes less than those of the clock.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from bench_build import machine
from bench_render import scattered

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.render import gradients
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.support import jit


def milliseconds(work: Callable[[], object], runs: int) -> float:
    """Median time of one thread, after a first run."""
    work()
    times = []
    for _ in range(runs):
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return 1e3 * statistics.median(times)


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splats", type=int, nargs="*", default=[5_000, 20_000, 100_000], help="numbers of splats")
    parser.add_argument("--size", type=int, nargs=2, default=[480, 270], help="width and height in pixels")
    parser.add_argument("--runs", type=int, default=15, help="number of runs after the first; medians are printed")
    arguments = parser.parse_args()
    jit.use_threads(1)
    width, height = arguments.size
    focal = height / (2 * math.tan(math.radians(30)))
    camera = Camera(np.eye(4), width, height, (focal, focal), (width / 2, height / 2))
    by_image = np.random.default_rng(0).normal(size=(height, width, 4)).astype(np.float32)
    print(f"Machine: {machine()}. {width} x {height} pixels, one thread, medians of {arguments.runs} runs.\n")
    print("| splats | picture ms | gradients ms | ratio |\n|---|---|---|---|")
    for count in arguments.splats:
        splats = scattered(count, camera)
        drawing = gradients.draw(splats, camera, RasterSettings())
        forward = milliseconds(partial(gradients.draw, splats, camera, RasterSettings()), arguments.runs)
        backward = milliseconds(partial(drawing.gradients, by_image), arguments.runs)
        print(f"| {count:,} | {forward:.1f} | {backward:.1f} | {backward / forward:.1f} |", flush=True)


if __name__ == "__main__":
    main()
