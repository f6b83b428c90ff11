"""SPLAT, KSPLAT and hierarchies: their bytes by hand, what their writers vary, and what is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from fixtures import by_hand_hier
from sparklod_cli.codecs import hier, ksplat, splat
from sparklod_cli.codecs.formats import sniff
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import FormatError
from tests.codecs import cases
from tests.codecs.cases import linear
from tests.conftest import FIXTURES
from tests.scenes import random_splats

# --- SPLAT ------------------------------------------------------------------------------------------------------------

SPLAT_FILE = FIXTURES / "golden" / "sh0.splat"


def row(center: tuple[float, ...], scale: tuple[float, ...], rgba: tuple[int, ...], wxyz: tuple[int, ...]) -> bytes:
    return struct.pack("<6f8B", *center, *scale, *rgba, *wxyz)


SPLAT_ROWS = (
    row((1.5, -2.25, 1e6), (2, 1, 0.5), (0, 51, 255, 255), (255, 128, 128, 128)),
    row((0, 0, 0), (0.5, 0.25, 3), (102, 153, 204, 51), (128, 0, 128, 128)),
    row((-1, 2, 3), (0, 1e-30, 1e30), (1, 2, 3, 0), (192, 64, 192, 64)),
)


def test_every_byte_is_decoded_as_worked_out_by_hand() -> None:
    splats = cases.decode(splat, b"".join(SPLAT_ROWS)).splats
    np.testing.assert_array_equal(splats.center, [[1.5, -2.25, 1e6], [0, 0, 0], [-1, 2, 3]])
    np.testing.assert_array_equal(splats.scale, np.float32([[2, 1, 0.5], [0.5, 0.25, 3], [0, 1e-30, 1e30]]))
    np.testing.assert_allclose(splats.rgb, [[0, 0.2, 1], [0.4, 0.6, 0.8], [1 / 255, 2 / 255, 3 / 255]], atol=1e-7)
    np.testing.assert_allclose(splats.opacity, [1, 0.2, 0], atol=1e-7)
    np.testing.assert_allclose(splats.quat_xyzw, [[0, 0, 0, 1], [-1, 0, 0, 0], [-0.5, 0.5, -0.5, 0.5]], atol=1e-7)
    assert splats.sh_degree == 0
    assert cases.encode(splat, splats) == b"".join(SPLAT_ROWS)  # in order of importance


def test_values_beyond_a_byte_are_clamped() -> None:
    splats = random_splats(3, sh_degree=2)
    splats.rgb[:] = [[-0.5, 1.5, 0.5]] * 3
    splats.quat_xyzw[:] = [[0, 0, 0, 1], [0, 0, 0, -1], [0, 1, 0, 0]]
    splats.scale[:] = [[3, 3, 3], [2, 2, 2], [1, 1, 1]]
    splats.opacity[:] = [1, 0.998, 1]
    rows = np.frombuffer(cases.encode(splat, splats), np.uint8).reshape(3, 32)
    assert rows[:, 24:28].tolist() == [[0, 255, 128, 255], [0, 255, 128, 254], [0, 255, 128, 255]]
    assert rows[:, 28:].tolist() == [[255, 128, 128, 128], [0, 128, 128, 128], [128, 128, 255, 128]]


def test_the_most_important_come_first_and_equals_keep_their_order() -> None:
    """Importance is the product of scales and opacity, as antimatter15's converter has it."""
    splats = random_splats(5)
    splats.center[:, 0] = np.arange(5)
    splats.scale[:] = [[1, 1, 1], [10, 10, 0.01], [3, 3, 3], [1e-20, 1e-20, 1e-20], [2, 0.5, 1]]
    splats.opacity[:] = [0.5, 1, 0.01, 1, 0.5]
    assert cases.decode(splat, cases.encode(splat, splats)).splats.center[:, 0].tolist() == [1, 0, 4, 2, 3]
    splats.scale[:] = np.array([1e-17, 1e-16, 1e-15, 1e-14, 1e-13], np.float32)[:, None]  # products are 0 in float32
    splats.opacity[:] = 1
    assert cases.decode(splat, cases.encode(splat, splats)).splats.center[:, 0].tolist() == [4, 3, 2, 1, 0]


