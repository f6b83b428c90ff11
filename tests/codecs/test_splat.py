""".splat: every byte by hand, both ways, and the order in which it is written."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs import splat
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError
from tests.conftest import FIXTURES
from tests.scenes import random_splats

GOLDEN = FIXTURES / "golden" / "sh0.splat"


def row(center: tuple[float, ...], scale: tuple[float, ...], rgba: tuple[int, ...], wxyz: tuple[int, ...]) -> bytes:
    return struct.pack("<6f8B", *center, *scale, *rgba, *wxyz)


ROWS = (
    row((1.5, -2.25, 1e6), (2, 1, 0.5), (0, 51, 255, 255), (255, 128, 128, 128)),
    row((0, 0, 0), (0.5, 0.25, 3), (102, 153, 204, 51), (128, 0, 128, 128)),
    row((-1, 2, 3), (0, 1e-30, 1e30), (1, 2, 3, 0), (192, 64, 192, 64)),
)


def decode(data: bytes) -> Splats:
    return decode_file(splat, io.BytesIO(data)).splats


def encode(splats: Splats, **more: object) -> bytes:
    return b"".join(splat.encode(Scene(splats, **more)))  # type: ignore[arg-type]


def test_every_byte_is_decoded_as_worked_out_by_hand() -> None:
    splats = decode(b"".join(ROWS))
    np.testing.assert_array_equal(splats.center, [[1.5, -2.25, 1e6], [0, 0, 0], [-1, 2, 3]])
    np.testing.assert_array_equal(splats.scale, np.float32([[2, 1, 0.5], [0.5, 0.25, 3], [0, 1e-30, 1e30]]))
    np.testing.assert_allclose(splats.rgb, [[0, 0.2, 1], [0.4, 0.6, 0.8], [1 / 255, 2 / 255, 3 / 255]], atol=1e-7)
    np.testing.assert_allclose(splats.opacity, [1, 0.2, 0], atol=1e-7)
    np.testing.assert_allclose(splats.quat_xyzw, [[0, 0, 0, 1], [-1, 0, 0, 0], [-0.5, 0.5, -0.5, 0.5]], atol=1e-7)
    assert splats.sh_degree == 0


def test_a_decoded_file_is_encoded_to_the_same_bytes() -> None:
    """They are in order of importance."""
    assert encode(decode(b"".join(ROWS))) == b"".join(ROWS)


def test_values_beyond_a_byte_are_clamped() -> None:
    splats = random_splats(3, sh_degree=2)
    splats.rgb[:] = [[-0.5, 1.5, 0.5]] * 3
    splats.quat_xyzw[:] = [[0, 0, 0, 1], [0, 0, 0, -1], [0, 1, 0, 0]]
    splats.scale[:] = [[3, 3, 3], [2, 2, 2], [1, 1, 1]]
    splats.opacity[:] = [1, 0.998, 1]
    rows = np.frombuffer(encode(splats), np.uint8).reshape(3, 32)
    assert rows[:, 24:28].tolist() == [[0, 255, 128, 255], [0, 255, 128, 254], [0, 255, 128, 255]]
    assert rows[:, 28:].tolist() == [[255, 128, 128, 128], [0, 128, 128, 128], [128, 128, 255, 128]]


def test_the_most_important_come_first_and_equals_keep_their_order() -> None:
    """Importance is the product of scales and opacity, as antimatter15's converter has it."""
    splats = random_splats(5)
    splats.center[:, 0] = np.arange(5)
    splats.scale[:] = [[1, 1, 1], [10, 10, 0.01], [3, 3, 3], [1e-20, 1e-20, 1e-20], [2, 0.5, 1]]
    splats.opacity[:] = [0.5, 1, 0.01, 1, 0.5]
    assert decode(encode(splats)).center[:, 0].tolist() == [1, 0, 4, 2, 3]


def test_importance_does_not_underflow() -> None:
    splats = random_splats(4)
    splats.center[:, 0] = np.arange(4)
    splats.scale[:] = np.array([1e-16, 1e-15, 1e-14, 1e-13], np.float32)[:, None]  # their products are 0 in float32
    splats.opacity[:] = 1
    assert decode(encode(splats)).center[:, 0].tolist() == [3, 2, 1, 0]


def test_threads_do_not_change_a_byte_of_splat() -> None:
    scene = Scene(random_splats(40_000))
    one = b"".join(splat.encode(scene))
    assert len(one) == 32 * 40_000
    assert b"".join(splat.encode(scene, threads=3)) == one


def test_splat_refuses_to_write_a_tree() -> None:
    tree = LodTree(np.array([1, 0], np.uint16), np.array([1, 0], np.uint32))
    with pytest.raises(FormatError, match="SPLAT holds no Level-of-Detail tree"):
        encode(random_splats(2), tree=tree)


@pytest.mark.filterwarnings("error")
def test_a_quaternion_of_zeros_in_splat_is_not_a_number() -> None:
    quats = decode(ROWS[0][:28] + bytes([128] * 4) + ROWS[1]).quat_xyzw
    assert np.isnan(quats).any(axis=1).tolist() == [True, False]


@pytest.mark.parametrize("suffix", [".splat", ".SPLAT"])
def test_only_the_suffix_makes_a_file_splat(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(GOLDEN.read_bytes())
    assert read_scene(path).format == "SPLAT"
    other = path.rename(tmp_path / "scene.bin")
    with pytest.raises(FormatError, match="not a splat file"):
        read_scene(other)


def test_a_suffix_does_not_make_another_format_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "scene.splat"
    path.write_bytes((FIXTURES / "one.ply").read_bytes())
    assert read_scene(path).format == "PLY"


@pytest.mark.parametrize("size", [1, 31, 33, 32 * 60 - 1])
def test_a_size_that_is_not_a_multiple_of_32_is_refused(size: int) -> None:
    with pytest.raises(FormatError, match=f"its {size:,} bytes are not a multiple of 32"):
        decode(GOLDEN.read_bytes()[:size])
