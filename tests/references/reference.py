"""Slow, obvious twins of the kernels, to test them against."""

from __future__ import annotations

import heapq
import math
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sparklod_cli.gaussian import MAX_OPACITY, MIN_OPACITY, THOMSEN_P
from sparklod_cli.lod.kernels.sight import CONE, FRUSTUM
from sparklod_cli.render.camera import Camera
from sparklod_cli.render.look import Look
from sparklod_cli.render.shown import Shown
from sparklod_cli.splats import Splats


def ellipsoid_area(scale: np.ndarray) -> np.ndarray:
    """Knud Thomsen's formula over (..., 3) semi-axes, as it is written down."""
    a, b, c = np.moveaxis(np.asarray(scale, np.float64), -1, 0)
    mean = ((a * b) ** THOMSEN_P + (a * c) ** THOMSEN_P + (b * c) ** THOMSEN_P) / 3
    return 4 * math.pi * mean ** (1 / THOMSEN_P)


def rotation_matrix(quat_xyzw: np.ndarray) -> np.ndarray:
    """(..., 3, 3) from (..., 4), by rotating the axes with the quaternion."""
    quat = np.asarray(quat_xyzw, np.float64)
    vector, w = quat[..., None, :3], quat[..., None, 3:]
    axes = np.broadcast_to(np.eye(3), (*quat.shape[:-1], 3, 3))
    turned = axes + 2 * np.cross(vector, np.cross(vector, axes) + w * axes)
    return np.swapaxes(turned, -1, -2)


def covariance(scale: np.ndarray, quat_xyzw: np.ndarray) -> np.ndarray:
    """(..., 3, 3) R S S^T R^T."""
    factor = rotation_matrix(quat_xyzw) * np.asarray(scale, np.float64)[..., None, :]
    return factor @ np.swapaxes(factor, -1, -2)


@dataclass
class Moments:
    """What a merged splat must have."""

    center: np.ndarray
    covariance: np.ndarray
    weight: float
    rgb: np.ndarray
    sh: np.ndarray


def merge(splats: Splats) -> Moments:
    """Moment matching with weights opacity * area."""
    weight = splats.opacity.astype(np.float64) * ellipsoid_area(splats.scale)
    share = weight / weight.sum()
    center = share @ splats.center.astype(np.float64)
    offset = splats.center - center
    spread = covariance(splats.scale, splats.quat_xyzw) + offset[:, :, None] * offset[:, None, :]
    return Moments(
        center,
        np.tensordot(share, spread, 1),
        weight.sum(),
        share @ splats.rgb.astype(np.float64),
        np.tensordot(share, splats.sh.astype(np.float64), 1),
    )


def opacity_of(weight: float, scale: np.ndarray) -> float:
    """Linear opacity of a merged splat of these scales."""
    return float(np.clip(weight / ellipsoid_area(scale), MIN_OPACITY, MAX_OPACITY))


def natural_level(scale: np.ndarray, base: float) -> int:
    """The smallest level whose step, base ** level, is not below 2 * max(scale)."""
    size = 2 * float(np.max(scale))
    level = math.ceil(math.log(size) / math.log(base))
    while base ** float(level - 1) >= size:
        level -= 1
    while base ** float(level) < size:
        level += 1
    return level


Tree = tuple  # a leaf is (splat index,), a merged node the sorted tuple of its children


def quick_tree(centers_of: dict, levels: list[int], base: float, merge_center) -> Tree:
    """The shape of the Quick-LoD tree, node by node with dictionaries.

    Args:
        centers_of: centre of each leaf (index,); merged nodes are added.
        levels: natural level of each splat.
        base: growth of the grid.
        merge_center: tells the centre of a merged node from the list of its children.
    """
    waiting = sorted(range(len(levels)), key=lambda i: levels[i])
    level, active = min(levels), []
    while True:
        while waiting and levels[waiting[0]] <= level:
            active.append((waiting.pop(0),))
        step = base ** float(level)
        cells: dict = {}
        for node in active:
            cells.setdefault(tuple(np.floor(centers_of[node].astype(np.float64) / step)), []).append(node)
        active = []
        for members in cells.values():
            active.append(_merged(members, centers_of, merge_center) if len(members) > 1 else members[0])
        spots = np.array([np.floor(centers_of[node].astype(np.float64) / step) for node in active])
        if not waiting and np.ptp(spots, axis=0).max() <= 1:
            return _merged(active, centers_of, merge_center) if len(active) > 1 else active[0]
        level += 1


