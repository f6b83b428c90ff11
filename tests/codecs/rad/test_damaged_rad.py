"""Damaged RAD: headers that say anything else, and properties that are damaged under their compression.

As in test_damaged.py: a scene or a `FormatError`, and nothing else.
"""

from __future__ import annotations

import io
import json
import tracemalloc
import zlib

import numpy as np
import pytest

from fixtures import by_hand_rad
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.property_codings import CODINGS
from sparklod_cli.codecs.rad.rad_header import read_header
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.system.errors import FormatError, PromiseError
from tests.codecs.damage import VALUES, attempt, content, places_of, replaced
from tests.conftest import FIXTURES

WHOLE = "golden/sh1-tree.rad"
FILES = {path.name: path.read_bytes() for path in (FIXTURES / "golden" / "sh3-rad").iterdir()}
CHUNKED = "golden/sh3-rad/sh3.rad"
PARTS = by_hand_rad.split(content(WHOLE))

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("error")]  # they would go to standard error


def test_parts_are_put_together_again() -> None:
    assert attempt("", by_hand_rad.joined(PARTS)) == "scene"
    assert by_hand_rad.split(by_hand_rad.joined(PARTS)).keys() == PARTS.keys()


def tried(files: dict[str, bytes], name: str, data: bytes, threads: int) -> str:
    """What comes of a file of a chunked scene that is replaced by another."""
    changed = files | {name: data}
    return attempt(CHUNKED, changed["sh3.rad"], files=changed, threads=threads)


@pytest.mark.parametrize("name", ["file.json", "0.json"])
def test_a_changed_header_gives_a_scene_or_a_format_error(name: str) -> None:
    fields = json.loads(by_hand_rad.split(by_hand_rad.joined(PARTS))[name])
    refused = total = 0
    for path in places_of(fields)[1:]:
        for value in (..., *VALUES):
            text = json.dumps(replaced(fields, path, value)).encode()
            refused += attempt("", by_hand_rad.joined(PARTS | {name: text}, PARTS), threads=1 + total % 2) != "scene"
            total += 1
    assert refused > 0.4 * total


@pytest.mark.parametrize("name", sorted(FILES))
def test_a_chunk_file_cut_short_or_with_a_flipped_bit_gives_a_scene_or_a_format_error(name: str) -> None:
    data, rng = FILES[name], np.random.default_rng(3)
    assert tried(FILES, name, data, 2) == "scene"
    for end in {*range(0, len(data), 41), len(data) - 1}:
        assert tried(FILES, name, data[:end], 1) != "scene"
    for bit in {*rng.integers(0, 8 * len(data), 200), *range(64)}:
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        tried(FILES, name, bytes(changed), 1 + int(bit) % 2)


@pytest.mark.parametrize("name", [name for name in PARTS if name.startswith("0 ")])
def test_any_bytes_of_a_property_give_a_scene_or_a_format_error(name: str) -> None:
    rng = np.random.default_rng(8)
    size = len(PARTS[name])
    for data in (b"", b"\xff" * size, bytes(size), rng.bytes(size), PARTS[name][:-1], PARTS[name] + b"\0"):
        result = attempt("", by_hand_rad.joined(PARTS | {name: data}, PARTS))
        assert (result == "scene") <= (len(data) == size)
    assert attempt("", by_hand_rad.joined(PARTS | {name: PARTS[name][:-1]}, PARTS)).startswith(
        f"{name[2:]} of chunk 0 has {size - 1:,} bytes"
    )


def with_property(name: str, piece: bytes) -> bytes:
    """The file with other stored bytes of a property of its first chunk."""
    fields = json.loads(PARTS["0.json"])
    rest = {each["property"]: by_hand_rad.stored(PARTS[f"0 {each['property']}"]) for each in fields["properties"]}
    payload = b""
    for each in fields["properties"]:
        data = piece if each["property"] == name else rest[each["property"]]
        each |= {"offset": len(payload), "bytes": len(data)}
        payload += by_hand_rad.padded(data)
    chunk = by_hand_rad.headed(b"RADC", fields | {"payloadBytes": len(payload)})
    chunk += len(payload).to_bytes(8, "little") + payload
    header = json.loads(PARTS["file.json"])
    header |= {"count": 24, "chunks": [{"offset": 0, "bytes": len(chunk)}], "allChunkBytes": len(chunk)}
    return by_hand_rad.headed(b"RAD0", header) + chunk


