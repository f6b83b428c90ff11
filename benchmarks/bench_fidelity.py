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
from fidelity_trees import METHODS, SHARES, Source, build, decimated
from fidelity_views import CAMERAS, MOVING, OF_PATHS, SIZE, Figures, FullDetail, cameras_of, of_tree
from fine_structure import fine_structure
from glossy_knot import glossy_knot
from performance.machine import machine
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

BUDGETS = "2%,5%,10%,25%,50%"


@dataclass(frozen=True)
class Measured:
    """What was found of one builder's tree, or of one way of splat-transform.

    Attributes:
        nodes, leaves: how many of a tree; 0 for splats without one.
        seconds: of each run of the builder.
        views: by set of cameras and budget.
    """

    nodes: int
    leaves: int
    seconds: list[float]
    views: dict[str, dict[str, Figures]]


def sources(path: Path, arguments: argparse.Namespace) -> Iterator[Source]:
    """A scene as it is drawn without spherical harmonics and, if asked for and it has some, with them."""
    read = sparklod.read(path)
    kept, _ = sparklod.Selection().apply(read.splats)
    scene = sparklod.Scene(kept, antialiased=read.antialiased)
    source = Source(path, scene, False, arguments.runs, arguments.growth, arguments.steps, arguments.trees)
    yield source
    if arguments.sh and kept.sh_degree:
        yield dataclasses.replace(source, sh=True, runs=0)


def measure(source: Source, arguments: argparse.Namespace) -> Iterator[tuple[str, Measured]]:
    """Measures one scene with every method, and with each way of splat-transform that there is."""
    drawn, suffix = source.drawn, WITH_SH * source.sh
    first, half = arguments.cameras[0], (arguments.size[0] // 2, arguments.size[1] // 2)
    sets = {}
    for name in [first] if source.sh else arguments.cameras:
        cameras = cameras_of(name, drawn, arguments.size if name == first else half)
        sets[name] = cameras[:: 1 if name in MOVING else arguments.every]
    for method in arguments.methods:
        built = build(source, method)
        views = {}
        for name, cameras in sets.items():
            budgets = OF_PATHS if name in MOVING else arguments.budgets
            views[name + suffix] = of_tree(built.tree, drawn, cameras, budgets)
            psnr = ", ".join(f"{each.psnr:.2f}" for each in views[name + suffix].values())
            print(f"{source.path.name}: {METHODS[method]}, {name}{suffix}: {psnr} dB", file=sys.stderr, flush=True)
        leaves = int(np.count_nonzero(built.tree.tree.is_leaf))
        yield method, Measured(len(built.tree), leaves, built.seconds, views)
    if arguments.decimated and first not in MOVING:
        full = FullDetail(drawn, sets[first])
        for way, scenes in decimated(arguments.decimated, source.path.stem, sh=source.sh):
            of_budgets = {}
            for share, scene in zip(SHARES, scenes, strict=True):
                if abs(len(scene) / (len(drawn) * share / 100) - 1) > 0.01:
                    raise SystemExit(f"{source.path.name}: {way} has {len(scene):,} splats, which are not {share} %")
                if f"{share}%" in arguments.budgets:
                    of_budgets[f"{share}%"] = full.of_scene(scene)
            yield way, Measured(0, 0, [], {first + suffix: of_budgets})


def run(arguments: argparse.Namespace, made: Path) -> dict[str, Any]:
    """Measures all scenes; what is known is written after each tree, so that a long run may end early."""
    record: dict[str, Any] = {
        "machine": machine(),
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
    for path in scenes_of(arguments.scenes, made):
        found = record["scenes"].setdefault(path.name, {})
        for source in sources(path, arguments):
            for method, measured in measure(source, arguments):
                before = found.get(method)
                found[method] = dataclasses.asdict(measured)
                if before:  # with spherical harmonics: how long building takes was measured before
                    found[method] = before | {"views": before["views"] | found[method]["views"]}
                if arguments.json:
                    arguments.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return record


def scenes_of(given: list[str], made: Path) -> Iterator[Path]:
    """The files; those of a folder are the real scenes, and those of a name in `MADE` are written into a folder."""
    for text in given:
        if text in MADE:
            path = made / f"{text}.ply"
            write_ply(path, MADE[text]())
            yield path
        elif Path(text).is_dir():
            yield from (Path(text, name) for name in REAL_SCENES)
        else:
            yield Path(text)


def size_of(text: str) -> tuple[int, int]:
    """Width and height of WxH."""
    width, height = map(int, text.split("x"))
    return width, height


def parsed() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    named = f"splat files, a folder with {', '.join(REAL_SCENES)}, or {', '.join(MADE)}, which is made"
    parser.add_argument("scenes", nargs="+", help=named)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="what builds trees")
    parser.add_argument("--budgets", default=BUDGETS, help="shares of the leaves, or counts, between commas")
    parser.add_argument("--growth", type=float, default=1.4, help="of our quality builder")
    parser.add_argument("--steps", type=int, help="of refining; by default what suits each tree")
    parser.add_argument("--runs", type=int, default=3, help="runs of each builder but for refining, which has one")
    sets = "sets of cameras; the first one is that of most tables, and orbit and dolly are for popping"
    parser.add_argument("--cameras", nargs="+", choices=CAMERAS, default=["around"], help=sets)
    parser.add_argument("--popping", action="store_true", help="add the cameras orbit and dolly")
    parser.add_argument(
        "--every", type=int, default=1, help="take every so many cameras of a set that does not move, for a quick run"
    )
    sizes = "of the pictures of the first set of cameras, halved for others (default 960x540)"
    parser.add_argument("--size", type=size_of, default=SIZE, help=sizes)
    parser.add_argument("--sh", action="store_true", help="measure with spherical harmonics as well")
    kept = "folder that keeps our trees as NAME-METHOD.spz; those in it are not built again, and not timed"
    parser.add_argument("--trees", type=Path, help=kept)
    text = "folder of NAME-decimate-50.ply and so on, which splat-transform made, for rows of them"
    parser.add_argument("--decimated", type=Path, help=text)
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
    """Prints Markdown tables."""
    arguments = parsed()
    with tempfile.TemporaryDirectory() as made:
        record = run(arguments, Path(made))
    report(record, arguments.docs, arguments.plot)


if __name__ == "__main__":
    main()
