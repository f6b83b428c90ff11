"""Writes scenes of extreme values in every format and encoding; whatever is written must pass `inspect --check`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sparklod_cli.codecs.formats import RAD_ENCODINGS
from sparklod_cli.lod.tree_settings import METHODS

from .. import scenes
from ..case import Case, LawError, Rng
from ..command import command
from ..laws import check_passes
from ..mutate import pick

#: Spread of the centres, in world units, in place of `scenes.EXTENTS`.
EXTENTS = (0.0, 1e-30, 1e-3, 1.0, 1.0, 1.0, 100.0, 1e6, 1e9, 1e20, 1e30, 1e38)

#: Outputs of a tree, and of the splats of one.
TREES = ("tree.spz", "tree.rad", "tree.rad", "chunks/tree.rad", "levels/lod-meta.json", "tiles/tileset.json")
PLAIN = ("plain.spz", "plain.rad", "plain.ply", "plain.splat", "plain.sog", "unpacked/meta.json")

LEVELS = ("auto", "50%", "90%,50%,1%", "99%,0.001%")


def make(rng: Rng) -> Case:
    """Makes a scene, the options to bake it with, and the name of a plain file for its splats."""
    columns = scenes.extreme(rng, EXTENTS)
    if rng.integers(6) == 0:
        columns = {name: np.repeat(values[:1], len(values), axis=0) for name, values in columns.items()}
    output = pick(rng, TREES)
    options = ["-o", output, "--on-invalid", "drop", "--method", pick(rng, METHODS)]
    if output.startswith("chunks"):
        options += ["--format", "rad-chunked"]
    if output.endswith(".rad"):
        for name in RAD_ENCODINGS:
            options += [f"--rad-{name}", pick(rng, ("auto", *RAD_ENCODINGS[name]))]
        if rng.integers(4) == 0:
            options += ["--cluster-sh", pick(rng, ("2", "64"))]
    if output.startswith("levels"):
        options += ["--levels", pick(rng, LEVELS), "--region-min-splats", pick(rng, ("1", "16", "8192"))]
        options += [
            "--region-extent",
            pick(rng, ("1e-3", "1", "16")),
            "--chunk-splats",
            pick(rng, ("20", "40", "9999")),
        ]
    if output.startswith("tiles"):
        options += ["--tile-splats", pick(rng, ("1", "7", "40", "9999"))]
    what = f"{len(columns['center'])} splats, {' '.join(options)}"
    return Case(what, {"scene.ply": scenes.ply_of(columns)}, {"options": options, "plain": pick(rng, PLAIN)})


def check(case: Case, folder: Path) -> None:
    """Bakes, and writes the splats of the tree back; each output passes the check, or there is none."""
    options, plain = case.run["options"], case.run["plain"]
    if not _written("build-lod", ["scene.ply", *options], folder / options[1]) or options[1].endswith(".json"):
        return
    _written("convert", [options[1], plain, "--leaves"], folder / plain)


def _written(name: str, arguments: list[str], output: Path) -> bool:
    """Whether a command wrote an output, which then passes the check."""
    done = command([name, *arguments])
    if done.code and output.exists():
        raise LawError(f"exit code {done.code}, but the output was written")
    if not done.code:
        check_passes(output)
    return not done.code
