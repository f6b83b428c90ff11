"""Every way to write each format, and the precision with which it keeps a scene: the input of the shared laws."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fixtures import (
    by_hand,
    by_hand_compressed_ply,
    by_hand_ksplat,
    by_hand_rad,
    by_hand_sog,
    by_hand_splat,
    by_hand_streamed_sog,
)
from sparklod_cli.codecs import ply, quantize, sh_palette, spark_codings, splat, spz
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.codecs.rad import codec as rad
from sparklod_cli.codecs.rad.property_codings import LARGEST_F16
from sparklod_cli.codecs.rad.rad_header import ENCODING_KEYS
from sparklod_cli.codecs.rad.rad_layout import choices
from sparklod_cli.codecs.rad.rad_options import HALF
from sparklod_cli.codecs.sog import codec as sog
from sparklod_cli.codecs.sog import texel_codings as codings
from sparklod_cli.codecs.sog.sog_writer import LARGE, SEEN
from sparklod_cli.codecs.sog.texel_codings import codebook
from sparklod_cli.codecs.splat_encoding import SplatEncoding
from sparklod_cli.model import morton
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from sparklod_cli.model.splats import Splats
from tests.codecs.test_quantize import stated_degrees

Array = NDArray[np.float64]
Content = bytes | dict[str, bytes]


@dataclass(frozen=True)
class Precision:
    """By how much a way of writing may change each column at most, and the ranges that it clamps to."""

    center: float | Array = 0.0
    log_scale: float | Array = 2e-6
    degrees: float = 1e-3
    opacity: float = 1e-6
    blur: float | None = None  # of `coverage.kept`, where the opacity makes up for the rounding of scales
    merged: float = 1e-6  # of an LoD opacity D above 1
    rgb: float | Array = 1e-6
    sh: tuple[float, float] = (0.0, 0.0)  # degree 1, degrees above
    scale_range: tuple[float, float] = (0.0, np.inf)
    rgb_range: tuple[float, float] = (-np.inf, np.inf)
    sh_range: tuple[float | Array, float | Array] = (-np.inf, np.inf)


def exact(source: Scene) -> Precision:
    return Precision()


def everything(splats: Splats) -> Splats:
    return splats


@dataclass(frozen=True)
class Case:
    """A way to write a format.

    Attributes:
        format: the name of the format that the reader must give.
        write: makes the file of a scene, or the files of a folder by their names.
        precision: by how much the columns of a scene may change.
        lod: whether the scene must have a tree.
        held: the splats that the file must hold, in its order.
        reach: the largest coordinate that the format can hold; scenes that go beyond are refused.
    """

    format: str
    write: Callable[[Scene], Content]
    precision: Callable[[Scene], Precision]
    lod: bool = False
    held: Callable[[Splats], Splats] = everything
    reach: float = np.inf


def put(content: Content, directory: Path, form: str) -> Path:
    """Writes a file under a name that says as little as possible of its format; returns its path."""
    if isinstance(content, bytes):
        path = directory / ("scene.splat" if form == "SPLAT" else "scene.bin")
        path.write_bytes(content)
        return path
    folder = directory / "scene"
    folder.mkdir()
    for name, data in content.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    return next((folder / name for name in content if name.endswith(".rad")), folder)


def linear(source: Scene) -> dict[str, Array]:
    """Returns the splats as arguments of the writers in `fixtures`."""
    splats = source.splats
    columns = {name: getattr(splats, name).astype(np.float64) for name in ("center", "scale", "opacity", "rgb", "sh")}
    return columns | {"quat_wxyz": splats.quat_xyzw[:, [3, 0, 1, 2]].astype(np.float64) * 7}


def rounding(values: Array) -> float:
    """Bounds the error of one or two float32 operations on values like these."""
    return 4 * float(np.spacing(np.float32(np.abs(values).max())))


def largest_dropped_degrees(steps: int) -> float:
    """Bounds the error of rotations, in degrees, that hold all but the largest component in `steps` for +-sqrt(1 / 2).

    Each of the three is off by up to half a step; the largest, which follows from them, by up to sqrt(3) times their
    error together.
    """
    return float(np.degrees(2 * 2 * 3**0.5 * (2**0.5 / steps / 2))) * 1.001


# --- PLY --------------------------------------------------------------------------------------------------------------


def as_ply(source: Scene, **layout: object) -> bytes:
    splats = source.splats
    with np.errstate(divide="ignore"):
        columns = by_hand.ply_columns(
            center=splats.center,
            log_scale=np.log(splats.scale),
            quat_wxyz=splats.quat_xyzw[:, [3, 0, 1, 2]] * 7,
            logit=np.log(splats.opacity.astype(np.float64)) - np.log1p(-splats.opacity.astype(np.float64)),
            dc=(splats.rgb - 0.5) / SH_C0,
            sh=splats.sh,
        )
    return by_hand.ply(columns, **layout)  # type: ignore[arg-type]


PLY = {
    "sparklod": Case("PLY", lambda source: b"".join(ply.encode(source)), exact),
    "binary": Case("PLY", as_ply, exact),
    "big-endian": Case("PLY", functools.partial(as_ply, byte_order=">"), exact),
    "ascii": Case("PLY", functools.partial(as_ply, text=True), exact),
    "double": Case("PLY", functools.partial(as_ply, types="f8"), exact),
}

# --- Compressed PLY ---------------------------------------------------------------------------------------------------


def half_steps(values: Array, steps: float | Array) -> Array:
    """Returns (N, 3): half a step between the bounds of each splat's chunk of 256."""
    chunks = [values[start : start + 256] for start in range(0, len(values), 256)]
    return np.concatenate([np.ones((len(chunk), 1)) * np.ptp(chunk, axis=0) / steps / 2 for chunk in chunks])


