"""Damaged Streamed SOG: a manifest that says anything else, and chunks that are something else.

As in test_damaged.py: a scene or a `FormatError`, and nothing else; the same for all levels.
"""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest

from sparklod_cli.codecs import streamed_sog as codec
from sparklod_cli.system.errors import FormatError
from tests.codecs.damage import VALUES, attempt, content, files_of, places_of, replaced

from .scenes import open_companion

NAME = "golden/sh1-streamed-sog/lod-meta.json"
FILES = files_of(NAME)
MANIFEST = content(NAME)

pytestmark = pytest.mark.filterwarnings("error")  # they would go to standard error


def levels(data: bytes, files: dict[str, bytes]) -> bool:
    """Whether all levels can be read."""
    try:
        scene = codec.decode_parts(io.BytesIO(data), open_companion=open_companion(files))
    except FormatError as error:
        assert "\n" not in str(error)
        return False
    assert scene.starts.shape == scene.counts.shape
    assert scene.scene().splats.sh_degree == scene.splats.sh_degree
    return True


def test_a_changed_manifest_gives_a_scene_or_a_format_error() -> None:
    meta = json.loads(MANIFEST)
    refused = tried = 0
    for number, path in enumerate(places_of(meta)[1:]):
        for value in (..., *VALUES)[number % 16 :: 16]:  # all of them at neighbouring places
            data = json.dumps(replaced(meta, path, value)).encode()
            refused += not levels(data, FILES) if tried % 2 else attempt(NAME, data) != "scene"
            tried += 1
    assert refused > 0.3 * tried


def test_changed_swapped_or_missing_files_give_a_scene_or_a_format_error() -> None:
    rng = np.random.default_rng(7)
    names = sorted(FILES)
    assert levels(MANIFEST, FILES)
    for number, name in enumerate(names):
        end, other = int(rng.integers(len(FILES[name]))), names[int(rng.integers(len(names)))]
        missing = {other: data for other, data in FILES.items() if other != name}
        assert not levels(MANIFEST, missing)
        assert not levels(MANIFEST, FILES | {name: FILES[name][:end]})
        changed = bytearray(FILES[name])
        changed[end] ^= 1 << number % 8
        attempt(NAME, MANIFEST, files=FILES | {name: bytes(changed)})
        attempt(NAME, MANIFEST, files=FILES | {name: FILES[other]})


def test_two_manifests_that_name_each_other_are_refused() -> None:
    meta: Any = json.loads(MANIFEST)
    meta["filenames"][0] = meta["environment"] = "lod-meta.json"
    data = json.dumps(meta).encode()
    assert attempt(NAME, data, files=FILES | {"lod-meta.json": data}) != "scene"
