"""Checkpoints: pickles are data, and what no checkpoint of splats is ends in one line."""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from collections.abc import Callable

import numpy as np
import pytest

from fixtures import by_hand_checkpoint
from sparklod_cli.codecs import checkpoint
from sparklod_cli.codecs.tensor_pickle import Tensor, unpickled
from sparklod_cli.model.scene import Scene
from sparklod_cli.support.errors import FormatError, NotSplatsError
from tests.codecs.cases import linear
from tests.scenes import random_splats

SCENE = Scene(random_splats(50, sh_degree=1))


def decode(data: bytes) -> Scene:
    scene: Scene = checkpoint.decode(io.BytesIO(data))
    return scene


def with_pickle(data: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("archive/data.pkl", data)
    return buffer.getvalue()


class Trap:
    """Pickles as a call of `print`, which a reader that runs pickles would make."""

    def __reduce__(self) -> tuple[Callable[..., None], tuple[str]]:
        return print, ("the pickle has run",)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_nothing_is_called(protocol: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert unpickled(pickle.dumps({"a": [Trap(), 1, 2.5, "text", (True, None)], (1,): 2}, protocol)) == {
        "a": [None, 1, 2.5, "text", (True, None)]
    }
    with pytest.raises(NotSplatsError, match="without splats"):
        decode(with_pickle(pickle.dumps(Trap(), protocol)))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x80\x02",
        b".",
        b"t.",
        b"h\x01.",
        b"\x85.",
        b"X\xff\xff\xff\x7fabc.",
        b"\x8e" + struct.pack("<Q", 1 << 62) + b"abc.",
        b"\x80\x02}(X\x01\0\0\0a",
        b"cos\nsystem\nP1\n.",
    ],
)
def test_a_broken_pickle_is_an_error(data: bytes) -> None:
    with pytest.raises(FormatError):
        unpickled(data)


def test_keys_that_take_for_ever_to_hash_are_left_out() -> None:
    nested = b")" + b"".join(b"q" + bytes([n]) + b"h" + bytes([n]) + b"\x86" for n in range(200))
    assert unpickled(b"\x80\x02}(" + nested + b"J\1\0\0\0u.") == {}


def test_views_of_storages_are_read_if_their_values_are_in_order() -> None:
    def of(size: tuple[int, ...], stride: tuple[int, ...]) -> bool:
        return Tensor(np.dtype("<f4"), "0", 0, size, stride).is_contiguous

    assert of((5, 3), (3, 1)) and of((5, 1, 3), (3, 99, 1)) and of((), ()) and of((5, 0, 3), (7, 7, 7))
    assert not of((5, 3), (1, 5)) and not of((5,), (2,))


def test_nerfstudio_without_sh_has_logits_of_colours() -> None:
    source = Scene(random_splats(50, sh_degree=0))
    columns = linear(source) | {"rgb": np.clip(linear(source)["rgb"], 0.01, 0.99)}
    splats = decode(by_hand_checkpoint.checkpoint(**columns, program="nerfstudio")).splats
    np.testing.assert_allclose(splats.rgb, columns["rgb"], atol=1e-5)


@pytest.mark.parametrize(
    ("tensors", "text"),
    [
        ({"means": np.zeros((5, 3), "<f4")}, "its splats have no scales, quats, opacities, sh0, shN"),
        ({}, "have no means"),
    ],
)
def test_missing_tensors_are_named(tensors: dict[str, np.ndarray], text: str) -> None:
    with pytest.raises(FormatError, match=text):
        decode(by_hand_checkpoint.saved(tensors, under="splats", is_parameter=False))


def test_shapes_that_are_none_of_splats_are_refused() -> None:
    columns = linear(SCENE)
    for name, values in {"scale": np.ones((49, 3)), "sh": np.zeros((50, 4, 3)), "quat_wxyz": np.ones((50, 3))}.items():
        with pytest.raises(FormatError, match="has the shape"):
            decode(by_hand_checkpoint.checkpoint(**columns | {name: values}))


def test_numbers_of_sixteen_bits_are_read() -> None:
    splats = decode(by_hand_checkpoint.checkpoint(**linear(SCENE), number="<f2")).splats
    np.testing.assert_allclose(splats.center, SCENE.splats.center, rtol=1e-3, atol=1e-3)
