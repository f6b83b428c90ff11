"""Measures the goals of docs/gpu.md on an NVIDIA card and the processor: `python benchmarks/bench_cuda.py --help`.

Prints a Markdown table. Scenes of other sizes than the given one are parts of it, or copies of its splats that are
moved by their own scales and shrunk. Pictures have SH of degree 3, and are of splats that lie on the card. The first
call of each compiles, and is not counted. `--scale` makes everything smaller, to try this in numba's simulator:

    NUMBA_ENABLE_CUDASIM=1 python benchmarks/bench_cuda.py fixtures/demo.ply --scale 1e-4 --repeat 1
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numba import cuda
from performance.machine import machine

import sparklod_cli as sparklod
from sparklod_cli.fitting import pictures as training
from sparklod_cli.fitting.cuda.card_optimiser import CardOptimiser
from sparklod_cli.fitting.fit import AHEAD, MOST_SHARE, RATES, raster_for
from sparklod_cli.fitting.pictures import TRAINING, FittedNodes, FullDetailPicture, Optimiser, Place, pictures, placed
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.render.cuda.card import find_card, to_card
from sparklod_cli.render.cuda.card_rasterizer import CardSplats, CardView, draw_on_card
from sparklod_cli.render.render_settings import RasterSettings

#: Share of the leaves of the cut that a step draws.
SHARE = 0.1

#: Coefficients of SH of degree 3.
DEGREE_3 = 15

#: Fewest splats, steps and pixels along a side with `--scale`.
LEAST_SPLATS, LEAST_STEPS, LEAST_SIDE = 60, 3, 32

#: Steps that the gains of card and processor are compared after.
COMPARED = 2400


@dataclass(frozen=True)
class Bench:
    """What is measured.

    Attributes:
        scene: as read. scale: of numbers of splats, pixels and steps. repeat: calls, of which the median counts.
        threads: of the processor.
    """

    scene: sparklod.Scene
    scale: float
    repeat: int
    threads: int | None

    def splats(self, count: int) -> sparklod.Splats:
        """Return so many splats, times the scale, that look like the scene."""
        count, every = max(LEAST_SPLATS, round(count * self.scale)), self.scene.splats
        rng = np.random.default_rng(0)
        if count <= len(every):
            return every.take(np.sort(rng.choice(len(every), count, replace=False)))
        some = every.take(np.arange(count) % len(every))
        shrunk = some.scale * np.float32(np.sqrt(len(every) / count))  # they lie on surfaces
        moved = some.center + some.scale * rng.normal(size=some.scale.shape).astype(np.float32)
        return dataclasses.replace(some, center=moved, scale=shrunk)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return the size of pictures, its sides times the root of the scale."""
        shrunk = (max(LEAST_SIDE, round(side * self.scale**0.5)) for side in (width, height))
        return next(shrunk), next(shrunk)

    @contextlib.contextmanager
    def training_size(self, width: int, height: int) -> Iterator[None]:
        """Have training cameras of this size, times the root of the scale."""
        before, training.SIZE = training.SIZE, self.size(width, height)
        try:
            yield
        finally:
            training.SIZE = before

    def steps(self, count: int) -> int:
        """Return a number of steps, times the scale."""
        return max(LEAST_STEPS, round(count * self.scale))

    def milliseconds(self, work: Callable[[], object]) -> float:
        """Return the median of some calls after the first."""
        times = []
        for _ in range(self.repeat + 1):
            start = time.perf_counter()
            work()
            times.append(1e3 * (time.perf_counter() - start))
        return statistics.median(times[1:])

    def nodes(self, count: int) -> tuple[FittedNodes, FullDetailPicture]:
        """Return the nodes of a tree of so many splats, and a picture of full detail."""
        tree = self.tree(count)
        place = Place.of(tree.splats.center[tree.tree.is_leaf])
        nodes = FittedNodes(tree.splats, tree.tree, raster_for(place), self.threads or 1)
        return nodes, next(pictures(placed(place, np.random.SeedSequence(0)), nodes))

    def tree(self, count: int) -> sparklod.Tree:
        """Return a tree of so many splats."""
        scene = dataclasses.replace(self.scene, splats=self.splats(count))
        return sparklod.build_lod(scene, method="quality", growth=1.4, threads=self.threads)

    def picture(self) -> tuple[str, str]:
        """1 million splats at 1920 x 1080."""
        splats, raster = self.splats(1_000_000), RasterSettings()
        splats = dataclasses.replace(splats, sh=np.zeros((len(splats), DEGREE_3, 3), np.float32))
        scene = sparklod.Scene(splats)
        camera = sparklod.orbit(scene, count=1, size=self.size(1920, 1080)).cameras[0]
        columns = splats.center, splats.scale, splats.quat_xyzw, lod_opacity(splats.opacity), splats.rgb, splats.sh
        uploaded, view = CardSplats.of(*columns), CardView.of(camera, raster)
        index = to_card(np.arange(len(splats), dtype=np.int32))

        def on_card() -> None:
            draw_on_card(uploaded, index, view)
            cuda.synchronize()

        on_processor = self.milliseconds(lambda: sparklod.render(scene, camera, threads=self.threads))
        return f"{self.milliseconds(on_card):.2f} ms", f"{on_processor:.2f} ms"

    def step(self, count: int) -> tuple[str, str]:
        """Return the time of a step at 960 x 540 whose cut was found ahead."""
        with self.training_size(960, 540):
            nodes, picture = self.nodes(count)
        found, cut = [], nodes.cut(picture.camera, SHARE)
        for optimiser in (CardOptimiser(nodes), Optimiser(nodes)):
            group = self.milliseconds(lambda optimiser=optimiser: _steps(optimiser, picture, cut))
            found.append(f"{group / AHEAD:.2f} ms")
        return found[0], found[1]

    def refine(self) -> tuple[str, str]:
        """`--refine` of 150,000 splats with 20,000 steps."""
        return self._refine("cuda", 20_000)[0], ""

    def gains(self) -> tuple[str, str]:
        """Gains with as many steps on both."""
        found = (self._refine(device, COMPARED) for device in ("cuda", "cpu"))
        return tuple(f"{taken}, {' '.join(f'{gain:+.2f}' for gain in gains)} dB" for taken, gains in found)

    def _refine(self, device: str, steps: int) -> tuple[str, list[float]]:
        tree, start = self.tree(150_000), time.perf_counter()
        with self.training_size(*training.SIZE):
            _, report = sparklod.refine(tree, steps=self.steps(steps), device=device, threads=self.threads)
        gains = [report.psnr_after[share] - before for share, before in report.psnr_before.items()]
        return f"{time.perf_counter() - start:.1f} s, {report.steps:,} steps", gains

    def memory(self) -> tuple[str, str]:
        """Memory of `--refine` of 5 million splats: of its largest cut, and of all pictures."""
        with self.training_size(*training.SIZE):
            nodes, picture = self.nodes(5_000_000)
        free, _ = cuda.current_context().get_memory_info()
        optimiser = CardOptimiser(nodes)
        optimiser.step(picture, nodes.cut(picture.camera, MOST_SHARE), RATES)
        used = free - cuda.current_context().get_memory_info()[0] + TRAINING * picture.full.nbytes
        return f"{used / 1e9:.1f} GB", ""


