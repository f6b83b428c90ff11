"""Checks that Spark reads a file of sparklod as the scene that it was written from."""

from __future__ import annotations

import gzip
import io

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs import quantize, spz
from sparklod_cli.codecs.options import DEFAULTS, WriteOptions
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from sparklod_cli.model.splats import Splats
from tests.interop.spark import ExtSplats, Spark

Floats = NDArray[np.floating]

#: HALF: relative rounding error of a float16, half of the last of its 11 bits. TINY: absolute error below its normal
#: numbers, with room for float32 arithmetic that differs in last bits.
HALF, TINY = 2.0**-11, 2.0**-25 + 1e-6

#: Error of a rotation in ExtSplats, in degrees. The decoded axis is off by up to 1 / 1023 along x and y of the
#: octahedron, so by up to sqrt(1 + 1 + 2 ** 2) / 1023 in space; in the middle of a face, that is at sqrt(1 / 3) from
#: the origin. The rotation is off by up to twice that angle, if it is one by 180 degrees, and half a step of its angle.
EXT_DEGREES = np.degrees(2 * np.sqrt(18) / 1023 + np.pi / 4095 / 2)

#: Error of a rotation in SPZ, in degrees, by version; a rotation differs by twice the angle between the quaternions.
#: 2: x, y and z are off by up to 1 / 255 each, together by r = sqrt(3) / 255. So the length of x y z is off by up to r,
#: and where it is near 1, w = sqrt(1 - length ** 2) is off by up to sqrt(2 * r).
#: 3: three components are off by up to sqrt(1 / 2) / 511 / 2 each, together by r = sqrt(3) times that. The fourth is at
#: least 1 / 2 and the length of the three at most sqrt(3) / 2, so it is off by up to sqrt(3) * r.
SPZ_DEGREES = {
    2: np.degrees(2 * np.hypot(np.sqrt(2 * np.sqrt(3) / 255), np.sqrt(3) / 255)),
    3: np.degrees(2 * 2 * np.sqrt(3) * np.sqrt(0.5) / 511 / 2),
}


def degrees_between(a: Floats, b: Floats) -> Floats:
    """Returns (N,) angles between rotations; q and -q are the same rotation."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return np.degrees(4 * np.arcsin(chord / 2))


def within(got: Floats, expected: Floats, tolerance: Floats | float) -> None:
    """Asserts that each number is within its tolerance of the expected one."""
    assert got.shape == expected.shape
    excess = np.abs(got.astype(np.float64) - expected) - tolerance
    assert excess.max(initial=-1) <= 0, f"{np.count_nonzero(excess > 0)} of {got.size} are off by up to {excess.max()}"


def held_by_ext_sh(sh: Floats) -> tuple[Floats, Floats]:
    """Returns SH coefficients (N, K, 3) as ExtSplats can hold them, and their largest error.

    The three channels share the exponent of the largest, rounded *down*, and each has a byte of magnitude for
    0..2 ** exponent. Larger magnitudes are clamped: Spark shows a coefficient with as little as half of its strength.
    """
    largest = np.maximum(np.abs(sh).max(axis=2, keepdims=True), 2.0**-15)
    most = 2.0 ** np.floor(np.log2(largest))
    return np.clip(sh, -most, most), most / 510


def check_tree(got: ExtSplats, tree: LodTree) -> None:
    """Asserts that Spark's tree has the same child columns, and that its nodes agree with their splats."""
    nodes = got.nodes
    assert nodes is not None
    assert len(nodes) == len(got.center) == len(tree)
    np.testing.assert_array_equal(nodes["child_count"], tree.child_count)
    np.testing.assert_array_equal(nodes["child_start"], tree.child_start)
    np.testing.assert_array_equal(nodes["center"], got.center.astype(np.float16))
    # Spark's own tree builder and its design notes use 2 * max(scale) * max(1, D) instead.
    size = 2 * np.exp(got.log_scale).mean(axis=1) * (1 + 0.7 * np.maximum(0, got.lod_opacity - 1))
    within(nodes["size"], size, HALF * size + TINY)


