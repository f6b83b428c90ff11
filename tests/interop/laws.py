"""What must hold between a scene, the file that sparklod makes of it and what Spark makes of that file."""

from __future__ import annotations

import gzip
import io

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import DEFAULTS, WriteOptions
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from sparklod_cli.model.splats import Splats
from tests.interop.spark import ExtSplats, Spark

Floats = NDArray[np.floating]

#: Relative rounding error of a float16: half of its last of 11 bits. Absolute below its normal numbers, and room for
#: float32 arithmetic that differs in its last bits.
HALF, TINY = 2.0**-11, 2.0**-25 + 1e-6

#: Degrees by which ExtSplats may turn a rotation. An axis lies within 1 / 1023 of its code along x and y of the
#: octahedron, so within sqrt(1 + 1 + 2 ** 2) / 1023 of it in space, at sqrt(1 / 3) from the origin in the middle of a
#: face. The rotation is off by up to twice that angle, where it is one by 180 degrees; and half a step of the angle.
EXT_DEGREES = np.degrees(2 * np.sqrt(18) / 1023 + np.pi / 4095 / 2)

#: Degrees by which SPZ may turn a rotation, by version; a rotation is twice the angle between its quaternions.
#: 2: x y z lie within 1 / 255 of their codes, together within r = sqrt(3) / 255. The length of x y z is off by up to r,
#: and where it is near 1 that makes w = sqrt(1 - length ** 2) off by up to sqrt(2 * r).
#: 3: three components lie within sqrt(1 / 2) / 511 / 2 of their codes, together within r = sqrt(3) times that. The
#: fourth is at least 1 / 2 and the three at most sqrt(3) / 2 long, so it is off by up to sqrt(3) * r.
SPZ_DEGREES = {
    2: np.degrees(2 * np.hypot(np.sqrt(2 * np.sqrt(3) / 255), np.sqrt(3) / 255)),
    3: np.degrees(2 * 2 * np.sqrt(3) * np.sqrt(0.5) / 511 / 2),
}


def degrees_between(a: Floats, b: Floats) -> Floats:
    """(N,) angles of the rotations that lead from one to the other; q and -q are the same rotation."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return np.degrees(4 * np.arcsin(chord / 2))


def within(got: Floats, expected: Floats, tolerance: Floats | float) -> None:
    """Each number lies within its tolerance."""
    assert got.shape == expected.shape
    excess = np.abs(got.astype(np.float64) - expected) - tolerance
    assert excess.max(initial=-1) <= 0, f"{np.count_nonzero(excess > 0)} of {got.size} are off by up to {excess.max()}"


def held_by_ext_sh(sh: Floats) -> tuple[Floats, Floats]:
    """What ExtSplats holds of SH coefficients (N, K, 3), and by how much it may be off.

    The three channels share the exponent of the largest, rounded *down*, and have a byte of magnitude each that stands
    for 0 .. 2 ** exponent. What exceeds that is cut off: Spark shows up to half of a coefficient's strength less.
    """
    largest = np.maximum(np.abs(sh).max(axis=2, keepdims=True), 2.0**-15)
    most = 2.0 ** np.floor(np.log2(largest))
    return np.clip(sh, -most, most), most / 510


def check_tree(got: ExtSplats, tree: LodTree) -> None:
    """Spark's tree has these links, and what its traversal reads of each node is that node's splat."""
    nodes = got.nodes
    assert nodes is not None
    assert len(nodes) == len(got.center) == len(tree)
    np.testing.assert_array_equal(nodes["child_count"], tree.child_count)
    np.testing.assert_array_equal(nodes["child_start"], tree.child_start)
    np.testing.assert_array_equal(nodes["center"], got.center.astype(np.float16))
    # Not the 2 * max(scale) * max(1, D) of Spark's own tree builder and its design notes.
    size = 2 * np.exp(got.log_scale).mean(axis=1) * (1 + 0.7 * np.maximum(0, got.lod_opacity - 1))
    within(nodes["size"], size, HALF * size + TINY)


def check_decoded(got: ExtSplats, data: bytes) -> Scene:
    """Spark reads the same numbers from a file as `spz.decode`, as far as ExtSplats can hold them."""
    scene = spz.decode(io.BytesIO(data))
    splats = scene.splats
    np.testing.assert_array_equal(got.center, splats.center)  # both have float32
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
        # D above 1 is a quarter of itself in the float16.
        within(got.lod_opacity, d, np.where(d > 1, 4 * 2 * HALF, HALF * d) + 4 * TINY)
        check_tree(got, scene.tree)
    return scene


def check_close(got: ExtSplats, splats: Splats, version: int, fractional_bits: int) -> None:
    """Spark shows what was there before encoding, to the steps of SPZ's codings and those of ExtSplats."""
    within(got.center, splats.center.astype(np.float64), 0.5 * 2.0**-fractional_bits)
    # A byte a channel, of SH DC coefficients times 0.15 around one half.
    range_, step = SH_C0 / 0.15 / 2, SH_C0 / 0.15 / 255
    rgb = splats.rgb.astype(np.float64).clip(0.5 - range_, 0.5 + range_)
    within(got.rgb, rgb, step / 2 + HALF * np.abs(rgb) + TINY)
    # A byte, sixteenths of a logarithm from -10 up.
    log_scale = np.log(splats.scale.astype(np.float64)).clip(-10, 255 / 16 - 10)
    within(got.log_scale, log_scale, 1 / 32 + 1e-6)
    assert degrees_between(got.quat_xyzw, splats.quat_xyzw).max() <= SPZ_DEGREES[version] + EXT_DEGREES
    if got.nodes is None:
        within(got.alpha, splats.opacity, 1 / 510 + HALF)
    else:
        d = lod_opacity(splats.opacity).astype(np.float64)
        # A byte, half of its codes for 0..1 and half for 1..5; 1 itself lies between the two.
        within(got.lod_opacity, d, np.where(d > 1, 4 / 255 + 8 * HALF, 1 / 255 + HALF))


def check_sh(spark: Spark, data: bytes, splats: Splats) -> None:
    """Spark reads the SH coefficients at full strength: the older layout, PackedSplats, does not cut them off."""
    got = spark.load_packed_sh(data)
    degree = np.repeat([0, 1, 2], [3, 5, 7])[: splats.sh.shape[1], None]
    spz_step = 2.0 ** np.array([3, 4, 4])[degree] / 128  # 5, 4 and 4 bits of -1..1, rounded
    packed_step = 1 / (2.0 ** np.array([6, 7, 5])[degree] - 1)  # 7, 8 and 6 bits
    sh = splats.sh.astype(np.float64).clip(-1, 127 / 128)
    within(got, sh, spz_step / 2 + 1 / 256 + packed_step / 2 + TINY)


def check(spark: Spark, scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1) -> ExtSplats:
    """All of the above, for the file that `spz.encode` makes of a scene."""
    data = b"".join(spz.encode(scene, options, threads=threads))
    raw = gzip.decompress(data)
    assert raw[4] == (options.spz_version or 3)
    got = spark.load(data)
    decoded = check_decoded(got, data)
    assert (decoded.tree is None) == (scene.tree is None)
    if scene.tree is not None:
        check_tree(got, scene.tree)  # what went in, not only what spz.decode finds
    check_close(got, scene.splats, options.version, raw[13])
    check_sh(spark, data, scene.splats)
    return got
