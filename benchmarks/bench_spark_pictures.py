"""Compares pictures with Spark's own in headless Chromium: `python -m benchmarks.bench_spark_pictures --help`.

Run it from the repository's root: it imports the tests' program that drives the browser.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from sparklod_cli.io.reading import read_scene
from sparklod_cli.render.render_settings import SORTS, RasterSettings
from tests.interop.pictures import AROUND, Difference, Page, cameras_around, compare

HEADINGS = (
    "scene",
    "view",
    "splats",
    "covered",
    "PSNR, dB",
    "of what is covered, dB",
    "largest difference of 255",
    "PSNR, unrounded, dB",
    "of Spark's numbers, dB",
    "same cut",
)


def row(scene: str, view: int, found: Difference) -> str:
    """Returns the Markdown row of one view."""
    around, up, away = AROUND[view]
    cells = [
        scene,
        f"{around}°, {up}° up, {away:g} radii",
        f"{found.drawn:,}",
        f"{found.share:.0%}",
        f"{found.psnr:.1f}",
        f"{found.covered:.1f}",
        f"{found.most}",
        f"{found.unrounded:.1f}",
        f"{found.held:.1f}",
        {None: "", True: "yes", False: "**no**"}[found.same_cut],
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+", help="splat files and LoD files")
    parser.add_argument("--budgets", type=int, nargs="*", default=[50_000], help="numbers of nodes to draw of a tree")
    parser.add_argument("--size", default="960x540", help="width and height in pixels")
    parser.add_argument("--views", type=int, default=len(AROUND), help="number of views")
    parser.add_argument("--sort", choices=SORTS, default=SORTS[0], help="order in which splats are blended")
    arguments = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None or "SPARK_DIR" not in os.environ:
        raise SystemExit(
            "needs Chromium, and SPARK_DIR: a folder whose node_modules has Spark, three and playwright-core"
        )
    width, height = map(int, arguments.size.split("x"))
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    least = np.inf
    with tempfile.TemporaryDirectory() as folder:
        page = Page(Path(os.environ["SPARK_DIR"]), chromium, Path(folder))
        for file in arguments.scenes:
            scene = read_scene(file)
            leaves = scene.splats.center[slice(None) if scene.tree is None else scene.tree.is_leaf]
            cameras = cameras_around(leaves, width, height)
            for budget in [0] if scene.tree is None else arguments.budgets:
                name = file.name + (f", {budget:,} nodes" if budget else "")
                pictures = compare(page, file, cameras[: arguments.views], RasterSettings(sort=arguments.sort), budget)
                for view, found in enumerate(pictures):
                    print(row(name, view, found), flush=True)
                    least = min(least, found.psnr)
        page.close()
    print(f"\nThe least PSNR is {least:.1f} dB.")


if __name__ == "__main__":
    main()
