"""Continuous cuts, which do not pop: nodes fade into their children as the camera approaches.

An ordinary cut refines a node or not, by whether its *limit* L, the least pixel scale on the path from the root to it,
is above a threshold T. Here a node is refined by a share that rises smoothly from 0 to 1,

    t(n) = smoothstep(ln(L(n) / T) / ln(width)),      0 where L <= T, 1 where L >= width * T, always 0 for a leaf,

and drawn with the weight by which its parent is refined and it is not:

    weight(n) = t(parent of n) - t(n),                1 - t(n) for a root.

L does not rise from a node to its children, so t does not either, and no weight is negative; on the path from the root
to any leaf the weights sum to 1, as the sum telescopes. Pixel scales, their minima and T are continuous in the camera's
position, hence the weights are: if no pixel scale changes by more than a factor of exp(d), no weight changes by more
than 6 * d / ln(width). (The slope of a smoothstep is at most 1.5, ln L and ln T change by at most d each, and a weight
is the difference of two shares.) With foveation this holds for two different cones, but not for a frustum, whose weight
jumps at its edges, nor for cones of the same angle; it holds for directions as it does for positions.

With a budget, T is where the weights sum to it. They sum to W(T) = roots + sum of t(n) * (children of n - 1), which is
continuous and falls with T; so there is such a T, and ln T changes by no more than the pixel scales' logarithms do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..lod.kernels.cut import BUCKET_BITS, BUCKETS
from ..lod.kernels.pixel_scale import pixel_scales
from ..lod.kernels.tree_links import find_depths, find_limits, find_parents
from ..model.gaussian import linear_opacity, lod_opacity
from ..model.splats import FloatArray
from .loaded_scene import Viewer, views_of
from .viewer_settings import BLEND

#: Bisections of the threshold's interval, whose ends differ by a factor of the width; 40 leave a share of 1e-12 of it.
HALVINGS = 40

#: In place of an infinite limit, so that logarithms are finite.
LARGEST = np.finfo(np.float32).max

Shares = NDArray[np.float64]


@dataclass(frozen=True)
class BlendedCut:
    """The S nodes of a continuous cut, of all instances together.

    Attributes:
        node: (S,) uint32 index in its tree; ascending within an instance.
        instance: (S,) uint16, ascending.
        weight: (S,) float64, above 0 and at most 1.
        threshold: pixel scale at or below which no node is refined; 0 if all are.
    """

    node: NDArray[np.uint32]
    instance: NDArray[np.uint16]
    weight: Shares
    threshold: float

    def __len__(self) -> int:
        return len(self.node)


class ContinuousCuts:
    """Finds continuous cuts."""

    def __init__(self, viewer: Viewer) -> None:
        self._forest, self._instances = viewer.forest, viewer.instances
        bases = self._forest.node_base
        self._inner = [_Inner(self._forest.nodes[bases[i] : bases[i + 1]]) for i in range(len(bases) - 1)]

    def cut(self, view: Camera, *, budget: int, smallest: float = 0.0, width: float = BLEND) -> BlendedCut:
        """Return the continuous cut.

        Args:
            budget: sum of the weights, all instances together, unless `smallest` or the leaves are reached first; at
                least the number of instances. The number of nodes is larger, because fading nodes count in part.
            smallest: nodes of this pixel scale or less are not refined; see `settings.pixel_limit`.
            width: nodes of this many times the threshold are refined completely; above 1.
        """
        views = views_of(self._forest, self._instances, view)
        inner = [self._inner[instance.tree] for instance in self._instances]
        limits = [each.limits(views, number) for number, each in enumerate(inner)]
        more = np.concatenate([each.more for each in inner])
        threshold = max(find_threshold(np.concatenate(limits), more, budget - len(views), width), smallest)
        parts = [each.blended(shares(limit, threshold, width)) for each, limit in zip(inner, limits, strict=True)]
        return BlendedCut(
            node=np.concatenate([node for node, _ in parts]),
            instance=np.repeat(np.arange(len(parts), dtype=np.uint16), [len(node) for node, _ in parts]),
            weight=np.concatenate([weight for _, weight in parts]),
            threshold=threshold,
        )


def shares(limit: NDArray[np.float32], threshold: float, width: float) -> Shares:
    """Return the (M,) shares, 0..1, by which nodes of (M,) limits are refined: t(n) above; 1 at a threshold of 0."""
    share = np.zeros(len(limit))
    above = np.flatnonzero(limit > threshold)
    share[above] = (
        _smoothstep(np.log(limit[above].astype(np.float64) / threshold) / math.log(width)) if threshold else 1
    )
    return share


def _smoothstep(x: Shares) -> Shares:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def find_threshold(limit: NDArray[np.float32], more: NDArray[np.int64], room: int, width: float) -> float:
    """Return the threshold at which `shares` of nodes add `room` to the sum of weights; 0 if all nodes can be refined.

    Args:
        limit: (M,) float32 of nodes with children; finite, at least 0.
        more: (M,) number of children minus 1.
        room: the budget minus the number of roots.
        width: above 1.
    """
    # At the limit of the first node that exceeds it, the shares add too little; `width` times lower, too much.
    most = _first_over(limit, more, room)
    if not most:
        return 0.0
    wide = limit.astype(np.float64)
    undecided = np.flatnonzero((wide * width > most) & (wide < most * width))
    room -= int(more[wide >= most * width].sum())
    places, adds = np.log(wide[undecided] / most) / math.log(width), more[undecided].astype(np.float64)
    low, high = -1.0, 0.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if adds @ _smoothstep(places - middle) > room:
            low = middle
        else:
            high = middle
    return most * float(width**high)


def _first_over(limit: NDArray[np.float32], more: NDArray[np.int64], room: int) -> float:
    """Return the limit at which nodes refined by descending limits exceed the room; 0 if they never do."""
    # Only nodes that have the upper half of its bits are sorted; the bits of floats >= 0 are in their order.
    upper = limit.view(np.int32) >> BUCKET_BITS
    totals = np.cumsum(np.bincount(upper, weights=more, minlength=BUCKETS)[::-1])
    place = int(np.searchsorted(totals, room, side="right"))
    if place == BUCKETS:
        return 0.0
    some = np.flatnonzero(upper == BUCKETS - 1 - place)
    some = some[np.argsort(-limit[some], kind="stable")]
    before = totals[place - 1] if place else 0
    return float(limit[some[np.searchsorted(np.cumsum(more[some]), room - before, side="right")]])


class _Inner:
    """The M inner nodes of a tree in order of depth; `more`, (M,), is the number of their children minus 1."""

    def __init__(self, nodes: NDArray[np.void]) -> None:
        children, start = nodes["child_count"].astype(np.uint16), nodes["child_start"].copy()
        depth, _ = find_depths(children, start, nodes["size"].copy())
        self._parent, _ = find_parents(children, start)
        inner = np.flatnonzero(children)
        self._nodes, self._node = nodes, inner[np.argsort(depth[inner], kind="stable")]
        place = np.empty(len(nodes), np.int32)
        place[self._node] = np.arange(len(inner), dtype=np.int32)
        above = self._parent[self._node]
        self._above = np.where(above < 0, np.int32(-1), place[above])
        self.more = children[self._node].astype(np.int64) - 1

    def limits(self, views: NDArray[np.void], number: int) -> NDArray[np.float32]:
        """Return the (M,) least pixel scales on the paths from the root to each node, in the view of an instance."""
        scale = np.empty(len(self._node), np.float32)
        pixel_scales(self._nodes, self._node, views, number, scale)
        limit: NDArray[np.float32] = np.minimum(find_limits(self._above, scale)[1], LARGEST)
        return limit

    def blended(self, share: Shares) -> tuple[NDArray[np.uint32], Shares]:
        """Return the nodes with a weight above 0, ascending, and their weights; `share` is (M,), see `shares`."""
        refined = np.zeros(len(self._nodes))
        refined[self._node] = share
        weight = refined[self._parent] - refined
        weight[0] = 1 - refined[0]
        drawn = np.flatnonzero(weight > 0)
        return drawn.astype(np.uint32), weight[drawn]


def faded(opacity: FloatArray, weight: Shares) -> FloatArray:
    """Return the (N,) linear opacities of splats drawn with a weight: those of D times the weight.

    A parent and children of half the weight each let more through than either alone: a quarter, if both are opaque.
    Ways to compensate for that were tried, and pop no less; see benchmarks/notes/rasterizer.md. Linear opacity times
    the weight pops as little, but a splat of linear opacity 1000 would still be opaque at a weight of a thousandth.
    """
    fading: FloatArray = np.where(weight < 1, linear_opacity(lod_opacity(opacity) * weight), opacity)
    return fading.astype(np.float32)