def compressed_precision(source: Scene, *, color_bounds: bool) -> Precision:
    values = linear(source)
    log_scale, words = np.log(values["scale"]), np.array([2047, 1023, 2047])
    return Precision(
        center=half_steps(values["center"], words) * 1.001 + rounding(values["center"]),
        log_scale=half_steps(log_scale, words) * 1.001 + rounding(log_scale),
        degrees=largest_dropped_degrees(1023),
        opacity=1.001 / 510,
        rgb=half_steps(values["rgb"], 255) * 1.001 + 1e-6 if color_bounds else 1.001 / 510,
        sh=(1 / 64, 1 / 64),
    )


COMPRESSED_PLY = {
    way: Case(
        "compressed PLY",
        lambda source, bounds=bounds: by_hand_compressed_ply.compressed_ply(**linear(source), color_bounds=bounds),
        functools.partial(compressed_precision, color_bounds=bounds),
    )
    for way, bounds in {"by hand": True, "old": False}.items()
}

# --- SPZ --------------------------------------------------------------------------------------------------------------


def as_spz(source: Scene, version: int) -> bytes:
    return b"".join(spz.encode(source, WriteOptions(spz_version=version)))


def spz_precision(source: Scene, version: int) -> Precision:
    bits = spz.settled(source, WriteOptions(spz_version=version)).fractional_bits
    assert bits is not None
    coding = quantize.decode_quat_smallest_three if version == 3 else quantize.decode_quat_first_three
    return Precision(
        center=0.5 * 2.0**-bits,
        log_scale=1.001 / 32,
        degrees=stated_degrees(coding),
        opacity=1.001 / 255 if source.tree else 1.001 / 510,
        blur=2.0**-bits,
        merged=4.004 / 255,
        rgb=0.00369,
        sh=(1 / 32, 1 / 16),
        scale_range=(np.exp(-10), np.exp(95 / 16)),
        rgb_range=(-0.4403, 1.4403),
        sh_range=(-1, 0.992),
    )


SPZ = {
    f"{version}{' LoD' * lod}": Case(
        f"SPZ {version}{' LoD' * lod}",
        functools.partial(as_spz, version=version),
        functools.partial(spz_precision, version=version),
        lod,
    )
    for version in (2, 3)
    for lod in (False, True)
}

# --- SOG --------------------------------------------------------------------------------------------------------------


