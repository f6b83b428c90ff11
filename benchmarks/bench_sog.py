"""Writes SOG, beside splat-transform in one run: `python benchmarks/bench_sog.py --help`."""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fidelity_report import head, line
from fidelity_views import Image, cameras_of, difference
from numpy.typing import NDArray
from performance.machine import machine
from scenes import load, write_ply

import sparklod_cli as sparklod
from sparklod_cli.model import morton
from sparklod_cli.system.threads import processors

HEADINGS = ("scene", "splats", "SH", "writer", "seconds", "MB", "size", "SH RMSE", "PSNR", "lowest PSNR")

#: Splats whose SH are compared.
SAMPLE = 4000

#: PSNR of pictures that do not differ, dB.
EQUAL = 99.0


def splat_transform(source: Path, target: Path) -> None:
    """Has splat-transform write a SOG without a GPU; its folder is FOREIGN_DIR."""
    tools = Path(os.environ.get("FOREIGN_DIR", ".")) / "node_modules" / ".bin"
    path = {"PATH": f"{tools}{os.pathsep}{os.environ['PATH']}"}
    command = [str(tools / "splat-transform"), "-q", "-w", "-g", "cpu", str(source), str(target)]
    subprocess.run(command, env={**os.environ, **path}, check=True)


def ours(source: Path, target: Path) -> None:
    """Reads the PLY and writes a SOG, as splat-transform does."""
    sparklod.write(target, sparklod.read(source), overwrite=True)


def pictures(scene: sparklod.Scene, cameras: list[sparklod.Camera]) -> list[Image]:
    """A picture for each camera."""
    return [sparklod.render(scene, camera) for camera in cameras]


def sh_error(scene: sparklod.Scene, written: sparklod.Scene) -> float:
    """Root mean square of the error of SH coefficients, of splats at equal steps."""
    if not scene.splats.sh.size:
        return 0.0
    some = written.splats.take(slice(None, None, max(1, len(written) // SAMPLE)))
    partner = np.array([nearest(scene.splats.center, each) for each in some.center])
    return float(np.sqrt(((some.sh - scene.splats.sh[partner]) ** 2).mean()))


def nearest(center: NDArray[np.float32], written: NDArray[np.float32]) -> np.intp:
    """The centre of the source that is nearest to a written one, which was rounded and has another place."""
    return ((center - written) ** 2).sum(axis=1).argmin()


def measure(path: Path, arguments: argparse.Namespace, folder: Path) -> None:
    """Prints a row for each writer."""
    splats = load(path)
    if arguments.splats and arguments.splats < len(splats):
        splats = splats.take(morton.order(splats.center)[: arguments.splats])
    source = folder / "source.ply"
    write_ply(source, splats)
    scene = sparklod.read(source)
    cameras = cameras_of("around", scene)[:: arguments.every]
    full = pictures(scene, cameras)
    ways: dict[str, Callable[[Path, Path], None]] = {"splat-transform": splat_transform, "ours": ours}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(arguments.runs):
        for name, way in ways.items():
            start = time.perf_counter()
            way(source, folder / f"{name}.sog")
            seconds[name].append(time.perf_counter() - start)
    base = (folder / "splat-transform.sog").stat().st_size
    for name in ways:
        file = folder / f"{name}.sog"
        back, size = sparklod.read(file), file.stat().st_size
        pairs = zip(pictures(back, cameras), full, strict=True)
        psnr = [min(difference(image, reference), EQUAL) for image, reference in pairs]
        cells = (path.name, f"{len(scene):,}", str(scene.splats.sh_degree), name)
        found = f"{statistics.median(seconds[name]):.2f}", f"{size / 1e6:.3f}", f"{size / base:.3f}"
        line((*cells, *found, f"{sh_error(scene, back):.5f}", f"{statistics.mean(psnr):.2f}", f"{min(psnr):.2f}"))


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files")
    parser.add_argument("--splats", type=int, default=0, help="keep so many, side by side along the Morton curve")
    parser.add_argument("--runs", type=int, default=3, help="of each writer, in turns; the median counts")
    parser.add_argument("--every", type=int, default=4, help="draw one of so many cameras")
    arguments = parser.parse_args()
    print(f"{machine()}, {processors()} processors\n")
    head(HEADINGS)
    with tempfile.TemporaryDirectory() as folder:
        for path in arguments.scenes:
            measure(path, arguments, Path(folder))


if __name__ == "__main__":
    main()
