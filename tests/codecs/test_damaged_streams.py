"""Damaged bytes: a stream and the decoder of the whole file fail with the same words, or give the same splats."""

from __future__ import annotations

import io
import itertools
import json
from collections.abc import Callable, Iterable
from typing import Any, BinaryIO

import numpy as np
import pytest
from PIL import Image

from fixtures import by_hand_sog
from sparklod_cli.codecs.reader import OpenFile, decode_file
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError, HasTreeError
from tests.codecs.test_damaged import FILES, WORDS, content, files_of, format_of, header, insides, members

TRIES = 40

pytestmark = pytest.mark.filterwarnings("error")


def in_memory(pieces: Callable[[], Iterable[bytes]]) -> OpenFile:
    return OpenFile(io.BytesIO(b"".join(pieces())))


def outcome(make: Callable[[], Splats]) -> Splats | str | None:
    """The splats, or what is wrong; None for a tree."""
    try:
        return make()
    except HasTreeError:
        return None
    except FormatError as error:
        return f"{type(error).__name__}: {error}"


def compare(name: str, data: bytes) -> str:
    """What came of both: "tree", "splats" or the error's text."""
    form = format_of(name, data)
    if form is None:
        return "unknown"
    codec: Any = form.codec()

    def open_companion(other: str) -> BinaryIO:
        if other not in files_of(name):
            raise FormatError("there is no such file")
        return io.BytesIO(files_of(name)[other])

    more = {"open_companion": open_companion} if form.folders else {}

    def streamed() -> Splats:
        reader = codec.open_content(OpenFile(io.BytesIO(data), scratch=in_memory, **more))
        return Splats.concat([Splats.empty(0, reader.sh_degree), *reader.blocks()])

    whole, found = outcome(lambda: decode_file(codec, io.BytesIO(data), **more).splats), outcome(streamed)
    if found is None:
        return "tree"
    if isinstance(whole, Splats) and isinstance(found, Splats):
        for column in COLUMNS:
            np.testing.assert_array_equal(getattr(found, column), getattr(whole, column), column)
        return "splats"
    assert found == whole
    return str(found)


def damaged(name: str, rng: np.random.Generator) -> Iterable[bytes]:
    """The bytes of a file as they are, cut short, with other bits, and with words in between."""
    data, packed = insides(name)[0]  # of SOG, meta.json
    yield packed(data)
    for raw, rest in ((content(name), bytes), (data, packed)):
        places = header(name, raw) if raw is not data or rest is bytes else list(range(len(raw)))
        for kind in range(TRIES):
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


@pytest.mark.parametrize("name", [name for name in FILES if name.endswith(".sog")])
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
