"""Measures the backends of `render` against numba in one run: `python benchmarks/bench_backends.py --help`."""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
from performance.machine import machine
from scenes import load

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.cameras.framing import framing
from sparklod_cli.images.metrics import psnr
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import Image, ShadedSplats, shade
from sparklod_cli.render.render_settings import RasterSettings
from sparklod_cli.render.renderer import MODULES
from sparklod_cli.system.errors import SparklodError

HEADINGS = (
    "scene",
    "splats",
    "camera",
    "pixels",
    "backend",
    "PSNR dB",
    "greatest difference",
    "ms a frame",
    "of numba's",
)

#: The backend that the others are compared with.
REFERENCE = "numba"

#: Distance of the cameras from the scene's centre, in radii of the scene: it fits the image, fills it, or surrounds it.
CAMERAS = {"far": 2.4, "near": 0.8, "inside": 0.1}

FOV_Y, FPS, TURN_PER_SECOND = math.radians(60), 30, math.radians(12)

Draw = Callable[[ShadedSplats, Camera, RasterSettings], Image]


def draw_function(spec: str) -> Draw:
    """Returns the function that draws, of a backend with options: `osmesa:precision=half,sorting=counting16`."""
    name, _, rest = spec.partition(":")
    options: dict[str, str | float] = {}
    for option in filter(None, rest.split(",")):
        key, _, value = option.partition("=")
        try:
            options[key] = float(value)
        except ValueError:
            options[key] = value
    return partial(import_module(MODULES[name], "sparklod_cli.render").draw, **options)


def orbit(splats: Splats, distance: float, size: tuple[int, int], frames: int) -> Iterator[Camera]:
    """Yields the cameras of a part of an orbit around a scene, slightly above it, as for a video."""
    middle, radius = framing(splats.center)
    width, height = size
    focal = height / 2 / math.tan(FOV_Y / 2)
    for frame in range(frames):
        turn = frame / FPS * TURN_PER_SECOND
        away = np.array([math.sin(turn), 0.3, math.cos(turn)])
        pose = look_at(middle + distance * radius * away, middle, (0, 1, 0))
        yield Camera(pose, width, height, (focal, focal), (width / 2, height / 2))


def measure(
    spec: str, splats: Splats, cameras: list[Camera], references: list[Image]
) -> tuple[list[Image], float, float, float]:
    """Draws a path; returns the pictures, the least PSNR, the largest difference, and the median time of a frame in s.

    Backends are measured one after the other and not in turns, since the threads of the one before may still spin. The
    first picture is drawn twice, and the first of these times is not counted.

    Args:
        spec: a backend with options.
        splats, cameras: the scene and the path.
        references: pictures to compare with; none for the reference itself.
    """
    draw, seconds, images = draw_function(spec), [], []
    for camera in [cameras[0], *cameras]:
        shaded = shade([(splats, np.eye(4))], camera)
        start = time.perf_counter()
        images.append(draw(shaded, camera, RasterSettings()))
        seconds.append(time.perf_counter() - start)
    images = images[1:]
    pairs = list(zip(images, references or images, strict=True))
    least = min(psnr(image, reference) for image, reference in pairs)
    greatest = max(float(np.abs(image - reference).max()) for image, reference in pairs)
    return images, least, greatest, statistics.median(seconds[1:])


def rows(
    name: str, splats: Splats, specs: list[str], size: tuple[int, int], frames: int, missing: dict[str, str]
) -> Iterator[tuple[str, ...]]:
    """Yields the rows of one scene; puts backends that cannot draw into `missing`, with the reason."""
    for view, distance in CAMERAS.items():
        head = name, f"{len(splats):,}", view, f"{size[0]} x {size[1]}"
        cameras = list(orbit(splats, distance, size, frames))
        references, _, _, base = measure(REFERENCE, splats, cameras, [])
        yield *head, REFERENCE, "", "", f"{1000 * base:.0f}", "1.0"
        for spec in specs:
            if spec in missing:
                continue
            try:
                _, decibels, difference, seconds = measure(spec, splats, cameras, references)
            except SparklodError as error:
                missing[spec] = str(error)
                continue
            agreement = f"{decibels:.1f}", f"{difference:.5f}"
            yield *head, spec, *agreement, f"{1000 * seconds:.0f}", f"{seconds / base:.1f}"


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files")
    default = ["osmesa", "osmesa:precision=half", "osmesa:sorting=counting16", "open3d"]
    parser.add_argument(
        "--backends",
        nargs="+",
        default=default,
        help=f"backends to compare with {REFERENCE}, as osmesa:precision=half",
    )
    parser.add_argument("--size", type=int, nargs=2, default=[1280, 720], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--frames", type=int, default=10, help="frames of each path")
    arguments = parser.parse_args()
    specs = [spec for spec in dict.fromkeys(arguments.backends) if spec != REFERENCE]
    for spec in specs:
        if spec.partition(":")[0] not in MODULES:
            parser.error(f"{spec} is not a backend; choose from {', '.join(MODULES)}")
    print(f"Machine: {machine()}. Paths of {arguments.frames} frames: the least PSNR, the median time.\n")
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    missing: dict[str, str] = {}
    for scene in arguments.scenes:
        for cells in rows(scene.name, load(scene), specs, tuple(arguments.size), arguments.frames, missing):
            print("| " + " | ".join(cells) + " |", flush=True)
    for spec, reason in missing.items():
        print(f"\nSkipped {spec}: {reason}")


if __name__ == "__main__":
    main()