@pytest.mark.filterwarnings("error")
def test_a_quaternion_of_zeros_in_splat_is_not_a_number() -> None:
    quats = cases.decode(splat, SPLAT_ROWS[0][:28] + bytes([128] * 4) + SPLAT_ROWS[1]).splats.quat_xyzw
    assert np.isnan(quats).any(axis=1).tolist() == [True, False]


@pytest.mark.parametrize("suffix", [".splat", ".SPLAT"])
def test_only_the_suffix_makes_a_file_splat(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(SPLAT_FILE.read_bytes())
    assert read_scene(path).format == "SPLAT"
    other = path.rename(tmp_path / "scene.bin")
    with pytest.raises(FormatError, match="not a splat file"):
        read_scene(other)


@pytest.mark.parametrize("size", [1, 31, 33, 32 * 60 - 1])
def test_a_size_that_is_not_a_multiple_of_32_is_refused(size: int) -> None:
    with pytest.raises(FormatError, match=f"its {size:,} bytes are not a multiple of 32"):
        cases.decode(splat, SPLAT_FILE.read_bytes()[:size])


# --- KSPLAT -----------------------------------------------------------------------------------------------------------

KSPLATS = [FIXTURES / "golden" / f"sh2-level{level}.ksplat" for level in range(3)]
SECTION = 4096


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
    scene = cases.decode(ksplat, headers(0, 1, {"splats": 1, "room": 1, "degree": 2}) + row)
    splats = scene.splats
    assert (scene.format, scene.antialiased, scene.notes, scene.tree) == ("KSPLAT", False, (), None)
    np.testing.assert_array_equal(splats.center, [[1.5, -2.25, 1e6]])
    np.testing.assert_array_equal(splats.scale, [[2, 1, 0.5]])
    np.testing.assert_allclose(splats.quat_xyzw, [[0, -0.6, 0.8, 0]], atol=1e-7)
    np.testing.assert_allclose(splats.rgb, [[0, 0.2, 1]], atol=1e-7)
    np.testing.assert_allclose(splats.opacity, [0.4], atol=1e-7)
    red, green, blue = [0, 1, 2, 9, 10, 11, 12, 13], [3, 4, 5, 14, 15, 16, 17, 18], [6, 7, 8, 19, 20, 21, 22, 23]
    np.testing.assert_array_equal(splats.sh[0] * 16, np.transpose([red, green, blue]))


BUCKETS = {"bucket_splats": 2, "buckets": 3, "width": 4.0, "bucket_bytes": 12, "steps": 32767, "full": 1, "partial": 2}
CENTERS = struct.pack("<9f", 0, 0, 0, 10, 20, 30, -5, -5, -5)


def test_positions_in_buckets_are_decoded_as_worked_out_by_hand() -> None:
    """One full bucket of two, then one that has one, and one that has two though it could have been full."""
    places = [(32767, 0, 65534), (32768, 32767, 65535), (32767, 32767, 32767), (0, 0, 0), (65534, 65534, 65534)]
    section = BUCKETS | {"splats": 5, "room": 5}
    data = headers(1, 5, section) + struct.pack("<2I", 1, 2) + CENTERS + b"".join(map(small_row, places))
    splats = cases.decode(ksplat, data).splats
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
    rest = struct.pack("<I", 1) + CENTERS[:12] + small_row((0, 0, 0), bytes(codes))
    splats = cases.decode(ksplat, headers(2, 1, section, sh_range=sh_range) + rest).splats
    low, high = expected
    values = low + np.array(codes) / 255 * (high - low)
    np.testing.assert_allclose(splats.sh[0], values.reshape(3, 3).T, atol=1e-6)


def test_a_section_may_have_room_for_more_than_it_has() -> None:
    """What is loaded so far is in front; the next section lies behind the room."""
    row = struct.pack("<10f4B", *[1] * 10, *[255] * 4)
    other = struct.pack("<10f4B9f", *[2] * 10, *[255] * 4, *[0.5] * 9)
    sections = {"splats": 2, "room": 5}, {}, {"splats": 1, "room": 1, "degree": 1}
    splats = cases.decode(ksplat, headers(0, 3, *sections) + row * 2 + bytes(3 * len(row)) + other).splats
    assert splats.center[:, 0].tolist() == [1, 1, 2]
    assert splats.sh[:, 2, 2].tolist() == [0, 0, 0.5]  # sections of lower degree have zeros


@pytest.mark.parametrize("level", [1, 2])
def test_a_range_of_0_steps_means_32767(level: int) -> None:
    section = BUCKETS | {"splats": 1, "room": 1, "full": 0, "partial": 1, "buckets": 1}
    rest = struct.pack("<I", 1) + CENTERS[:12] + small_row((65534, 32767, 0))
    one, other = (
        cases.decode(ksplat, headers(level, 1, section | {"steps": steps}) + rest).splats for steps in (0, 32767)
    )
    np.testing.assert_array_equal(one.center, other.center)
    np.testing.assert_allclose(one.center, [[2, 0, -2]], rtol=1e-6)


def edited(at: int, kind: str, value: float) -> bytes:
    data = bytearray(KSPLATS[1].read_bytes())
    struct.pack_into("<" + kind, data, at, value)
    return bytes(data)


KSPLAT_REFUSED = {
    "version 1.1": (edited(0, "B", 1), r"KSPLAT version 1\.1 is unknown"),
    "version 0.0": (edited(1, "B", 0), r"KSPLAT version 0\.0 is unknown"),
    "level 3": (edited(20, "H", 3), "compression level 3 is unknown"),
    "degree 4": (edited(SECTION + 40, "H", 4), "KSPLAT has no SH degree 4"),
    "degree 3 of fewer bytes": (edited(SECTION + 40, "H", 3), "cut short"),
    "a splat more": (edited(16, "I", 61), "its header announces 61 splats, its sections have 60"),
    "a splat less in a section": (edited(SECTION, "I", 35), "its header announces 60 splats"),
    "more splats than room": (edited(SECTION, "I", 37), "cut short"),
    "more room than bytes": (edited(SECTION + 1024 + 4, "I", 25), "cut short"),
    "other buckets": (edited(SECTION + 20, "H", 16), "buckets of a section do not follow KSPLAT"),
    "fewer buckets than are full": (edited(SECTION + 32, "I", 99), "buckets of a section do not follow KSPLAT"),
    "small buckets": (edited(SECTION + 8, "I", 1), "buckets of a section are too small for its 36 splats"),
    "more sections than bytes": (edited(4, "I", 10), "10 sections"),
    "no header": (KSPLATS[0].read_bytes()[:4095], "cut short inside the header"),
    "no rows": (KSPLATS[0].read_bytes()[: 4096 + 2048], "cut short"),
    "a byte less": (KSPLATS[2].read_bytes()[:-1], "cut short"),
}


@pytest.mark.parametrize("what", KSPLAT_REFUSED)
def test_broken_ksplat_is_refused_with_a_reason(what: str) -> None:
    data, reason = KSPLAT_REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        cases.decode(ksplat, data)


# --- Hierarchies ------------------------------------------------------------------------------------------------------

SCENE = Scene(random_splats(10, sh_degree=1))
#: Ten splats below three nodes and a root; the positions of the numbers of splats and of nodes.
DATA, SPLATS, NODES = by_hand_hier.hier(**linear(SCENE)), 14, 4 + 14 * 236
#: Numbers of a node.
DEPTH, PARENT, START, LEAVES, MERGED, FIRST_CHILD, CHILDREN = range(7)


def changed(*changes: tuple[int, int, int], data: bytes = DATA) -> bytes:
    """Changes numbers of nodes, each by node, number and value."""
    new = bytearray(data)
    for node, number, value in changes:
        struct.pack_into("<i", new, NODES + 4 + 28 * node + 4 * number, value)
    return bytes(new)


def test_full_detail_is_the_leaves_in_the_order_of_the_file() -> None:
    np.testing.assert_array_equal(cases.decode(hier, DATA).splats.center, SCENE.splats.center)


def test_a_node_without_children_stands_for_them() -> None:
    """As in hierarchies that were cut to a chunk; the splats of its former children are still in the file."""
    lost = [(node, LEAVES, 0) for node in (12, 13)]  # the splats of the last inner node
    centers = cases.decode(hier, changed((3, CHILDREN, 0), *lost)).splats.center
    np.testing.assert_array_equal(centers[:8], SCENE.splats.center[:8])
    np.testing.assert_allclose(centers[8], SCENE.splats.center[8:].mean(axis=0), rtol=1e-5)
    assert len(centers) == 9


def test_a_node_may_have_splats_of_its_own() -> None:
    first_two = [(4, LEAVES, 2), (5, LEAVES, 0)]
    np.testing.assert_array_equal(cases.decode(hier, changed(*first_two)).splats.center, SCENE.splats.center)


def test_opacities_above_one_are_one() -> None:
    columns = linear(SCENE) | {"opacity": np.linspace(0.5, 1.4, 10)}
    opacity = cases.decode(hier, by_hand_hier.hier(**columns)).splats.opacity
    np.testing.assert_allclose(opacity, np.minimum(columns["opacity"], 1), rtol=1e-6)


HIER_REFUSED = {
    "nothing": (b"", "cut short"),
    "more splats than bytes": (struct.pack("<i", 2**31 - 1) + DATA[4:], "fewer splats than it announces"),
    "more halves than bytes": (struct.pack("<i", -(2**31)) + DATA[4:], "fewer splats than it announces"),
    "more nodes than bytes": (
        DATA[:NODES] + struct.pack("<i", 2**31 - 1) + DATA[NODES + 4 :],
        "14 splats in 2,147,483,647 nodes",
    ),
    "fewer nodes than none": (DATA[:NODES] + struct.pack("<i", -1) + DATA[NODES + 4 :], "in -1 nodes"),
    "a run past the end": (changed((13, START, SPLATS)), "does not have"),
    "a run before the beginning": (changed((4, START, -1)), "does not have"),
    "a negative number": (changed((4, LEAVES, -1)), "does not have"),
    "children past the end": (changed((0, FIRST_CHILD, 12)), "does not have"),
    "a child that is the root": (changed((1, FIRST_CHILD, 0)), "does not have"),
    "the same splats twice": (changed((5, START, 2)), "name the same splats"),
    "all splats for each node": (
        changed(*((node, number, value) for node in range(14) for number, value in ((START, 0), (LEAVES, 14)))),
        "does not have|name the same splats",
    ),
    "a byte less": (DATA[:-1], "cut short"),
    "a byte less of halves": (by_hand_hier.hier(**linear(SCENE), half=True)[:-1], "cut short"),
}


@pytest.mark.parametrize("what", HIER_REFUSED)
def test_broken_hierarchies_are_refused_with_a_reason(what: str) -> None:
    data, reason = HIER_REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        cases.decode(hier, data)


def test_bytes_after_the_boxes_are_counted() -> None:
    assert cases.decode(hier, DATA + b"more").header["trailing_bytes"] == 4


@pytest.mark.parametrize("count", [256, 1024, 65_280])
def test_a_number_of_splats_is_no_magic(count: int) -> None:
    """Such a number begins as a KSPLAT does."""
    form = sniff(struct.pack("<i3f", count, 0.5, 1, 2), ".hier")
    assert form is not None and form.name == "HIER"
