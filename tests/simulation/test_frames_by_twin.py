"""Rows and cuts as they are worked out without sparklod."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.model.foveation import Frustum
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.scene import Scene
from sparklod_cli.viewers.cut import Forest
from sparklod_cli.viewers.loaded_scene import LoadedScene
from sparklod_cli.viewers.scenes import CutFinder, Scenes
from sparklod_cli.viewers.viewer_settings import LodSettings
from tests.lod.forests import random_tree, transform
from tests.references import frames as twin
from tests.scenes import random_splats
from tests.simulation.paths import SPARK, camera, path_of, rows_of


def small_forest(seed: int) -> tuple[Scenes, list[twin.Instance]]:
    """Two trees of a few hundred nodes and three instances of them, as the package and the twin have them."""
    rng = np.random.default_rng(seed)
    trees = [random_tree(rng, count, 5) for count in (300, 120)]
    spots = [np.eye(4), transform(rng, scale=0.6, spread=2), transform(rng, scale=1.4, spread=4)]
    of, weights = (0, 1, 0), (1.0, 2.5, 0.7)
    own, of_all = Frustum(0.3, 0.1), SPARK
    instances = [
        Instance(Path(f"{tree}.spz"), f"{number}", spot, weight, own if number == 1 else None)
        for number, (tree, spot, weight) in enumerate(zip(of, spots, weights, strict=True))
    ]
    as_nodes = [
        twin.Nodes(tree.center.astype(float), tree.size.astype(float), tree.tree.child_count, tree.tree.child_start)
        for tree in trees
    ]
    made = []
    for number, tree in enumerate(trees):
        splats = random_splats(len(tree.size))
        made.append(LoadedScene(Path(f"{number}.spz"), 1000, Scene(splats, tree.tree), splats, number))
    cones = twin.cones(of_all.fov0, of_all.fov, of_all.foveate, of_all.behind)
    weighting = [cones, twin.frustum(own.outside, own.behind), cones]
    twins = [
        twin.Instance(as_nodes[tree], spot, weight, how)
        for tree, spot, weight, how in zip(of, spots, weights, weighting, strict=True)
    ]
    scenes = Scenes(instances, made, [made[tree] for tree in of])
    scenes.__dict__["forest"] = Forest(trees)  # of other sizes than those of the splats
    return scenes, twins


@pytest.mark.parametrize("seed", range(6))
def test_rows_are_as_worked_out_without_sparklod(seed: int) -> None:
    scenes, twins = small_forest(seed)
    rng = np.random.default_rng(100 + seed)
    for budget, render_scale in ((3, 1.0), (150, 1.0), (100_000, 40.0), (100_000, 0.0)):
        eye, target = rng.normal(0, 2, 3), rng.normal(0, 1, 3)
        at = camera(eye, target, fov=70, size=(500, 300))
        right, up, back = at.camera_to_world[:3, :3].T
        seen = twin.Eye(eye, right, up, -back, math.radians(70), 500, 300)
        (row,) = rows_of(scenes, LodSettings(budget, SPARK, render_scale=render_scale), path_of([at]))
        drawn = twin.frame(twins, seen, budget, seen.pixel * render_scale)
        assert twin.differing(drawn.cells, row) == []
        cut = CutFinder(scenes, LodSettings(budget, SPARK, render_scale=render_scale)).cut(at).nodes
        assert [set(part.tolist()) for part in cut] == [
            {node for number, node in drawn.cut if number == instance} for instance in range(3)
        ]
