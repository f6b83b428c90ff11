"""Number codings of SOG: each decoder's largest error, and what is written again stays the same."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.codecs.sog import codings
from sparklod_cli.model.gaussian import normalized_quat
from tests.codecs.test_quantize import rotation_degrees, stated_degrees
from tests.references.sog_quats import decode_quat


def quats() -> np.ndarray:
    rng = np.random.default_rng(3)
    some = rng.normal(size=(20_000, 4)).astype(np.float32)
    axes = np.concatenate([np.eye(4), -np.eye(4)]).astype(np.float32)
    halves = np.array([[a, b, c, d] for a in (1, -1) for b in (1, -1) for c in (1, -1) for d in (1, -1)], np.float32)
    return np.ascontiguousarray(normalized_quat(np.concatenate([some, axes, halves])))


def test_rotations_come_back_within_the_stated_error() -> None:
    given = quats()
    back = decode_quat(codings.encode_quat(given))
    assert rotation_degrees(back, given).max() <= stated_degrees(codings.quat_components)


def test_a_rotation_and_its_opposite_have_the_same_code() -> None:
    np.testing.assert_array_equal(codings.encode_quat(quats()), codings.encode_quat(-quats()))


@pytest.mark.parametrize("ends", [(-2.0, 3.0), (0.0, 1e-30), (-3e38, 3e38), (1e6, 1e6)])
def test_coordinates_come_back_within_half_a_step(ends: tuple[float, float]) -> None:
    center = np.random.default_rng(4).uniform(-1, 1, (5000, 3))
    center = ((center + 1) / 2 * (ends[1] / 2 - ends[0] / 2) * 2 + ends[0]).astype(np.float32)
    low, high = codings.sign_log(center.min(axis=0)), codings.sign_log(center.max(axis=0))
    words = codings.encode_center(center, low, high)
    table = codings.center_table(low, high)
    back = np.stack([table[axis][words[:, axis]] for axis in range(3)], axis=1)
    off = np.abs(codings.sign_log(back) - codings.sign_log(center))
    half = (high - low) / codings.LAST_WORD / 2
    assert (off <= half * 1.001 + 1e-7 * np.abs(codings.sign_log(center))).all()
    np.testing.assert_array_equal(codings.encode_center(back, low, high), words)
    np.testing.assert_array_equal(back.min(axis=0), center.min(axis=0))
    np.testing.assert_array_equal(back.max(axis=0), center.max(axis=0))
