"""Checkpoints: pickles are data, and what no checkpoint of splats is ends in one line."""

from __future__ import annotations

import io
import pickle
import struct
import time
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand_checkpoint
from sparklod_cli.codecs import checkpoint
from sparklod_cli.codecs.checkpoint import Tensor, unpickled
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from sparklod_cli.model.splats import COLUMNS
from sparklod_cli.system.errors import FormatError, NotSplatsError, TruncatedError
from tests.codecs import cases
from tests.codecs.cases import linear
from tests.scenes import random_splats

SCENE = Scene(random_splats(50, sh_degree=1))


def decode(data: bytes) -> Scene:
    return cases.decode(checkpoint, data)


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
        *(b"", b"\x80\x02", b".", b"t.", b"h\x01.", b"\x85.", b"X\xff\xff\xff\x7fabc.", b"cos\nsystem\nP1\n."),
        b"\x8e" + struct.pack("<Q", 1 << 62) + b"abc.",
        b"\x80\x02}(X\x01\0\0\0a",
    ],
)
def test_a_broken_pickle_is_an_error(data: bytes) -> None:
    with pytest.raises(FormatError):
        unpickled(data)


def test_keys_that_are_no_texts_are_left_out() -> None:
    nested = b")" + b"".join(b"q" + bytes([n]) + b"h" + bytes([n]) + b"\x86" for n in range(200))
    for key in (nested, by_hand_checkpoint.integers((1,))[1:-1], b"N", b"\x88", b"]"):
        assert unpickled(b"\x80\x02}(" + key + b"J\1\0\0\0u.") == {}


# --- Pickles that nobody can have meant ---

TEXT = by_hand_checkpoint.text
DOUBLED = b"K\x07q\0" + b"h\0\x86q\0" * 60
DEEP = b")" + b"\x85" * 20_000
REBUILD = b"ctorch._utils\n_rebuild_tensor_v2\n"
LIST_OF_ONES = b"(" + b"K\1" * 100_000 + b"t"


def big(value: int) -> bytes:
    """Pickles an integer of any size."""
    data = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8b" + struct.pack("<i", len(data)) + data


def storage(key: bytes, kind: bytes = b"ctorch\nFloatStorage\n") -> bytes:
    return b"(" + TEXT("storage") + kind + key + TEXT("cpu") + b"K\0tQ"


def tensor_of(
    size: bytes = by_hand_checkpoint.integers((8, 3)),
    stride: bytes = by_hand_checkpoint.integers((3, 1)),
    of: bytes = storage(TEXT("0")),
    first: bytes = b"K\0",
) -> bytes:
    return REBUILD + b"(" + of + first + size + stride + b"\x89}tR"


def with_means(means: bytes, before: bytes = b"", under: str = "splats", name: bytes = TEXT("means")) -> bytes:
    """Pickles a checkpoint whose only tensor is given, after other objects that are on the stack."""
    return b"\x80\x02" + before + b"}(" + TEXT(under) + b"}(" + name + means + b"uu."


HOSTILE = {
    "a name of doubled tuples": with_means(tensor_of(), DOUBLED + b"K\1\x93"),
    "a name of deep tuples": with_means(tensor_of(), DEEP + b"K\1\x93"),
    "a key of doubled tuples": with_means(tensor_of(of=storage(DOUBLED))),
    "a key of deep tuples": with_means(tensor_of(of=storage(DEEP))),
    "a key of no text": with_means(tensor_of(of=storage(b"K\0"))),
    "a storage that is a pair": with_means(tensor_of(of=TEXT("<f4") + TEXT("0") + b"\x86")),
    "a storage of no type": with_means(tensor_of(of=storage(TEXT("0"), kind=TEXT("torch FloatStorage")))),
    "sizes beyond any memory": with_means(tensor_of(size=b"K\x08" + big(10**200) * 2 + b"\x87")),
    "one size beyond any memory": with_means(tensor_of(size=b"K\x08" + big(10**400) + b"\x86")),
    "sizes of 64 bits": with_means(tensor_of(size=big(2**63 - 1) * 2 + b"\x86")),
    "a size that is true": with_means(tensor_of(size=b"\x88K\x03\x86")),
    "a size that is a float": with_means(tensor_of(size=b"G" + struct.pack(">d", 8.0) + b"K\x03\x86")),
    "sizes that are a list": with_means(tensor_of(size=b"](K\x08K\3e")),
    "many axes": with_means(tensor_of(size=LIST_OF_ONES, stride=LIST_OF_ONES)),
    "fewer strides": with_means(tensor_of(stride=b"K\1\x85")),
    "a negative offset": with_means(tensor_of(first=b"J\xff\xff\xff\xff")),
    "a huge offset": with_means(tensor_of(first=big(2**62))),
    "few arguments": with_means(REBUILD + b"K\0K\1\x86R"),
    "arguments that are none": with_means(REBUILD + b"NR"),
    "a parameter of nothing": with_means(b"ctorch._utils\n_rebuild_parameter\n)R"),
    "a name that is a large number": with_means(tensor_of(), under="pipeline", name=big(10**5000)),
    "a root that is a list": b"\x80\x02].",
    "a root that contains itself": b"\x80\x02}q\0(" + TEXT("splats") + b"h\0u.",
}


