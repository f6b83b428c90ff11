"""Every way to write RAD, and its precision."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from fixtures import (
    by_hand_rad,
)
from sparklod_cli.codecs import spark_codings
from sparklod_cli.codecs.formats import RAD_ENCODINGS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.property_codings import LARGEST_F16
from sparklod_cli.codecs.rad.rad_header import ENCODING_KEYS
from sparklod_cli.codecs.rad.rad_writer import HALF
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.model.scene import Scene
from tests.codecs.cases import Array, Case, Content, Precision, linear, stated_degrees

#: Two sets of encodings that have each one between them.
PLAIN_RAD = {
    "center": "f32",
    "alpha": "f32",
    "rgb": "f32",
    "scales": "f32",
    "orientation": "f32",
    "sh": "f32",
}
SMALL_RAD = {
    "center": "f32_lebytes",
    "alpha": "r8",
    "rgb": "r8",
    "scales": "ln_f16",
    "orientation": "f16",
    "sh": "s8_delta",
}
WIDE_RANGES = by_hand_rad.RANGES | {"rgbMin": -0.5, "rgbMax": 1.5, "sh2Max": 1.25, "sh3Max": 1.5}


def half_spacing(values: Array) -> Array:
    """Bounds the error of numbers as float16, of which the largest is clamped."""
    inside = np.clip(values, -65504, 65504)
    return np.spacing(np.minimum(np.abs(inside), 60000).astype(np.float16)).astype(np.float64) * 0.501 + np.abs(
        values - inside
    )


def rad_precision(
    source: Scene, encodings: Mapping[str, str], ranges: SplatEncoding, bits: int | None = None
) -> Precision:
    values = linear(source)
    rgb, scales, sh = encodings["rgb"], encodings["scales"], encodings["sh"]
    tops = np.repeat([float(ranges.sh_max(degree)) for degree in (1, 2, 3)], [3, 5, 7])
    steps = {"f32": 0 * tops, "f16": 2**-11 * np.ones(15), "r8": tops / 255, "s8": tops / 254}[
        sh.removesuffix("_delta")
    ]
    log_range = ranges.ln_scale_min, ranges.ln_scale_max
    alpha = {"f32": 1e-6, "f16": 2**-12, "r8": 1 / 255 if source.tree else 1 / 510}[encodings["alpha"]]
    center = half_spacing(values["center"]) if "f16" in encodings["center"] else np.zeros(1)
    top = tops[: source.splats.sh.shape[1], None]
    return Precision(
        center=center if bits is None else center + 0.5 * 2.0**-bits,
        log_scale={
            "f32": 2e-6,
            "ln_f16": 2**-11 * np.abs(np.log(values["scale"])) + 1e-6,
            "ln_0r8": 1.001 * (log_range[1] - log_range[0]) / 508,
        }[scales],
        # Near half a turn, w follows from x y z by a difference of nearly equal numbers: 2 ** -11 of 1 makes w 0.031.
        degrees={"f32": 0.05, "f16": 3.6, "oct88r8": stated_degrees(spark_codings.decode_axis_angle)}[
            encodings["orientation"]
        ],
        opacity=1.001 * alpha,
        merged={"f32": 1e-5, "f16": 2**-9, "r8": 4 / 255}[encodings["alpha"]] * 1.001,
        rgb={"f32": 1e-6, "f16": half_spacing(values["rgb"])}.get(rgb, 1.001 * (ranges.rgb_max - ranges.rgb_min) / 510),
        sh=(steps[0] * 1.001, steps[3:].max() * 1.001),
        scale_range=(0, np.inf) if scales != "ln_0r8" else (np.exp(log_range[0]), np.exp(log_range[1])),
        rgb_range=(ranges.rgb_min, ranges.rgb_max) if rgb.startswith("r8") else (-np.inf, np.inf),
        sh_range=(-top, top) if sh[1] == "8" else (-np.inf, np.inf),
    )


def by_hand_rad_files(source: Scene, encodings: Mapping[str, str], ranges: Mapping[str, float], stem: str) -> Content:
    tree = None if source.tree is None else (source.tree.child_count, source.tree.child_start)
    files = by_hand_rad.rad(
        **linear(source), tree=tree, encodings=encodings, ranges=ranges, chunk_size=1000 if stem else 65536, stem=stem
    )
    return files if stem else files["scene.rad"]


def encoding_of(ranges: Mapping[str, float]) -> SplatEncoding:
    return SplatEncoding(**{ENCODING_KEYS[key]: value for key, value in ranges.items()})


BY_HAND_RAD = {
    f"by hand {way}{' LoD' * lod}": Case(
        f"RAD{' LoD' * lod}",
        functools.partial(by_hand_rad_files, encodings=encodings, ranges=ranges, stem=stem),
        functools.partial(rad_precision, encodings=encodings, ranges=encoding_of(ranges)),
        lod,
    )
    for way, encodings, ranges, stem in (
        ("Spark", by_hand_rad.SPARK, by_hand_rad.RANGES, ""),
        ("plain", PLAIN_RAD, by_hand_rad.RANGES, ""),
        ("small", SMALL_RAD, WIDE_RANGES, "scene"),
    )
    for lod in (False, True)
}


def as_rad(source: Scene, options: RadOptions) -> Content:
    if not options.chunked:
        return b"".join(rad.encode(source, WriteOptions(rad=options)))
    files = rad.encode_chunked(source, WriteOptions(rad=options), "scene")
    return {name: b"".join(pieces) for name, pieces in files}


def written_rad_precision(source: Scene, options: RadOptions) -> Precision:
    chosen = rad.settled(source, WriteOptions(rad=options)).rad
    assert chosen.ranges is not None
    ranges = chosen.ranges  # those of SH are for viewers; codes in a file reach at least from -1 to 1
    tops = {f"sh{degree}_max": max(1.0, float(ranges.sh_max(degree))) for degree in (1, 2, 3)}
    encodings = {name: getattr(chosen, name) for name in SMALL_RAD}
    found = rad_precision(source, encodings, dataclasses.replace(ranges, **tops), chosen.center_bits)
    return dataclasses.replace(found, blur=0.0 if chosen.center_bits is None else 2.0**-chosen.center_bits)


def rad_encodings(number: int) -> RadOptions:
    """The n-th encoding of each property; where it has fewer, they are repeated."""
    return RadOptions(**{name: known[number % len(known)] for name in SMALL_RAD for known in [RAD_ENCODINGS[name]]})


RAD_OPTIONS = {
    "auto": RadOptions(),
    "chunked": RadOptions(chunked=True),
    **{f"encodings {number}": rad_encodings(number) for number in range(len(RAD_ENCODINGS["sh"]))},
}

RAD = BY_HAND_RAD | {
    f"{way}{' LoD' * lod}": Case(
        f"RAD{' LoD' * lod}",
        functools.partial(as_rad, options=options),
        functools.partial(written_rad_precision, options=options),
        lod,
        reach=LARGEST_F16 if options.center in HALF else np.inf,
    )
    for index, (way, options) in enumerate(RAD_OPTIONS.items())
    for lod in ((False, True) if index < 2 else (bool(index % 2),))
}
