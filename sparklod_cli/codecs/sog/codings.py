"""The number codings of SOG as pairs of encode and decode; each decode states its largest error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...model.splats import FloatArray
from .. import quantize

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Wide = NDArray[np.float64]

#: Entries in a row of the image of SH centroids.
PALETTE_WIDTH = 64

#: Largest word of a coordinate.
LAST_WORD = 0xFFFF

#: Alpha of a rotation's texel minus the index, in w x y z, of the largest component.
FIRST_TAG = 252


def sign_log(values: FloatArray) -> Wide:
    """sign(x) * log(1 + abs(x)) of coordinates, in float64."""
    wide = values.astype(np.float64)
    return np.copysign(np.log1p(np.abs(wide)), wide)


def encode_center(center: FloatArray, low: Wide, high: Wide) -> Words:
    """(N, 3) coordinates to words in equal steps of `sign_log`, of which (3,) `low` and `high` are the ends."""
    words = np.empty(center.shape, np.uint16)
    for axis, extent in enumerate(high - low):
        steps = LAST_WORD / extent if extent > 0 else 0.0
        words[:, axis] = np.rint((sign_log(center[:, axis]) - low[axis]) * steps)
    return words


def center_table(low: Wide, high: Wide) -> FloatArray:
    """(3, 65536) coordinates of each word, between (3,) ends of `sign_log`.

    Largest error: half a step of `sign_log`, of (high - low) / 65535.
    """
    logs = quantize.range_table(low, high, LAST_WORD + 1)
    with np.errstate(over="ignore"):
        return np.copysign(np.expm1(np.abs(logs)), logs).astype(np.float32, order="C")


def encode_quat(quat_xyzw: FloatArray) -> Bytes:
    """(N, 4) unit quaternions to (N, 4) bytes: all components but the largest, in the order w x y z, and its tag."""
    wxyz = quat_xyzw[:, [3, 0, 1, 2]]
    largest = np.abs(wxyz).argmax(axis=1)[:, None]
    flip = np.where(np.take_along_axis(wxyz, largest, axis=1) < 0, np.float32(-1), np.float32(1))
    others = np.take_along_axis(wxyz, quantize.OTHERS[largest[:, 0]], axis=1) * flip
    codes = np.empty((len(wxyz), 4), np.uint8)
    codes[:, :3] = np.clip(np.rint(others * np.float32(127.5 * np.sqrt(2)) + np.float32(127.5)), 0, 255)
    codes[:, 3] = largest[:, 0] + FIRST_TAG
    return codes


def quat_components() -> FloatArray:
    """(256,) components of a rotation by their bytes, for `texels.fill_quats`.

    Largest error: 1.1 degrees of rotation.
    """
    return (np.arange(256, dtype=np.float32) / np.float32(127.5) - 1) * np.float32(np.sqrt(0.5))
