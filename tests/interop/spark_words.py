"""Compares the words of splats in Spark's two layouts, as its worker has them, with those of sparklod.

The last bit of a logarithm, or of a number decoded from a file, may differ between Spark's float32 and sparklod's (and
the float64 of Spark's JavaScript). That changes a code only if the value is a tie but for last bits; then by one.
"""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs import layouts, spark_codings
from sparklod_cli.codecs.spark_codings import DEFAULT, SplatEncoding
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model import gaussian
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from tests.interop.spark import Spark

Words = dict[str, NDArray[np.uint32]]
Floats = NDArray[np.floating[Any]]
#: Values in steps of their code, and the error of their last bits in steps.
Steps = tuple[Floats, Floats | float]

LAST_BITS = 2.0**-22  # relative: a few float32 operations


def linear(values: Floats, low: float, high: float, most: int) -> Steps:
    return np.clip((values.astype(np.float64) - low) / (high - low), 0, 1) * most, most * LAST_BITS


def half(values: Floats) -> Steps:
    """Return values in units of the last place of their float16."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        steps = values.astype(np.float64) / np.spacing(np.abs(values).astype(np.float16)).astype(np.float64)
    return steps, np.abs(steps) * LAST_BITS


def rotation(splats: Splats, steps: tuple[int, int]) -> dict[str, Steps]:
    quat = splats.quat_xyzw.astype(np.float64)
    quat *= np.where(quat[:, 3:] < 0, -1, 1)
    sine = np.linalg.norm(quat[:, :3], axis=1)
    quat[sine < 1e-6, :3] = [1, 0, 0]
    axis = quat[:, :3] / np.abs(quat[:, :3]).sum(axis=1, keepdims=True)
    uv = axis[:, :2]
    folded = (1 - np.abs(uv[:, ::-1])) * np.where(uv >= 0, 1, -1)
    uv = np.where(axis[:, 2:] < 0, folded, uv)
    angle = 2 * np.arctan2(sine, quat[:, 3]) / np.pi * steps[1]
    # For small angles w is near 1, where its arc cosine magnifies an error of its last bit.
    angle_error = steps[1] * LAST_BITS * (1 + 1 / np.maximum(sine, 1e-9))
    codes = {"u": linear(uv[:, 0], -1, 1, steps[0]), "v": linear(uv[:, 1], -1, 1, steps[0])}
    return codes | {"angle": (angle, angle_error)}


def packed_steps(splats: Splats, encoding: SplatEncoding) -> dict[str, Steps]:
    d = lod_opacity(splats.opacity)
    alpha = np.where(d > 1, (d + 3) / 4, d) if encoding.lod_opacity else splats.opacity
    with np.errstate(divide="ignore"):
        log = np.log(splats.scale.astype(np.float64))
    log_scale, error = linear(log, encoding.ln_scale_min, encoding.ln_scale_max, 254)
    return {
        "rgb": linear(splats.rgb, encoding.rgb_min, encoding.rgb_max, 255),
        "alpha": linear(alpha, 0, encoding.alpha_max, 255),
        "center": half(splats.center),
        "log_scale": (np.where(log < -30, 0, 1 + log_scale), error * np.abs(log).clip(1, 50)),
    } | rotation(splats, spark_codings.STEPS_8_8_8)


def packed_codes(words: Words) -> dict[str, NDArray[Any]]:
    rows = words["packed"].view(layouts.PACKED)[:, 0]
    codes = {name: rows[name] for name in ("rgb", "alpha", "center", "log_scale", "angle")}
    return codes | {"u": rows["axis"][:, 0], "v": rows["axis"][:, 1]}


def ext_steps(splats: Splats) -> dict[str, Steps]:
    d = lod_opacity(splats.opacity)
    with np.errstate(divide="ignore"):
        log_scale = half(np.log(splats.scale.astype(np.float64)).astype(np.float32))
    steps = {"alpha": half(np.where(d > 1, (d + 3) / 4, d)), "rgb": half(splats.rgb), "log_scale": log_scale}
    return steps | rotation(splats, spark_codings.STEPS_10_10_12)


def ext_codes(words: Words) -> dict[str, NDArray[Any]]:
    second = words["ext1"].view(layouts.EXT_1)[:, 0]
    rotation = second["rotation"]
    return {
        "alpha": words["ext0"].view(layouts.EXT_0)[:, 0]["alpha"],
        "rgb": second["rgb"],
        "log_scale": second["log_scale"],
        "u": rotation & 1023,
        "v": rotation >> 10 & 1023,
        "angle": rotation >> 20,
    }


def check(
    ours: dict[str, NDArray[Any]], theirs: dict[str, NDArray[Any]], steps: dict[str, Steps], share: float
) -> None:
    """Assert that all codes are equal, but for a share of ties that last bits decide."""
    assert ours.keys() == theirs.keys() == steps.keys()
    for name, (value, error) in steps.items():
        one, other = ours[name], theirs[name]
        if one.dtype == np.float16:  # compare as integers, which have the order of the magnitudes
            np.testing.assert_array_equal(np.signbit(one), np.signbit(other), name)
            one, other, value = one.view(np.uint16) & 0x7FFF, other.view(np.uint16) & 0x7FFF, np.abs(value)
        differ = one != other
        assert np.count_nonzero(differ) <= share * one.size, f"{np.count_nonzero(differ)} of {one.size} {name} differ"
        assert (np.abs(one.astype(int) - other.astype(int))[differ] == 1).all(), name
        off = np.abs(value % 1 - 0.5)[differ] / np.broadcast_to(error, value.shape)[differ]
        assert off.max(initial=0) <= 1, f"{name} differs {off.max()} times as far from a tie as last bits reach"


def spark_encoding(encoding: SplatEncoding) -> dict[str, Any]:
    """Return an encoding by Spark's names."""
    return {re.sub("_(.)", lambda match: match[1].upper(), name): value for name, value in asdict(encoding).items()}


