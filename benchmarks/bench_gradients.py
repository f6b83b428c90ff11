"""Measures pictures and their gradients on one thread: `python benchmarks/bench_gradients.py --help`.

Times are those of the processor, which other work on the machine changes less than those of the clock.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial

import numpy as np
from bench_render import ahead, scattered
from performance.machine import machine
from performance.rows import Row, Table, figure, label, ratio

from sparklod_cli.render import gradients
from sparklod_cli.render.render_settings import RasterSettings
from sparklod_cli.system.threads import on_threads

TABLE = Table(
    columns=(
        label("splats"),
        figure("picture_cpu_s", "picture ms", 1, per=1e-3),
        figure("gradients_cpu_s", "gradients ms", 1, per=1e-3, spread=True),
        ratio("gradients_cpu_s", "picture_cpu_s", "ratio"),
    ),
    key=("splats",),
    judged=("picture_cpu_s", "gradients_cpu_s"),
)

#: Width and height in pixels, and numbers of splats.
SIZE, SPLATS = (480, 270), (5_000, 20_000, 100_000)


def seconds_of(work: Callable[[], object], runs: int) -> list[float]:
    """Processor time of one thread, after a first run."""
    work()
    times = []
    for _ in range(runs):
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return times


def rows(counts: Iterable[int], size: tuple[int, int], runs: int) -> Iterator[Row]:
    """A row for each number of splats."""
    width, height = size
    camera = ahead(size)
    by_image = np.random.default_rng(0).normal(size=(height, width, 4)).astype(np.float32)
    for count in counts:
        splats = scattered(count, camera)
        drawing = gradients.draw(splats, camera, RasterSettings())
        forward = seconds_of(partial(gradients.draw, splats, camera, RasterSettings()), runs)
        backward = seconds_of(partial(drawing.gradients, by_image), runs)
        yield Row({"splats": count}, {"picture_cpu_s": forward, "gradients_cpu_s": backward})


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splats", type=int, nargs="*", default=SPLATS, help="numbers of splats")
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, help="width and height in pixels")
    parser.add_argument("--runs", type=int, default=15, help="number of runs after the first; medians are printed")
    arguments = parser.parse_args()
    width, height = arguments.size
    print(f"Machine: {machine()}. {width} x {height} pixels, one thread, medians of {arguments.runs} runs.\n")
    with on_threads(1):
        TABLE.show(rows(arguments.splats, (width, height), arguments.runs))


if __name__ == "__main__":
    main()
