"""Compares sparklod's words with Spark's, which may differ only where a value is half-way between two codes.

The last bit of a logarithm, or of a number decoded from a file, may differ between Spark's float32 and sparklod's (and
the float64 of Spark's JavaScript). That changes a code only if the value is a tie but for last bits; then by one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs import ext_splats, packed_splats, spark_codings
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.model.splats import Splats

Words = dict[str, NDArray[np.uint32]]
Floats = NDArray[np.floating[Any]]
#: Values in steps of their code, and the error of their last bits in steps.
Steps = tuple[Floats, Floats | float]

LAST_BITS = 2.0**-22  # relative: a few float32 operations


def linear(values: Floats, low: float, high: float, most: int) -> Steps:
    return np.clip((values.astype(np.float64) - low) / (high - low), 0, 1) * most, most * LAST_BITS


def half(values: Floats) -> Steps:
    """Returns values in units of the last place of their float16."""
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
    rows = words["packed"].view(packed_splats.SPLAT)[:, 0]
    codes = {name: rows[name] for name in ("rgb", "alpha", "center", "log_scale", "angle")}
    return codes | {"u": rows["axis"][:, 0], "v": rows["axis"][:, 1]}


def ext_steps(splats: Splats) -> dict[str, Steps]:
    d = lod_opacity(splats.opacity)
    with np.errstate(divide="ignore"):
        log_scale = half(np.log(splats.scale.astype(np.float64)).astype(np.float32))
    steps = {"alpha": half(np.where(d > 1, (d + 3) / 4, d)), "rgb": half(splats.rgb), "log_scale": log_scale}
    return steps | rotation(splats, spark_codings.STEPS_10_10_12)


def ext_codes(words: Words) -> dict[str, NDArray[Any]]:
    second = words["ext1"].view(ext_splats.SPLAT_1)[:, 0]
    rotation = second["rotation"]
    return {
        "alpha": words["ext0"].view(ext_splats.SPLAT_0)[:, 0]["alpha"],
        "rgb": second["rgb"],
        "log_scale": second["log_scale"],
        "u": rotation & 1023,
        "v": rotation >> 10 & 1023,
        "angle": rotation >> 20,
    }


def check(
    ours: dict[str, NDArray[Any]], theirs: dict[str, NDArray[Any]], steps: dict[str, Steps], share: float
) -> None:
    """Asserts that all codes are equal, but for a share of ties that last bits decide."""
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
