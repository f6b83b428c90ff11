"""Scenes of any size for `bench_scale.py`, written piece by piece, for they may be larger than memory."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
from scenes import ply_header, ply_rows

from sparklod_cli import Splats

#: Splats that are made at a time.
BLOCK = 1 << 18


def write_tiled(path: Path, splats: Splats, count: int, seed: int = 0) -> None:
    """Writes a binary PLY of `count` splats of copies of a scene, side by side on the ground, in random order.

    Each is a random splat of a random copy, moved by half its largest scale, so that no two are the same. The order is
    as random as in a trained scene, and harder on whatever works block by block than that of tiles one after the other.
    """
    copies = math.ceil(count / len(splats))
    side = math.ceil(math.sqrt(copies))
    low, high = np.percentile(splats.center, [1, 99], axis=0)
    with path.open("wb") as file:
        file.write(ply_header(count, splats.sh.shape[1]))
        for start in range(0, count, BLOCK):
            rng = np.random.default_rng([seed, start])
            size = min(BLOCK, count - start)
            copy, some = rng.integers(copies, size=size), splats.take(rng.integers(len(splats), size=size))
            offset = np.stack([copy % side, np.zeros(size), copy // side], axis=1) * (high - low)
            jitter = rng.normal(0, 0.5, (size, 3)) * some.scale.max(axis=1, keepdims=True)
            file.write(ply_rows(dataclasses.replace(some, center=(some.center + offset + jitter).astype(np.float32))))


def bytes_of(count: int, sh_degree: int) -> int:
    """Size of such a file."""
    coefficients = (sh_degree + 1) ** 2 - 1
    return len(ply_header(count, coefficients)) + count * 4 * (14 + 3 * coefficients)