def sog_precision(source: Scene, version: int) -> Precision:
    values = linear(source)
    center, log_scale = values["center"], np.log(values["scale"])
    half_log_step = np.ptp(np.sign(center) * np.log1p(np.abs(center)), axis=0) / 65535 / 2
    logit = np.log(values["opacity"] / (1 - values["opacity"]))
    book = 1.3 / 255 / 2 * 1.001  # half the largest step of the codebook, at its end
    sh = np.ptp(values["sh"]) * (book if version == 2 else 1.001 / 510) + 1e-6 if values["sh"].size else 0.0
    return Precision(
        center=(1 + np.abs(center)) * np.expm1(half_log_step * 1.001 + 4e-6),
        log_scale=np.ptp(log_scale) * book + 4e-6 if version == 2 else np.ptp(log_scale, axis=0) / 510 * 1.001 + 4e-6,
        degrees=largest_dropped_degrees(255),
        opacity=1.001 / 510 if version == 2 else float(np.ptp(logit)) / 510 / 4 * 1.001 + 1e-6,
        rgb=np.ptp(values["rgb"]) * book + 1e-6 if version == 2 else np.ptp(values["rgb"], axis=0) / 510 * 1.001 + 1e-6,
        sh=(sh, sh),
    )


def as_sog(source: Scene, version: int, *, folder: bool = False) -> Content:
    files = by_hand_sog.sog_files(**linear(source), version=version)
    return files if folder else by_hand_sog.zipped(files)


def written_sog(source: Scene, *, folder: bool = False) -> Content:
    return dict(sog.encode_files(source)) if folder else b"".join(sog.encode(source))


def written_sog_precision(source: Scene) -> Precision:
    """As the format allows; books and palettes are as exact as those that the writer makes."""
    splats = source.splats
    found = sog_precision(source, 2)
    log_scale, dc = quantize.encode_log(splats.scale), quantize.encode_dc(splats.rgb)
    sh = 0.0
    if splats.sh_degree:
        codes = sog.settled(source, WriteOptions()).sog.sh_codes
        palette = sh_palette.cluster(splats.sh, codes or 0, weight=sh_palette.visible_weight(splats) ** SEEN)
        sh = float(np.abs(palette.expand() - splats.sh).max()) + largest_half_step(palette.codes)
    return dataclasses.replace(
        found,
        log_scale=float(np.diff(codebook(log_scale, LARGE)).max()) / 2 + 4e-6,
        rgb=largest_half_step(dc) * SH_C0 + 1e-6,
        sh=(sh + 1e-6, sh + 1e-6),
    )


def largest_half_step(values: NDArray[np.floating[Any]]) -> float:
    return float(np.diff(codebook(values)).max()) / 2


def in_sog_order(splats: Splats) -> Splats:
    low, high = (codings.sign_log(end) for end in (splats.center.min(axis=0), splats.center.max(axis=0)))
    return splats.take(morton.order_of_cells(codings.encode_center(splats.center, low, high)))


SOG = {
    f"sparklod{' folder' * folder}": Case(
        "SOG 2",
        functools.partial(written_sog, folder=folder),
        written_sog_precision,
        held=in_sog_order,
    )
    for folder in (False, True)
} | {
    f"{version}{' folder' * folder}": Case(
        f"SOG {version}",
        functools.partial(as_sog, version=version, folder=folder),
        functools.partial(sog_precision, version=version),
    )
    for version in (1, 2)
    for folder in (False, True)
}

# --- Streamed SOG -----------------------------------------------------------------------------------------------------


def as_streamed_sog(source: Scene, *, around: int = 0, **layout: Any) -> Content:
    """Three regions at two levels; the last splats are the environment."""
    values = linear(source)
    count = len(source) - min(around, len(source) - 1)
    parts = [part for part in np.array_split(np.arange(count), 3) if len(part)]

    def some(part: NDArray[np.int64]) -> dict[str, Array]:
        return {name: column[part] for name, column in values.items()}

    return by_hand_streamed_sog.streamed_sog_files(
        [[some(part), some(part[::4])] for part in parts],
        by_hand_sog.sog_files,
        environment=some(np.arange(count, len(source))) if count < len(source) else None,
        **layout,
    )


STREAMED_SOG = {
    way: Case("Streamed SOG 1", functools.partial(as_streamed_sog, **how), functools.partial(sog_precision, version=2))
    for way, how in {
        "by hand": {"around": 7},
        "a chunk for each run": {"together": 1},
        "before versions": {"version": None},
    }.items()
}

# --- KSPLAT -----------------------------------------------------------------------------------------------------------

