"""Splats that are more than opaque as ones of opacity 1."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sparklod_cli.lod.plain_opacity import with_plain_opacity
from tests.scenes import random_splats


@pytest.mark.parametrize("opacity", [1.0, 1.01, 1.7, 3.0, 20.0, 1000.0])
def test_a_plain_splat_covers_as_much(opacity: float) -> None:
    splats = random_splats(2, seed=1)
    merged = dataclasses.replace(splats, opacity=np.array([opacity, 0.5], np.float32))
    plain = with_plain_opacity(merged)
    assert plain.opacity.tolist() == [1.0, 0.5]
    z = np.linspace(0, 40, 200_001)
    covered = np.trapezoid(z * (1 - (1 - np.exp(-(z**2) / 2)) ** opacity), z)
    times = plain.scale[0] / merged.scale[0]
    np.testing.assert_allclose(times, times[0], rtol=1e-6)
    np.testing.assert_allclose(np.trapezoid(z * np.exp(-(z**2) / (2 * float(times[0]) ** 2)), z), covered, rtol=1e-5)
    assert plain.scale[1].tolist() == merged.scale[1].tolist()
    for name in ("center", "quat_xyzw", "rgb", "sh"):
        assert getattr(plain, name) is getattr(merged, name)


def test_splats_that_are_at_most_opaque_stay() -> None:
    splats = random_splats(50, seed=2)
    assert with_plain_opacity(splats) is splats
