"""The backends that draw splats, beside the reference in one run: `python benchmarks/bench_backends.py --help`."""

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
from bench_build import machine
from scenes import load

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.framing import framing
from sparklod_cli.cameras.pose import look_at
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.backends import BACKENDS
from sparklod_cli.render.rasterizer import Image
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.render.shading import ShadedSplats, shade
from sparklod_cli.support import jit
from sparklod_cli.support.errors import SparklodError
from sparklod_cli.support.parallel import processors

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

#: What others are compared with.
REFERENCE = "numba"

#: How far from the scene's middle the cameras are, in radii of the scene: it fits the image, it fills it, from inside.
CAMERAS = {"far": 2.4, "near": 0.8, "inside": 0.1}

FOV_Y, FPS, TURN_A_SECOND = math.radians(60), 30, math.radians(12)

Draw = Callable[[ShadedSplats, Camera, RasterSettings], Image]


def drawer(spec: str) -> Draw:
    """What draws, by the name of a backend and its options: `osmesa` or `osmesa:precision=half,sorting=counting16`."""
    name, _, rest = spec.partition(":")
    options: dict[str, str | float] = {}
    for option in filter(None, rest.split(",")):
        key, _, value = option.partition("=")
        try:
            options[key] = float(value)
        except ValueError:
            options[key] = value
    backend = BACKENDS[name]
    return partial(import_module(backend.module, "sparklod_cli.render").draw, **options) if options else backend.draw


def path(splats: Splats, distance: float, size: tuple[int, int], frames: int) -> Iterator[Camera]:
    """Cameras around a scene, as a video has them, from one place slightly above it."""
    middle, radius = framing(splats.center)
    width, height = size
    focal = height / 2 / math.tan(FOV_Y / 2)
    for frame in range(frames):
        turn = frame / FPS * TURN_A_SECOND
        away = np.array([math.sin(turn), 0.3, math.cos(turn)])
        pose = look_at(middle + distance * radius * away, middle, (0, 1, 0))
        yield Camera(pose, width, height, (focal, focal), (width / 2, height / 2))


def psnr(image: Image, reference: Image) -> float:
    """In dB, of all four channels, whose greatest is 1."""
    error = float(np.mean((image.astype(np.float64) - reference) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def measure(
    spec: str, splats: Splats, cameras: list[Camera], references: list[Image]
) -> tuple[list[Image], float, float, float]:
    """Pictures of a path, the least PSNR and the greatest difference from others, and the median seconds a frame.

    One backend after the other, not in turns: the threads of the one before may still be spinning. The first picture is
    drawn twice, and the time of the first of the two not counted.
    """
    draw, seconds, images = drawer(spec), [], []
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
    """The rows of one scene. Backends that cannot draw are put among the missing, with the reason."""
    for view, distance in CAMERAS.items():
        head = name, f"{len(splats):,}", view, f"{size[0]} x {size[1]}"
        cameras = list(path(splats, distance, size, frames))
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
        "--backends", nargs="+", default=default, help=f"beside {REFERENCE}; with options: osmesa:precision=half"
    )
    parser.add_argument("--size", type=int, nargs=2, default=[1280, 720], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--frames", type=int, default=10, help="of each path")
    arguments = parser.parse_args()
    specs = [spec for spec in dict.fromkeys(arguments.backends) if spec != REFERENCE]
    for spec in specs:
        if spec.partition(":")[0] not in BACKENDS:
            parser.error(f"there is no backend {spec}, only {', '.join(BACKENDS)}")
    jit.use_threads(processors())
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