#: For each section, the share of the splats at which it ends, and its SH degree.
SECTIONS: Mapping[str, tuple[tuple[float, int], ...]] = {"": ((1.0, 2),), " sections": ((0.3, 1), (0.6, 0), (1.0, 2))}
SH_RANGE = (-0.9, 0.8)


def block(splats: Splats) -> float:
    """Returns the side of a bucket that holds all of the splats, wherever its centre is."""
    return float(np.float32(2.1 * np.ptp(splats.center, axis=0).max() + 0.001))


def as_ksplat(source: Scene, level: int, sections: str) -> bytes:
    return by_hand_ksplat.ksplat(
        **linear(source),
        level=level,
        sections=SECTIONS[sections],
        bucket_size=7 if sections else 16,
        block=block(source.splats),
        sh_range=None if sections else SH_RANGE,
    )


def ksplat_precision(source: Scene, level: int, sections: str) -> Precision:
    values = linear(source)
    bytes_of_color = Precision(opacity=1.001 / 510, rgb=1.001 / 510, rgb_range=(0, 1))
    if level == 0:
        return bytes_of_color
    low, high = (-1.5, 1.5) if sections else SH_RANGE
    sh = (high - low) / 510 * 1.001 if level == 2 else 2.0**-11 * float(np.abs(values["sh"]).max(initial=0))
    return dataclasses.replace(
        bytes_of_color,
        center=block(source.splats) / 65534 / 2 * 1.001 + rounding(values["center"]),
        log_scale=np.spacing(values["scale"].astype(np.float16)) / values["scale"] * 0.51,
        degrees=float(np.degrees(2 * 3**0.5 * 2.0**-12)),  # three components of up to 1 / sqrt(2), or fewer larger ones
        sh=(sh, sh),
    )


def held_by_ksplat(splats: Splats, sections: str) -> Splats:
    """Returns the splats with SH up to degree 2, and zeros where a section has a lower degree."""
    cut = by_hand_ksplat.parts(len(splats), SECTIONS[sections])
    held = splats.with_max_sh(max(degree for _, degree in cut))
    sh = held.sh.copy()
    for part, degree in cut:
        sh[part, (0, 3, 8)[degree] :] = 0
    return dataclasses.replace(held, sh=sh)


KSPLAT = {
    f"{level}{sections}": Case(
        "KSPLAT",
        functools.partial(as_ksplat, level=level, sections=sections),
        functools.partial(ksplat_precision, level=level, sections=sections),
        held=functools.partial(held_by_ksplat, sections=sections),
    )
    for level in (0, 1, 2)
    for sections in SECTIONS
}

# --- SPLAT ------------------------------------------------------------------------------------------------------------


def splat_precision(source: Scene) -> Precision:
    """Of four bytes of a rotation each is off by up to half a step of 1 / 128; the angle is off by twice that."""
    return Precision(degrees=float(np.degrees(2 * 2 / 256)), opacity=1.001 / 510, rgb=1.001 / 510, rgb_range=(0, 1))


def most_important_first(splats: Splats) -> Splats:
    importance = splats.scale.astype(np.float64).prod(axis=1) * splats.opacity
    return splats.with_max_sh(0).take(np.argsort(-importance))


SPLAT = {
    "sparklod": Case(
        "SPLAT", lambda source: b"".join(splat.encode(source)), splat_precision, held=most_important_first
    ),
    "by hand": Case(
        "SPLAT",
        lambda source: by_hand_splat.splat(**linear(source)),
        splat_precision,
        held=lambda splats: splats.with_max_sh(0),
    ),
}

# --- RAD --------------------------------------------------------------------------------------------------------------

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
    return RadOptions(**{name: known[number % len(known)] for name in SMALL_RAD for known in [choices(name)[1:]]})


RAD_OPTIONS = {
    "auto": RadOptions(),
    "chunked": RadOptions(chunked=True),
    **{f"encodings {number}": rad_encodings(number) for number in range(len(choices("sh")) - 1)},
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

#: Every way to write each format of the table, by its name there.
WRITERS: dict[str, dict[str, Case]] = {
    "PLY": PLY,
    "compressed PLY": COMPRESSED_PLY,
    "SPZ": SPZ,
    "SOG": SOG,
    "Streamed SOG": STREAMED_SOG,
    "KSPLAT": KSPLAT,
    "SPLAT": SPLAT,
    "RAD": RAD,
}
