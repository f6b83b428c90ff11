"""Kernels that fill columns from pixels, against numpy."""

from __future__ import annotations

import numpy as np

from sparklod_cli.codecs.kernels import texels
from sparklod_cli.codecs.sog import texel_codings as codings
from tests.references.sog_quats import decode_quat

RNG = np.random.default_rng(2)
CODES = RNG.integers(0, 256, (5000, 4), np.uint8)  # red, green, blue, alpha
PIXELS = (CODES.astype(np.uint32) << np.array([16, 8, 0, 24], np.uint32)).sum(axis=1).astype(np.uint32)


def test_two_bytes_make_the_words_of_coordinates() -> None:
    tables = RNG.normal(size=(3, 1 << 16)).astype(np.float32)
    center = np.full((len(PIXELS), 3), np.nan, np.float32)
    texels.place_bytes(PIXELS, center.view(np.uint8), 0)
    texels.place_bytes(PIXELS[::-1].copy(), center.view(np.uint8), 1)
    texels.look_up_words(center.view(np.uint32), tables, center)
    words = CODES[:, :3] + 256 * CODES[::-1, :3].astype(np.int64)
    np.testing.assert_array_equal(center, np.stack([tables[axis][words[:, axis]] for axis in range(3)], axis=1))


def test_channels_are_looked_up_each_in_its_table() -> None:
    tables = RNG.normal(size=(4, 256)).astype(np.float32)
    out = np.empty((len(PIXELS), 4), np.float32)
    texels.look_up(PIXELS, np.array([16, 8, 0, 24], np.uint32), tables, out)
    np.testing.assert_array_equal(out, np.stack([tables[k][CODES[:, k]] for k in range(4)], axis=1))


def test_rotations_are_those_of_numpy_to_the_last_bit() -> None:
    codes = CODES.copy()
    codes[:, 3] = RNG.integers(250, 256, len(codes))
    codes[:100, :3] = RNG.choice([0, 255], (100, 3))  # longer than 1
    pixels = (codes.astype(np.uint32) << np.array([16, 8, 0, 24], np.uint32)).sum(axis=1).astype(np.uint32)
    out = np.empty((len(codes), 4), np.float32)
    texels.fill_quats(pixels, codings.quat_components(), out)
    np.testing.assert_array_equal(out.view(np.uint32), decode_quat(codes).view(np.uint32))


def test_rows_are_gathered_unless_a_label_is_beyond_them() -> None:
    labels = (CODES[:, 0] + 256 * CODES[:, 1].astype(np.int64)).astype(np.int64)
    rows = RNG.normal(size=(int(labels.max()) + 1, 9)).astype(np.float32)
    out = np.zeros((len(PIXELS), 9), np.float32)
    assert texels.gather_rows(PIXELS, rows, out) == labels.max()
    np.testing.assert_array_equal(out, rows[labels])
    out[:] = 5
    assert texels.gather_rows(PIXELS, rows[:-1], out) == labels.max()
    assert (out == 5).all()
