"""Palettes by brute force, k-means as it is in books; and rotations of SOG."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs import quantize
from sparklod_cli.codecs.sog_images import FIRST_TAG


def distances(rows: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """(N, C) squared distances: |r| ** 2 - 2 r c + |c| ** 2."""
    rows, codes = rows.astype(np.float64), codes.astype(np.float64)
    squares = (rows**2).sum(axis=1)[:, None] - 2 * rows @ codes.T + (codes**2).sum(axis=1)
    return np.maximum(squares, 0)


def squared_error(rows: np.ndarray, codes: np.ndarray, weight: np.ndarray) -> float:
    """The weighted sum of the squared distances of rows to their nearest codes."""
    return float((weight * distances(rows, codes).min(axis=1)).sum())


def k_means(rows: np.ndarray, count: int, weight: np.ndarray, rounds: int, seed: int) -> np.ndarray:
    """(count, D) codes of Lloyd's algorithm, from random rows; a code without rows stays where it is."""
    codes = rows[np.random.default_rng(seed).choice(len(rows), count, replace=False)].astype(np.float64)
    for _ in range(rounds):
        labels = distances(rows, codes).argmin(axis=1)
        for code in range(count):
            of_code = labels == code
            if of_code.any():
                codes[code] = np.average(rows[of_code], axis=0, weights=weight[of_code])
    return codes


def halved(rows: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Which rows are in the second half of a cell, of the two whichever holds the first row, and the error of both.

    The cell is cut across its principal axis, between the means of the halves along it.
    """
    away = rows - np.average(rows, axis=0, weights=weight)
    axis = np.linalg.eigh(np.cov(rows.T, aweights=weight, ddof=0))[1][:, -1]
    place, threshold = away @ axis, 0.0
    for _ in range(20):
        above = place > threshold
        threshold = (
            np.average(place[above], weights=weight[above]) + np.average(place[~above], weights=weight[~above])
        ) / 2
    parts = [(rows[part], weight[part]) for part in (~above, above)]
    errors = [squared_error(part, np.average(part, axis=0, weights=w)[None], w) for part, w in parts]
    return above == above[0], (errors[0], errors[1])


def decode_quat(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(N, 4) bytes to (N, 4) unit quaternions x y z w; one without a tag gives NaN."""
    others = [(codes[:, k].astype(np.float32) / np.float32(127.5) - 1) * np.float32(np.sqrt(0.5)) for k in range(3)]
    tag = codes[:, 3]
    quat = quantize.quat_of_others(tag.astype(np.int16) - FIRST_TAG, *others)[:, [1, 2, 3, 0]]
    quat[tag < FIRST_TAG] = np.nan
    return quat
