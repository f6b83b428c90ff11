"""Nodes that keep the codes of a file are written bit for bit as they stand there, whatever wrote them."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable

import numpy as np
import pytest

from sparklod_cli.codecs import spz
from sparklod_cli.codecs.encoder import results
from sparklod_cli.codecs.options import RAD_ENCODINGS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.reader import OpenFile, decode_file
from sparklod_cli.codecs.spz import like
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats, same_rows
from tests.conftest import FIXTURES, real_scene
from tests.scenes import random_splats

#: Of each property the encodings that a file may have, side by side: the last ones are repeated.
ENCODINGS = [
    RadOptions(
        **{name: ("auto", *RAD_ENCODINGS[name])[min(number, len(RAD_ENCODINGS[name]))] for name in RAD_ENCODINGS}
    )
    for number in range(1 + max(map(len, RAD_ENCODINGS.values())))
]


def tree_of(count: int = 900, sh_degree: int = 2) -> Scene:
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


def check(form: object, data: bytes, options: WriteOptions | None = None) -> Scene:
    """What is written over the nodes of a file has those that are kept, bit for bit, and the others nearly."""
    codec: Callable = form  # type: ignore[assignment]
    before = decode_file(codec, io.BytesIO(data))
    assert before.tree is not None
    kept = before.tree.is_leaf.copy()
    kept[1::3] = True
    stored, like_file = codec.stored(OpenFile(io.BytesIO(data)), options or WriteOptions())
    scene = dataclasses.replace(before, splats=others(before.splats, kept))
    settled = codec.settled(scene, like_file)
    encoder = codec.encoder(scene, settled).keeping(stored, kept)
    windows = list(results(encoder, scene, 2, lambda *_: None, "encoding"))
    written = b"".join(encoder.pieces(lambda number, name: windows[number][name], threads=2, progress=lambda *_: None))
    after = decode_file(codec, io.BytesIO(written))
    assert after.antialiased == before.antialiased
    assert after.tree is not None
    for name in ("child_count", "child_start"):
        assert np.array_equal(getattr(after.tree, name), getattr(before.tree, name))
    assert same_rows(after.splats, before.splats)[kept].all()
    plain = decode_file(codec, io.BytesIO(b"".join(codec.encode(scene, settled))))
    assert same_rows(after.splats, plain.splats)[~kept].all()
    return after


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_an_spz_keeps_any_code_of_a_rotation(version: int, sh_degree: int) -> None:
    """Also those that the encoder does not write."""
    scene = tree_of(sh_degree=sh_degree)
    options = spz.settled(scene, WriteOptions(spz_version=version))
    encoder = spz.encoder(scene, options)
    (result,) = results(encoder, scene, 1, lambda *_: None, "encoding")
    rng = np.random.default_rng(2)
    for name in {"rotations", "sh"} & {*result}:
        result[name] = rng.integers(0, 256, result[name].shape, dtype=np.uint8)
    data = b"".join(encoder.pieces(lambda number, name: result[name], threads=1, progress=lambda *_: None))
    read = decode_file(spz, io.BytesIO(data))
    again = decode_file(spz, io.BytesIO(b"".join(spz.encode(read, like(read.header, WriteOptions())))))
    assert not same_rows(again.splats, read.splats).all()  # or there would be no need of codes
    after = check(spz, data)
    assert after.header["version"] == version
    assert after.header["fractional_bits"] == read.header["fractional_bits"]


@pytest.mark.parametrize("name", ["hand-tree-v2.spz", "hand-tree-v3.spz", "hand-tree-v4.spz", "tree-v2.spz"])
def test_an_spz_of_other_writers_keeps_its_codes(name: str) -> None:
    check(spz, (FIXTURES / "golden" / name).read_bytes())


def test_a_choice_of_another_coding_is_heeded() -> None:
    """Only the streams that it changes are encoded anew."""
    scene = tree_of()
    data = b"".join(spz.encode(scene))
    bits = decode_file(spz, io.BytesIO(data)).header["fractional_bits"]
    asked = WriteOptions(spz_version=2, fractional_bits=bits - 1)
    stored, like_file = spz.stored(OpenFile(io.BytesIO(data)), asked)
    assert like_file == asked
    encoder = spz.encoder(scene, spz.settled(scene, asked)).keeping(stored, np.ones(len(scene), bool))
    assert {*encoder.stored} == {"alphas", "colors", "scales", "sh"}


@pytest.mark.parametrize(
    "given", ENCODINGS, ids=lambda options: "-".join(getattr(options, name) for name in RAD_ENCODINGS)
)
def test_a_rad_of_any_encodings_keeps_its_codes(given: RadOptions) -> None:
    scene = tree_of()
    options = rad.settled(scene, WriteOptions(rad=given))
    data = b"".join(rad.encode(scene, options))
    _, like_file = rad.stored(OpenFile(io.BytesIO(data)), WriteOptions())
    after = check(rad, data)
    found = rad.settled(after, like_file).rad
    assert [getattr(found, name) for name in RAD_ENCODINGS] == [getattr(options.rad, name) for name in RAD_ENCODINGS]
    assert found.ranges == options.rad.ranges


def test_a_rad_of_several_chunks_keeps_its_codes() -> None:
    check(rad, b"".join(rad.encode(tree_of(60_000, 0))))


def test_a_rad_with_a_palette_keeps_its_values() -> None:
    """As coefficients of each node's own, for merged splats have new ones."""
    data = b"".join(rad.encode(tree_of(), WriteOptions(rad=RadOptions(sh_codes=32))))
    after = check(rad, data)
    assert "sh_codes" not in after.header


def test_a_rad_of_spark_keeps_its_codes() -> None:
    check(rad, real_scene("rad/biker-spark.rad").read_bytes())


def test_a_rad_of_other_chunks_keeps_its_codes() -> None:
    check(rad, (FIXTURES / "golden" / "sh1-tree.rad").read_bytes())


def test_a_property_in_another_encoding_is_encoded_anew() -> None:
    scene = tree_of()
    data = b"".join(rad.encode(scene))
    before = decode_file(rad, io.BytesIO(data))
    stored, like_file = rad.stored(OpenFile(io.BytesIO(data)), WriteOptions(rad=RadOptions(rgb="f16")))
    settled = rad.settled(before, like_file)
    assert settled.rad.rgb == "f16"
    encoder = rad.encoder(before, settled).keeping(stored, np.ones(len(before), bool))
    made = list(results(encoder, before, 1, lambda *_: None, "encoding"))
    pieces = encoder.pieces(lambda number, name: made[number][name], threads=1, progress=lambda *_: None)
    after = decode_file(rad, io.BytesIO(b"".join(pieces)))
    assert np.abs(after.splats.rgb - before.splats.rgb).max() > 0
    for name in {*COLUMNS} - {"rgb"}:
        assert np.array_equal(getattr(after.splats, name), getattr(before.splats, name)), name


def test_the_same_rows_are_found() -> None:
    one = random_splats(6, sh_degree=1)
    other = one.take(np.arange(6))
    assert same_rows(one, other).all()
    for row, name in enumerate(COLUMNS):
        column = getattr(other, name)
        column.reshape(len(other), -1)[row, -1] *= np.float32(-0.5)
    assert not same_rows(one, other).any()