def _merged(members: list, centers_of: dict, merge_center) -> Tree:
    node = tuple(sorted(members, key=str))
    centers_of[node] = merge_center(members)
    return node


@dataclass
class Walked:
    """What the links of a tree lead to, however broken they are."""

    parents: list[list[int]]  # the nodes that have each as a child
    depth: list[int]
    limit: list[float]


def links_of(child_count: np.ndarray, child_start: np.ndarray) -> list[range]:
    """The children of each node that there are."""
    starts, counts = child_start.tolist(), child_count.tolist()
    return [range(start, min(len(starts), start + count)) for start, count in zip(starts, counts, strict=True)]


def walk(child_count: np.ndarray, child_start: np.ndarray, size: np.ndarray) -> Walked:
    """Breadth first, with sets."""
    links = links_of(child_count, child_start)
    every = range(len(links))
    parents = [[node for node in every if child in links[node]] for child in every]
    depth, limit = {0: 0}, {0: float(size[0])}
    waiting = deque([0])
    while waiting:
        node = waiting.popleft()
        for child in links[node]:
            if child not in depth:
                depth[child], limit[child] = depth[node] + 1, min(limit[node], float(size[child]))
                waiting.append(child)
    return Walked(parents, [depth.get(node, -1) for node in every], [limit.get(node, 0.0) for node in every])


def on_cycles(parent: list[int], depth: list[int]) -> list[bool]:
    """Whether one who goes up from a node never comes to an end, nor to a node that has a depth."""
    found = []
    for node in range(len(parent)):
        seen: set[int] = set()
        while node >= 0 and depth[node] < 0 and node not in seen:
            seen.add(node)
            node = parent[node]
        found.append(node in seen)
    return found


def coarse_cut(child_count: np.ndarray, child_start: np.ndarray, size: np.ndarray, most: int) -> set[int]:
    """The cut of a tree that is left when the largest node is divided as long as the cut has no more than `most`."""
    links = links_of(child_count, child_start)
    heap = [(-float(size[0]), 0)]
    leaves: set[int] = set()
    while heap:
        _, node = heap[0]
        if links[node] and len(heap) + len(leaves) - 1 + len(links[node]) > most:
            break
        heapq.heappop(heap)
        if not links[node]:
            leaves.add(node)
        for child in links[node]:
            heapq.heappush(heap, (-float(size[child]), child))
    return leaves | {node for _, node in heap}


def pixel_scale(node: np.void, view: np.void) -> np.float32:
    """Size over distance, times the weights of the view; float32 after every operation."""
    with np.errstate(all="ignore"):
        x, y, z = (node[axis] - view[f"origin_{axis}"] for axis in "xyz")
        distance = np.sqrt(x * x + y * y + z * z)
        nearest = np.float32(1e-6)
        distance = distance if distance > nearest else nearest
        scale = node["size"] * (np.float32(1) / distance) * view["lod_scale"]
        if view["kind"] not in (CONE, FRUSTUM):
            return scale

        def along(axis: str) -> np.float32:
            return x * view[f"{axis}_x"] + y * view[f"{axis}_y"] + z * view[f"{axis}_z"]

        ahead, side, behind, inner, outer = along("forward"), *(view[n] for n in ("side", "behind", "inner", "outer"))
        one = np.float32(1)
        cosine = ahead * (one / distance)
        if ahead <= 0:
            weight = behind
        elif view["kind"] == FRUSTUM:
            seen = abs(along("right")) <= inner * ahead and abs(along("up")) <= outer * ahead
            weight = one if seen else side
        elif cosine >= inner:
            weight = one
        elif cosine >= outer:
            weight = side + (one - side) * ((cosine - outer) / (inner - outer))
        else:
            weight = behind + (side - behind) * (cosine / outer)
        return weight * scale


