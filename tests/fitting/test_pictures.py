"""What fitted nodes must keep."""

from __future__ import annotations

import itertools

import numpy as np

from sparklod_cli.fitting.pictures import FittedNodes, Place, keep_gains, keep_sizes, pictures, placed, scores_of
from sparklod_cli.fitting.settings import SHARES
from sparklod_cli.inspection.tree import examine
from sparklod_cli.lod import quality
from sparklod_cli.render.render_settings import RasterSettings
from tests.scenes import random_splats

COUNT = 3000


def some() -> FittedNodes:
    return FittedNodes(*quality.build(random_splats(COUNT)), RasterSettings(), 1)


def faults(nodes: FittedNodes) -> list[str]:
    return [finding.code for finding in examine(nodes.result(), nodes.tree)[1]]


def test_nodes_that_shrank_below_their_children_get_their_first_values() -> None:
    nodes = some()
    shrunk = nodes.fitted[::7]
    nodes.columns.scale[shrunk] /= 4
    nodes.columns.rgb[nodes.fitted] += 0.01
    assert faults(nodes) == ["tree.size"]
    assert keep_sizes(nodes)
    assert faults(nodes) == []
    back = ~nodes.changed()
    assert back[shrunk].any()
    assert not back[np.setdiff1d(nodes.fitted, shrunk)].any()


def test_children_that_outgrew_a_node_get_their_first_values() -> None:
    nodes = some()
    deep = nodes.fitted[nodes.tree.depths()[nodes.fitted] >= 4]
    nodes.columns.scale[deep] *= 8
    assert "tree.size" in faults(nodes)
    assert keep_sizes(nodes)
    assert faults(nodes) == []


def test_sizes_that_keep_the_law_stay() -> None:
    nodes = some()
    nodes.columns.scale[nodes.fitted] *= 1.05
    assert not keep_sizes(nodes)
    assert nodes.changed()[nodes.fitted].all()


def test_the_nodes_of_a_budget_that_lost_get_their_first_values_and_no_budget_loses() -> None:
    nodes = some()
    cameras = placed(Place.of(nodes.old.center[nodes.leaves]), np.random.SeedSequence(1))
    held_out = list(itertools.islice(pictures(cameras, nodes), 3))
    before = scores_of(nodes, held_out)
    coarse = np.unique(np.concatenate([nodes.cut(picture.camera, SHARES[0]) for picture in held_out]))
    coarse = np.intersect1d(coarse, nodes.fitted)
    nodes.columns.rgb[coarse] += 0.3
    after = keep_gains(nodes, held_out, before)
    assert all(after[share] >= before[share] for share in SHARES)
    assert not nodes.changed()[coarse].all()


def test_what_gained_stays() -> None:
    nodes = some()
    cameras = placed(Place.of(nodes.old.center[nodes.leaves]), np.random.SeedSequence(1))
    held_out = list(itertools.islice(pictures(cameras, nodes), 3))
    worse = {share: value - 1 for share, value in scores_of(nodes, held_out).items()}
    nodes.columns.rgb[nodes.fitted] += 1e-4
    keep_gains(nodes, held_out, worse)
    assert nodes.changed()[nodes.fitted].all()
