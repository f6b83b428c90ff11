""".ksplat: headers and rows by hand, and what files may have that the shared writer has not."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable

import numpy as np
import pytest

from sparklod_cli.codecs import ksplat
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import FormatError
from tests.conftest import FIXTURES

GOLDEN = [FIXTURES / "golden" / f"sh2-level{level}.ksplat" for level in range(3)]
SECTION = 4096


def decode(data: bytes) -> Scene:
    return decode_file(ksplat, io.BytesIO(data))


def headers(level: int, splats: int, *sections: dict[str, float], sh_range: tuple[float, float] = (0, 0)) -> bytes:
    """The headers of a file; sections by what differs from zeros."""
    data = bytearray(struct.pack("<BBxx4IHxx3f2f", 0, 1, len(sections), 1, 7, splats, level, 9, 9, 9, *sh_range))
    data += bytes(4096 - len(data))
    for section in sections:
        assert section.keys() <= set(FIELDS)
        data += struct.pack("<4IfHxx4IH982x", *(section.get(name, 0) for name in FIELDS))
    return bytes(data)


FIELDS = ("splats", "room", "bucket_splats", "buckets", "width", "bucket_bytes", "steps", "bytes", "full", "partial")
FIELDS = (*FIELDS, "degree")


def halves(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}e", *values)


def small_row(place: tuple[int, int, int], sh: bytes = b"") -> bytes:
    rest = halves(2, 1, 0.5) + halves(0, 0, -3, 4) + bytes([0, 51, 255, 102])
    return struct.pack("<3H", *place) + rest + sh


def test_a_row_of_floats_is_decoded_as_worked_out_by_hand() -> None:
    numbers = (1.5, -2.25, 1e6, 2, 1, 0.5, 0, 0, -3, 4)  # w x y z, of any length
    sh = np.arange(24) / 16
    row = struct.pack("<10f4B24f", *numbers, 0, 51, 255, 102, *sh)
    scene = decode(headers(0, 1, {"splats": 1, "room": 1, "degree": 2}) + row)
    splats = scene.splats
    assert (scene.format, scene.antialiased, scene.notes, scene.tree) == ("KSPLAT", False, (), None)
    np.testing.assert_array_equal(splats.center, [[1.5, -2.25, 1e6]])
    np.testing.assert_array_equal(splats.scale, [[2, 1, 0.5]])
    np.testing.assert_allclose(splats.quat_xyzw, [[0, -0.6, 0.8, 0]], atol=1e-7)
    np.testing.assert_allclose(splats.rgb, [[0, 0.2, 1]], atol=1e-7)
    np.testing.assert_allclose(splats.opacity, [0.4], atol=1e-7)
    red, green, blue = [0, 1, 2, 9, 10, 11, 12, 13], [3, 4, 5, 14, 15, 16, 17, 18], [6, 7, 8, 19, 20, 21, 22, 23]
    np.testing.assert_array_equal(splats.sh[0] * 16, np.transpose([red, green, blue]))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_within_a_degree_all_of_red_come_first(degree: int) -> None:
    count = (degree + 1) ** 2 - 1
    row = struct.pack(f"<10f4B{3 * count}f", *range(10), 0, 0, 0, 0, *range(3 * count))
    sh = decode(headers(0, 1, {"splats": 1, "room": 1, "degree": degree}) + row).splats.sh[0]
    bands = ((0, 1, 2), (3, 4, 5, 6, 7), (8, 9, 10, 11, 12, 13, 14))[:degree]
    in_file = [sh[k, c] for band in bands for c in range(3) for k in band]
    assert in_file == list(range(3 * count))


BUCKETS = {"bucket_splats": 2, "buckets": 3, "width": 4.0, "bucket_bytes": 12, "steps": 32767, "full": 1, "partial": 2}
CENTERS = struct.pack("<9f", 0, 0, 0, 10, 20, 30, -5, -5, -5)


def test_positions_in_buckets_are_decoded_as_worked_out_by_hand() -> None:
    """One full bucket of two, then one that has one, and one that has two though it could have been full."""
    places = [(32767, 0, 65534), (32768, 32767, 65535), (32767, 32767, 32767), (0, 0, 0), (65534, 65534, 65534)]
    section = BUCKETS | {"splats": 5, "room": 5}
    data = headers(1, 5, section) + struct.pack("<2I", 1, 2) + CENTERS + b"".join(map(small_row, places))
    splats = decode(data).splats
    step = 2 / 32767
    expected = [[0, -2, 2], [step, 0, 2 + step], [10, 20, 30], [-7, -7, -7], [-3, -3, -3]]
    np.testing.assert_allclose(splats.center, expected, rtol=1e-6)
    np.testing.assert_array_equal(splats.scale, [[2, 1, 0.5]] * 5)
    np.testing.assert_allclose(splats.quat_xyzw, [[0, -0.6, 0.8, 0]] * 5, atol=1e-7)


@pytest.mark.parametrize(
    ("sh_range", "expected"), [((0, 0), (-1.5, 1.5)), ((-0.5, 1), (-0.5, 1)), ((-1, 0), (-1, 1.5))]
)
def test_sh_bytes_lie_in_the_range_that_the_header_says(
    sh_range: tuple[float, float], expected: tuple[float, float]
) -> None:
    codes = [0, 255, 51, 102, 153, 204, 1, 2, 3]
    section = BUCKETS | {"splats": 1, "room": 1, "full": 0, "partial": 1, "buckets": 1, "degree": 1}
    row = small_row((0, 0, 0), bytes(codes))
    splats = decode(headers(2, 1, section, sh_range=sh_range) + struct.pack("<I", 1) + CENTERS[:12] + row).splats
    low, high = expected
    values = low + np.array(codes) / 255 * (high - low)
    np.testing.assert_allclose(splats.sh[0], values.reshape(3, 3).T, atol=1e-6)


def test_a_section_may_have_room_for_more_than_it_has() -> None:
    """What is loaded so far is in front; the next section lies behind the room."""
    row = struct.pack("<10f4B", *[1] * 10, *[255] * 4)
    other = struct.pack("<10f4B9f", *[2] * 10, *[255] * 4, *[0.5] * 9)
    sections = {"splats": 2, "room": 5}, {}, {"splats": 1, "room": 1, "degree": 1}
    splats = decode(headers(0, 3, *sections) + row * 2 + bytes(3 * len(row)) + other).splats
    assert splats.center[:, 0].tolist() == [1, 1, 2]
    assert splats.sh[:, 2, 2].tolist() == [0, 0, 0.5]  # sections of lower degree have zeros


@pytest.mark.parametrize("level", [1, 2])
def test_a_range_of_0_steps_means_32767(level: int) -> None:
    section = BUCKETS | {"splats": 1, "room": 1, "full": 0, "partial": 1, "buckets": 1}
    rest = struct.pack("<I", 1) + CENTERS[:12] + small_row((65534, 32767, 0))
    one, other = (decode(headers(level, 1, section | {"steps": steps}) + rest).splats for steps in (0, 32767))
    np.testing.assert_array_equal(one.center, other.center)
    np.testing.assert_allclose(one.center, [[2, 0, -2]], rtol=1e-6)


def test_levels_hold_the_same_scene() -> None:
    floats, halves, fewest = (decode(path.read_bytes()).splats for path in GOLDEN)
    assert np.abs(halves.center - floats.center).max() < 8 / 65534 * 0.51
    np.testing.assert_array_equal(fewest.center, halves.center)
    np.testing.assert_array_equal(halves.rgb, floats.rgb)
    assert 0 < np.abs(fewest.sh - floats.sh).max() < 3 / 510 * 1.01


def edited(at: int, kind: str, value: float, level: int = 1) -> bytes:
    data = bytearray(GOLDEN[level].read_bytes())
    struct.pack_into("<" + kind, data, at, value)
    return bytes(data)


REFUSED: dict[str, tuple[Callable[[], bytes], str]] = {
    "version 1.1": (lambda: edited(0, "B", 1), r"KSPLAT version 1\.1 is unknown"),
    "version 0.0": (lambda: edited(1, "B", 0), r"KSPLAT version 0\.0 is unknown"),
    "level 3": (lambda: edited(20, "H", 3), "compression level 3 is unknown"),
    "degree 4": (lambda: edited(SECTION + 40, "H", 4), "KSPLAT has no SH degree 4"),
    "degree 3 of fewer bytes": (lambda: edited(SECTION + 40, "H", 3), "cut short"),
    "a splat more": (lambda: edited(16, "I", 61), "its header announces 61 splats, its sections have 60"),
    "a splat less in a section": (lambda: edited(SECTION, "I", 35), "its header announces 60 splats"),
    "more splats than room": (lambda: edited(SECTION, "I", 37), "cut short"),
    "more room than bytes": (lambda: edited(SECTION + 1024 + 4, "I", 25), "cut short"),
    "other buckets": (lambda: edited(SECTION + 20, "H", 16), "buckets of a section do not follow KSPLAT"),
    "fewer buckets than are full": (lambda: edited(SECTION + 32, "I", 99), "buckets of a section do not follow KSPLAT"),
    "buckets that hold too little": (
        lambda: edited(SECTION + 8, "I", 1),
        "buckets of a section are too small for its 36 splats",
    ),
    "more sections than bytes": (lambda: edited(4, "I", 10), "10 sections"),
    "no header": (lambda: GOLDEN[0].read_bytes()[:4095], "cut short inside the header"),
    "no rows": (lambda: GOLDEN[0].read_bytes()[: 4096 + 2048], "cut short"),
    "a byte less": (lambda: GOLDEN[2].read_bytes()[:-1], "cut short"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_broken_ksplat_is_refused_with_a_reason(what: str) -> None:
    make, reason = REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        decode(make())