def bits_of(value: float) -> int:
    """A number >= 0 as bits, which order as numbers do; NaN counts as infinity."""
    value = np.float32(math.inf if np.isnan(value) else value)
    return int(value.view(np.uint32)) & 0x7FFFFFFF


def number_of(bits: int) -> float:
    return float(np.uint32(bits).view(np.float32))


@dataclass
class BudgetedCut:
    """What the queue drew; nodes are (instance, index), pixel scales are numbers."""

    limit: dict = field(default_factory=dict)  # of each node that is drawn: the least pixel scale from the root to it
    waiting: set = field(default_factory=set)  # nodes that are drawn because they still wait in the queue
    reason: str = ""
    missing: int = 0
    least: float = math.inf
    stop: tuple | None = None
    wanted: dict = field(default_factory=lambda: defaultdict(float))  # largest limit by chunk, of those wanted


def budgeted_cut(
    nodes: np.ndarray,
    views: np.ndarray,
    budget: int,
    smallest: float,
    is_resident: Callable[[int], bool],
    bits: int = 16,
) -> BudgetedCut:
    """One queue of the nodes of all instances: the one of the largest pixel scale is divided, as long as there is room.

    Args:
        nodes: of all trees; views: of the instances. As the kernel has them.
        budget: how many nodes may be drawn.
        smallest: nodes of this pixel scale or less are not divided.
        is_resident: whether a chunk, counted through all trees, is there.
        bits: a chunk has 2 ** bits nodes.
    """
    cut, heap, drawn = BudgetedCut(), [], {}

    def push(instance: int, index: int, limit: int) -> None:
        own = bits_of(pixel_scale(nodes[views[instance]["node_base"] + index], views[instance]))
        heapq.heappush(heap, (-own, -instance, -index, min(limit, own)))

    for instance, view in enumerate(views):
        if is_resident(int(view["chunk_base"])):
            push(instance, 0, bits_of(math.inf))
        else:
            cut.missing += 1
    small = False
    while heap:
        own, instance, index, limit = heap[0]
        own, instance, index = -own, -instance, -index
        view = views[instance]
        node = nodes[view["node_base"] + index]
        start, count = int(node["child_start"]), int(node["child_count"])
        if own <= bits_of(smallest):
            break
        chunks = {int(view["chunk_base"]) + (child >> bits) for child in range(start, start + count)}
        there = all(is_resident(chunk) for chunk in chunks)
        if count and there and len(drawn) + len(heap) - 1 + count > budget:
            cut.stop = number_of(own), instance, index
            break
        heapq.heappop(heap)
        for chunk in chunks:
            cut.wanted[chunk] = max(cut.wanted[chunk], number_of(limit))
        if count and there:
            cut.least = min(cut.least, number_of(limit))
            for child in range(start, start + count):
                push(instance, child, limit)
        else:
            drawn[instance, index] = limit
            cut.missing += count > 0
    for own, instance, index, limit in heap:
        node = nodes[views[-instance]["node_base"] - index]
        small |= -own <= bits_of(smallest) and bool(node["child_count"])
        drawn[-instance, -index] = limit
        cut.waiting.add((-instance, -index))
    cut.limit = {node: number_of(limit) for node, limit in drawn.items()}
    cut.reason = "budget" if cut.stop else "pixel" if small else "missing" if cut.missing else "exhausted"
    return cut


def spherical_harmonics(direction: np.ndarray, degree: int) -> list[float]:
    """Real spherical harmonics of degree 1 and above at a direction, with the sign of Condon and Shortley."""
    x, y, z = direction / np.linalg.norm(direction)
    azimuth, sine = math.atan2(y, x), math.hypot(x, y)
    found = []
    for at in range(1, degree + 1):
        for order in range(-at, at + 1):
            m = abs(order)
            norm = math.sqrt((2 * at + 1) / (4 * math.pi) * math.factorial(at - m) / math.factorial(at + m))
            legendre = (-sine) ** m * np.polynomial.legendre.Legendre.basis(at).deriv(m)(z)
            wave = 1 if not order else math.sqrt(2) * (math.cos if order > 0 else math.sin)(m * azimuth)
            found.append(float(norm * legendre * wave))
    return found


