"""The detail levels that PlayCanvas's engine chooses, by its own modules, and those of `viewers.playcanvas`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.viewers.playcanvas import Chains, Distant, RegionBounds, choose
from sparklod_cli.viewers.viewer_settings import DetailRule
from tests.interop.node import Node
from tests.lod.trees import CutView, Regions, random_regions, random_view

pytestmark = pytest.mark.slow

#: By name: the rule, and the share of runs that are empty.
RULES = {
    "defaults": (DetailRule(), 0.0),
    "gaps": (DetailRule(), 0.3),
    "a limit": (DetailRule(mode="limit", base_distance=8.0), 0.1),
    "far": (DetailRule(mode="limit", base_distance=40.0, multiplier=1.2), 0.0),
    "a range": (DetailRule(finest=1, coarsest=2, behind_penalty=4.0), 0.3),
    "no shrinking": (DetailRule(shrink=0.0, behind_penalty=1.0, multiplier=1.7), 0.0),
}

SCENES = 6


@pytest.fixture(scope="module")
def engine(engines_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    """PlayCanvas's modules in Node."""
    process = Node("detail_choice.mjs", engines_dir, scratch=tmp_path_factory.mktemp("engine"))
    yield process
    process.close()


def manifest(regions: Regions) -> dict[str, Any]:
    """The part of lod-meta.json that the engine reads; its tree is a list in this test."""
    levels, leaves = range(regions.counts.shape[1]), []
    for (low, high), counts in zip(regions.bounds, regions.counts, strict=True):
        runs = {str(level): {"file": level, "offset": 0, "count": int(counts[level])} for level in levels}
        held = {level: run for level, run in runs.items() if run["count"]}
        leaves.append({"bound": {"min": low.tolist(), "max": high.tolist()}, "lods": held})
    filenames = [f"{level}_0/meta.json" for level in levels]
    return {"lodLevels": len(levels), "filenames": filenames, "tree": {"children": leaves}}


def seen_by(view: CutView) -> dict[str, Any]:
    return {
        "matrix": view.camera_to_world.T.ravel().tolist(),
        "fov": math.degrees(view.fov_y),
        "aspectRatio": math.tan(view.fov_x / 2) / math.tan(view.fov_y / 2),
    }


def placed(random: np.random.Generator) -> np.ndarray:
    """A matrix of a rotation, a uniform scale and a translation."""
    matrix = random_view(random, 20.0).camera_to_world
    matrix[:3, :3] *= random.lognormal(0, 0.5)
    return matrix


@pytest.mark.parametrize("name", RULES)
def test_levels_are_those_of_playcanvas(name: str, engine: Node) -> None:
    """Every level of every region, but for one in a thousand where instances are placed, whose distances round."""
    rule, gaps = RULES[name]
    random = np.random.default_rng(sum(map(ord, name)))
    different = every = 0
    for number in range(SCENES):
        several = number >= SCENES // 2
        shapes = [(int(random.integers(1, 400)), int(random.integers(1, 7))) for _ in range(3 if several else 1)]
        scenes = [random_regions(random, *shape, gaps=gaps) for shape in shapes]
        matrices = [placed(random) if several else np.eye(4) for _ in scenes]
        bases = [rule.base_distance * (at + 1) for at in range(len(scenes))]
        views = [random_view(random) for _ in range(4)]
        finest = sum(int(scene.counts[:, 0].sum()) for scene in scenes)
        budgets = [1, *(int(share * finest) for share in (0.05, 0.2, 0.5, 0.9)), 2 * finest]
        chosen = {"lodMultiplier": rule.multiplier, "lodRangeMin": rule.finest, "lodRangeMax": rule.coarsest}
        manifests = [
            {
                "data": manifest(scene),
                "matrix": matrix.T.ravel().tolist(),
                "settings": {"lodBaseDistance": base, **chosen},
            }
            for scene, matrix, base in zip(scenes, matrices, bases, strict=True)
        ]
        params = {"lodBehindPenalty": rule.behind_penalty, "lodDistanceShrink": rule.shrink}
        request = {"manifests": manifests, "cameras": list(map(seen_by, views)), "budgets": budgets}
        found = engine.ask({**request, "mode": rule.mode, "params": params})["found"]
        for view, answer in zip(views, found, strict=True):
            distances = [
                RegionBounds(scene.bounds).squared_distances(view, matrix, rule)
                for scene, matrix in zip(scenes, matrices, strict=True)
            ]
            for ours, theirs in zip(distances, answer["distances"], strict=True):
                np.testing.assert_allclose(ours, theirs, rtol=1e-4 if several else 1e-12, atol=1e-3 if several else 0)
            distant = [
                Distant(Chains.of(scene.counts, rule), distance, base)
                for scene, distance, base in zip(scenes, distances, bases, strict=True)
            ]
            for budget, levels in zip(budgets, answer["levels"], strict=True):
                ours = np.concatenate(choose(distant, budget, rule).levels)
                different += int((ours != np.concatenate(levels)).sum())
                every += len(ours)
                if not several:
                    assert ours.tolist() == levels[0], (name, number, budget)
    assert every > 1000 and different <= every / 1000
