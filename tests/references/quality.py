"""Slow, obvious twins of the quality builder's kernels."""

from __future__ import annotations

import math

import numpy as np

from sparklod_cli.lod.kernels import prune
from sparklod_cli.lod.kernels.pair_merge import (
    CENTER,
    COLOR,
    COLOR_COST,
    COVARIANCE,
    COVERED,
    DENSITY,
    LOG_DET,
    WEIGHT,
    WIDTH,
)
from sparklod_cli.model.lod_tree import MAX_CHILDREN
from tests.references import gaussians

#: Where the elements of a covariance are in a node row.
ELEMENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def row(
    center: np.ndarray, covariance: np.ndarray, density: float = 1.0, color: tuple[float, ...] = (0.5, 0.5, 0.5)
) -> np.ndarray:
    """A node row."""
    filled = np.empty(WIDTH, np.float32)
    filled[CENTER : CENTER + 3] = center
    filled[COVARIANCE : COVARIANCE + 6] = [covariance[i, j] for i, j in ELEMENTS]
    filled[COLOR : COLOR + 3] = color
    filled[LOG_DET] = np.linalg.slogdet(covariance)[1]
    filled[DENSITY] = density
    filled[COVERED] = filled[WEIGHT] = density * gaussians.ellipsoid_area(np.sqrt(np.linalg.eigvalsh(covariance)))
    return filled


def matrix(row: np.ndarray) -> np.ndarray:
    """The covariance of a node row."""
    full = np.empty((3, 3))
    for element, (i, j) in enumerate(ELEMENTS):
        full[i, j] = full[j, i] = row[COVARIANCE + element]
    return full


def random_rows(count: int, seed: int, spread: float = 2.0) -> np.ndarray:
    """Node rows whose covariances are well conditioned."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    variance = np.exp(rng.normal(0, 1, (count, 3)))
    return np.array(
        [
            row(rng.normal(0, spread, 3), (turn[i] * variance[i]) @ turn[i].T, density, tuple(rng.uniform(0, 1, 3)))
            for i, density in enumerate(rng.uniform(0.05, 1.5, count))
        ],
        np.float32,
    ).reshape(count, WIDTH)


def joint_covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the covariance of two rows together, weighted by what each covers."""
    share = float(a[COVERED]) / (float(a[COVERED]) + float(b[COVERED]))
    offset = (b[CENTER : CENTER + 3] - a[CENTER : CENTER + 3]).astype(np.float64)
    return share * matrix(a) + (1 - share) * matrix(b) + share * (1 - share) * np.outer(offset, offset)


def merge_cost(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the cost of a pair: Runnalls' bound times what both cover, plus Ward's variance of colour."""
    wa, wb = float(a[COVERED]), float(b[COVERED])
    logs = [np.linalg.slogdet(one)[1] for one in (joint_covariance(a, b), matrix(a), matrix(b))]
    shape = ((wa + wb) * logs[0] - wa * logs[1] - wb * logs[2]) / 2
    color = a[COLOR : COLOR + 3].astype(np.float64) - b[COLOR : COLOR + 3]
    return float(shape + float(COLOR_COST) * wa * wb / (wa + wb) * (color @ color))


def costs(rows: np.ndarray, window: int, largest: float) -> np.ndarray:
    """(n, n) of all pairs in the window that are small enough, infinite for others."""
    cost = np.full((len(rows), len(rows)), np.inf)
    for i in range(len(rows)):
        for j in range(i + 1, min(len(rows), i + window + 1)):
            if np.trace(joint_covariance(rows[i], rows[j])) <= largest:
                cost[i, j] = cost[j, i] = merge_cost(rows[i], rows[j])
    return cost


def gaussian_on_plane(row: np.ndarray, axes: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Evaluates the Gaussian of a row, of height 1, at (..., 2) points of a plane."""
    inverse = np.linalg.inv(matrix(row)[np.ix_(axes, axes)])
    offset = points - row[[CENTER + axis for axis in axes]].astype(np.float64)
    return np.exp(-0.5 * np.einsum("...i,ij,...j->...", offset, inverse, offset))


def integrals(a: np.ndarray, b: np.ndarray, axes: tuple[int, int]) -> tuple[float, float, float]:
    """Integrates over a plane the product of two Gaussians, and each of them."""
    both = (a, b)
    reach = [8 * math.sqrt(np.diag(matrix(row)).max()) for row in both]
    middle = [row[[CENTER + axis for axis in axes]].astype(np.float64) for row in both]
    low = np.min([m - r for m, r in zip(middle, reach, strict=True)], axis=0)
    high = np.max([m + r for m, r in zip(middle, reach, strict=True)], axis=0)
    x, y = (np.linspace(low[k], high[k], 500) for k in range(2))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    cell = (x[1] - x[0]) * (y[1] - y[0])
    fa, fb = (gaussian_on_plane(row, axes, points) for row in both)
    return (fa * fb).sum() * cell, fa.sum() * cell, fb.sum() * cell


def moments_of_profile(a: float) -> tuple[float, float]:
    """Returns coverage / 2 pi, and variance along an axis, of the profile of opacity A with sigma 1.

    The profile is 1 - (1 - exp(-t)) ** A for A above 1, and A * exp(-t) up to 1.
    """
    t = (np.arange(400_000) + 0.5) * (60 / 400_000)
    opacity = 1 - (1 - np.exp(-t)) ** a if a > 1 else a * np.exp(-t)
    coverage = opacity.sum() * (t[1] - t[0])
    return coverage, (t * opacity).sum() * (t[1] - t[0]) / coverage


def drop_nodes(
    leaves: int,
    most: int,
    parent: np.ndarray,
    log_size: np.ndarray,
    lost: np.ndarray,
    weight: np.ndarray,
    saved: np.ndarray,
) -> None:
    """As `lod.quality.drop_nodes`."""
    root = len(parent) - 1 - leaves
    left, turn, children = root + 1, prune.ROUNDS, prune.MOST_CHILDREN

    def above(node: int) -> int:
        return int(parent[node + leaves]) - leaves

    def is_candidate(node: int) -> bool:
        return bool(saved[node] > 0 and saved[above(node)] + saved[node] < children)

    def key(node: int) -> int:
        span = log_size[parent[node + leaves]] - log_size[node + leaves]
        span = prune.UNKNOWN_SPAN if span > prune.ABOVE_ALL / 2 else span
        useful = span * (np.float32(saved[node]) - lost[node]) * weight[node]
        return int(prune.usefulness_key(np.float32(useful)))

    while left > most:
        keys = sorted(key(node) for node in range(root) if is_candidate(node))
        if not keys:
            if children == MAX_CHILDREN:
                return
            children = min(2 * children, MAX_CHILDREN)
            continue
        threshold = keys[min(max((left - most) // turn, 1), len(keys)) - 1]
        for node in range(root):
            if left > most and is_candidate(node) and key(node) <= threshold:
                saved[above(node)] += saved[node]
                lost[above(node)] += lost[node]
                saved[node], left = -1, left - 1
        for any_node in range(len(parent) - 2, -1, -1):
            if saved[parent[any_node] - leaves] == -1:
                parent[any_node] = parent[parent[any_node]]
        turn = max(turn - 1, 1)
