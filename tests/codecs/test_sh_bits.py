"""How many bits of SH an SPZ file keeps."""

from __future__ import annotations

import dataclasses
import io
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.codecs import quantize, spz
from sparklod_cli.codecs.options import DEFAULTS, WriteOptions
from sparklod_cli.codecs.sh_bits import ALL_BITS, LARGEST_ERROR, ShBytes, enough
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.transforms import sh_basis
from tests.scenes import random_splats


def sh_of(degree: int, spread: float, count: int = 400, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(0, spread, (count, COEFFICIENTS[degree], 3)).clip(-1, 0.99).astype(np.float32)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_error_is_that_of_colours_over_all_directions(degree: int) -> None:
    sh = quantize.decode_sh(quantize.encode_sh(sh_of(degree, 0.2), ALL_BITS))
    found = ShBytes.of(sh)
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(1_000, 3))
    basis = sh_basis(direction / np.linalg.norm(direction, axis=1, keepdims=True), degree)
    for bits in range(4, 8):
        off = quantize.decode_sh(quantize.encode_sh(sh, bits)) - sh
        seen = np.sqrt(np.square(np.einsum("dk,nkc->dnc", basis, off)).mean())
        assert found.error(bits) == pytest.approx(seen, rel=0.05)
    assert found.error(ALL_BITS) == 0


@pytest.mark.parametrize(("degree", "spread", "bits"), [(3, 0.002, 4), (1, 0.2, 4), (2, 0.2, 6), (3, 0.2, 7)])
def test_stronger_sh_keep_more_bits(degree: int, spread: float, bits: int) -> None:
    found = ShBytes.of(sh_of(degree, spread))
    assert enough(found) == bits
    assert found.error(bits) <= LARGEST_ERROR
    assert bits == 4 or found.error(bits - 1) > LARGEST_ERROR


@settings(max_examples=30)
@given(st.integers(4, 8), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_codes_keep_the_bits_that_they_have(bits: int, degree: int, seed: int) -> None:
    sh = quantize.decode_sh(quantize.encode_sh(sh_of(degree, 0.3, seed=seed), bits))
    found = ShBytes.of(sh)
    assert found.between == 0
    kept = enough(found)
    assert kept <= bits
    np.testing.assert_array_equal(quantize.decode_sh(quantize.encode_sh(sh, kept)), sh)


def test_leaves_decide_and_merged_splats_keep_the_fewest() -> None:
    splats = random_splats(500, sh_degree=3, seed=5)
    nodes, tree = quick.build(splats)
    scene = Scene(dataclasses.replace(nodes), tree)
    bits = spz.settled(scene, DEFAULTS).sh_bits
    assert bits is not None and bits > 4
    assert bits == spz.settled(Scene(splats), DEFAULTS).sh_bits
    back = spz.decode(io.BytesIO(b"".join(spz.encode(scene)))).splats.sh
    for rows, kept in ((tree.is_leaf, bits), (~tree.is_leaf, 4)):
        np.testing.assert_array_equal(back[rows], quantize.decode_sh(quantize.encode_sh(nodes.sh[rows], kept)))


def test_bits_may_be_given() -> None:
    scene = Scene(random_splats(50, sh_degree=2))
    for bits in range(4, 9):
        back = spz.decode(io.BytesIO(b"".join(spz.encode(scene, WriteOptions(sh_bits=bits))))).splats.sh
        assert math.log2(np.abs(back - scene.splats.sh).max()) < -bits
    with pytest.raises(ValueError, match="sh_bits is 3, not 4 to 8"):
        spz.settled(scene, WriteOptions(sh_bits=3))