@pytest.mark.parametrize(
    ("piece", "message"),
    [
        (b"\xff\xff", "corrupt data in rgb of chunk 0"),
        (by_hand_rad.stored(bytes(72))[:-1], "rgb of chunk 0 has 71 bytes"),
        (by_hand_rad.stored(bytes(72)).replace(b"\1", b"\0", 1), "its compressed data do not end"),
        (by_hand_rad.stored(bytes(73)), "more than the 72 bytes of 24 splats in r8_delta"),
        (b"", "rgb of chunk 0 has 0 bytes; 24 splats in r8_delta take 72"),
    ],
)
def test_data_that_are_not_those_of_the_splats_say_what_they_are(piece: bytes, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        decode_file(rad, io.BytesIO(with_property("rgb", piece)), validate=False)


def test_a_deflate_bomb_is_not_unpacked() -> None:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    bomb = packer.compress(bytes(1 << 28)) + packer.flush()
    data = with_property("rgb", bomb)
    tracemalloc.start()
    with pytest.raises(FormatError, match="more than the 72 bytes"):
        decode_file(rad, io.BytesIO(data), validate=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6


@pytest.mark.parametrize("count", [10**9, 4 * 10**9, 2**63, 10**18])
def test_a_header_that_promises_too_much_is_refused_before_memory_is_asked_for(count: int) -> None:
    header = json.loads(PARTS["file.json"])
    entry = {"offset": 0, "bytes": len(content(WHOLE)) - read_header(io.BytesIO(content(WHOLE))).bytes}
    fields = json.loads(PARTS["0.json"])
    chunk = by_hand_rad.headed(b"RADC", fields | {"count": count, "properties": [], "payloadBytes": 0}) + bytes(8)
    entry["bytes"] = len(chunk)
    header |= {"count": count, "chunkSize": count, "chunks": [entry], "allChunkBytes": len(chunk)}
    data = by_hand_rad.headed(b"RAD0", header) + chunk
    tracemalloc.start()
    with pytest.raises(PromiseError, match="more than a file of"):
        decode_file(rad, io.BytesIO(data))
    file = io.BytesIO(data)
    known = read_header(file)
    with pytest.raises(PromiseError, match="more than a file of"):
        rad.read_chunk(file, known.chunks[0], known)
    assert tracemalloc.get_traced_memory()[1] < 2e6
    tracemalloc.stop()


def test_a_chunk_that_ends_beyond_its_file_is_refused_before_memory_is_asked_for() -> None:
    header = json.loads(PARTS["file.json"])
    header["chunks"][0]["bytes"] = 10**15
    data = by_hand_rad.headed(b"RAD0", header)
    file = io.BytesIO(data)
    known = read_header(file)
    with pytest.raises(FormatError, match="cut short"):
        rad.read_chunk(file, known.chunks[0], known)
    with pytest.raises(FormatError, match=r"cut short|inside"):
        decode_file(rad, io.BytesIO(data))


def test_a_label_beyond_the_palette_is_named() -> None:
    chunk = by_hand_rad.split(FILES["sh3-1.radc"])
    labels = np.full(24, 24, "<u2").tobytes()
    data = by_hand_rad.joined(chunk | {"0 sh_label": labels}, chunk)
    header = json.loads(by_hand_rad.split(FILES["sh3.rad"])["file.json"])
    header["chunks"][1]["bytes"] = len(data)
    files = FILES | {"sh3-1.radc": data, "sh3.rad": by_hand_rad.headed(b"RAD0", header)}
    result = attempt(CHUNKED, files["sh3.rad"], files=files)
    assert result == "SH label 24 of chunk 1 is beyond the 24 codes of the palette"


def test_a_range_that_float32_cannot_hold_is_refused_without_a_warning() -> None:
    fields = json.loads(PARTS["0.json"])
    ranged = next(number for number, each in enumerate(fields["properties"]) if CODINGS[each["encoding"]].ends)
    text = json.dumps(replaced(fields, ("properties", ranged, "max"), 1e39)).encode()
    with pytest.raises(FormatError, match=r"its max is 1e\+39$"):
        decode_file(rad, io.BytesIO(by_hand_rad.joined(PARTS | {"0.json": text}, PARTS)))
