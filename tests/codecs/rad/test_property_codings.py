"""RAD's encodings: their bytes against examples laid out by hand, and their errors against what they state."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fixtures import by_hand_rad
from sparklod_cli.codecs.options import AUTO, RAD_ENCODINGS, RadOptions
from sparklod_cli.codecs.rad.property_codings import CODINGS, LARGEST_F16, PROPERTIES
from tests.codecs.cases import rotation_degrees
from tests.scenes import random_splats

Array = NDArray[np.float32]

#: Two splats of three numbers.
TWO = np.array([[0.0, 1.0, 2.0], [0.5, 0.25, -1.0]], np.float32)
AXIS_X = [[0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]]


def encoded(name: str, values: Any, low: float = 0, high: float = 1) -> bytes:
    return CODINGS[name].encode(np.asarray(values, np.float32), low, high).tobytes()


def decoded(name: str, data: bytes, count: int, numbers: int, low: float = 0, high: float = 1) -> Array:
    return CODINGS[name].decode(np.frombuffer(data, np.uint8), count, numbers, low, high)


F32 = struct.pack("<6f", 0, 0.5, 1, 0.25, 2, -1)  # number by number
F16 = struct.pack("<6e", 0, 0.5, 1, 0.25, 2, -1)


@pytest.mark.parametrize(
    ("name", "values", "low", "high", "expected"),
    [
        ("f32", TWO, 0, 0, F32),
        ("f16", TWO, 0, 0, F16),
        ("f32_lebytes", TWO, 0, 0, F32[0::4] + F32[1::4] + F32[2::4] + F32[3::4]),
        ("f16_lebytes", TWO, 0, 0, F16[0::2] + F16[1::2]),
        ("r8", TWO, -1, 2, bytes([85, 128, 170, 106, 255, 0])),  # 127.5 rounds up
        ("r8_delta", TWO, -1, 2, bytes([85, 43, 170, 192, 255, 1])),  # modulo 256, and from 0 for each number
        ("s8", TWO, -2, 2, bytes([0, 32, 64, 16, 127, 256 - 64])),  # 31.75, 63.5, 15.875, 127, -63.5 away from 0
        ("s8", [[3e38], [-3e38], [0.0]], -1e-3, 1e-3, bytes([127, 129, 0])),  # far outside of the range
        ("s8_delta", TWO, -2, 2, bytes([0, 32, 64, 208, 127, 65])),
        ("ln_0r8", np.exp([[-31.0], [-5.0], [-1.0], [1.0], [2.0]]), -1, 1, bytes([0, 1, 1, 255, 255])),
        ("ln_0r8", [[0.0], [1.0]], -1, 1, bytes([0, 128])),
        ("ln_f16", [[0.0], [1.0], [np.e]], 0, 0, struct.pack("<3e", -np.inf, 0, 1)),
        ("oct88r8", AXIS_X, 0, 0, bytes([255, 128, 0, 255, 128, 255])),  # splat by splat: axis u v, angle of pi
    ],
)
def test_an_encoding_has_the_bytes_that_spark_reads(
    name: str, values: Any, low: float, high: float, expected: bytes
) -> None:
    assert encoded(name, values, low, high) == expected


@pytest.mark.parametrize("name", [name for name in CODINGS if name not in ("oct88r8", "u16", "u32")])
@pytest.mark.parametrize("numbers", [1, 3, 15])
def test_bytes_are_those_of_the_writer_by_hand_and_come_back(name: str, numbers: int) -> None:
    rng = np.random.default_rng(4)
    values = np.exp(rng.normal(-2, 0.5, (700, numbers))).astype(np.float32)
    data = encoded(name, values, -1.5, 1.5)
    assert len(data) == values.size * CODINGS[name].size
    ours, theirs = (np.frombuffer(each, np.uint8) for each in (data, by_hand_rad.encoded(values, name, -1.5, 1.5)))
    # Logarithms and quotients in float64 decide some ties in another way.
    assert np.count_nonzero(ours != theirs) <= (0 if name[0] == "f" else 0.002 * ours.size)
    back = decoded(name, data, 700, numbers, -1.5, 1.5)
    assert back.shape == values.shape
    inside = values if name[0] in "fl" else np.clip(values, -1.5, 1.5)
    bound = {
        "f32": 0 * values,
        "f16": np.maximum(2.0**-11 * values, 2.0**-25),
        "r8": np.full(values.shape, 3 / 510),
        "s8": np.full(values.shape, 1.5 / 254),
        "ln_0r8": None,
        "ln_f16": np.expm1(2.0**-11 * np.abs(np.log(values))) * values,
    }[name.removesuffix("_delta").removesuffix("_lebytes")]
    if bound is None:
        clamped = np.clip(np.log(values), -1.5, 1.5)
        assert np.abs(np.log(back) - clamped).max() <= 3 / 508 * 1.001
    else:
        assert (np.abs(back - inside) <= bound * 1.001 + 1e-6 * (name[0] != "f")).all()


def test_rotations_come_back_within_what_is_stated_whatever_the_sign_of_w() -> None:
    quats = random_splats(5000).quat_xyzw
    assert (quats[:, 3] < 0).any()
    assert encoded("oct88r8", quats) == encoded("oct88r8", -quats)
    back = decoded("oct88r8", encoded("oct88r8", quats), len(quats), 3)
    assert rotation_degrees(back, quats).max() <= 1.94
    assert encoded("oct88r8", quats) == by_hand_rad.octahedral(quats.astype(np.float64)).tobytes()


@pytest.mark.parametrize("name", ["f16", "f16_lebytes"])
def test_what_float16_cannot_hold_becomes_its_largest_number(name: str) -> None:
    values = np.array([[65519.0, 1e9, -3e38]], np.float32)
    assert decoded(name, encoded(name, values), 1, 3).tolist() == [[LARGEST_F16, LARGEST_F16, -LARGEST_F16]]


@pytest.mark.parametrize("name", [name for name in CODINGS if name not in ("u16", "u32")])
def test_any_bytes_and_any_range_are_decoded_without_a_warning(name: str) -> None:
    rng = np.random.default_rng(6)
    numbers = 3
    for low, high in ((0, 0), (1, -1), (-3e38, 3e38), (1e-45, 2e-45)):
        data = rng.bytes(1000 * numbers * CODINGS[name].size)
        with np.errstate(all="raise", under="ignore"):
            assert decoded(name, data, 1000, numbers, low, high).shape[0] == 1000


@pytest.mark.parametrize("option", ["center", "alpha", "rgb", "scales", "orientation", "sh"])
def test_every_choice_of_an_option_has_a_coding(option: str) -> None:
    assert AUTO == "auto" == getattr(RadOptions(), option)
    assert set(RAD_ENCODINGS[option]) <= CODINGS.keys()


def test_every_property_can_be_in_an_encoding() -> None:
    assert all(row.encodings and set(row.encodings) <= CODINGS.keys() for row in PROPERTIES)
    assert len({row.name for row in PROPERTIES}) == len(PROPERTIES)
