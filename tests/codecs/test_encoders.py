"""Files written window by window have the bytes of those written from memory; nodes may keep the codes of a file."""

from __future__ import annotations

import dataclasses
import functools
import io
import pickle
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sparklod_cli.codecs import encoder as encoder_module
from sparklod_cli.codecs import losses, sh_palette, spz
from sparklod_cli.codecs.formats import DEFAULTS, RAD_ENCODINGS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.reader import OpenFile
from sparklod_cli.codecs.sh_palette import cluster
from sparklod_cli.lod import quality, quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats, same_rows
from sparklod_cli.system.progress import silent
from tests.codecs.cases import assert_same, decode, encode
from tests.conftest import FIXTURES, real_scene
from tests.scenes import node_stream, random_splats

PALETTE = WriteOptions(rad=RadOptions(sh_codes=40))


@functools.cache
def tree_of(method: str, sh_degree: int) -> Scene:
    splats = random_splats(3_000, sh_degree=sh_degree, seed=sh_degree)
    splats.rgb[::50] *= 4
    splats.sh[::500] *= 60
    built = quick.build(splats, 1.5) if method == "quick" else quality.build(splats, 1.4)
    return Scene(*built, antialiased=sh_degree == 1)


@pytest.mark.parametrize("window", [None, 900, 4_097])
@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("method", ["quick", "quality"])
@pytest.mark.parametrize("codec", [spz, rad])
def test_windows_are_encoded_anywhere_and_count_what_they_clamp(
    codec: ModuleType, method: str, sh_degree: int, window: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever encodes a window has the encoder as it was sent, and the nodes; in any order."""
    if window is not None:
        monkeypatch.setattr(encoder_module, "CHUNK_NODES", window)
    scene = tree_of(method, sh_degree)
    nodes, options = node_stream(scene), codec.settled(scene, PALETTE)
    ranges = tuple(encoder_module.SPZ_RANGES if codec is spz else rad.held(options, sh_degree))
    sent = pickle.dumps(codec.encoder(nodes, options, counting=True))
    found = {}
    for number, part in reversed(list(enumerate(encoder_module.windows_of(len(scene))))):
        found[number] = pickle.loads(sent).encode(*nodes.read(part.start, part.stop), part.start)
    pieces = pickle.loads(sent).pieces(lambda number, name: found[number][name], threads=1, progress=silent)
    assert b"".join(pieces) == encode(codec, scene, PALETTE, threads=2)
    tallies = [found[number][encoder_module.CLAMPED] for number in sorted(found)]
    expected = losses.clamps_in(scene.splats, ranges=ranges, tree=scene.tree)
    assert losses.clamps_of(tallies, ranges) == expected
    assert not sh_degree or set(expected[0]) >= {"sh"}


@pytest.mark.parametrize("options", [DEFAULTS, PALETTE])
def test_chunk_files_are_made_of_the_results_of_windows(options: WriteOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoder_module, "CHUNK_NODES", 1_500)
    scene = tree_of("quality", 2)
    whole = [(name, b"".join(pieces)) for name, pieces in rad.encode_chunked(scene, options, "town")]
    assert [name for name, _ in whole] == ["town-0.radc", "town-1.radc", "town-2.radc", "town.rad"]
    chunks = rad.encoder(scene, rad.settled(scene, options))
    found = list(encoder_module.results(chunks, scene, 1, silent, "encoding"))
    assembled = chunks.files((each[rad.CHUNK].tobytes() for each in found), "town")
    assert [(name, b"".join(pieces)) for name, pieces in assembled] == whole


def test_a_palette_of_a_sample_is_nearly_as_good_as_one_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(*quick.build(random_splats(8_000, sh_degree=1), 1.5))
    nodes = node_stream(scene)
    whole = rad.Palette.of(scene, 40, 1, silent)
    assert rad.Palette.of(nodes, 40, 1, silent).labels is not None  # of all nodes
    monkeypatch.setattr(rad, "SAMPLE", 2_048)
    monkeypatch.setattr(encoder_module, "CHUNK_NODES", 3_000)
    sampled = rad.Palette.of(nodes, 40, 1, silent)
    assert sampled.labels is None

    def error(found: rad.Palette) -> float:
        return float(np.square(found.codes[found.labels_of(scene.splats, 0)] - scene.splats.sh).mean())

    assert error(sampled) < 1.1 * error(whole)


@pytest.mark.parametrize(("codes", "slack"), [(1, 0), (3, 0), (250, 0), (3_000, 0.02)])
def test_labels_name_the_nearest_code(codes: int, slack: float) -> None:
    sh = random_splats(8_000, sh_degree=1).sh
    table = cluster(sh[:6_000], codes).codes
    labels = sh_palette.labels_of(sh, table)
    rows, wide = sh.reshape(len(sh), -1).astype(np.float64), table.reshape(len(table), -1).astype(np.float64)
    half = np.square(wide).sum(axis=1) / 2
    nearest = np.concatenate([(half - part @ wide.T).argmin(axis=1) for part in np.array_split(rows, 8)])

    def error(index: np.ndarray) -> float:
        return float(np.square(rows - wide[index]).sum())

    assert error(labels) <= error(nearest) * (1 + slack)
    assert slack or (labels == nearest).all()


# --- Nodes that keep the codes of a file, bit for bit, whatever wrote them --------------------------------------------

#: Of each property the encodings that a file may have, side by side: the last ones are repeated.
ENCODINGS = [
    RadOptions(
        **{name: ("auto", *RAD_ENCODINGS[name])[min(number, len(RAD_ENCODINGS[name]))] for name in RAD_ENCODINGS}
    )
    for number in range(1 + max(map(len, RAD_ENCODINGS.values())))
]


def simple_tree(count: int = 900, sh_degree: int = 2) -> Scene:
    """A tree, some of whose scales are next to 1, where codes of logarithms are finest."""
    splats = random_splats(count, sh_degree=sh_degree, seed=5)
    splats.scale[::7] = 1 + np.linspace(-1e-4, 1e-4, splats.scale[::7].size, dtype=np.float32).reshape(-1, 3)
    return Scene(*quick.build(splats), antialiased=True)


def others(splats: Splats, kept: np.ndarray) -> Splats:
    """Splats of which those that are not kept have other values, some beyond all ranges."""
    other = random_splats(len(splats), sh_degree=splats.sh_degree, seed=6, extent=4)
    columns = {}
    for name in COLUMNS:
        columns[name] = getattr(splats, name).copy()
        columns[name][~kept] = getattr(other, name)[~kept]
    columns["opacity"][~kept] *= 700
    columns["rgb"][~kept] = 3 * columns["rgb"][~kept] - 1
    low, high = splats.center.min(axis=0), splats.center.max(axis=0)
    columns["center"] = np.clip(columns["center"], low, high)
    return Splats(**columns)


def assert_keeps(codec: Any, data: bytes) -> Scene:
    """Assert that nodes that are kept have the same bits in a file written over another, and others nearly."""
    before = decode(codec, data)
    assert before.tree is not None
    kept = before.tree.is_leaf.copy()
    kept[1::3] = True
    stored, like_file = codec.stored(OpenFile(io.BytesIO(data)), WriteOptions())
    scene = dataclasses.replace(before, splats=others(before.splats, kept))
    settled = codec.settled(scene, like_file)
    after = decode(codec, written(codec.encoder(scene, settled).keeping(stored, kept), scene))
    assert after.antialiased == before.antialiased
    assert after.tree is not None
    for name in ("child_count", "child_start"):
        assert np.array_equal(getattr(after.tree, name), getattr(before.tree, name))
    assert same_rows(after.splats, before.splats)[kept].all()
    plain = decode(codec, encode(codec, scene, settled))
    assert same_rows(after.splats, plain.splats)[~kept].all()
    return after


def written(encoder: Any, scene: Scene, threads: int = 2, **changed: Any) -> bytes:
    """The file of an encoder, of whose results some arrays are changed by functions."""
    windows = list(encoder_module.results(encoder, scene, threads, silent, "encoding"))
    for window in windows:
        window.update({name: change(window[name]) for name, change in changed.items() if name in window})
    return b"".join(encoder.pieces(lambda number, name: windows[number][name], threads=threads, progress=silent))


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_an_spz_keeps_any_code_of_a_rotation(version: int, sh_degree: int) -> None:
    """Also those that the encoder does not write."""
    scene = simple_tree(sh_degree=sh_degree)
    rng = np.random.default_rng(2)

    def noise(codes: np.ndarray) -> np.ndarray:
        return rng.integers(0, 256, codes.shape, dtype=np.uint8)

    encoder = spz.encoder(scene, spz.settled(scene, WriteOptions(spz_version=version)))
    data = written(encoder, scene, rotations=noise, sh=noise)
    read = decode(spz, data)
    again = decode(spz, encode(spz, read, spz.like(read.header, WriteOptions())))
    assert not same_rows(again.splats, read.splats).all()  # or there would be no need of codes
    after = assert_keeps(spz, data)
    assert after.header["version"] == version
    assert after.header["fractional_bits"] == read.header["fractional_bits"]


GOLDEN = FIXTURES / "golden"


@pytest.mark.parametrize(
    ("codec", "read"),
    [
        *((spz, (GOLDEN / f"{name}.spz").read_bytes) for name in ("hand-tree-v2", "hand-tree-v3", "hand-tree-v4")),
        (spz, (GOLDEN / "tree-v2.spz").read_bytes),
        (rad, (GOLDEN / "sh1-tree.rad").read_bytes),
        (rad, lambda: encode(rad, simple_tree(60_000, 0))),  # of several chunks
        (rad, lambda: real_scene("rad/biker-spark.rad").read_bytes()),
    ],
)
def test_files_of_any_writer_keep_their_codes(codec: ModuleType, read: Callable[[], bytes]) -> None:
    assert_keeps(codec, read())


def test_a_choice_of_another_coding_is_heeded() -> None:
    """Only the streams that it changes are encoded anew."""
    scene = simple_tree()
    data = encode(spz, scene)
    bits = decode(spz, data).header["fractional_bits"]
    asked = WriteOptions(spz_version=2, fractional_bits=bits - 1)
    stored, like_file = spz.stored(OpenFile(io.BytesIO(data)), asked)
    assert like_file == asked
    encoder = spz.encoder(scene, spz.settled(scene, asked)).keeping(stored, np.ones(len(scene), bool))
    assert {*encoder.stored} == {"alphas", "colors", "scales", "sh"}


@pytest.mark.parametrize(
    "given", ENCODINGS, ids=lambda options: "-".join(getattr(options, name) for name in RAD_ENCODINGS)
)
def test_a_rad_of_any_encodings_keeps_its_codes(given: RadOptions) -> None:
    scene = simple_tree()
    options = rad.settled(scene, WriteOptions(rad=given))
    data = encode(rad, scene, options)
    _, like_file = rad.stored(OpenFile(io.BytesIO(data)), WriteOptions())
    after = assert_keeps(rad, data)
    found = rad.settled(after, like_file).rad
    assert [getattr(found, name) for name in RAD_ENCODINGS] == [getattr(options.rad, name) for name in RAD_ENCODINGS]
    assert found.ranges == options.rad.ranges


def test_a_rad_with_a_palette_keeps_its_values() -> None:
    """As coefficients of each node's own, for merged splats have new ones."""
    data = encode(rad, simple_tree(), WriteOptions(rad=RadOptions(sh_codes=32)))
    after = assert_keeps(rad, data)
    assert "sh_codes" not in after.header


def test_a_property_in_another_encoding_is_encoded_anew() -> None:
    scene = simple_tree()
    data = encode(rad, scene)
    before = decode(rad, data)
    stored, like_file = rad.stored(OpenFile(io.BytesIO(data)), WriteOptions(rad=RadOptions(rgb="f16")))
    settled = rad.settled(before, like_file)
    assert settled.rad.rgb == "f16"
    encoder = rad.encoder(before, settled).keeping(stored, np.ones(len(before), bool))
    after = decode(rad, written(encoder, before))
    assert np.abs(after.splats.rgb - before.splats.rgb).max() > 0
    assert_same(after.splats, before.splats, but="rgb")