@pytest.mark.parametrize("what", HOSTILE)
def test_no_pickle_ends_in_another_way_than_one_error(what: str) -> None:
    began = time.process_time()
    with pytest.raises(FormatError) as caught:
        decode(with_pickle(HOSTILE[what]))
    assert len(str(caught.value)) < 300 and "\n" not in str(caught.value)
    assert time.process_time() - began < 5


@pytest.mark.parametrize(
    "before",
    [
        LIST_OF_ONES + b"q\0" + storage(TEXT("0")) + b"q\1(h\1K\0h\0h\0tq\2" + REBUILD + b"q\3" + b"h\3h\2R" * 4_000,
        b"}(" + b"".join(big(number * (2**61 - 1)) + b"N" for number in range(1, 60_000)) + b"u",
        b"}q\0(" + b"".join(TEXT(str(n)) + b"h\0" for n in range(10_000)) + b"u",
    ],
    ids=["one tensor of many axes many times", "numbers of one hash as keys", "a dict in itself many times"],
)
def test_a_small_pickle_takes_little_time_and_memory(before: bytes) -> None:
    data = b"\x80\x02}(" + TEXT("other") + before + TEXT("again") + b"h\0u."
    tracemalloc.start()
    try:
        began = time.process_time()
        with pytest.raises(FormatError):
            decode(with_pickle(data))
        assert time.process_time() - began < 10  # of a process that is traced
        assert tracemalloc.get_traced_memory()[1] < 64 * len(data) + 5e7
    finally:
        tracemalloc.stop()


def test_a_pickle_of_too_many_steps_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert unpickled(b"\x80\x02]" + b"N" * 90 + b".") is None
    monkeypatch.setattr(checkpoint, "MOST_STEPS", 90)
    with pytest.raises(FormatError, match="more than 90 steps"):
        unpickled(b"\x80\x02" + b"N" * 90 + b".")


# --- The zip ---


