"""The data texture against a slow twin that follows the viewer splat by splat, and the largest error of every field."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs.gpu import data_texture
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.threads import BLOCK_ROWS
from tests.references import gaussians
from tests.scenes import random_splats

ROWS, COLUMNS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]


def splats_with(count: int, **columns: Any) -> Splats:
    splats = random_splats(count)
    for name, values in columns.items():
        getattr(splats, name)[:] = values
    return splats


def texels_of(splats: Splats) -> np.ndarray:
    """Rows of `data_texture.SPLAT`."""
    return data_texture.pack(splats)["texture"].reshape(-1, 8).view(data_texture.SPLAT)[: len(splats), 0]


def covariance_of(splats: Splats) -> np.ndarray:
    """(N, 6) covariances, as the texture has them."""
    return texels_of(splats)["covariance"].astype(np.float32) / 4


def true_covariance(splats: Splats) -> np.ndarray:
    return gaussians.covariance(splats.scale, splats.quat_xyzw)[:, ROWS, COLUMNS]


def viewers_texels(splats: Splats, index: int) -> bytes:
    """The 32 bytes that the viewer's formulas make of one splat: a matrix of 3 x 3 by rows, each times its scale."""
    x, y, z, w = (float(number) for number in splats.quat_xyzw[index])
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ]
    m = [[float(scale) * number for number in row] for scale, row in zip(splats.scale[index], turn, strict=True)]
    sigma = [sum(m[k][i] * m[k][j] for k in range(3)) for i, j in zip(ROWS, COLUMNS, strict=True)]
    colour = [*splats.rgb[index], splats.opacity[index]]
    rgba = [round(min(max(float(number), 0), 1) * 255) for number in colour]
    return struct.pack("<3fI6e4B", *splats.center[index], 0, *(4 * number for number in sigma), *rgba)


def test_every_byte_is_that_of_the_slow_twin() -> None:
    splats = random_splats(3000)
    texture = data_texture.pack(splats)["texture"]
    assert texture.shape == (3, 2048, 4)
    assert texture.dtype == np.uint32
    for index in range(len(splats)):
        row, column = divmod(index, 1024)  # as the viewer's shader finds them
        texels = texture[row, 2 * column : 2 * column + 2]
        assert texels.tobytes() == viewers_texels(splats, index), index
    assert not texture.reshape(-1, 8)[len(splats) :].any()


@pytest.mark.parametrize(("count", "height"), [(0, 1), (1, 1), (1024, 1), (1025, 2), (2048, 2)])
def test_a_texture_has_as_many_rows_as_its_splats_need(count: int, height: int) -> None:
    packed = data_texture.pack(random_splats(2048).take(slice(count)))
    assert packed["texture"].shape == (height, 2048, 4)
    assert data_texture.capacity(packed) == 1024 * height


@given(
    scale=arrays(np.float32, (8, 3), elements=st.floats(2.0**-20, 127, width=32)),
    quats=arrays(np.float32, (8, 4), elements=st.floats(-1, 1, width=32)),
)
def test_covariance_keeps_its_error(scale: np.ndarray, quats: np.ndarray) -> None:
    quats[np.abs(quats).max(axis=1) == 0] = [0, 0, 0, 1]
    splats = splats_with(8, scale=scale, quat_xyzw=normalized_quat(quats))
    expected = true_covariance(splats)
    error = np.abs(covariance_of(splats) - expected)
    # The twin makes its matrix in another way, which float32 quaternions of nearly unit length tell apart.
    noise = 2e-6 * (splats.scale.astype(np.float64) ** 2).max(axis=1, keepdims=True)
    assert (error <= np.maximum(2.0**-11 * np.abs(expected), 2.0**-27) + noise).all()


def test_covariance_reaches_its_error() -> None:
    scale = np.exp(np.linspace(-9, math.log(127), 60_000)).astype(np.float32).reshape(-1, 3)
    splats = splats_with(len(scale), scale=scale, quat_xyzw=[0, 0, 0, 1])
    expected = scale.astype(np.float64) ** 2
    error = np.abs(covariance_of(splats)[:, [0, 3, 5]] - expected)
    ratio = error / np.maximum(2.0**-11 * expected, 2.0**-27)
    assert 0.99 <= ratio.max() <= 1
    assert ratio[expected < 2.0**-16].max() >= 0.99


@pytest.mark.filterwarnings("error")
def test_splats_too_wide_are_shrunk_in_their_shape() -> None:
    splats = random_splats(500)
    splats.scale[:] *= np.exp(np.linspace(0, 85, 500)).astype(np.float32)[:, None]
    true = true_covariance(splats)
    widest = true[:, [0, 3, 5]].max(axis=1, keepdims=True)
    factor = np.minimum(1, 65504 / 4 / widest)
    assert np.count_nonzero(factor < 1) > 100
    got = covariance_of(splats)
    assert np.isfinite(got).all()
    np.testing.assert_allclose(got, true * factor, rtol=2.0**-11, atol=2e-6 * 65504 / 4)
    np.testing.assert_allclose(got[:, [0, 3, 5]].max(axis=1)[factor[:, 0] < 1], 65504 / 4)


def test_rgba_keeps_and_reaches_its_error() -> None:
    rgba = np.linspace(0, 1, 80_000, dtype=np.float32).reshape(-1, 4)
    codes = texels_of(splats_with(20_000, rgb=rgba[:, :3], opacity=rgba[:, 3]))["rgba"]
    error = np.abs(codes / 255 - rgba)
    assert 0.99 / 510 <= error.max() <= 1.001 / 510


@pytest.mark.filterwarnings("error")
def test_rgba_is_clamped_and_centres_are_exact() -> None:
    splats = splats_with(1, rgb=[-0.5, 3e38, 0.5], opacity=1000, center=[3e38, -1e-40, 0.1])
    got = texels_of(splats)
    np.testing.assert_array_equal(got["rgba"], [[0, 255, 128, 255]])
    np.testing.assert_array_equal(got["center"], splats.center)


def test_threads_and_chunks_do_not_change_a_texel() -> None:
    splats = random_splats(BLOCK_ROWS + 1000)
    one, two = (data_texture.pack(splats, threads=threads)["texture"] for threads in (1, 2))
    np.testing.assert_array_equal(one, two)
    last = data_texture.pack(splats.take(slice(BLOCK_ROWS, None)))["texture"]
    np.testing.assert_array_equal(one[BLOCK_ROWS // 1024 :], last)


@pytest.mark.parametrize(
    ("packed", "text"),
    [
        ({}, "no array texture, only none"),
        ({"texture": np.zeros((1, 2048, 4), np.uint8)}, "texture is uint8"),
        ({"texture": np.zeros((1, 1024, 4), np.uint32)}, r"expected uint32\[H, 2048, 4\]"),
        ({"texture": np.zeros((2048, 4), np.uint32)}, r"texture is uint32\[2048, 4\]"),
        ({"texture": np.array(3)}, r"texture is int64\[\]"),
    ],
)
def test_textures_that_hold_no_splats_are_refused(packed: dict[str, np.ndarray], text: str) -> None:
    with pytest.raises(FormatError, match=text):
        data_texture.capacity(packed)
