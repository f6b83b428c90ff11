"""Scenes for the benchmarks: real ones, and larger ones tiled from them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

import sparklod_cli as sparklod
from sparklod_cli import Splats

#: The first spherical harmonic, 1 / (2 * sqrt(pi)).
SH_C0 = 0.28209479177387814


def tiled(splats: Splats, count: int, seed: int = 0) -> Splats:
    """Tiles a scene: `count` splats of copies side by side on the ground, with jittered centres, in random order.

    The jitter, half the largest scale of each splat, keeps copies from falling into the same cells of the grid. The
    order is as random as in a trained scene, which is harder on memory than a sorted one.
    """
    rng = np.random.default_rng(seed)
    copies = math.ceil(count / len(splats))
    side = math.ceil(math.sqrt(copies))
    low, high = np.percentile(splats.center, [1, 99], axis=0)
    parts = []
    for copy in range(copies):
        offset = np.array([copy % side, 0, copy // side]) * (high - low)
        jitter = rng.normal(0, 0.5, splats.center.shape) * splats.scale.max(axis=1, keepdims=True)
        parts.append(dataclasses.replace(splats, center=(splats.center + offset + jitter).astype(np.float32)))
    return Splats.concat(parts).take(rng.permutation(copies * len(splats))[:count])


def ply_header(count: int, coefficients: int) -> bytes:
    """The header of a binary PLY as Inria's trainer writes it, but without normals.

    Args:
        count: of splats.
        coefficients: of SH above degree 0, of each colour.
    """
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(3 * coefficients))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {count}"])
    return (header + "".join(f"\nproperty float {name}" for name in names) + "\nend_header\n").encode()


def ply_rows(splats: Splats) -> bytes:
    """The rows of some splats behind a `ply_header`."""
    opacity = np.clip(splats.opacity, 1e-6, 1 - 1e-6)
    columns = [
        splats.center,
        (splats.rgb - 0.5) / SH_C0,
        splats.sh.transpose(0, 2, 1).reshape(len(splats), -1),
        np.log(opacity / (1 - opacity))[:, None],
        np.log(splats.scale),
        splats.quat_xyzw[:, [3, 0, 1, 2]],
    ]
    return np.concatenate(columns, axis=1).astype("<f4").tobytes()


def write_ply(path: Path, splats: Splats) -> None:
    """Writes a binary PLY."""
    with path.open("wb") as file:
        file.write(ply_header(len(splats), splats.sh.shape[1]))
        for start in range(0, len(splats), 1 << 18):
            file.write(ply_rows(splats.take(slice(start, start + (1 << 18)))))


def load(path: Path) -> Splats:
    """Reads the splats of a file that can be drawn: opacity and scale above 0."""
    splats = sparklod.read(path).splats
    return splats.take((splats.opacity > 0) & (splats.scale.max(axis=1) > 0))
