"""Unpacks compressed splat files into parts and packs them again: changes to the parts get past checksums."""

from __future__ import annotations

import functools
import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import zstandard
from PIL import Image

from fixtures import by_hand, by_hand_glb, by_hand_rad, by_hand_sog

from .case import Rng
from .mutate import INTEGERS, json_mutated, mutated, pick, text_mutated
from .pickles import pickle_mutated

FIXTURES = Path(__file__).resolve().parents[1] / "fixtures"

#: Small files of every format. Those in faults/ are broken already; changed further, they reach other code.
PATTERNS = ("one.ply", "sh[0-3]*.ply", "flat.ply", "golden/*.*", "faults/*.*")

#: Seeds are at most this long, in bytes, so that a case takes milliseconds.
LARGEST = 32_000

#: Number of leading bytes that are changed more often than others, since they say what the others mean.
HEADER = 120

#: Exceptions that reading a broken container raises.
BROKEN = (
    *(EOFError, KeyError, OSError, TypeError, ValueError),
    *(struct.error, zipfile.BadZipFile, zlib.error, zstandard.ZstdError),
)

Parts = Mapping[str, bytes]


@functools.cache
def seeds() -> Mapping[str, bytes]:
    """The files that cases start from, by their path in fixtures/."""
    paths = sorted({path for pattern in PATTERNS for path in FIXTURES.glob(pattern) if path.is_file()})
    files = {str(path.relative_to(FIXTURES)): path.read_bytes() for path in paths}
    return {name: data for name, data in files.items() if len(data) <= LARGEST}


@functools.cache
def valid_seeds() -> tuple[str, ...]:
    """Names of the seeds that are valid files."""
    return tuple(name for name in seeds() if not name.startswith("faults/"))


#: Folders of files that belong together, and the names by which a command is given them.
FOLDERS = {
    "sh1-sog": (".", "meta.json"),
    "sh1-streamed-sog": (".", "lod-meta.json"),
    "sh1-tiles": (".", "tileset.json"),
    "sh3-rad": ("sh3.rad",),
    "sh1-gltf": ("scene.gltf",),
}


def folder_seed(name: str) -> dict[str, bytes]:
    """The files of one of `FOLDERS` and of the folders there, by their paths in it."""
    folder = FIXTURES / "golden" / name
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def split_file(data: bytes) -> tuple[Parts, Callable[[Parts], bytes]]:
    """Splits a file into named parts, and returns a function that makes a file of parts again."""
    try:
        if data[:2] == b"\x1f\x8b":
            raw = gzip.decompress(data)
            return {"header": raw[:16], "payload": raw[16:]}, _gzipped
        if data[:4] == b"NGSP":
            return _spz_4(data)
        if data[:3] == b"RAD":
            rad = by_hand_rad.split(data)
            return rad, functools.partial(by_hand_rad.joined, original=rad)
        if data[:4] == b"glTF":
            root, content = by_hand_glb.split(data)
            return {"glTF.json": json.dumps(root).encode(), "payload": content}, _glb
        if data[:4] == b"PK\x03\x04":
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                return {name: archive.read(name) for name in archive.namelist()}, by_hand_sog.zipped
    except BROKEN:
        return {"file": data}, _joined  # the seed itself is broken
    end = data.find(b"end_header\n") + 11 if data[:3] == b"ply" else 0
    return ({"text": data[:end], "payload": data[end:]} if end > 11 else {"file": data}), _joined


def _joined(parts: Parts) -> bytes:
    return b"".join(parts.values())


def _glb(parts: Parts) -> bytes:
    text, content = parts.values()
    return by_hand_glb.container_of(text, content)


def _gzipped(parts: Parts) -> bytes:
    return gzip.compress(_joined(parts), 1, mtime=0)


def _spz_4(data: bytes) -> tuple[Parts, Callable[[Parts], bytes]]:
    count, at = data[15], struct.unpack_from("<I", data, 16)[0]
    parts, end = {"header": data[:at]}, at + 16 * count
    for index in range(count):
        packed, size = struct.unpack_from("<QQ", data, at + 16 * index)
        frame = zstandard.ZstdDecompressor().decompress(data[end : end + packed], max_output_size=min(size, 1 << 20))
        parts[f"stream {index}"] = frame
        end += packed

    def joined(parts: Parts) -> bytes:
        header, *streams = parts.values()
        frames = [by_hand.zstd_stored(stream[: 1 << 17]) for stream in streams]
        table = b"".join(
            struct.pack("<QQ", len(frame), len(stream)) for frame, stream in zip(frames, streams, strict=True)
        )
        return b"".join([header, table, *frames])

    return parts, joined


def mutated_scene(rng: Rng, data: bytes, other: bytes) -> tuple[str, bytes]:
    """Changes the bytes of a splat file, or those under its compression; returns "bytes" or "inside", and the file."""
    parts, joined = split_file(data)
    if len(parts) == 1 or rng.integers(3) == 0:
        return "bytes", mutated(rng, data, other=other, header=HEADER)
    changed = dict(parts)
    long = [name for name in parts if name not in ("header", "text", "meta.json")]
    for _ in range(int(pick(rng, (1, 1, 2)))):
        name = pick(rng, long if rng.integers(2) else list(parts))
        changed[name] = mutated_part(rng, name, parts[name])
    return "inside", joined(changed)


def mutated_part(rng: Rng, name: str, data: bytes) -> bytes:
    """Changes a part of a splat file by its kind: the structure of JSON, opcodes, the pixels of an image, or text."""
    if name.endswith(".json") and rng.integers(4):
        return json_mutated(rng, data)
    if name.endswith("data.pkl") and rng.integers(8):
        return pickle_mutated(rng, data)
    if name.endswith(".webp") and rng.integers(3):
        return _picture(rng, data)
    if name == "text" and rng.integers(3):
        return text_mutated(rng, data.decode("utf-8", "replace")).encode("utf-8", "replace")
    return mutated(rng, data, header=16 if name == "header" else 0)


def _picture(rng: Rng, data: bytes) -> bytes:
    try:
        with Image.open(io.BytesIO(data)) as image:
            pixels = np.asarray(image.convert("RGBA")).copy()
    except (OSError, ValueError, Image.DecompressionBombError):
        return mutated(rng, data)
    kind = int(rng.integers(6))
    if kind == 0:
        pixels = pixels[: int(rng.integers(1, len(pixels) + 1)), : int(rng.integers(1, pixels.shape[1] + 1))]
    elif kind == 1:
        sides = [number for number in INTEGERS if 1 <= number <= 16384]
        return by_hand_sog.flat_webp(pick(rng, sides), pick(rng, sides))
    elif kind == 2:
        pixels[..., int(rng.integers(4))] = int(rng.integers(256))
    elif kind == 3:
        return by_hand_sog.webp(np.ascontiguousarray(pixels[..., :3]))
    else:
        flat = pixels.reshape(-1)
        flat[rng.integers(len(flat), size=20)] = rng.integers(0, 256, 20)
    return by_hand_sog.webp(np.ascontiguousarray(pixels))
