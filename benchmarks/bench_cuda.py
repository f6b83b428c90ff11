"""Times an NVIDIA card and the processor, pictures and steps of refining: `python benchmarks/bench_cuda.py --help`.

Prints a Markdown table. Pictures are of splats that lie on the card; a step is one of `--refine`, its cut included.
The first call of each compiles, and is not counted.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
from performance.machine import machine

import sparklod_cli as sparklod
from sparklod_cli.fitting.cameras import Place, placed
from sparklod_cli.fitting.fit import raster_for
from sparklod_cli.fitting.nodes import FittedNodes
from sparklod_cli.fitting.optimiser import RATES, Optimiser
from sparklod_cli.fitting.pictures import pictures
from sparklod_cli.render.cuda.card import find_card
from sparklod_cli.render.cuda.rasterizer import CardSplats, CardView, draw_on_card
from sparklod_cli.render.rasterizer import draw

#: Share of the leaves of the cut that a step draws.
SHARE = 0.1


def milliseconds(work: Callable[[], object], repeat: int) -> float:
    """Return the median of some runs after the first."""
    times = []
    for _ in range(repeat + 1):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[1:])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="any file that sparklod reads, without a tree")
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 1080), help="of pictures (default 1920 1080)")
    parser.add_argument("--repeat", type=int, default=20, help="runs, of which the median counts")
    parser.add_argument("--steps", type=int, default=2400, help="of --refine, for its gains; 0 for none")
    arguments = parser.parse_args()
    card = find_card()
    scene = sparklod.read(arguments.scene)
    tree = sparklod.build_lod(scene, method="quality", growth=1.4)
    nodes = FittedNodes(tree.splats, tree.tree, raster_for(Place.of(tree.splats.center[tree.tree.is_leaf])), 2)
    cameras = placed(Place.of(scene.splats.center), np.random.SeedSequence(0))
    picture = next(pictures(cameras, nodes))
    large = sparklod.Camera.look_at(
        picture.camera.position.tolist(), nodes.old.center.mean(axis=0).tolist(), size=tuple(arguments.size)
    )
    rows = [("picture of full detail", *_pictures(nodes, large, arguments.repeat))]
    rows += [("step of refining", *_steps(nodes, picture, arguments.repeat))]
    print(f"{card}; {machine()}; {len(scene.splats):,} splats\n\n| | card, ms | processor, ms |\n|---|---|---|")
    for name, on_card, on_processor in rows:
        print(f"| {name} | {on_card:.2f} | {on_processor:.2f} |")
    for device in ("cuda", "cpu") if arguments.steps else ():
        start = time.perf_counter()
        _, report = sparklod.refine(tree, steps=arguments.steps, device=device)
        gains = (f"{report.psnr_after[share] - before:+.2f}" for share, before in report.psnr_before.items())
        print(f"\n{device}: {report.steps:,} steps, {time.perf_counter() - start:.1f} s, {' '.join(gains)} dB")


def _pictures(nodes: FittedNodes, camera: sparklod.Camera, repeat: int) -> tuple[float, float]:
    """Return milliseconds of a picture of all leaves on the card and on the processor."""
    from numba import cuda

    splats, view = CardSplats.of(*nodes.columns), CardView.of(camera, nodes.raster)
    index = cuda.to_device(nodes.leaves.astype(np.int32))

    def on_card() -> None:
        draw_on_card(splats, index, view)
        cuda.synchronize()

    def on_processor() -> None:
        draw(nodes.visible(nodes.leaves, camera)[1], camera, nodes.raster)

    return milliseconds(on_card, repeat), milliseconds(on_processor, repeat)


def _steps(nodes: FittedNodes, picture: object, repeat: int) -> tuple[float, float]:
    """Return milliseconds of a step on the card and on the processor."""
    from sparklod_cli.fitting.cuda.optimiser import CardOptimiser

    found = []
    for optimiser in (CardOptimiser(nodes), Optimiser(nodes)):
        step = optimiser.step
        found.append(milliseconds(lambda step=step: step(picture, nodes.cut(picture.camera, SHARE), RATES), repeat))
    return found[0], found[1]


if __name__ == "__main__":
    main()