def zipped(*files: bytes, names: dict[str, str] = {}) -> bytes:  # noqa: B006
    """Joins zips, with other names of some members."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about names that are there already
        for file in files:
            with zipfile.ZipFile(io.BytesIO(file)) as part:
                for name in part.namelist():
                    archive.writestr(names.get(name, name), part.read(name))
    return buffer.getvalue()


def test_two_checkpoints_in_a_zip_are_refused() -> None:
    one, other = (
        by_hand_checkpoint.saved(
            {"means": np.zeros((count, 3), "<f4")}, under="splats", is_parameter=True, folder=folder
        )
        for count, folder in ((8, "a"), (16, "b/c"))
    )
    for both in (zipped(one, other), zipped(other, one), zipped(one, one)):
        with pytest.raises(FormatError, match="its zip has 2 checkpoints; give each in a file of its own"):
            decode(both)


def test_members_of_one_name_are_refused() -> None:
    whole = by_hand_checkpoint.checkpoint(**linear(SCENE))
    with pytest.raises(FormatError, match="corrupt: its zip has several members 'archive/data/0'"):
        decode(zipped(whole, names={"archive/data/1": "archive/data/0"}))


@pytest.mark.parametrize("count", [50, 10**6, 10**8, 2**40])
def test_splats_beyond_the_file_are_refused_before_memory_is_taken(count: int) -> None:
    """The directory of a zip may announce any size of a member, too."""
    sizes = (big(count) + b"K\3\x86", by_hand_checkpoint.integers((3, 1)))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("archive/data.pkl", with_every_column(tensor_of(*sizes), count))
        archive.writestr("archive/data/0", bytes(12 * 49))
    data = bytearray(buffer.getvalue())
    entry = data.index(b"PK\1\2", data.index(b"PK\1\2") + 1)  # of the second member
    data[entry + 20 : entry + 28] = struct.pack("<2I", 2**32 - 2, 2**32 - 2)
    tracemalloc.start()
    try:
        with pytest.raises(TruncatedError, match=r"its tensor \w+ announces"):
            decode(bytes(data))
        assert tracemalloc.get_traced_memory()[1] < 1e7
    finally:
        tracemalloc.stop()


def with_every_column(means: bytes, count: int) -> bytes:
    """Pickles splats whose other tensors lie at the beginning of the storage of the centres."""
    items = TEXT("means") + means
    for name, width in {"scales": 3, "quats": 4, "opacities": 1, "sh0": 3, "shN": 0}.items():
        size, stride = big(count) + b"K" + bytes([width]) + b"\x86", by_hand_checkpoint.integers((width, 1))
        items += TEXT(name) + tensor_of(size, stride)
    return b"\x80\x02}(" + TEXT("splats") + b"}(" + items + b"uu."


# --- What is left out ---


@pytest.mark.parametrize("program", ["gsplat", "nerfstudio"])
def test_sh_of_degree_4_is_cut_to_3(program: str) -> None:
    columns = linear(Scene(random_splats(50, sh_degree=3)))
    more = columns | {"sh": np.concatenate([columns["sh"], np.full((50, 9, 3), 7.0)], axis=1)}
    scene, whole = (decode(by_hand_checkpoint.checkpoint(**each, program=program)) for each in (more, columns))
    assert scene.notes == ("SH degree 4 is cut to 3",) and whole.notes == ()
    cases.assert_same(scene.splats, whole.splats)


def test_tensors_that_are_left_out_are_named() -> None:
    widths = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "features_dc": 3, "features_rest": 9, "normals": 3}
    tensors = {f"gauss_params.{name}": np.ones((9, width)) for name, width in widths.items()}
    tensors |= {"gauss_params.labels": np.ones(9), "bil_grids.grids": np.ones((2, 4)), "empty.grids": np.ones((0, 3))}
    tensors |= dict.fromkeys(("appearance.0.weight", "appearance.0.bias", "lpips.net.slice1.weight"), np.ones(2))
    floats = {f"_model.{name}": values.astype("<f4") for name, values in tensors.items()}
    floats["_model.device_indicator_param"] = np.ones(1, "<f4")
    scene = decode(by_hand_checkpoint.saved(floats, under="pipeline", is_parameter=False))
    assert scene.notes == ("its tensors appearance, bil_grids and labels are left out",)


def test_other_parts_of_a_checkpoint_of_gsplat_are_named() -> None:
    widths = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "sh0": 3, "shN": 0, "features": 32}
    tensors = {name: np.ones((9, width), "<f4") for name, width in widths.items()}
    other = by_hand_checkpoint.tensor("0", tensors["means"], is_parameter=False)
    more = b"".join(TEXT(key) + b"}(" + TEXT("embeds.weight") + other + b"u" for key in ("pose_adjust", "optimizers"))
    more += TEXT("exposure") + other
    scene = decode(by_hand_checkpoint.saved(tensors, under="splats", is_parameter=True, more=more))
    assert scene.notes == ("its tensors exposure, features and pose_adjust are left out",)


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


COLUMNS_OF = linear(SCENE)
GSPLAT = {"means": "center", "scales": "scale", "quats": "quat_wxyz", "opacities": "opacity", "sh0": "rgb", "shN": "sh"}
TENSORS = {name: np.ascontiguousarray(COLUMNS_OF[column], "<f4") for name, column in GSPLAT.items()}
TENSORS["sh0"] = TENSORS["sh0"][:, None]
FAR_APART = np.zeros((50, 4_000), "<f4")[:, :3]


@pytest.mark.parametrize(
    ("tensors", "text"),
    [
        ({"means": TENSORS["means"]}, "its splats have no scales, quats, opacities, sh0, shN"),
        ({}, "have no means"),
        (TENSORS | {"scales": np.ones((49, 3), "<f4")}, "has the shape"),
        (TENSORS | {"shN": np.zeros((50, 4, 3), "<f4")}, "has the shape"),
        (TENSORS | {"quats": np.ones((50, 3), "<f4")}, "has the shape"),
        (TENSORS | {"means": FAR_APART}, "means are not in order"),
    ],
)
def test_tensors_that_are_not_those_of_splats_are_refused(tensors: dict[str, np.ndarray], text: str) -> None:
    with pytest.raises(FormatError, match=text):
        decode(by_hand_checkpoint.saved(tensors, under="splats", is_parameter=False))


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
