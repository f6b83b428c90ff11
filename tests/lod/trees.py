"""What holds for the trees of every builder, and scenes that are hard to build one of."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from sparklod_cli.model.gaussian import MAX_OPACITY, MIN_OPACITY
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.threads import on_threads
from tests.references import gaussians
from tests.scenes import random_splats


def children(tree: LodTree, node: int) -> slice:
    start = int(tree.child_start[node])
    return slice(start, start + int(tree.child_count[node]))


def sorted_rows(splats: Splats) -> np.ndarray:
    rows = np.concatenate([getattr(splats, name).reshape(len(splats), -1) for name in COLUMNS], axis=1)
    return rows[np.lexsort(rows.T)]


def check_tree(splats: Splats, nodes: Splats, tree: LodTree) -> None:
    """What holds for every tree: it is one, its leaves are the input bit for bit, its merges are merges."""
    tree.validate()
    assert len(nodes) == len(tree)
    assert np.array_equal(sorted_rows(nodes.take(tree.is_leaf)), sorted_rows(splats))
    assert (tree.child_count[~tree.is_leaf] > 1).all()
    for name in COLUMNS:
        assert np.isfinite(getattr(nodes, name)).all(), name
    inner = nodes.take(~tree.is_leaf)
    assert ((inner.opacity >= np.float32(MIN_OPACITY)) & (inner.opacity <= MAX_OPACITY)).all()
    assert np.allclose(np.linalg.norm(inner.quat_xyzw, axis=1), 1, atol=1e-6)


def parents(tree: LodTree) -> np.ndarray:
    """The parent of each node, that of the root itself."""
    parent = np.zeros(len(tree), np.int64)
    for node in np.flatnonzero(~tree.is_leaf):
        parent[children(tree, node)] = node
    return parent


def check_threads(build: Callable[[], tuple[Splats, LodTree]]) -> None:
    """The number of threads does not change a bit."""
    results = []
    for threads in (1, 2, 3):
        with on_threads(threads):
            results.append(build())
    for nodes, tree in results[1:]:
        for name in COLUMNS:
            assert getattr(nodes, name).tobytes() == getattr(results[0][0], name).tobytes(), name
        assert tree.child_start.tobytes() == results[0][1].child_start.tobytes()


def coincident(count: int) -> Splats:
    """So many splats of one size at one point, and 20 elsewhere."""
    splats = random_splats(count + 20, seed=5)
    center, scale = splats.center.copy(), splats.scale.copy()
    center[:count] = center[0]
    scale[:count] = 0.01
    return dataclasses.replace(splats, center=center, scale=scale)


def hard_cases() -> dict[str, Splats]:
    plain = random_splats(500, seed=6)
    rng = np.random.default_rng(7)

    def scaled(factors: list[float]) -> Splats:
        return dataclasses.replace(plain, scale=np.ascontiguousarray(plain.scale * np.float32(factors)))

    spread = np.float32(10.0) ** rng.uniform(-12, 12, (500, 1)).astype(np.float32)
    return {
        "flat": scaled([1, 1, 0]),
        "needle": scaled([1, 0, 0]),
        "almost flat": scaled([1, 1, 1e-12]),
        "tiny": dataclasses.replace(plain, scale=np.full_like(plain.scale, 1e-30)),
        "huge": dataclasses.replace(plain, scale=np.full_like(plain.scale, 1e18)),
        "every scale": dataclasses.replace(plain, scale=np.ascontiguousarray(plain.scale * spread)),
        "far": dataclasses.replace(plain, center=plain.center + np.float32(1e7)),
        "far and tiny": dataclasses.replace(
            plain, center=plain.center * np.float32(1e7), scale=np.full_like(plain.scale, 1e-9)
        ),
        "widest": dataclasses.replace(plain, center=plain.center * np.float32(1e37)),
        "one point": dataclasses.replace(plain, center=np.zeros_like(plain.center)),
        "on cell edges": dataclasses.replace(plain, center=np.rint(plain.center * 4).astype(np.float32)),
        "faint": dataclasses.replace(plain, opacity=np.full_like(plain.opacity, 1e-30)),
        "opaque": dataclasses.replace(plain, opacity=np.ones_like(plain.opacity)),
    }


def check_colours(nodes: Splats, tree: LodTree) -> None:
    """Asserts that the colours of a quality tree are means of those of its leaves, weighted by what these cover."""
    parent = parents(tree)
    color = np.concatenate([nodes.rgb, nodes.sh.reshape(len(nodes), -1)], axis=1).astype(np.float64)
    weight = np.where(tree.is_leaf, nodes.opacity.astype(np.float64) * gaussians.ellipsoid_area(nodes.scale), 0)
    total = weight[:, None] * color
    for node in range(len(tree) - 1, 0, -1):
        weight[parent[node]] += weight[node]
        total[parent[node]] += total[node]
    np.testing.assert_allclose(color, total / weight[:, None], atol=2e-5)
