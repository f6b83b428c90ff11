"""Measures drawing with the numba backend: `python benchmarks/bench_render.py --help`."""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from fidelity_views import cameras_of
from performance.machine import machine
from performance.process import SPARKLOD, in_turn, run, runs_of
from performance.rows import Row, Table, figure, label, ratio
from scenes import load

import sparklod_cli as sparklod
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.scene import Scene
from sparklod_cli.render.rasterizer import ShadedSplats, draw, shade
from sparklod_cli.render.render_settings import RasterSettings

#: Width and height in pixels, and numbers of splats.
SIZE, SPLATS = (1280, 720), (100_000, 500_000, 1_500_000)

#: Nodes of the cuts that are drawn of a scene besides full detail.
BUDGET = 50_000

SCATTERED = Table(
    columns=(
        label("splats"),
        figure("draw_s", "ms", 1, per=1e-3, spread=True),
        ratio("splats", "draw_s", "million splats/s", per=1e6),
    ),
    key=("splats",),
    judged=("draw_s",),
)
VIEWS = Table(
    columns=(
        *(label("scene"), label("drawn"), label("splats"), label("SH")),
        figure("shade_s", "shading ms", 1, per=1e-3),
        figure("draw_s", "drawing ms", 1, per=1e-3, spread=True),
        figure("slowest_s", "slowest view ms", 1, per=1e-3),
        ratio("splats", "draw_s", "million splats/s", per=1e6),
    ),
    key=("scene", "drawn"),
    judged=("shade_s", "draw_s", "slowest_s"),
)
COMMAND = Table(
    columns=(
        *(label("command"), label("scene")),
        figure("wall_s", "s", 2, spread=True),
        figure("cpu_s", "processors' s", 2),
        figure("peak_bytes", "peak MB", 0, per=1e6),
    ),
    key=("command", "scene"),
    judged=("wall_s", "cpu_s", "peak_bytes"),
)


def ahead(size: tuple[int, int]) -> Camera:
    """A camera at the origin, 60 degrees from the bottom to the top, that looks along -z."""
    width, height = size
    focal = height / (2 * math.tan(math.radians(30)))
    return Camera(np.eye(4), width, height, (focal, focal), (width / 2, height / 2))


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


def scattered_rows(counts: Iterable[int], size: tuple[int, int], runs: int) -> Iterator[Row]:
    """A row for each number of scattered splats, from shaded splats to floats, on all processors."""
    camera = ahead(size)
    for count in counts:
        splats = scattered(count, camera)
        yield Row({"splats": count}, {"draw_s": [_drawing(splats, camera) for _ in range(runs + 1)][1:]})


def view_rows(paths: Iterable[Path], size: tuple[int, int], runs: int, budget: int = BUDGET) -> Iterator[Row]:
    """Real scenes from the twelve cameras around them: full detail, and cuts of their quality trees.

    A run is the mean of all views; the slowest view of each run stands beside.
    """
    for path in paths:
        scene = Scene(load(path))
        cameras = cameras_of("around", scene, size)
        degree = scene.splats.sh_degree
        labels = {"scene": path.name, "drawn": "full detail", "splats": len(scene), "SH": degree}
        yield Row(labels, _views([scene.splats] * len(cameras), cameras, runs))
        if budget < len(scene):
            tree = sparklod.build_lod(scene, method="quality")
            cuts = [sparklod.cut(tree, camera, budget=budget) for camera in cameras]
            drawn = [cut.splats for cut in cuts]
            mean = round(sum(map(len, drawn)) / len(drawn))
            labels = {"scene": path.name, "drawn": f"cuts of {budget:,}", "splats": mean, "SH": degree}
            yield Row(labels, _views(drawn, cameras, runs))


def _views(splats: Sequence[sparklod.Splats], cameras: Sequence[Camera], runs: int) -> dict[str, list[float]]:
    """Runs of all views of some splats, one after another."""
    figures: dict[str, list[float]] = {"shade_s": [], "draw_s": [], "slowest_s": []}
    for turn in range(runs + 1):
        shading, drawing = [], []
        for each, camera in zip(splats, cameras, strict=True):
            start = time.perf_counter()
            shaded = shade([(each, np.eye(4))], camera)
            shading.append(time.perf_counter() - start)
            drawing.append(_drawing(shaded, camera))
        if turn:
            figures["shade_s"].append(sum(shading) / len(cameras))
            figures["draw_s"].append(sum(drawing) / len(cameras))
            figures["slowest_s"].append(max(drawing))
    return figures


def _drawing(splats: ShadedSplats, camera: Camera) -> float:
    start = time.perf_counter()
    draw(splats, camera, RasterSettings())
    return time.perf_counter() - start


def command_rows(paths: Iterable[Path], size: tuple[int, int], runs: int) -> Iterator[Row]:
    """Whole commands: a view of a tree, and an orbit of 24 frames as an animation."""
    with tempfile.TemporaryDirectory() as folder:
        for path in paths:
            tree = Path(folder, f"{path.stem}-lod.spz")
            run([*SPARKLOD, "build-lod", path, "-o", tree, "-q"])
            line = [*SPARKLOD, "render", tree, "--size", f"{size[0]}x{size[1]}", "--overwrite", "-q"]
            small = [*SPARKLOD, "render", tree, "--size", "480x270", "--overwrite", "-q", "--orbit", "24"]
            commands = {
                "render, one view": [*line, "-o", Path(folder, "view.png")],
                "render --orbit 24, GIF": [*small, "-o", Path(folder, "orbit.gif")],
            }
            found = in_turn(runs, [lambda command=command: run(command) for command in commands.values()])
            for name, took in zip(commands, found, strict=True):
                yield Row({"command": name, "scene": tree.name}, runs_of(took))


def main() -> None:
    """Prints Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", type=Path, help="splat files, drawn from twelve cameras around them")
    parser.add_argument("--splats", type=int, nargs="*", default=SPLATS, help="numbers of scattered splats")
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, help="width and height in pixels")
    parser.add_argument("--runs", type=int, default=15, help="number of runs after the first; medians are printed")
    arguments = parser.parse_args()
    size = (arguments.size[0], arguments.size[1])
    print(f"Machine: {machine()}. {size[0]} x {size[1]} pixels, medians of {arguments.runs} runs.\n")
    SCATTERED.show(scattered_rows(arguments.splats, size, arguments.runs))
    if arguments.scenes:
        print()
        VIEWS.show(view_rows(arguments.scenes, size, arguments.runs))
        print()
        COMMAND.show(command_rows(arguments.scenes, size, arguments.runs))


if __name__ == "__main__":
    main()
