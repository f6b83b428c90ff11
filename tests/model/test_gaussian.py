"""Formulas that numpy and kernels share."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.lod.kernels import geometry
from sparklod_cli.model import gaussian
from sparklod_cli.render.kernels import ellipse, project
from tests.scenes import random_splats

QUATS = random_splats(50, seed=4).quat_xyzw


def rotated(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """q v q*, by Hamilton's product, in float64."""
    axis, w = quat[:3].astype(np.float64), float(quat[3])
    return vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)


def test_a_rotation_matrix_turns_vectors_as_its_quaternion_does() -> None:
    matrices = gaussian.rotation_matrices(QUATS)
    for i, quat in enumerate(QUATS):
        for column, unit in enumerate(np.eye(3)):
            np.testing.assert_allclose(matrices[:, column, i], rotated(quat, unit), atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "kernel"), [(np.float32, ellipse.rotation_matrix), (np.float64, geometry.rotation_matrix)]
)
def test_kernels_have_the_rotation_matrix_of_numpy_bit_for_bit(kind: type, kernel) -> None:  # type: ignore[no-untyped-def]
    quats = QUATS.astype(kind)
    expected = np.array(gaussian.rotation_matrix(*quats.T, kind(1)), kind)
    for i, quat in enumerate(quats):
        found = kernel(*quat, kind(1))
        assert np.array_equal(np.array(found, kind), expected[:, i])


def test_kernels_have_the_opacities_of_numpy() -> None:
    opacity = np.geomspace(1.001, 1000, 200, dtype=np.float32)
    d = gaussian.lod_opacity(opacity)
    one, e = np.float32(1), np.float32(np.e)
    back = [project.linear_opacity_above_1(value, one, e) for value in d]
    np.testing.assert_allclose(back, gaussian.linear_opacity(d), rtol=1e-6)
    found = [geometry.lod_opacity_above_1(float(value), 1.0, np.e) for value in opacity]
    np.testing.assert_allclose(found, d, rtol=1e-6)


@pytest.mark.filterwarnings("error")
def test_sizes_of_splats_that_are_not_finite_are_no_warning() -> None:
    splats = random_splats(3)
    splats.scale[:2] = [[np.inf, -np.inf, 1], [3e38, 3e38, 3e38]]
    assert np.isfinite(gaussian.spark_size(splats)).tolist() == [False, False, True]
