"""Every way to write each format, and the precision with which it keeps a scene: the input of the shared laws."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fixtures import (
    by_hand,
    by_hand_checkpoint,
    by_hand_compressed_ply,
    by_hand_glb,
    by_hand_hier,
    by_hand_ksplat,
    by_hand_sog,
    by_hand_splat,
    by_hand_streamed_sog,
    by_hand_tiles,
)
from sparklod_cli.codecs import gltf as glb
from sparklod_cli.codecs import ply, quantize, sh_palette, sog, splat, spz
from sparklod_cli.codecs import sog_images as codings
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.codecs.sog import LARGE, SEEN
from sparklod_cli.codecs.sog_images import codebook
from sparklod_cli.model import morton
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from sparklod_cli.model.splats import Splats
from tests.codecs.cases import (
    Array,
    Case,
    Content,
    Precision,
    exact,
    largest_dropped_degrees,
    linear,
    rounding,
    stated_degrees,
)
from tests.codecs.rad_cases import RAD

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
    coding = quantize.decode_quat_smallest_three if version >= 3 else quantize.decode_quat_first_three
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
    for version, lod in ((2, False), (2, True), (3, False), (3, True), (4, False))
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
SECTIONS: Mapping[str, tuple[tuple[float, int], ...]] = {
    "": ((1.0, 3),),
    " sections": ((0.3, 1), (0.6, 0), (0.8, 3), (1.0, 2)),
}
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
    """Returns the splats with zeros where the SH of a section have a lower degree."""
    cut = by_hand_ksplat.parts(len(splats), SECTIONS[sections])
    held = splats.with_max_sh(max(degree for _, degree in cut))
    sh = held.sh.copy()
    for part, degree in cut:
        sh[part, (0, 3, 8, 15)[degree] :] = 0
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

# --- GLB --------------------------------------------------------------------------------------------------------------


def written_glb(source: Scene, profile: str) -> bytes:
    return b"".join(glb.encode(source, WriteOptions(glb_profile=profile)))


GLB = {
    "sparklod": Case("GLB", functools.partial(written_glb, profile="khronos"), exact),
    "sparklod, SPZ": Case(
        "GLB SPZ 3",
        functools.partial(written_glb, profile="cesium"),
        functools.partial(spz_precision, version=3),
    ),
    "by hand": Case("GLB", lambda source: by_hand_glb.glb(**linear(source)), exact),
    "interleaved": Case("GLB", lambda source: by_hand_glb.glb(**linear(source), interleaved=True), exact),
    "quantized": Case(
        "GLB",
        lambda source: by_hand_glb.glb(**linear(source), quantized=True),
        lambda source: Precision(degrees=0.01, opacity=1.001 / 510),
    ),
}


def in_parts(source: Scene, **more: Any) -> bytes:
    """Two primitives, each of a half of the splats."""
    values = linear(source)
    parts = [part for part in np.array_split(np.arange(len(source)), 2) if len(part)]
    halves = [by_hand_glb.glb(**{name: column[part] for name, column in values.items()}) for part in parts]
    return by_hand_glb.together(halves, **more)


GLB |= {
    "draft": Case("GLB", lambda source: by_hand_glb.glb(**linear(source), draft=True), exact),
    "two nodes": Case("GLB", in_parts, exact),
    "two primitives": Case("GLB", functools.partial(in_parts, one_mesh=True), exact),
}


def as_gltf(source: Scene, buffer: str) -> Content:
    text, content = by_hand_glb.as_json(by_hand_glb.glb(**linear(source)), buffer)
    return {"scene.gltf": text, "buffers/a b.bin": content}


GLTF = {
    "data within": Case("glTF", lambda source: by_hand_glb.as_json(by_hand_glb.glb(**linear(source)))[0], exact),
    "file": Case("glTF", functools.partial(as_gltf, buffer="./buffers/a%20b.bin"), exact),
}

# --- 3D Tiles ---------------------------------------------------------------------------------------------------------


def as_tiles(source: Scene, *, nested: bool = False) -> Content:
    """A root of some of the splats, and three tiles of all of them, of which the last is a nested tileset."""
    values = linear(source)
    parts = [part for part in np.array_split(np.arange(len(source)), 3) if len(part)]
    tiles = [by_hand_tiles.Tile({name: column[part] for name, column in values.items()}) for part in parts]
    if nested:
        tiles[-1] = dataclasses.replace(tiles[-1], children=[tiles[-1]], nested=True)
    root = by_hand_tiles.Tile({name: column[::3] for name, column in values.items()}, tiles)
    return by_hand_tiles.tileset_files(root, by_hand_glb.glb)


def as_tiles_of_json(source: Scene) -> Content:
    """Tiles of glTF as JSON, whose buffers are files beside them."""
    files = as_tiles(source, nested=True)
    assert isinstance(files, dict)
    made: dict[str, bytes] = {}
    for name, data in files.items():
        path, suffix = name.rsplit(".", 1)
        if suffix == "glb":
            buffer = f"{path}.bin"
            made[f"{path}.gltf"], made[buffer] = by_hand_glb.as_json(data, buffer.rsplit("/", 1)[-1])
        else:
            made[name] = data.replace(b".glb", b".gltf")
    return made


TILES = {
    "by hand": Case("3D Tiles 1.1 of GLB", as_tiles, exact),
    "nested": Case("3D Tiles 1.1 of GLB", functools.partial(as_tiles, nested=True), exact),
    "JSON": Case("3D Tiles 1.1 of glTF", as_tiles_of_json, exact),
}

# --- Checkpoints ------------------------------------------------------------------------------------------------------

CHECKPOINT = {
    name: Case(
        "checkpoint",
        lambda source, ways=ways: by_hand_checkpoint.checkpoint(**linear(source), **ways),
        exact,
    )
    for name, ways in {
        "gsplat": {},
        "gsplat, float64": {"number": "<f8"},
        "nerfstudio": {"program": "nerfstudio"},
        "nerfstudio, old": {"program": "nerfstudio", "prefix": "_model."},
    }.items()
}

# --- Hierarchies ------------------------------------------------------------------------------------------------------


def with_all_sh(splats: Splats) -> Splats:
    sh = np.zeros((len(splats), 15, 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh
    return dataclasses.replace(splats, sh=sh)


def half_precision(source: Scene) -> Precision:
    values = linear(source)
    sh = 2.0**-11 * float(np.abs(values["sh"]).max(initial=0)) + 2.0**-25
    return Precision(
        log_scale=2.0**-11 * np.abs(np.log(values["scale"])) + 2e-6,
        degrees=float(np.degrees(2 * 2 * 2.0**-11)),  # four components of three or less, which are divided by that
        opacity=2.0**-12 * 1.001,
        rgb=2.0**-11 * np.abs(values["rgb"] - 0.5) + 1e-6,
        sh=(sh, sh),
    )


HIER = {
    "floats": Case("HIER", lambda source: by_hand_hier.hier(**linear(source)), exact, held=with_all_sh),
    "halves": Case(
        "HIER", lambda source: by_hand_hier.hier(**linear(source), half=True), half_precision, held=with_all_sh
    ),
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
    "GLB": GLB,
    "glTF": GLTF,
    "3D Tiles": TILES,
    "checkpoint": CHECKPOINT,
    "HIER": HIER,
}
