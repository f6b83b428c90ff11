"""Damage for the files of every format, and what a decoder makes of it."""

from __future__ import annotations

import functools
import gzip
import io
import struct
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from fixtures import by_hand_sog
from sparklod_cli.codecs.formats import HEAD, Format, sniff
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import decode
from tests.conftest import FIXTURES

#: Files to damage: small ones of every kind that is read.
FILES = (
    "one.ply",
    "sh1.ply",
    "sh1-ascii.ply",
    "sh1-big-endian.ply",
    "golden/sh3-compressed.ply",
    "golden/sh1-compressed-old.ply",
    *(f"golden/hand-{name}.spz" for name in ("v1", "v2", "v3", "v4", "v4-sh4")),
    *(f"golden/tree-v{version}.spz" for version in (2, 3)),
    "golden/sh3-v2.sog",
    "golden/sh2-v1.sog",
    "golden/sh1-streamed-sog/lod-meta.json",
    "golden/sh1-tiles/tileset.json",
    *(f"golden/sh2-level{level}.ksplat" for level in (0, 1, 2)),
    "golden/sh0.splat",
    *("golden/sh1.hier", "golden/sh3-half.hier"),
    *("golden/sh2-gsplat.pt", "golden/sh1-nerfstudio.ckpt"),
    "golden/sh1-tree.rad",
    *(f"golden/{name}.glb" for name in ("sh2", "sh1-quantized", "hand-spz", "sh1-draft", "parts")),
    *("golden/sh2.gltf", "golden/sh1-gltf/scene.gltf"),
)
GZIPPED = tuple(name for name in FILES if name.endswith(".spz") and "v4" not in name)
ZIPPED = tuple(name for name in FILES if name.endswith(".sog"))
#: Of a processor, which are no fewer where other processes want it, too.
SECONDS = 2.0


@functools.cache
def content(name: str) -> bytes:
    return (FIXTURES / name).read_bytes()


@functools.cache
def files_of(name: str) -> dict[str, bytes]:
    """All files of the folder of a manifest, and of the folders there."""
    folder = (FIXTURES / name).parent
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.glob("*/*") if path.is_file()}


def format_of(name: str, data: bytes) -> Format | None:
    return sniff(data[:HEAD], Path(name).suffix)


@functools.cache
def _load_kernels() -> None:
    """Decodes a file of a format that needs kernels, whose loading takes longer than any damage."""
    name = "golden/sh3-v2.sog"
    decode(format_of(name, content(name)).codec(), content(name))  # type: ignore[union-attr]


def attempt(name: str, data: bytes, *, files: Mapping[str, bytes] | None = None, threads: int = 1) -> str:
    """Decode bytes in a file of this name, among others if need be; return "scene", "unknown" or the error's text."""
    form = format_of(name, data)
    if form is None:
        return "unknown"
    more = companions(form, (files_of(name) if name and files is None and form.folders else files) or {})
    _load_kernels()
    start = time.process_time()
    try:
        scene = decode(form.codec(), data, threads=threads, **more)
    except FormatError as error:
        assert "\n" not in str(error)
        result = str(error)
    else:
        assert isinstance(scene, Scene)
        if scene.tree:
            scene.tree.validate()
        result = "scene"
    assert time.process_time() - start < SECONDS
    return result


def companions(form: Format, files: Mapping[str, bytes]) -> dict[str, Any]:
    """Arguments of a decoder whose format names other files: what opens them."""

    def open_companion(name: str) -> BinaryIO:
        if name not in files:
            raise FormatError("there is no such file")
        return io.BytesIO(files[name])

    return {"open_companion": open_companion} if form.companions else {}


def header(name: str, data: bytes) -> list[int]:
    """Where the bytes of a file are that say what the others mean."""
    if name.endswith(".ply"):
        return list(range(data.index(b"end_header\n") + 11))
    if name.endswith(".ksplat"):
        return [base + place for base in (0, 4096, 5120, 6144) for place in range(44)]
    if name.endswith(".sog"):  # the end is the directory, which decides
        return [*range(120), *range(len(data) - 400, len(data))]
    if name.endswith(".glb"):
        return list(range(28 + struct.unpack_from("<I", data, 12)[0]))
    if name.endswith(".rad"):  # the file's, and that of the first chunk
        return list(range(data.index(b"RADC") + 1200))
    if name.endswith(".hier"):  # the number of splats, and the nodes without their boxes
        count = struct.unpack_from("<i", data)[0]
        nodes, node = (4 + 236 * count, 28) if count > 0 else (4 - 124 * count, 20)
        return [*range(4), *range(nodes, nodes + 4 + node * struct.unpack_from("<i", data, nodes)[0])]
    return list(range(len(data) if name.endswith(".json") else min(120, len(data))))


def insides(name: str) -> list[tuple[bytes, Callable[[bytes], bytes]]]:
    """What lies under a file's checksums, part by part, and what puts the file together again around another part."""
    if name in GZIPPED:
        return [(gzip.decompress(content(name)), lambda data: gzip.compress(data, 1))]
    if name in ZIPPED:
        files = members(name)
        return [
            (data, lambda other, part=part: by_hand_sog.zipped(files | {part: other})) for part, data in files.items()
        ]
    return [(content(name), bytes)]


@functools.cache
def members(name: str) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content(name))) as archive:
        return {part: archive.read(part) for part in archive.namelist()}


WORDS = (
    *(b"element ", b"vertex", b"property ", b"list uchar int ", b"format ascii 1.0\n", b"comment ", b"end_header\n"),
    *(b"\n", b" ", b"-1", b"0", b"99999999999999999999", b"4294967295", b"1e999", b"\0", b"\xff", b"nan", b"inf"),
    *(b"NaN", b"-Infinity", b"null", b"true", b'"', b"{", b"}", b"[", b"]", b",", b":", b'"count":', b'"files":["'),
)

#: Values in place of any other in a JSON document.
VALUES = (
    *(None, True, "", "1", "means_l.webp", "two\nlines", "\ud800.webp", "\0", "x" * 3000),
    *({}, [], [[]], [None], ["a", "b"], {"0": 1}),
    *(0, -1, 1, 2, 3, 0.5, -3e37, 3e37, -1e300, 1e300, 2**31, 2**64, 10**40, float("nan"), float("inf"), float("-inf")),
)


def places_of(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to all that is in a JSON document; of long lists, to the ends."""
    keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    inner = [key for key in keys if not isinstance(key, int) or key < 2 or key == len(node) - 1]
    return [path, *(place for key in inner for place in places_of(node[key], (*path, key)))]


def replaced(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy of a JSON document with another value in one place; without it, if that is `...`."""
    if not path:
        return value
    copy = dict(document) if isinstance(document, dict) else list(document)
    if value is ... and len(path) == 1:
        del copy[path[0]]
    else:
        copy[path[0]] = replaced(copy[path[0]], path[1:], value)
    return copy