def _steps(optimiser: Optimiser, picture: FullDetailPicture, cut: np.ndarray) -> None:
    """Take steps until nodes are placed."""
    for _ in range(AHEAD):
        optimiser.step(picture, cut, RATES)
    optimiser.place()


def rows(bench: Bench) -> Iterator[tuple[str, str, Callable[[], tuple[str, str]]]]:
    """Yield each goal, its figure, and what measures it."""
    yield "1 million splats at 1920 x 1080, once uploaded", "5 ms", bench.picture
    yield "a step of refining, 20,000 splats at 960 x 540", "2 ms", lambda: bench.step(20_000)
    yield "a step of refining, 200,000 splats", "6 ms", lambda: bench.step(200_000)
    yield "`--refine` of 150,000 splats with 20,000 steps", "60 s", bench.refine
    yield f"its gains with {COMPARED:,} steps", "within 0.1 dB", bench.gains
    yield "`--refine` of 5 million splats", "within 16 GB", bench.memory


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="any file that sparklod reads, without a tree")
    parser.add_argument("--scale", type=float, default=1.0, help="of numbers of splats, pixels and steps (default 1)")
    parser.add_argument("--repeat", type=int, default=20, help="calls, of which the median counts (default 20)")
    parser.add_argument("--threads", type=int, help="of the processor (default all)")
    arguments = parser.parse_args()
    bench = Bench(sparklod.read(arguments.scene), arguments.scale, arguments.repeat, arguments.threads)
    print(f"{find_card()}; {machine()}; sizes times {bench.scale:g}\n")
    print("| goal | figure | card | processor |\n| --- | --- | --- | --- |")
    for name, goal, measure in rows(bench):
        print(f"| {name} | {goal} | {' | '.join(measure())} |", flush=True)


if __name__ == "__main__":
    main()
