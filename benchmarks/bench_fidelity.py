"""How far cuts of our trees and of Spark's are from full detail: `python benchmarks/bench_fidelity.py --help`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fidelity_report import WITH_SH, add_outputs, report
from fidelity_trees import METHODS, Source, build
from fidelity_views import CAMERAS, MOVING, OF_PATHS, SIZE, Figures, cameras_of, of_tree, that_see
from fine_structure import fine_structure
from glossy_knot import glossy_knot
from photo_cloud import loose_cloud, photo_cloud
from scenes import write_ply
from thin_scenes import THIN

import sparklod_cli as sparklod

#: What a folder stands for.
REAL_SCENES = ("biker.ply", "playbot.sog", "playbot-125k.ply", "meadow.sog")

#: Scenes that we make.
MADE = {
    "fine-structure": fine_structure,
    "glossy-knot": glossy_knot,
    "photo-cloud": photo_cloud,
    "loose-cloud": loose_cloud,
    **THIN,
}

BUDGETS = "0.5%,1%,2%,5%,10%,25%,50%"


@dataclass(frozen=True)
class Measured:
    """Figures of the tree of one builder.

    Attributes:
        nodes, leaves: numbers of its splats.
        views: by set of cameras and budget.
    """

    nodes: int
    leaves: int
    views: dict[str, dict[str, Figures]]


def sources(path: Path, arguments: argparse.Namespace) -> Iterator[Source]:
    """Yield a scene as it is drawn without spherical harmonics and, with `--sh`, as it is drawn with them."""
    scene = sparklod.read(path)
    selected, _ = sparklod.Selection().apply(scene.splats)
    scene = sparklod.Scene(selected, antialiased=scene.antialiased)
    source = Source(path, scene, False, arguments.growth, arguments.steps, arguments.trees)
    yield source
    if arguments.sh and selected.sh_degree:
        yield dataclasses.replace(source, sh=True)


def measure(source: Source, arguments: argparse.Namespace) -> Iterator[tuple[str, Measured]]:
    """Yield the name and the figures of each builder for one scene."""
    drawn, suffix = source.drawn, WITH_SH * source.sh
    first, half = arguments.cameras[0], (arguments.size[0] // 2, arguments.size[1] // 2)
    sets = {}
    for name in [first] if source.sh else arguments.cameras:
        cameras = cameras_of(name, drawn, arguments.size if name == first else half)
        sets[name] = cameras if name in MOVING else that_see(cameras[:: arguments.every], drawn)
    for method in arguments.methods:
        tree = build(source, method)
        views = {}
        for name, cameras in sets.items():
            budgets = OF_PATHS if name in MOVING else arguments.budgets
            views[name + suffix] = of_tree(tree, drawn, cameras, budgets)
            psnr = ", ".join(f"{figures.psnr:.2f}" for figures in views[name + suffix].values())
            print(f"{source.path.name}: {METHODS[method]}, {name}{suffix}: {psnr} dB", file=sys.stderr, flush=True)
        yield method, Measured(len(tree), int(np.count_nonzero(tree.tree.is_leaf)), views)


def run(arguments: argparse.Namespace, scratch: Path) -> dict[str, Any]:
    """Measure all scenes; the JSON is written after each tree, so that a long run may end early."""
    record: dict[str, Any] = {
        "growth": arguments.growth,
        "steps": arguments.steps,
        "size": arguments.size,
        "every": arguments.every,
        "cameras": arguments.cameras,
        "moving": MOVING,
        "budgets": arguments.budgets,
        "budgets_of_paths": OF_PATHS,
        "scenes": {},
    }
    for path in scenes_of(arguments.scenes, scratch):
        methods = record["scenes"].setdefault(path.name, {})
        for source in sources(path, arguments):
            for method, measured in measure(source, arguments):
                views = methods.get(method, {}).get("views", {})  # those without spherical harmonics
                methods[method] = dataclasses.asdict(measured)
                methods[method]["views"] = views | methods[method]["views"]
                if arguments.json:
                    arguments.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return record


def scenes_of(scenes: list[str], scratch: Path) -> Iterator[Path]:
    """Yield the files of scenes: a folder stands for its real ones, and those of `MADE` are written to `scratch`."""
    for text in scenes:
        if text in MADE:
            path = scratch / f"{text}.ply"
            write_ply(path, MADE[text]())
            yield path
        elif Path(text).is_dir():
            yield from (Path(text, name) for name in REAL_SCENES)
        else:
            yield Path(text)


def size_of(text: str) -> tuple[int, int]:
    """Return width and height of WxH."""
    width, height = map(int, text.split("x"))
    return width, height


def parsed() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    named = f"splat files, a folder with {', '.join(REAL_SCENES)}, or {', '.join(MADE)}, which is made"
    parser.add_argument("scenes", nargs="+", help=named)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="what builds trees")
    parser.add_argument("--budgets", default=BUDGETS, help="shares of the leaves, or counts, between commas")
    parser.add_argument("--growth", type=float, default=1.4, help="of our quality builder")
    parser.add_argument("--steps", type=int, help="of refining; by default what suits each tree")
    sets = "sets of cameras; the first one is that of most tables, and orbit and dolly are for popping"
    parser.add_argument("--cameras", nargs="+", choices=CAMERAS, default=["around"], help=sets)
    parser.add_argument("--popping", action="store_true", help="add the cameras orbit and dolly")
    parser.add_argument(
        "--every", type=int, default=1, help="take every so many cameras of a set that does not move, for a quick run"
    )
    sizes = "of the pictures of the first set of cameras, halved for others (default 960x540)"
    parser.add_argument("--size", type=size_of, default=SIZE, help=sizes)
    parser.add_argument("--sh", action="store_true", help="measure with spherical harmonics as well")
    text = "folder that keeps our trees as NAME-METHOD.spz; those in it are not built again"
    parser.add_argument("--trees", type=Path, help=text)
    parser.add_argument("--json", type=Path, help="file for all numbers, with those of each camera")
    add_outputs(parser)
    arguments = parser.parse_args()
    arguments.budgets = arguments.budgets.split(",")
    if arguments.popping:
        arguments.cameras = list(dict.fromkeys([*arguments.cameras, *MOVING]))
    if "SPARK_DIR" not in os.environ and any(method.startswith("spark-") for method in arguments.methods):
        parser.error("Spark's builders need SPARK_DIR: a folder with Spark in its node_modules")
    return arguments


def main() -> None:
    """Print Markdown tables."""
    arguments = parsed()
    with tempfile.TemporaryDirectory() as scratch:
        record = run(arguments, Path(scratch))
    report(record, arguments.docs, arguments.plot)


if __name__ == "__main__":
    main()
