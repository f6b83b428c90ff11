"""Smooth curves through given points."""

from __future__ import annotations

import numpy as np

from .camera import Matrix

#: Smallest step between knots as a share of the mean step, so that no step takes no time.
SHORTEST = 1e-3


def centripetal_knots(points: Matrix) -> Matrix:
    """(n,) knots from 0 on that differ by the square roots of the distances between points.

    Args:
        points: (n, D), n at least 2. If all are the same, the steps are 1.
    """
    with np.errstate(over="ignore"):
        steps = np.sqrt(np.linalg.norm(np.diff(points, axis=0), axis=1))
    steps = np.maximum(steps, SHORTEST * steps.mean()) if steps.any() else np.ones(len(steps))
    return np.concatenate([[0.0], np.cumsum(steps)])


def catmull_rom_tangents(knots: Matrix, points: Matrix) -> Matrix:
    """(n, D) tangents of the Catmull-Rom spline with arbitrary knots (Barry and Goldman 1988).

    Each is the tangent of the parabola through a point and its neighbours; at the ends, through the last three points.

    Args:
        knots: (n,) increasing, n at least 2.
        points: (n, D).
    """
    steps = np.diff(knots)[:, None]
    slopes = np.diff(points, axis=0) / steps
    if len(points) == 2:
        return np.repeat(slopes, 2, axis=0)
    inner = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[:-1] + steps[1:])
    return np.concatenate([2 * slopes[:1] - inner[:1], inner, 2 * slopes[-1:] - inner[-1:]])


def cardinal_tangents(knots: Matrix, points: Matrix) -> Matrix:
    """(n, D) tangents along the line from the previous to the next point, as SuperSplat has them.

    Args:
        knots: (n,) increasing, n at least 2.
        points: (n, D).
    """
    slopes = np.diff(points, axis=0) / np.diff(knots)[:, None]
    inner = (points[2:] - points[:-2]) / (knots[2:] - knots[:-2])[:, None]
    return np.concatenate([slopes[:1], inner, slopes[-1:]])


def hermite(knots: Matrix, points: Matrix, tangents: Matrix, at: Matrix) -> Matrix:
    """(m, D) points of the piecewise cubic curve with these points and tangents at the knots.

    Args:
        knots: (n,) increasing, n at least 2.
        points: (n, D).
        tangents: (n, D) derivatives by the parameter.
        at: (m,) parameters between the first and the last knot.
    """
    piece = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    step = np.diff(knots)[piece, None]
    t = (at[:, None] - knots[piece, None]) / step
    return (
        (1 + 2 * t) * (1 - t) ** 2 * points[piece]
        + t * (1 - t) ** 2 * step * tangents[piece]
        + t * t * (3 - 2 * t) * points[piece + 1]
        + t * t * (t - 1) * step * tangents[piece + 1]
    )
