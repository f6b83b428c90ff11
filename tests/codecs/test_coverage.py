"""Opacities make up for what rounding does to the size of a splat, and to nothing else."""

from __future__ import annotations

import io
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.codecs import quantize, spz
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.rad import codec as rad
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS
from tests.scenes import random_splats

SEEDS = st.integers(0, 2**32 - 1)


def rounded(scale: np.ndarray) -> np.ndarray:
    return quantize.decode_log_scale(quantize.encode_log_scale(scale))


def integral(opacity: np.ndarray) -> np.ndarray:
    """Of the falloff over the plane, per area of 2 * pi: opacity up to 1, else of 1 - (1 - exp(-z * z / 2)) ** A."""
    u = np.linspace(0, 40, 40_001)[:, None]
    beyond = (-np.expm1(opacity * np.log1p(-np.exp(-u.clip(1e-12))))).sum(axis=0) * (u[1] - u[0])
    return np.where(opacity <= 1, opacity, beyond)


@given(SEEDS)
@settings(max_examples=20)
def test_a_splat_covers_what_it_did(seed: int) -> None:
    splats = random_splats(300, seed=seed)
    held = rounded(splats.scale)
    before = splats.opacity * quantize.faces(splats.scale, 0)
    area = quantize.faces(held, 0)
    kept = quantize.compensated(splats.opacity, splats.scale, held, 0.0)
    off = np.abs(kept * area / before - 1)
    assert (off[kept < 1] < 1e-5).all()
    assert (off <= np.abs(splats.opacity * area / before - 1) + 1e-6).all()  # saturated ones gain as much as they can
    assert kept.max() <= 1


@given(SEEDS)
@settings(max_examples=20)
def test_a_file_is_nearer_to_what_splats_cover(seed: int) -> None:
    """Through the codes of opacities, too, whose steps are what is left."""
    splats = random_splats(300, seed=seed)
    splats.opacity[:] = splats.opacity.clip(0.2, 0.93)
    back = again(spz, Scene(splats), WriteOptions())
    blur = 2.0 ** -back.header["fractional_bits"]
    expected, area = splats.opacity * quantize.faces(splats.scale, blur), quantize.faces(back.splats.scale, blur)
    left = np.abs(back.splats.opacity * area / expected - 1)
    before = np.abs(splats.opacity * area / expected - 1)
    assert (left <= 0.51 / 255 / splats.opacity * 1.08 + 1e-4).all()
    assert np.square(left).mean() < np.square(before).mean() / 4


def test_merged_splats_cover_what_they_did() -> None:
    splats = random_splats(400, seed=3)
    opacity = np.geomspace(1.2, 1000, 400).astype(np.float32)
    held = rounded(splats.scale)
    kept = quantize.compensated(opacity, splats.scale, held, 0.0)
    expected, area = integral(opacity) * quantize.faces(splats.scale, 0), quantize.faces(held, 0)
    off = np.abs(integral(kept) * area / expected - 1)
    assert off.max() < 0.012  # of 0.06
    assert (np.abs(kept - opacity) > 0).all()
    barely = np.full(400, 1.001, np.float32)
    assert (quantize.compensated(barely, splats.scale, held, 0.0) > 1).all()  # they keep their falloff


@pytest.mark.parametrize("opacity", [0.0, 0.5, 1.0, 1.5, 1000.0])
@pytest.mark.parametrize("blur", [0.0, 1e-3])
def test_what_is_not_rounded_stays_bit_for_bit(opacity: float, blur: float) -> None:
    scale = np.concatenate([random_splats(50).scale, np.zeros((1, 3), np.float32)])
    column = np.full(len(scale), opacity, np.float32)
    assert quantize.compensated(column, scale, scale.copy(), blur).tobytes() == column.tobytes()


def test_what_is_thinner_than_a_step_of_positions_makes_no_splat_fainter() -> None:
    """A speck or a wire, of which a pixel shows as much however thin it is."""
    opacity, least = np.full(2, 0.8, np.float32), np.float32(np.exp(-10))
    scale = np.array([[1e-9, 1e-9, 1e-9], [0.5, 1e-8, 1e-7]], np.float32)
    held = np.maximum(scale, least)
    assert (quantize.compensated(opacity, scale, held, 1e-3) > 0.79).all()
    # In a scene of such splats a pixel is as small, up to what cannot be told from a speck.
    np.testing.assert_allclose(quantize.compensated(opacity, scale, held, 0.0), [0.8 * quantize.LEAST_GROWTH] * 2)


@pytest.mark.filterwarnings("error")
def test_what_shrinks_to_the_largest_code_does_not_get_dense() -> None:
    opacity = np.array([0.5, 2, 1000], np.float32)
    scale = np.full((3, 3), 1e9, np.float32)
    kept = quantize.compensated(opacity, scale, rounded(scale), 1.0)
    assert kept[0] == pytest.approx(0.5 * quantize.MOST_GROWTH)
    assert np.isfinite(kept).all()
    assert np.isfinite(quantize.compensated(opacity, np.zeros_like(scale), np.zeros_like(scale), 0.0)).all()


def again(codec: ModuleType, scene: Scene, options: WriteOptions) -> Scene:
    decoded: Scene = decode_file(codec, io.BytesIO(b"".join(codec.encode(scene, options))))
    return decoded


@pytest.mark.parametrize("lod", [False, True])
@pytest.mark.parametrize("codec", [spz, rad])
@given(SEEDS, st.integers(0, 3))
@settings(max_examples=15)
def test_what_was_read_is_written_as_it_is(codec: ModuleType, lod: bool, seed: int, degree: int) -> None:
    """SPZ with the same fractional bits: its other choices follow the values, which are where they were put. RAD with
    the same choices."""
    splats = random_splats(60, sh_degree=degree, seed=seed, extent=0.02)
    splats.sh[:] *= np.random.default_rng(seed).choice([0.1, 1, 4])
    scene = Scene(*quick.build(splats)) if lod else Scene(splats)
    options = codec.settled(scene, WriteOptions())
    if codec is spz:
        options = WriteOptions(fractional_bits=options.fractional_bits)
    once = again(codec, scene, options)
    twice = again(codec, once, options)
    for column in sorted(set(COLUMNS) - {"quat_xyzw"}):
        np.testing.assert_array_equal(getattr(twice.splats, column), getattr(once.splats, column), column)
