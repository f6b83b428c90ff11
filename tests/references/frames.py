"""Computes the row of a frame without sparklod's code: slowly, in float64, and in world instead of object space."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

CHUNK = 65_536


@dataclass(frozen=True)
class Nodes:
    """A tree: (N, 3) centres, (N,) sizes, and the child columns."""

    center: np.ndarray
    size: np.ndarray
    child_count: np.ndarray
    child_start: np.ndarray

    @cached_property
    def level(self) -> np.ndarray:
        level = np.zeros(len(self.size), int)
        for node in np.flatnonzero(self.child_count):
            start = int(self.child_start[node])
            level[start : start + int(self.child_count[node])] = level[node] + 1
        return level


@dataclass(frozen=True)
class Eye:
    """A camera: position, unit vectors to the right, up and ahead, (3,) each, and the field of view in radians."""

    position: np.ndarray
    right: np.ndarray
    up: np.ndarray
    ahead: np.ndarray
    fov_y: float
    width: int
    height: int

    @property
    def tan_y(self) -> float:
        return math.tan(self.fov_y / 2)

    @property
    def tan_x(self) -> float:
        return self.tan_y * self.width / self.height  # pixels are square

    @property
    def pixel(self) -> float:
        """Size over distance of a pixel."""
        return 2 * self.tan_y / self.height


def cones(fov0: float, fov: float, foveate: float, behind: float) -> Callable[[Eye, np.ndarray], np.ndarray]:
    """Weighs (N, 3) directions: 1 in the inner cone, `foveate` on the outer one, `behind` from 90° on."""
    inner, outer = math.cos(math.radians(fov0 / 2)), math.cos(math.radians(fov / 2))

    def weight(eye: Eye, offset: np.ndarray) -> np.ndarray:
        cosine = offset @ eye.ahead / np.maximum(np.linalg.norm(offset, axis=1), 1e-300)
        return np.interp(cosine, [0, outer, inner], [behind, foveate, 1])

    return weight


def frustum(outside: float, behind: float) -> Callable[[Eye, np.ndarray], np.ndarray]:
    """Weighs (N, 3) directions: 1 inside the frustum, `outside` it, or `behind` the camera."""

    def weight(eye: Eye, offset: np.ndarray) -> np.ndarray:
        ahead = offset @ eye.ahead
        seen = (abs(offset @ eye.right) <= eye.tan_x * ahead) & (abs(offset @ eye.up) <= eye.tan_y * ahead)
        return np.where(ahead <= 0, behind, np.where(seen, 1, outside))

    return weight


@dataclass(frozen=True)
class Instance:
    """A tree, the matrix that places it in the world, and its LoD settings."""

    nodes: Nodes
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    lod_scale: float = 1.0
    weight: Callable[[Eye, np.ndarray], np.ndarray] = field(default_factory=lambda: cones(0, 0, 1, 1))


@dataclass
class Drawn:
    """The cut of a frame, (instance, node) each, and the cells of its row that need no other frame."""

    cut: list[tuple[int, int]]
    cells: dict[str, object]


def frame(
    instances: Sequence[Instance], eye: Eye, budget: int, smallest: float, resident: Collection[int] | None = None
) -> Drawn:
    """Finds the cut of a frame with one queue, and computes its cells.

    Args:
        instances: the trees in the world.
        eye: the camera.
        budget: number of nodes at most.
        smallest: nodes of this pixel scale or less are not refined.
        resident: resident chunks, if there is one tree; None for all.
    """
    offsets, scales, sizes = [], [], []
    for each in instances:
        offset = each.nodes.center @ each.matrix[:3, :3].T + each.matrix[:3, 3] - eye.position
        size = each.nodes.size * np.linalg.norm(each.matrix[:3, 0])
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-300)
        offsets.append(offset)
        sizes.append(size / distance)
        scales.append(size / distance * each.weight(eye, offset) * each.lod_scale)

    def are_resident(chunks: set[int]) -> bool:
        return resident is None or chunks <= set(resident)

    queue: list[tuple[float, int, int, float]] = []
    missing = 0
    for number in range(len(instances)):
        if are_resident({0}):
            queue.append((-scales[number][0], -number, 0, math.inf))
        else:
            missing += 1
    heapq.heapify(queue)
    drawn: list[tuple[int, int]] = []
    least, reason, touched = math.inf, "exhausted", {(id(each.nodes), 0) for each in instances}
    while queue:
        scale, number, node, above = -queue[0][0], -queue[0][1], -queue[0][2], queue[0][3]
        if scale <= smallest:
            break
        nodes = instances[number].nodes
        count, start = int(nodes.child_count[node]), int(nodes.child_start[node])
        chunks = {start // CHUNK, (start + count - 1) // CHUNK} if count else set()
        if count and len(drawn) + len(queue) - 1 + count > budget:
            reason = "budget"
            break
        heapq.heappop(queue)
        touched |= {(id(nodes), chunk) for chunk in chunks}
        if count and are_resident(chunks):
            limit = min(above, scale)
            least = min(least, limit)
            for child in range(start, start + count):
                heapq.heappush(queue, (-scales[number][child], -number, -child, limit))
        else:
            missing += count > 0
            drawn.append((number, node))
    frontier = [(-number, -node) for _, number, node, _ in queue]
    coarse = any(instances[number].nodes.child_count[node] for number, node in frontier)
    if reason != "budget":
        reason = "pixel" if coarse else "missing" if missing else "exhausted"
    cut = drawn + frontier
    cells = {
        "selected": len(cut),
        "leaves": sum(instances[number].nodes.child_count[node] == 0 for number, node in cut),
        "budget_used": len(cut) / budget,
        "stop_reason": reason,
        "pixel_scale_min": None if least == math.inf else least,
        "pixel_scale_limit": smallest,
        "frontier": len(frontier),
        "missing": missing,
        "chunks_touched": len(touched),
    }
    cells["interior"] = cells["selected"] - cells["leaves"]
    return Drawn(cut, cells | _seen(instances, eye, cut, offsets, sizes))


def _seen(
    instances: Sequence[Instance],
    eye: Eye,
    cut: list[tuple[int, int]],
    offsets: list[np.ndarray],
    sizes: list[np.ndarray],
) -> dict[str, object]:
    offset = np.array([offsets[number][node] for number, node in cut]).reshape(-1, 3)
    pixels = np.array([sizes[number][node] for number, node in cut]) / eye.pixel
    level = [int(instances[number].nodes.level[node]) for number, node in cut]
    ahead = offset @ eye.ahead
    inside = (ahead > 0) & (abs(offset @ eye.right) <= eye.tan_x * ahead) & (abs(offset @ eye.up) <= eye.tan_y * ahead)
    seen = pixels[inside]
    # A splat is a disc of sqrt(8) standard deviations; its size is two of them. None covers more than the picture.
    area = np.minimum(math.pi * (math.sqrt(8) * seen / 2) ** 2, eye.width * eye.height)
    return {
        "in_frustum": int(inside.sum()),
        "outside": int(((ahead > 0) & ~inside).sum()),
        "behind": int((ahead <= 0).sum()),
        "level_min": min(level, default=None),
        "level_max": max(level, default=None),
        "level_mean": float(np.mean(level)) if level else None,
        "projected_px_p50": float(np.percentile(seen, 50)) if len(seen) else None,
        "projected_px_p95": float(np.percentile(seen, 95)) if len(seen) else None,
        "overdraw_estimate": float(area.sum()) / (eye.width * eye.height),
    }


def differing(cells: dict[str, object], row: dict[str, object]) -> list[str]:
    """Returns a text for each column in which a row differs; floats may differ by rounding."""
    wrong = []
    for name, value in cells.items():
        other = row[name]
        if isinstance(value, float) and isinstance(other, float):
            if not math.isclose(value, other, rel_tol=2e-5, abs_tol=1e-3):
                wrong.append(f"{name}: {value} but {other}")
        elif value != other:
            wrong.append(f"{name}: {value} but {other}")
    return wrong
