"""Checkpoints: pickles are data, and what no checkpoint of splats is ends in one line."""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand_checkpoint
from sparklod_cli.codecs import checkpoint
from sparklod_cli.codecs.content import decode_file
from sparklod_cli.codecs.tensor_pickle import Tensor, unpickled
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from sparklod_cli.model.splats import COLUMNS
from sparklod_cli.support.errors import FormatError, NotSplatsError
from tests.codecs.cases import linear
from tests.scenes import random_splats

SCENE = Scene(random_splats(50, sh_degree=1))


def decode(data: bytes) -> Scene:
    scene: Scene = decode_file(checkpoint, io.BytesIO(data))
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
    def of(size: tuple[int, ...], stride: tuple[int, ...]) -> int | None:
        return Tensor(np.dtype("<f4"), "0", 0, size, stride).pitch

    assert (of((5, 3), (3, 1)), of((5, 1, 3), (3, 99, 1)), of((), ()), of((1, 3), (99, 1))) == (3, 3, 1, 3)
    assert (of((5, 2, 3), (12, 3, 1)), of((5,), (2,))) == (12, 2)  # parts of larger ones
    assert of((5, 0, 3), (7, 7, 7)) is not None
    assert [of((5, 3), stride) for stride in ((1, 5), (2, 1), (0, 1), (-3, 1), (6, 2))] == [None] * 5


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


def test_rows_that_are_far_apart_are_refused() -> None:
    columns = linear(SCENE)
    tensors = {"means": np.zeros((50, 4_000), "<f4")[:, :3]}
    names = {"scales": "scale", "quats": "quat_wxyz", "opacities": "opacity", "shN": "sh"}
    tensors |= {name: columns[column].astype("<f4") for name, column in names.items()}
    tensors["sh0"] = columns["rgb"].astype("<f4")
    with pytest.raises(FormatError, match="means are not in order"):
        decode(by_hand_checkpoint.saved(tensors, under="splats", is_parameter=True))


def test_numbers_of_sixteen_bits_are_read() -> None:
    splats = decode(by_hand_checkpoint.checkpoint(**linear(SCENE), number="<f2")).splats
    np.testing.assert_allclose(splats.center, SCENE.splats.center, rtol=1e-3, atol=1e-3)


def torch_columns(torch: Any) -> dict[str, Any]:
    """Returns the splats as gsplat begins to train them: SH are parts of a tensor of all coefficients."""
    splats = SCENE.splats
    values = {
        "means": splats.center,
        "scales": np.log(splats.scale),
        "quats": 3 * splats.quat_xyzw[:, [3, 0, 1, 2]],
        "opacities": np.log(splats.opacity / (1 - splats.opacity)),
    }
    tensors = {name: torch.from_numpy(np.array(array, order="C")) for name, array in values.items()}
    colors = torch.from_numpy(np.concatenate([(splats.rgb[:, None] - 0.5) / SH_C0, splats.sh], axis=1))
    tensors |= {"sh0": colors[:, :1], "shN": colors[:, 1:]}
    return {name: torch.nn.Parameter(tensor) for name, tensor in tensors.items()}


def saved_by_torch(program: str, torch: Any) -> bytes:
    """Has PyTorch save a step of a training, with an optimizer that has run, as a program does."""
    columns = torch_columns(torch)
    if program == "nerfstudio":
        columns["opacities"] = torch.nn.Parameter(columns["opacities"].detach()[:, None])
        columns["features_dc"] = torch.nn.Parameter(columns.pop("sh0").detach()[:, 0].clone())
        columns["features_rest"] = columns.pop("shN")
    splats = torch.nn.ParameterDict(columns)
    optimizer = torch.optim.Adam([{"params": [each], "lr": 0.0, "name": name} for name, each in columns.items()])
    sum(each.sum() for each in columns.values()).backward()
    optimizer.step()
    content = {"step": 1, "splats": splats.state_dict()}
    if program == "nerfstudio":
        model = torch.nn.Module()
        model.gauss_params = splats
        model.register_buffer("device_indicator", torch.zeros(0))
        pipeline = torch.nn.Module()
        pipeline._model = model
        optimizers, scaler = {"means": optimizer.state_dict()}, torch.amp.GradScaler("cpu").state_dict()
        content = {"step": 1, "pipeline": pipeline.state_dict(), "optimizers": optimizers, "scalers": scaler}
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("program", ["gsplat", "nerfstudio"])
def test_what_pytorch_saves_is_read(program: str) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    splats = decode(saved_by_torch(program, torch)).splats
    for column in COLUMNS:
        expected = getattr(SCENE.splats, column)
        np.testing.assert_allclose(getattr(splats, column), expected, atol=2e-6, rtol=2e-6, err_msg=column)
