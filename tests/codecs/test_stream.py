"""Files are decoded as streams: beside the splats there is never much more than a few chunks in memory."""

from __future__ import annotations

import io
import struct
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from fixtures import by_hand
from sparklod_cli.codecs import ply, splat, spz
from sparklod_cli.codecs.formats import HEAD, sniff
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.reader import decode_file, rows_of
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.threads import BLOCK_ROWS, ordered_map
from tests.scenes import random_splats

COUNT = 12 * BLOCK_ROWS


def spz4(splats: Splats) -> bytes:
    """Version 4 of what version 3 has: the same streams, a zstd frame each."""
    gzipped = b"".join(spz.encode(Scene(splats), WriteOptions(spz_version=3)))
    raw = by_hand.unpacked(gzipped)
    streams, at = [], 16
    for size in (9, 1, 3, 3, 4, 3 * splats.sh.shape[1]):
        streams.append(raw[at : at + size * len(splats)])
        at += size * len(splats)
    assert at == len(raw)
    assert struct.unpack_from("<I", raw)[0] == by_hand.MAGIC
    return by_hand.spz_zstd(len(splats), splats.sh_degree, raw[13], raw[14], streams)


WRITERS: dict[str, Callable[[Splats], bytes]] = {
    "ply": lambda splats: b"".join(ply.encode(Scene(splats))),
    "splat": lambda splats: b"".join(splat.encode(Scene(splats))),
    "spz 3": lambda splats: b"".join(spz.encode(Scene(splats), WriteOptions(spz_version=3))),
    "spz 4": spz4,
}


#: Bytes beside the splats. The files are, or unfold to, 49, 6, 13 and 13 MB, so whoever reads them whole needs more.
EXTRA = {"ply": 12e6, "splat": 3e6, "spz 3": 9e6, "spz 4": 9e6}


@pytest.mark.parametrize("kind", WRITERS)
def test_decoding_takes_little_memory_beside_the_splats(kind: str) -> None:
    file = io.BytesIO(WRITERS[kind](random_splats(COUNT, sh_degree=3)))
    head = file.read(HEAD)
    file.seek(0)
    form = sniff(head, f".{kind}")
    assert form is not None
    codec = form.codec()
    tracemalloc.start()
    scene = decode_file(codec, file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    decoded = sum(getattr(scene.splats, name).nbytes for name in COLUMNS)
    assert len(scene.splats) == COUNT
    assert decoded < peak < decoded + EXTRA[kind]


def test_rows_that_are_missing_are_counted() -> None:
    file = io.BytesIO(bytes(4 * (BLOCK_ROWS + 10) + 3))
    with pytest.raises(FormatError, match=f"cut short after {BLOCK_ROWS + 10:,} of {2 * BLOCK_ROWS:,} splats"):
        list(rows_of(lambda at, size: file.read(size), 0, np.dtype("<u4"), 0, 2 * BLOCK_ROWS, 2 * BLOCK_ROWS))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_items_are_taken_as_they_are_needed(threads: int) -> None:
    taken = 0

    def items() -> io.IOBase:
        nonlocal taken
        for item in range(1000):
            taken += 1
            yield item

    results = ordered_map(lambda item: 2 * item, items(), threads)
    for expected in range(1000):
        assert next(results) == 2 * expected
        assert taken <= expected + 2 * threads + 2
    with pytest.raises(StopIteration):
        next(results)


@pytest.mark.parametrize("threads", [1, 3])
def test_a_failure_is_passed_on_and_ends_the_work(threads: int) -> None:
    done = []

    def work(item: int) -> None:
        done.append(item)
        if item == 5:
            raise FormatError("five")

    with pytest.raises(FormatError, match="five"):
        list(ordered_map(work, range(1000), threads))
    assert len(done) < 20
