"""Instances files, with changes to their structure and text."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from sparklod_cli.viewers.instances_file import read_instances

from ..case import Case, LawError, Rng
from ..command import command
from ..mutate import json_mutated, mutated, pick
from .cameras import tree

TURNED = [0, -1, 0, 5, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
SEEDS = tuple(
    json.dumps({"instances": instances}).encode()
    for instances in (
        [{"file": "tree.spz"}],
        [{"file": "tree.spz", "translation": [1, 0, 0], "rotation": [0, 0.6, 0, 0.8], "scale": 2, "name": "left"}] * 2,
        [{"file": "tree.spz", "matrix": TURNED, "lod_scale": 0.5}, {"file": "tree.spz", "name": "total2"}],
        [{"file": "tree.spz", "foveation": {"outside_foveate": 0.5, "behind_foveate": 0.1}}],
        [{"file": "tree.spz", "foveation": {"cone_fov0": 90, "cone_fov": 120, "cone_foveate": 0.4}}],
    )
)


def make(rng: Rng) -> Case:
    """Changes an instances file; most cases only read it, some run a command with it."""
    data = pick(rng, SEEDS)
    data = json_mutated(rng, data) if rng.integers(8) else mutated(rng, data)
    line = pick(rng, ("", "", "", "traverse --per-instance --orbit 2 --no-timing", "render --size 16x12 -o out.png"))
    return Case(line or "read", {"scene.json": data, "tree.spz": tree()}, {"arguments": line.split()})


def check(case: Case, folder: Path) -> None:
    """The instances have finite matrices, or the file is refused with an error."""
    arguments = case.run["arguments"]
    if arguments:
        command([arguments[0], "--scene", "scene.json", *arguments[1:]])
        return
    for instance in read_instances(Path("scene.json")):
        if not np.isfinite(instance.object_to_world).all():
            raise LawError(f"an instance that cannot be drawn: {instance!r:.200}")