def check_decoded(got: ExtSplats, data: bytes) -> Scene:
    """Asserts that Spark reads the same numbers as `decode_file`, within the precision of ExtSplats."""
    scene = decode_file(spz, io.BytesIO(data))
    splats = scene.splats
    np.testing.assert_array_equal(got.center, splats.center)  # float32 in both
    within(got.rgb, splats.rgb, HALF * np.abs(splats.rgb) + TINY)
    log_scale = np.log(splats.scale.astype(np.float64))
    within(got.log_scale, log_scale, 1e-6)  # a float16 holds sixteenths up to 10 exactly
    assert degrees_between(got.quat_xyzw, splats.quat_xyzw).max() <= EXT_DEGREES
    held, tolerance = held_by_ext_sh(splats.sh)
    within(got.sh, held, tolerance + TINY)
    if scene.tree is None:
        assert got.nodes is None
        within(got.alpha, splats.opacity, HALF * splats.opacity + TINY)
    else:
        d = lod_opacity(splats.opacity)
        # The float16 holds (D + 3) / 4 for D above 1, so errors are four times as large.
        within(got.lod_opacity, d, np.where(d > 1, 4 * 2 * HALF, HALF * d) + 4 * TINY)
        check_tree(got, scene.tree)
    return scene


def check_close(got: ExtSplats, splats: Splats, version: int, fractional_bits: int) -> None:
    """Asserts that Spark reads the splats that were encoded, within the precision of SPZ and of ExtSplats."""
    within(got.center, splats.center.astype(np.float64), 0.5 * 2.0**-fractional_bits)
    # A byte for each channel: 0.15 times the SH DC coefficient, around one half.
    range_, step = SH_C0 / 0.15 / 2, SH_C0 / 0.15 / 255
    rgb = splats.rgb.astype(np.float64).clip(0.5 - range_, 0.5 + range_)
    within(got.rgb, rgb, step / 2 + HALF * np.abs(rgb) + TINY)
    # A byte: sixteenths of a natural logarithm, from -10 upwards.
    log_scale = np.log(splats.scale.astype(np.float64)).clip(-10, 255 / 16 - 10)
    within(got.log_scale, log_scale, 1 / 32 + 1e-6)
    assert degrees_between(got.quat_xyzw, splats.quat_xyzw).max() <= SPZ_DEGREES[version] + EXT_DEGREES
    # The opacity makes up for the rounding of scales.
    codes = np.rint(16 * (got.log_scale.astype(np.float64) + 10))
    opacity = quantize.compensated(splats.opacity, splats.scale, np.exp(codes / 16 - 10), 2.0**-fractional_bits)
    if got.nodes is None:
        within(got.alpha, opacity, 1 / 510 + HALF + TINY)
    else:
        d = lod_opacity(opacity).astype(np.float64)
        # A byte: half of its codes are for 0..1, half for 1..5; 1 lies between two codes.
        within(got.lod_opacity, d, np.where(d > 1, 4 / 255 + 8 * HALF, 1 / 255 + HALF))


def check_sh(spark: Spark, data: bytes, splats: Splats) -> None:
    """Asserts that Spark reads SH at full strength in its older layout, PackedSplats, which does not clamp them."""
    got = spark.load_packed_sh(data)
    degree = np.repeat([0, 1, 2], [3, 5, 7])[: splats.sh.shape[1], None]
    spz_step = 2.0 ** np.array([3, 4, 4])[degree] / 128  # 5, 4 and 4 bits of -1..1, rounded
    packed_step = 1 / (2.0 ** np.array([6, 7, 5])[degree] - 1)  # 7, 8 and 6 bits
    sh = splats.sh.astype(np.float64).clip(-1, 127 / 128)
    within(got, sh, spz_step / 2 + 1 / 256 + packed_step / 2 + TINY)


def check(spark: Spark, scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1) -> ExtSplats:
    """Writes a scene with `spz.encode` and makes all of the checks above."""
    data = b"".join(spz.encode(scene, options, threads=threads))
    raw = gzip.decompress(data)
    assert raw[4] == (options.spz_version or 3)
    got = spark.load(data)
    decoded = check_decoded(got, data)
    assert (decoded.tree is None) == (scene.tree is None)
    if scene.tree is not None:
        check_tree(got, scene.tree)  # the tree that was written, and not only what `decode_file` reads
    check_close(got, scene.splats, raw[4], raw[13])
    check_sh(spark, data, scene.splats)
    return got
