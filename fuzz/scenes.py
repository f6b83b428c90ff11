"""Scenes of extreme values, and trees of odd shapes."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fixtures import by_hand

from .case import Rng
from .mutate import FLOATS, pick

Columns = dict[str, NDArray[Any]]

#: Spread of the centres, in world units; SPZ holds coordinates up to 8,388,607.
EXTENTS = (0.0, 1e-30, 1e-6, 1e-3, 1.0, 1.0, 1.0, 100.0, 1e4, 1e6, 8.3e6, 8388607.0)

#: Mean of the natural logarithm of the scales; exp(88) is near the largest float32.
LOG_SCALES = (-100.0, -40.0, -20.0, -10.0, -4.0, -4.0, -4.0, 0.0, 5.0, 10.0, 40.0, 88.0)

#: Standard deviation of log scales and of logits.
SPREADS = (0.0, 0.5, 0.5, 3.0, 20.0)


def extreme(rng: Rng, extents: Sequence[float] = EXTENTS) -> Columns:
    """Makes columns for `by_hand.ply_columns` of 1 to 200 splats with extreme values.

    Args:
        rng: the case's random generator.
        extents: spreads of the centres to choose from, in world units.
    """
    count = int(pick(rng, (1, 2, 3, 5, 17, 60, 200)))
    sh = int(pick(rng, (0, 0, 3, 8, 15)))
    center: NDArray[np.float64] = rng.normal(size=(count, 3)) * pick(rng, extents)
    layout = int(rng.integers(7))
    if layout == 0:
        center[:, int(rng.integers(3))] = pick(rng, extents)
    elif layout == 1:
        center[:] = center[0]
    elif layout == 2:
        center[:] = rng.integers(-1, 2, (count, 3)) * pick(rng, extents)
    elif layout == 3:
        center[: count // 2] *= 1e-6
    values = {
        "center": np.clip(center, -max(extents), max(extents)),
        "log_scale": pick(rng, LOG_SCALES) + pick(rng, SPREADS) * rng.normal(size=(count, 3)),
        "quat_wxyz": rng.normal(size=(count, 4)) * pick(rng, (1.0, 1.0, 1e-30, 1e30)),
        "logit": pick(rng, (0.0, 3.0, -10.0, 100.0, -80.0)) + pick(rng, SPREADS) * rng.normal(size=count),
        "dc": pick(rng, (1.0, 1.0, 0.0, 1e3, 1e30)) * rng.normal(size=(count, 3)),
        "sh": pick(rng, (0.2, 0.2, 0.0, 100.0)) * rng.normal(size=(count, sh, 3)),
    }
    if rng.integers(3) == 0:
        name = pick(rng, list(values))
        flat = values[name].reshape(-1)
        if len(flat):
            flat[rng.integers(len(flat), size=int(rng.integers(1, 4)))] = pick(rng, FLOATS)
    return values


def ply_of(columns: Columns) -> bytes:
    """Writes columns as a PLY file."""
    with np.errstate(all="ignore"):
        return by_hand.ply(by_hand.ply_columns(**columns))


def splat_of(columns: Columns) -> bytes:
    """Writes columns as a .splat file, in which some linear scales are negative."""
    rows = np.zeros(len(columns["center"]), [("center", "<f4", 3), ("scale", "<f4", 3), ("bytes", "u1", 8)])
    with np.errstate(all="ignore"):
        rows["center"], rows["scale"] = columns["center"], np.exp(columns["log_scale"].astype(np.float32))
        rows["scale"] *= np.sign(columns["dc"] + 2.5)
        parts = np.concatenate([columns["dc"], columns["logit"][:, None], columns["quat_wxyz"]], axis=1)
        rows["bytes"] = np.clip(np.nan_to_num(parts) * 60 + 128, 0, 255)
    return rows.tobytes()


#: The child columns of a tree: child_count and child_start of each node.
ChildColumns = tuple[NDArray[np.int64], NDArray[np.int64]]


def child_columns(rng: Rng, kind: str, count: int) -> ChildColumns:
    """Makes a tree of about `count` nodes.

    Args:
        rng: the case's random generator.
        kind: "chain", "star", "pairs", "broom" (a chain that ends in a star), "shuffled" (children of nodes in any
            order) or "any".
        count: number of nodes.
    """
    fan_out = {"chain": [1], "star": [count - 1], "pairs": [2], "broom": [1] * (count // 2) + [count]}.get(
        kind, rng.choice([0, 1, 2, 2, 3, 8, 40], 50).tolist()
    )
    counts, starts, waiting, at = [0], [0], [0], 0
    while waiting and len(counts) < count:
        node = waiting.pop(int(rng.integers(len(waiting))) if kind == "shuffled" else 0)
        children = min(fan_out[at % len(fan_out)] or int(not waiting), count - len(counts), 65535)
        at += 1
        if children:
            counts[node], starts[node] = children, len(counts)
            waiting += range(len(counts), len(counts) + children)
            counts += [0] * children
            starts += [0] * children
    return np.array(counts), np.array(starts)


def broken(rng: Rng, tree: ChildColumns) -> ChildColumns:
    """Breaks a tree: children that are ancestors, shared, past the end, or missing."""
    counts, starts = tree[0].copy(), tree[1].copy()
    for _ in range(int(rng.integers(1, 4))):
        node, other = rng.integers(len(counts), size=2)
        kind = int(rng.integers(6))
        if kind == 0:
            counts[node], starts[node] = counts[other], starts[other]
        elif kind == 1:
            starts[node] = pick(rng, (0, 1, node, max(0, node - 1), other, len(counts), 65536, 2**31, 2**32 - 1))
        elif kind == 2:
            counts[node] = pick(rng, (0, 1, 2, len(counts), 65535))
        elif kind == 3:
            counts[node], starts[node] = 1, node
        elif kind == 4:
            counts[node], starts[node] = 0, other
        else:
            counts[node], starts[node] = 65535, pick(rng, (0, 1, len(counts) - 1))
    return np.clip(counts, 0, 65535), starts


def node_streams(rng: Rng, tree: ChildColumns, *, plain: bool) -> list[bytes]:
    """Makes the streams of an SPZ file of version 3 or 4 with a tree.

    Args:
        rng: the case's random generator.
        tree: its child columns.
        plain: True for centres, alphas and scales of a plausible tree, False for random bytes.
    """
    counts, starts = tree
    number = len(counts)
    if plain:
        scales = np.repeat(np.linspace(190, 90, number).astype(np.uint8), 3).tobytes()
        centers = b"".join(by_hand.fixed24(rng.normal(size=3), 12) for _ in range(min(number, 50)))
        centers = (centers * -(-number // 50))[: 9 * number].ljust(9 * number, b"\0")
        alphas = np.where(counts > 0, 160, 100).astype(np.uint8).tobytes()
    else:
        scales, centers, alphas = rng.bytes(3 * number), rng.bytes(9 * number), rng.bytes(number)
    return [
        *(centers, alphas, rng.bytes(3 * number), scales, struct.pack("<I", 3 << 30) * number),
        *(counts.astype("<u2").tobytes(), starts.astype("<u4").tobytes()),
    ]
