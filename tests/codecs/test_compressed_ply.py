"""Compressed PLY: what hand-made words stand for, and what else its writers vary."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from fixtures import by_hand_compressed_ply
from sparklod_cli.codecs import compressed_ply
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import linear
from tests.conftest import FIXTURES
from tests.scenes import random_splats

GOLDEN = FIXTURES / "golden" / "sh3-compressed.ply"


def decode(data: bytes) -> Scene:
    return decode_file(compressed_ply, io.BytesIO(data))


def by_words(bounds: list[float], *rows: tuple[int, int, int, int], sh: bytes = b"") -> bytes:
    """A file of one chunk, whose words are given; 12 bounds or, with those of colours, 18."""
    names = by_hand_compressed_ply.compressed_ply(**linear(Scene(random_splats(1)))).split(b"\n")
    properties = [line for line in names if line.startswith(b"property float")][: len(bounds)]
    lines = [b"ply", b"format binary_little_endian 1.0", b"element chunk 1", *properties]
    lines += [b"element vertex %d" % len(rows), *(line for line in names if line.startswith(b"property uint"))]
    if sh:
        values = len(sh) // len(rows)
        lines += [b"element sh %d" % len(rows), *(b"property uchar f_rest_%d" % index for index in range(values))]
    words = b"".join(struct.pack("<4I", *row) for row in rows)
    return b"\n".join([*lines, b"end_header\n"]) + struct.pack(f"<{len(bounds)}f", *bounds) + words + sh


POSITION, SCALE = [-1.0, 0.0, 2.0, 3.0, 1023.0, 2.0], [-2.0, 0.0, 1.0, 0.0, 1.0, 1.0]
HALF = 0.5**0.5


def test_every_word_is_decoded_as_worked_out_by_hand() -> None:
    none, all_ones = 0, 2**32 - 1
    mixed = 1 << 21 | 7 << 11 | 2047
    splats = decode(
        by_words(
            [*POSITION, *SCALE],
            (none, 0 << 30 | 512 << 20 | 512 << 10 | 512, none, 0x00_33_66_FF),
            (all_ones, 2 << 30 | 1023 << 20 | 512 << 10 | 512, all_ones, 0xFF_CC_99_00),
            (mixed, 3 << 30 | 0 << 20 | 512 << 10 | 512, mixed, 0x80_00_00_33),
        )
    ).splats
    np.testing.assert_allclose(splats.center, [[-1, 0, 2], [3, 1023, 2], [-1 + 4 / 2047, 7, 2]], rtol=1e-6)
    logs = [[-2, 0, 1], [0, 1, 1], [-2 + 2 / 2047, 7 / 1023, 1]]
    np.testing.assert_allclose(splats.scale, np.exp(logs), rtol=1e-6)
    little = (512 / 1023 - 0.5) / HALF  # there is no code for 0
    w_x_y_z = [[1, little, little, little], [HALF, little, HALF, little], [-HALF, little, little, HALF]]
    np.testing.assert_allclose(splats.quat_xyzw[:, [3, 0, 1, 2]], w_x_y_z, atol=2e-6)
    np.testing.assert_allclose(splats.rgb, [[0, 0.2, 0.4], [1, 0.8, 0.6], [128 / 255, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(splats.opacity, [1, 0, 0.2], atol=1e-7)


def test_colors_have_bounds_of_their_own() -> None:
    splats = decode(by_words([*POSITION, *SCALE, -1, 0, 2, 3, 0.5, 2], (0, 0, 0, 0x00_FF_80_FF))).splats
    np.testing.assert_allclose(splats.rgb, [[-1, 0.5, 2]], rtol=1e-6)


def test_sh_bytes_are_the_middles_of_their_256th_parts_but_for_the_ends() -> None:
    codes = bytes([0, 1, 127, 128, 254, 255, 192, 64, 0])
    sh = decode(by_words([*POSITION, *SCALE], (0, 0, 0, 0), sh=codes)).splats.sh
    values = [-4, -4 + 1.5 / 32, -1 / 64, 1 / 64, 4 - 1.5 / 32, 4, 2 + 1 / 64, -2 + 1 / 64, -4]
    np.testing.assert_array_equal(sh, np.reshape(values, (1, 3, 3)).transpose(0, 2, 1))  # red's come first


def test_sh_of_degree_4_are_cut_to_degree_3() -> None:
    scene = decode(by_words([*POSITION, *SCALE], (0, 0, 0, 0), sh=bytes(range(72))))
    assert scene.splats.sh_degree == 3
    assert scene.notes == ("SH degree 4 is cut to 3",)
    np.testing.assert_allclose(scene.splats.sh[0, :, 1], (np.arange(24, 39) + 0.5) / 32 - 4)


def edited(old: str, new: str, data: bytes | None = None) -> bytes:
    data = GOLDEN.read_bytes() if data is None else data
    assert old.encode() in data
    return data.replace(old.encode(), new.encode(), 1)


def other_order(data: bytes) -> bytes:
    """SH, vertices, chunks."""
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].split(b"element ")
    sizes = [72, 60 * 16, 60 * 45]
    parts = [data[end + sum(sizes[:index]) : end + sum(sizes[: index + 1])] for index in range(3)]
    sh = lines[3].removesuffix(b"end_header\n")
    return b"element ".join([lines[0], sh, lines[2], lines[1] + b"end_header\n"]) + b"".join(parts[::-1])


def big_endian(data: bytes) -> bytes:
    data = edited("little_endian", "big_endian", data)
    end = data.index(b"end_header\n") + len(b"end_header\n")
    words = np.frombuffer(data[end : end + 72 + 960], "<u4").astype(">u4").tobytes()
    return data[:end] + words + data[end + len(words) :]


def padded_vertices(data: bytes) -> bytes:
    data = edited("property uint packed_scale", "property uchar flag\nproperty uint packed_scale", data)
    begin = data.index(b"end_header\n") + len(b"end_header\n") + 72
    rows = [data[at : at + 8] + b"!" + data[at + 8 : at + 16] for at in range(begin, begin + 960, 16)]
    return data[:begin] + b"".join(rows) + data[begin + 960 :]


LAYOUTS: dict[str, Callable[[bytes], bytes]] = {
    "comments": lambda data: edited("element chunk", "comment element chunk 7\nelement chunk", data),
    "long comments": lambda data: edited("element chunk", f"comment {'x' * 9000}\nelement chunk", data),
    "other order": other_order,
    "big-endian": big_endian,
    "another property": padded_vertices,
    "something behind": lambda data: data + b"more",
    "CRLF header": lambda data: (
        data[: data.index(b"end_header")].replace(b"\n", b"\r\n") + data[data.index(b"end_header") :]
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_compressed_ply_hold_the_same_scene(layout: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(LAYOUTS[layout](GOLDEN.read_bytes()))
    one, other = read_scene(path), read_scene(GOLDEN)
    assert one.format == other.format == "compressed PLY"
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(one.splats, column), getattr(other.splats, column), column)


def test_a_comment_does_not_make_a_ply_a_compressed_one(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    plain = (FIXTURES / "one.ply").read_bytes()
    path.write_bytes(edited("element vertex", "comment was packed_position before\nelement vertex", plain))
    assert read_scene(path).format == "PLY"


REFUSED: dict[str, tuple[Callable[[], bytes], str]] = {
    "ascii": (lambda: edited("binary_little_endian", "ascii"), "ascii compressed PLY"),
    "no rotations": (lambda: edited("packed_rotation", "packed_rotations"), "element vertex has no packed_rotation"),
    "positions of another type": (
        lambda: edited("uint packed_position", "float packed_position"),
        "element vertex has no packed_position of type uint32",
    ),
    "no chunks": (lambda: edited("element chunk", "element chunks"), "element chunk has no"),
    "bounds of another type": (
        lambda: edited("float min_x", "int min_x"),
        "element chunk has no min_x of type float32",
    ),
    "bounds of one color": (lambda: edited("float min_r", "float min_red"), "element chunk has no min_r"),
    "too few chunks": (lambda: edited("element chunk 1", "element chunk 0"), "0 chunks of 256 cannot hold 60 splats"),
    "as many chunks as fill one less": (
        lambda: edited("element vertex 60", "element vertex 257"),
        "1 chunk of 256 cannot hold 257 splats",
    ),
    "SH of fewer splats": (lambda: edited("element sh 60", "element sh 59"), "59 rows of 45 values for 60 splats"),
    "SH of another type": (lambda: edited("uchar f_rest_7", "char f_rest_7"), "element sh has no f_rest_7"),
    "44 SH": (lambda: edited("property uchar f_rest_44\n", ""), "60 rows of 44 values"),
    "42 SH": (
        lambda: re.sub(rb"property uchar f_rest_4[234]\n", b"", GOLDEN.read_bytes()),
        "14 SH coefficients per channel",
    ),
    "lists": (lambda: edited("property uchar f_rest_0\n", "property list uchar uchar f_rest_0\n"), "element sh has no"),
    "cut short": (lambda: GOLDEN.read_bytes()[:-1], "cut short: 1 bytes are missing"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_broken_compressed_ply_is_refused_with_a_reason(what: str) -> None:
    make, reason = REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        decode(make())


def test_what_is_left_out_of_compressed_ply_is_named() -> None:
    plain = PlyData.read(GOLDEN)
    rows = plain["vertex"].data
    labelled = np.empty(len(rows), [*rows.dtype.descr, ("label_0", "u1"), ("nx", "f4")])
    for name in rows.dtype.names:
        labelled[name] = rows[name]
    vertex = PlyElement.describe(labelled, "vertex")
    camera, none = (PlyElement.describe(np.zeros(count, [("id", "i4")]), f"camera_{count}") for count in (1, 0))
    others = [each for each in plain.elements if each.name != "vertex"]
    file = io.BytesIO()
    PlyData([others[0], vertex, *others[1:], camera, none]).write(file)
    scene = decode(file.getvalue())
    assert scene.notes == ("its property label_0 is left out", "its element camera_1 is left out")
    assert decode(GOLDEN.read_bytes()).notes == ()
    for column in COLUMNS:
        np.testing.assert_array_equal(
            getattr(scene.splats, column), getattr(decode(GOLDEN.read_bytes()).splats, column)
        )