def check_file(spark: Spark, path: Path, share: float, encoding: SplatEncoding = DEFAULT) -> None:
    """Compare both layouts and the tree of a file: those of Spark's worker, and ours of the same file.

    Args:
        share: of codes that ties may decide, see `ties`.
        encoding: that Spark's worker is asked for; files with an encoding of their own have that instead.
    """
    scene = read_scene(path)
    encoding = SplatEncoding(**asdict(encoding) | {"lod_opacity": scene.tree is not None})
    check_packed(spark.load_words("Packed", path, encoding=spark_encoding(encoding)), scene, encoding, share)
    check_ext(spark.load_words("Ext", path), scene, share)


def check_packed(theirs: Words, scene: Scene, encoding: SplatEncoding, share: float) -> None:
    """Compare Spark's PackedSplats and tree of a scene with ours."""
    ours = layouts.pack_packed(scene.splats, encoding)
    check(packed_codes(ours), packed_codes(theirs), packed_steps(scene.splats, encoding), share)
    assert theirs.keys() - {"lodTree"} == ours.keys()
    for name in ours.keys() - {"packed"}:
        np.testing.assert_array_equal(ours[name], theirs[name])
    if scene.tree:
        held = layouts.unpack_packed({"packed": theirs["packed"]}, encoding)
        check_tree(layouts.pack_nodes(held, scene.tree)["lod_tree"], theirs["lodTree"], held, share)


def check_ext(theirs: Words, scene: Scene, share: float) -> None:
    """Compare Spark's ExtSplats and tree of a scene with ours."""
    ours = layouts.pack_ext(scene.splats)
    np.testing.assert_array_equal(ours["ext0"][:, :3], theirs["ext0"][:, :3])
    check(ext_codes(ours), ext_codes(theirs), ext_steps(scene.splats), share)
    assert theirs.keys() - {"lodTree"} == ours.keys()
    np.testing.assert_array_equal(ext_sh(ours), ext_sh(theirs))
    if scene.tree:
        held = layouts.unpack_ext({name: theirs[name] for name in ("ext0", "ext1")})
        check_tree(layouts.pack_nodes(held, scene.tree)["lod_tree"], theirs["lodTree"], held, share)


def ext_sh(words: Words) -> NDArray[np.uint32]:
    """Return the words of SH without unused ones, in which Spark leaves what its buffer had before."""
    names = [name for name in ("sh1", "sh2", "sh3a", "sh3b") if name in words]
    everything = np.concatenate([words["ext0"][:, :0], *(words[name] for name in names)], axis=1)
    return everything[:, : (0, 3, 8, 0, 15)[len(names)]]


def check_tree(ours: NDArray[np.uint32], theirs: NDArray[np.uint32], held: Splats, share: float) -> None:
    one, other = (words.view(layouts.NODE)[:, 0] for words in (ours, theirs))
    for name in ("center", "child_count", "child_start"):
        np.testing.assert_array_equal(one[name], other[name])
    steps, error = half(gaussian.spark_size(held))
    check({"size": one["size"]}, {"size": other["size"]}, {"size": (steps, 4 * error)}, share)
