"""Eigenvalues and axes of covariances, against numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.lod.kernels.geometry import CONVERGED, ROWS, decompose
from tests.references import gaussians


def matrices() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]

    def of(*values: object) -> np.ndarray:
        diagonal = np.stack([np.broadcast_to(value, 200) for value in values], axis=1)
        return np.einsum("nij,nj,nkj->nik", turn, diagonal, turn)

    return {
        "any": of(*np.exp(rng.normal(-8, 3, (3, 200)))),
        "spherical": of(1, 1, 1),
        "almost spherical": of(1, 1 + 1e-9, 1 - 1e-9),
        "flat": of(1, 0.5, 0),
        "disc": of(1, 1, 1e-12),
        "needle": of(1, 0, 0),
        "tiny": of(1e-60, 2e-60, 3e-60),
        "huge": of(1e70, 1e69, 1e60),
        "diagonal": np.tile(np.diag([3.0, 1.0, 2.0]), (200, 1, 1)),
        "nothing": np.zeros((200, 3, 3)),
    }


@pytest.mark.parametrize("name", matrices())
def test_eigenvalues_and_axes_make_the_matrix_again(name: str) -> None:
    matrix = matrices()[name]
    work = np.full((ROWS, len(matrix) + 3), np.nan)
    for row, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        work[row, : len(matrix)] = matrix[:, i, j]
    decompose(work, len(matrix))
    values, quat = work[:3, : len(matrix)].T, work[6:10, : len(matrix)].T
    assert np.allclose(np.linalg.norm(quat, axis=1), 1)
    rotation = gaussians.rotation_matrix(quat)
    assert np.allclose(np.linalg.det(rotation), 1)
    size = np.abs(matrix).max()
    bound = 3 * CONVERGED**0.5  # what is left beside the diagonal, in the worst case of equal eigenvalues
    again = np.einsum("nij,nj,nkj->nik", rotation, values, rotation)
    assert np.abs(again - matrix).max() <= bound * size
    assert np.abs(np.sort(values) - np.linalg.eigvalsh(matrix)).max() <= bound * size
    assert np.isnan(work[:, len(matrix) :]).all()  # columns beyond the count are left alone


def test_the_matrices_beside_it_do_not_change_a_bit_of_a_matrix() -> None:
    matrix = np.concatenate(list(matrices().values()))
    rows = np.zeros((ROWS, len(matrix)))
    rows[:6] = [matrix[:, i, j] for i, j in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]]
    together = rows.copy()
    decompose(together, len(matrix))
    for i in range(len(matrix)):
        alone = rows[:, i : i + 1].copy()
        decompose(alone, 1)
        assert alone.tobytes() == together[:, i].tobytes()
