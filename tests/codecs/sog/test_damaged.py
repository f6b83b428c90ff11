"""Damaged SOG: a meta.json that says anything else, and images that are something else.

As in test_damaged.py: a scene or a `FormatError`, and nothing else.
"""

from __future__ import annotations

import json
from typing import Any

import pytest

from fixtures import by_hand_sog
from tests.codecs.test_damaged import ZIPPED, attempt, content, members
from tests.conftest import FIXTURES

FOLDER = "golden/sh1-sog"
FILES = {path.name: path.read_bytes() for path in (FIXTURES / FOLDER).iterdir()}
META = FILES["meta.json"]

pytestmark = pytest.mark.filterwarnings("error")  # they would go to standard error

VALUES = (
    *(
        None,
        True,
        "",
        "1",
        "means_l.webp",
        "two\nlines",
        "\ud800.webp",
        "\0",
        "x" * 3000,
        {},
        [],
        [[]],
        [None],
        ["a", "b"],
        {"0": 1},
    ),
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


@pytest.mark.parametrize("name", [f"{FOLDER}/meta.json", *ZIPPED])
def test_a_changed_meta_json_gives_a_scene_or_a_format_error(name: str) -> None:
    unpacked = name.startswith(FOLDER)
    files = FILES if unpacked else members(name)
    meta = json.loads(files["meta.json"])
    refused, tried = 0, 0
    for number, path in enumerate(places_of(meta)[1:]):
        for value in (..., *VALUES)[number % 3 :: 3]:  # all of them at neighbouring places
            text = json.dumps(replaced(meta, path, value)).encode()
            data = text if unpacked else by_hand_sog.zipped(files | {"meta.json": text})
            refused += attempt(name, data, files=files, threads=1 + tried % 2) != "scene"
            tried += 1
    assert refused > 0.5 * tried


@pytest.mark.parametrize("part", ["means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"])
def test_changed_swapped_or_missing_images_give_a_scene_or_a_format_error(part: str) -> None:
    assert attempt("meta.json", META, files=FILES) == "scene"
    others = {name: data for name, data in FILES.items() if name != part}
    assert attempt("meta.json", META, files=others) != "scene"
    for end in range(0, len(FILES[part]), 5):
        assert attempt("meta.json", META, files=FILES | {part: FILES[part][:end]}) != "scene"
    for other in (META, b"GIF89a" + bytes(99), content("one.ply"), by_hand_sog.flat_webp(4, 4)):
        assert attempt("meta.json", META, files=FILES | {part: other}) != "scene"
    attempt("meta.json", META, files=FILES | {part: FILES["shN_centroids.webp"]})
