"""Rotations of SOG, decoded with numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs import quantize
from sparklod_cli.codecs.sog_images import FIRST_TAG


def decode_quat(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(N, 4) bytes to (N, 4) unit quaternions x y z w; one without a tag gives NaN."""
    others = [(codes[:, k].astype(np.float32) / np.float32(127.5) - 1) * np.float32(np.sqrt(0.5)) for k in range(3)]
    tag = codes[:, 3]
    quat = quantize.quat_of_others(tag.astype(np.int16) - FIRST_TAG, *others)[:, [1, 2, 3, 0]]
    quat[tag < FIRST_TAG] = np.nan
    return quat
