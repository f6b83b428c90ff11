"""Trees as arrays of words: what the command writes is what the codecs pack."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import ENCODINGS
from sparklod_cli.codecs.gpu import dump
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES

SCENE = FIXTURES / "sh3.ply"
ARRAYS = {
    "packed": {"packed": 4, "sh1": 2, "sh2": 4, "sh3": 4},
    "ext": {"ext0": 4, "ext1": 4, "sh1": 4, "sh2": 4, "sh3a": 4, "sh3b": 4},
    "lodtree": {"lod_tree": 4},
}


def baked() -> Scene:
    return Scene(*quick.build(read_scene(SCENE).splats))


def test_every_encoding_can_be_had() -> None:
    assert set(ENCODINGS) == {*ARRAYS, "texture"}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_an_npz_has_the_arrays_that_the_codec_packs(
    encoding: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["build-lod", str(SCENE), "--encoding", encoding, "--output-dir", str(tmp_path), "--json"]
    assert run(command) == 0
    record = json.loads(capsys.readouterr().out)
    path = tmp_path / "sh3-lod.npz"
    nodes, expected = record["nodes"], dump.pack(baked(), encoding)
    with np.load(path) as file:
        assert set(file) == set(expected) == set(record["arrays"])
        for name, words in expected.items():
            assert words.dtype == np.uint32
            np.testing.assert_array_equal(file[name], words, name)
            assert record["arrays"][name] == list(words.shape)
    if encoding in ARRAYS:
        assert {name: words.shape for name, words in expected.items()} == {
            name: (nodes, width) for name, width in ARRAYS[encoding].items()
        }
    else:
        assert expected["texture"].shape == (1, 2048, 4)
    assert (record["bytes"], record["version"]) == (path.stat().st_size, None)
    before = path.read_bytes()
    assert run([*command, "--overwrite"]) == 0
    assert path.read_bytes() == before


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_bin_has_the_words_of_all_arrays_one_after_the_other(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.bin"
    assert run(["build-lod", str(SCENE), "--encoding", encoding, "-o", str(path)]) == 0
    expected = np.concatenate([words.ravel() for words in dump.pack(baked(), encoding).values()])
    np.testing.assert_array_equal(np.fromfile(path, "<u4"), expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--encoding", "ext", "--fractional-bits", "9"], "--fractional-bits is an option of SPZ, not of --encoding"),
        (["-o", "x.npz"], ".npz is a file of arrays; choose their layout with --encoding"),
        (["-o", "x.splat"], ".splat cannot hold a tree"),
    ],
)
def test_outputs_that_do_not_suit_an_encoding_are_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["build-lod", "scene.ply", *arguments]) == 2
    assert message in capsys.readouterr().err