def seen_rgb(splats: Splats, eye: np.ndarray) -> np.ndarray:
    """(N, 3) colours of splats that are seen from a point."""
    degree = math.isqrt(splats.sh.shape[1] + 1) - 1
    seen = splats.rgb.astype(np.float64)
    for color, center, sh in zip(seen, splats.center, splats.sh, strict=True):
        color += np.array(spherical_harmonics(center - eye, degree)) @ sh if degree else 0
    return np.maximum(seen, 0)


@dataclass
class Drawn:
    """What `picture` drew.

    Attributes:
        rgba: (height, width, 4) float64, multiplied by alpha.
        unsure: (height, width) whether a splat ends so near to a pixel that float32 cannot tell if it is in or out.
    """

    rgba: np.ndarray
    unsure: np.ndarray


def picture(shown: Shown, camera: Camera, look: Look) -> Drawn:
    """Splats as Spark's shaders draw them, from far to near, each over the whole picture."""
    to_camera = np.linalg.inv(camera.camera_to_world)
    (fx, fy), (cx, cy), width, height = camera.focal, camera.principal, camera.width, camera.height
    centers = shown.center.astype(np.float64) @ to_camera[:3, :3].T + to_camera[:3, 3]
    turned = to_camera[:3, :3] @ covariance(shown.scale, shown.quat_xyzw) @ to_camera[:3, :3].T
    key = np.linalg.norm(centers, axis=1) if look.sort == "radial" else -centers[:, 2]
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    rgba, unsure = np.zeros((height, width, 4)), np.zeros((height, width), bool)
    for i in np.argsort(-key, kind="stable"):
        (x, y, z), d = centers[i], min(float(shown.lod_opacity[i]), 5)
        if not look.near < -z < look.far or not d >= 0.5 / 255:
            continue
        middle = np.array([cx - fx * x / z, cy + fy * y / z])
        if (abs(middle / (width, height) - 0.5) > 1.4 / 2).any():
            continue
        jacobian = np.array([[-fx / z, 0, fx * x / z**2], [0, fy / z, -fy * y / z**2]])
        flat = jacobian @ turned[i] @ jacobian.T
        blurred = flat + 0.3 * np.eye(2)
        strength = d * math.sqrt(max(np.linalg.det(flat) / np.linalg.det(blurred), 0))
        deviations = 8**0.5 + 0.7 * max(d - 1, 0)
        sizes, axes = np.linalg.eigh(blurred)
        reach = np.minimum(deviations * np.sqrt(sizes), 512)
        z2 = (((pixels - middle) @ axes * (deviations / reach)) ** 2).sum(axis=-1)
        alpha = _falloff(z2, strength, look.profile)
        inside = z2 <= deviations**2
        unsure |= abs(z2 / deviations**2 - 1) < 2e-4
        unsure |= inside & (min(abs(strength * 255 - 0.5), 1) < 0.01)
        unsure |= inside & (abs(alpha * 255 - 0.5) < 0.01)
        alpha = np.where(inside & (alpha >= 0.5 / 255) & (strength >= 0.5 / 255), alpha, 0)[..., None]
        rgba = np.minimum(alpha * [*shown.rgb[i].astype(np.float64), 1], 1) + (1 - alpha) * rgba
    return Drawn(rgba, unsure)


def _falloff(z2: np.ndarray, d: float, profile: str) -> np.ndarray:
    if d <= 1:
        return d * np.exp(-z2 / 2)
    if profile == "shifted":
        return np.exp(-d / 2 * np.maximum(np.sqrt(z2) - (d - 1), 0) ** 2)
    return 1 - (1 - np.exp(-z2 / 2)) ** math.exp((d * d - 1) / math.e)
