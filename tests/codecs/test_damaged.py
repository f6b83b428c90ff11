"""Damaged bytes: a decoder gives a scene or a `FormatError`, and nothing else, quickly and in little memory.

A stream of the same bytes fails with the same words, or gives the same splats.
"""

from __future__ import annotations

import gzip
import io
import itertools
import json
import struct
import tracemalloc
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fixtures import by_hand_sog
from sparklod_cli.codecs.formats import FORMATS, sniff
from sparklod_cli.codecs.reader import OpenFile
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError, HasTreeError
from tests.codecs.cases import assert_same, decode
from tests.codecs.damage import (
    FILES,
    GZIPPED,
    VALUES,
    WORDS,
    ZIPPED,
    attempt,
    companions,
    content,
    files_of,
    format_of,
    header,
    insides,
    members,
    places_of,
    replaced,
)
from tests.conftest import FIXTURES

#: Bytes; a header may promise 64 MiB without being doubted.
MEMORY = 2e8

pytestmark = pytest.mark.filterwarnings("error")  # warnings would go to standard error

# --- Decoding ---------------------------------------------------------------------------------------------------------


def test_the_files_are_of_every_format() -> None:
    assert {format_of(name, content(name)) for name in FILES} == set(FORMATS)
    assert [attempt(name, content(name)) for name in FILES] == ["scene"] * len(FILES)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_file_truncated_anywhere_is_refused(name: str) -> None:
    data = content(name)
    spread, end = range(0, len(data), max(1, len(data) // 97)), range(len(data) - 9, len(data))
    harmless: Iterable[int] = ()
    if "ascii" in name:  # without its last newline, or a digit before it, it is still one of numbers
        harmless = range(data.rindex(b" ") + 2, len(data))
    elif name.endswith(".splat"):  # nothing says how many there should be
        harmless = range(0, len(data), 32)
    for place in sorted({*header(name, data), *spread, *end} - set(harmless)):
        assert attempt(name, data[:place]) != "scene", place


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_flipped_bit_gives_a_scene_or_a_format_error(name: str) -> None:
    data, rng = content(name), np.random.default_rng(10)
    every = [8 * place + bit for place in header(name, data) for bit in range(8)]
    tries = 150 if name in ZIPPED else 400  # images take longer
    bits = {*rng.choice(every, min(len(every), tries), replace=False), *rng.integers(0, 8 * len(data), tries // 2)}
    if not name.endswith(".ply"):  # a bit of the count is a promise of billions; tracing plyfile would take long
        tracemalloc.start()
    refused = sum(attempt(name, flipped(data, bit)) != "scene" for bit in sorted(bits))
    peak = tracemalloc.get_traced_memory()[1]  # 0 if nothing is traced
    tracemalloc.stop()
    assert peak < MEMORY
    if name in GZIPPED:
        assert refused >= len(bits) - 8 * 7  # unseen: the header's time, system, level and a flag; padding
    elif not name.endswith(".splat"):  # all bits of which are numbers
        assert refused > 0.1 * len(bits)


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*GZIPPED, *ZIPPED])
def test_flipped_bits_under_a_valid_checksum_give_a_scene_or_a_format_error(name: str) -> None:
    """What a faulty writer could make: gzip or zip find nothing wrong with it."""
    rng = np.random.default_rng(15)
    for data, packed in insides(name):
        first = range(8 * min(len(data), 400 if name in GZIPPED else 6))
        for bit in {*first, *(rng.integers(0, 8 * len(data), 30) if name in ZIPPED else ())}:
            attempt(name, packed(flipped(data, bit)))


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("seed", range(2))
def test_inserted_deleted_or_changed_bytes_give_a_scene_or_a_format_error(name: str, seed: int) -> None:
    rng = np.random.default_rng([11, seed, len(name)])
    raw, packed = insides(name)[0]  # of SOG, meta.json
    reach = [len(header(name, raw)), len(raw)]
    for _ in range(150):
        data = bytearray(raw)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(0, min(len(data), reach[rng.integers(2)]) + 1))
            start = int(rng.integers(0, len(data) + 1))
            width = int(rng.choice([1, 2, 5, 20]))
            kind = rng.integers(4)
            if kind == 0:
                data[at:at] = WORDS[rng.integers(len(WORDS))]
            elif kind == 1:
                del data[at : at + width]
            elif kind == 2:
                data[at : at + width] = data[start : start + width]
            else:
                data[at : at + width] = rng.bytes(width)
        attempt(name, packed(bytes(data)), threads=2)


NUMBERS = (np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45, 0.0, -1.0)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", [name for name in FILES if name.endswith(("splat", "compressed.ply", "old.ply"))])
def test_invalid_numbers_are_passed_on_without_a_warning(name: str, threads: int) -> None:
    """Whether they are an error is for `selection` to say; numpy must not warn of them, on any thread."""
    raw = content(name)
    begin = len(header(name, raw)) if name.endswith(".ply") else 6144 if name.endswith(".ksplat") else 0
    places = np.arange(begin, len(raw) - 3, 4)
    if name.endswith(".ksplat"):
        places = np.concatenate([[36, 40, 4096 + 16, 5120 + 16], places])  # the range of SH bytes, the size of buckets
    rng = np.random.default_rng(16)
    for number in NUMBERS:
        for chosen in (places, places[:4], *(rng.choice(places, 20) for _ in range(5))):
            data = bytearray(raw)
            for place in chosen:
                data[place : place + 4] = struct.pack("<f", number)
            result = attempt(name, bytes(data), threads=threads)
            assert result == "scene" or name.endswith(".ksplat")


MAGICS = (
    *(b"ply\n", b"ply\r", b"ply\nelement chunk 1\nelement vertex 1\nproperty uint packed_position\n"),
    *(b"\x1f\x8b\x08\0", b"NGSP", b"PK\x03\x04", b'{"quats":1, "means":', b'{"lodLevels":'),
    *(b'{"asset":{},"geometricError":', b'{"asset":{"version":"2.0"},"accessors":['),
    b"PK\x03\x04" + bytes(26) + b"archive/data.pkl",
    *(b"\0\1\0\0\1\0\0\0", b"\0\1\0\0\3" + bytes(4091)),
    *(b"RAD0", b"RAD0\40\0\0\0{", b"RADC", b"glTF", b"glTF\2\0\0\0"),
)


def test_every_format_with_a_magic_is_tried() -> None:
    assert {sniff(magic, "") for magic in MAGICS} == {form for form in FORMATS if not form.unmarked}


@pytest.mark.slow
@pytest.mark.parametrize("magic", MAGICS)
def test_random_bytes_after_a_magic_are_refused(magic: bytes) -> None:
    rng = np.random.default_rng(12)
    for size in (0, 1, 12, 40, 1000, 100_000):
        for _ in range(10):
            data = magic + rng.bytes(size)
            assert attempt("", data) != "scene"
            other = data.replace(b"\n", b" ") if magic.startswith(b"ply") else gzip.compress(data)
            assert attempt("", other) != "scene"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", sorted({suffix for form in FORMATS for suffix in form.suffixes}))
def test_random_bytes_with_a_suffix_are_refused(suffix: str) -> None:
    rng = np.random.default_rng(14)
    for size in (0, 1, 12, 31, 33, 1000, 4097, 100_001):
        for _ in range(10):
            assert attempt(f"scene{suffix}", rng.bytes(size)) != "scene" or (size == 0 and suffix == ".splat")


# --- SOG: a meta.json that says anything else, and images that are something else -------------------------------------

SOG = "golden/sh1-sog/meta.json"
SOG_FILES = {path.name: path.read_bytes() for path in (FIXTURES / SOG).parent.iterdir()}


@pytest.mark.parametrize("name", [SOG, *ZIPPED])
def test_a_changed_meta_json_gives_a_scene_or_a_format_error(name: str) -> None:
    files = SOG_FILES if name == SOG else members(name)
    meta = json.loads(files["meta.json"])
    refused = tried = 0
    for number, path in enumerate(places_of(meta)[1:]):
        for value in (..., *VALUES)[number % 3 :: 3]:  # all of them at neighbouring places
            text = json.dumps(replaced(meta, path, value)).encode()
            data = text if name == SOG else by_hand_sog.zipped(files | {"meta.json": text})
            refused += attempt(name, data, files=files, threads=1 + tried % 2) != "scene"
            tried += 1
    assert refused > 0.5 * tried


@pytest.mark.parametrize("part", ["means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"])
def test_changed_swapped_or_missing_images_give_a_scene_or_a_format_error(part: str) -> None:
    meta, whole = SOG_FILES["meta.json"], SOG_FILES[part]
    assert attempt(SOG, meta, files=SOG_FILES) == "scene"
    assert attempt(SOG, meta, files={name: data for name, data in SOG_FILES.items() if name != part}) != "scene"
    others = [meta, b"GIF89a" + bytes(99), content("one.ply"), by_hand_sog.flat_webp(4, 4)]
    for other in [*others, *(whole[:end] for end in range(0, len(whole), 5))]:
        assert attempt(SOG, meta, files=SOG_FILES | {part: other}) != "scene"
    attempt(SOG, meta, files=SOG_FILES | {part: SOG_FILES["shN_centroids.webp"]})


# --- Streams ----------------------------------------------------------------------------------------------------------


def outcome(make: Callable[[], Splats]) -> Splats | str | None:
    """The splats, or what is wrong; None for a tree."""
    try:
        return make()
    except HasTreeError:
        return None
    except FormatError as error:
        return f"{type(error).__name__}: {error}"


def compare(name: str, data: bytes) -> str:
    """What both come to: "tree", "splats" or the error's text."""
    form = format_of(name, data)
    if form is None:
        return "unknown"
    codec: Any = form.codec()
    more = companions(form, files_of(name)) if form.folders else {}

    def in_memory(pieces: Callable[[], Iterable[bytes]]) -> OpenFile:
        return OpenFile(io.BytesIO(b"".join(pieces())))

    def streamed() -> Splats:
        reader = codec.open_content(OpenFile(io.BytesIO(data), scratch=in_memory, **more))
        return Splats.concat([Splats.empty(0, reader.sh_degree), *reader.blocks()])

    whole, found = outcome(lambda: decode(codec, data, **more).splats), outcome(streamed)
    if found is None:
        return "tree"
    if isinstance(whole, Splats) and isinstance(found, Splats):
        assert_same(found, whole)
        return "splats"
    assert found == whole
    return str(found)


def damaged(name: str, rng: np.random.Generator) -> Iterable[bytes]:
    """The bytes of a file as they are, cut short, with other bits, and with words in between."""
    data, packed = insides(name)[0]  # of SOG, meta.json
    yield packed(data)
    for raw, rest in ((content(name), bytes), (data, packed)):
        places = header(name, raw) if raw is not data or rest is bytes else list(range(len(raw)))
        for kind in range(40):
            changed = bytearray(raw)
            at = int(rng.choice(places)) if kind % 2 else int(rng.integers(len(raw)))
            at = min(at, len(raw) - 1)
            if kind % 4 == 0:
                del changed[at:]
            elif kind % 4 == 1:
                changed[at:at] = WORDS[rng.integers(len(WORDS))]
            else:
                changed[at] ^= 1 << int(rng.integers(8))
            yield rest(bytes(changed))


@pytest.mark.parametrize("name", FILES)
def test_a_stream_of_damaged_bytes_fails_as_the_decoder_does(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.codecs.reader.BLOCK_SPLATS", 20)
    rng = np.random.default_rng([17, len(name)])
    found = [compare(name, data) for data in damaged(name, rng)]
    assert found[0] == ("tree" if "tree" in name else "splats")
    assert name.endswith(".splat") or any(text not in ("tree", "splats", "unknown") for text in found)


@pytest.mark.parametrize("name", ZIPPED)
def test_of_two_faults_a_stream_of_sog_finds_the_one_that_the_decoder_does(name: str) -> None:
    """Images are read in an order of their own; a label beyond the palette is found in an image that is whole."""
    files = members(name)
    images = [part for part in files if part != "meta.json"]
    labels = json.loads(files["meta.json"])["shN"]["files"][1]
    with Image.open(io.BytesIO(files[labels])) as image:
        beyond = np.full((image.height, image.width, 4), 255, np.uint8)
    faults = [{part: b"GIF89a" + bytes(99)} for part in images]
    faults += [{part: files[part][: len(files[part]) // 2]} for part in images]
    faults += [{labels: by_hand_sog.webp(beyond)}]
    texts = {
        compare(name, by_hand_sog.zipped(files | first | second))
        for first, second in itertools.combinations(faults, 2)
        if first.keys() != second.keys()
    }
    assert len(texts) > len(images)
    assert compare(name, by_hand_sog.zipped(files | faults[-1])).startswith("FormatError: an SH label")
