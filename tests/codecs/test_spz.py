"""SPZ against files that were put together by hand, and how the fractional bits are chosen."""

from __future__ import annotations

import gzip
import math
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fixtures import by_hand
from sparklod_cli.codecs import quantize, spz
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.codecs.losses import clamps_in
from sparklod_cli.codecs.spz import MOST_EXTENSION_BYTES
from sparklod_cli.codecs.statistics import Statistics
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import assert_same, decode, encode, splats_with
from tests.conftest import FIXTURES
from tests.scenes import random_splats

GOLDEN = FIXTURES / "golden"

# --- Reading: every field of the three splats of fixtures/by_hand.py --------------------------------------------------

STEP = 0.28209479177387814 / 0.15  # of a colour, for the whole range of a byte
RGB = [[code / 255 * STEP - STEP / 2 + 0.5 for code in row] for row in ((0, 51, 102), (153, 204, 255), (127, 128, 0))]
SCALE = [[1, 1 / math.e, math.e], [math.exp(-10), math.exp(5.9375), math.exp(-5)], [1.0644945, 0.9394131, 1]]
THIRD = 3**-0.5
FIRST_THREE = [
    [0.6, -0.6, -1 / 255, 0.5291359],  # w is what is left of 1
    [0.9999846, -0.0039215, 0.0039215, 0],
    [-THIRD, -THIRD, -THIRD, 0],
]
PART = 0.5**0.5 / 511
REST = (1 - (256**2 + 100**2) * PART**2) ** 0.5
SMALLEST_THREE = [[0, 0, 0, 1], [511 * PART, 0, 0, 0.5**0.5], [-256 * PART, REST, 0, 100 * PART]]


def golden(name: str) -> Scene:
    return decode(spz, (GOLDEN / f"{name}.spz").read_bytes())


@pytest.mark.parametrize(
    ("name", "format_name", "sh_degree", "antialiased", "quats"),
    [
        ("hand-v1", "SPZ 1", 1, False, FIRST_THREE),
        ("hand-v2", "SPZ 2", 2, False, FIRST_THREE),
        ("hand-v3", "SPZ 3", 3, True, SMALLEST_THREE),
        ("hand-v4", "SPZ 4", 3, True, SMALLEST_THREE),
        ("hand-v4-sh4", "SPZ 4", 3, False, SMALLEST_THREE),  # its table of streams comes after extension records
    ],
)
def test_every_field_of_a_file_made_by_hand_is_decoded(
    name: str, format_name: str, sh_degree: int, antialiased: bool, quats: list[list[float]]
) -> None:
    scene = golden(name)
    splats = scene.splats
    assert (scene.format, scene.antialiased, scene.tree) == (format_name, antialiased, None)
    left_out = "SH degree 4 is cut to 3", "extension 0x12340001 (5 bytes) is left out"
    assert (scene.up, scene.notes) == (("-y", left_out) if name.endswith("sh4") else ("y", ()))
    assert scene.up_by == ("" if name.endswith("sh4") else "SPZ")
    np.testing.assert_array_equal(splats.center, [[1.5, -2.25, 0.125], [0, -100, 2047], [-0.5, 0.25, -2048]])
    np.testing.assert_allclose(splats.opacity, [1, 0, 0.2], atol=1e-7)
    np.testing.assert_allclose(splats.rgb, RGB, atol=1e-6)
    np.testing.assert_allclose(splats.scale, SCALE, rtol=1e-6)
    np.testing.assert_allclose(splats.quat_xyzw, quats, atol=1e-6)
    assert splats.sh_degree == sh_degree
    k, channel = np.mgrid[: splats.sh.shape[1], :3]
    np.testing.assert_array_equal(splats.sh, np.broadcast_to((8 * k + channel - 128) / 128, splats.sh.shape))


# --- Writing: every byte of a small tree ------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [2, 3])
def test_every_stream_of_a_tree_has_its_bytes(version: int) -> None:
    data = gzip.decompress((GOLDEN / f"tree-v{version}.spz").read_bytes())
    bits, count = 8, 8  # the smallest scale is e ** -1.5 (its largest axis: e ** -2.5), 16 steps of 1 / 256 and more
    assert struct.unpack("<IIIBBBB", data[:16]) == (0x5053474E, version, count, 1, bits, 0x80, 0)
    rotation = 4 if version == 3 else 3
    ends = 16 + np.cumsum([9 * count, count, 3 * count, 3 * count, rotation * count, 9 * count, 2 * count, 4 * count])
    position, alpha, color, scale, quat, sh, counts, starts = (
        data[start:end] for start, end in zip([16, *ends], ends, strict=False)
    )
    assert len(data) == ends[-1]
    assert position == by_hand.fixed24([[i, -0.5 * i, 0.25] for i in range(count)], bits)
    assert list(alpha) == [237, 163, 115, 127, 32, 0, 127, 89]  # D of 1000 is 4.447, of 3.5 it is 2.099
    rgb = np.linspace(-0.2, 1.2, 3 * count)
    assert list(color) == [round((value - 0.5) / 0.28209479177387814 * 0.15 * 255 + 127.5) for value in rgb]
    logs = [max(0, round((-0.5 * i + axis + 10) * 16)) for i in range(count) for axis in (1, 0, -1)]
    assert list(scale) == logs
    assert list(sh) == [8 * round(v * 16) + 128 for v in np.linspace(-0.9, 0.9, 9 * count)]
    assert struct.unpack("<8H", counts) == (3, 2, 0, 2, 0, 0, 0, 0)
    assert struct.unpack("<8I", starts) == (1, 4, 0, 6, 0, 0, 0, 0)
    x, w = np.sin(np.arange(count) * 0.7), np.cos(np.arange(count) * 0.7)
    if version == 2:
        first = [round(abs(a) * math.copysign(1, a * b) * 127.5 + 127.5) for a, b in zip(x, w, strict=True)]
        assert list(quat[::3]) == first
        assert set(quat[1::3] + quat[2::3]) == {128}  # 127.5, to even
    else:
        codes = struct.unpack("<8I", quat)
        assert [code >> 30 for code in codes] == [0 if abs(a) > abs(b) else 3 for a, b in zip(x, w, strict=True)]


# --- Fractional bits --------------------------------------------------------------------------------------------------


def spread(*, reach: float = 1.0, scale: float = 0.01, count: int = 200) -> Splats:
    return splats_with(count, center=np.linspace(-reach, reach, count)[:, None], scale=scale)


def bits_of(splats: Splats, fractional_bits: int | None = None) -> int | None:
    return spz.settled(Scene(splats), WriteOptions(fractional_bits=fractional_bits)).fractional_bits


@given(reach=st.floats(2.0**-10, spz.LAST_CODE, width=32))
def test_the_most_bits_are_the_most_that_fit(reach: float) -> None:
    splats = spread(reach=reach, count=2)
    bits = spz.largest_fractional_bits(float(np.abs(splats.center).max()))
    assert round(reach * 2.0**bits) <= spz.LAST_CODE == 2**23 - 2
    assert bits == 24 or round(reach * 2.0 ** (bits + 1)) > spz.LAST_CODE
    back = decode(spz, encode(spz, splats, WriteOptions(fractional_bits=bits)))
    assert np.abs(back.splats.center.astype(np.float64) - splats.center).max() <= 0.5 * 2.0**-bits


@given(log_scale=st.floats(-12, 6))
def test_auto_is_the_fewest_bits_with_16_steps_in_a_small_splat(log_scale: float) -> None:
    splats = spread(reach=1e-3, scale=math.exp(log_scale))  # so small that the extent sets no limit before 24
    bits = bits_of(splats)
    assert bits is not None
    assert bits in (0, 24) or 16 * 2.0**-bits <= math.exp(log_scale) * 1.0001 < 16 * 2.0 ** (1 - bits) * 1.0002
    assert bits > 0 or math.exp(log_scale) >= 16 * 0.9999
    assert bits < 24 or math.exp(log_scale) <= 32 * 2.0**-24 * 1.0001


def test_auto_looks_at_the_largest_scale_and_not_at_the_smallest_percent() -> None:
    flat = spread(scale=0.25)
    flat.scale[:, 2] = 1e-9
    assert bits_of(flat) == 6
    flat.scale[0] = 1e-9  # one of 200 is less than a percent
    assert bits_of(flat) == 6
    flat.scale[:5] = 1e-9
    assert bits_of(flat) == 22  # as many as coordinates of 1 allow


@pytest.mark.parametrize(("reach", "most"), [(0.4, 24), (1, 22), (100, 16), (2047, 12), (2049, 11), (8e6, 0)])
def test_extent_limits_auto_and_refuses_more_by_name(reach: float, most: int) -> None:
    splats = spread(reach=reach, scale=1e-12)
    assert bits_of(splats) == most
    assert bits_of(splats, most) == most
    assert bits_of(splats, 0) == 0
    if most < 24:
        with pytest.raises(FormatError, match=rf"does not fit {most + 1} fractional bits; use at most {most}"):
            bits_of(splats, most + 1)


TREE = golden("tree-v3")
FAR, VERSIONS = r"coordinates reach 1e\+07, SPZ holds at most 8388606", "no spz version [15]; give one of 2, 3, 4"
VERSION_4 = WriteOptions(spz_version=4)


@pytest.mark.parametrize(
    ("scene", "options", "error", "text"),
    [
        *((Scene(spread(reach=1e7)), {"fractional_bits": bits}, FormatError, FAR) for bits in (None, 0)),
        *((Scene(spread()), {"spz_version": version}, ValueError, VERSIONS) for version in (1, 5)),
        (TREE, {"spz_version": 4}, FormatError, "SPZ version 4 holds no tree"),
        (Statistics.of_scene(TREE, spz.needed(VERSION_4)), {"spz_version": 4}, FormatError, "4 holds no tree"),
        (Scene(spread(), up="-x"), {"spz_version": 4}, FormatError, "cannot note that -x points up"),
        (Scene(spread()), {"sh_bits": 3}, ValueError, "sh_bits is 3, not 4 to 8"),
    ],
)
def test_what_spz_cannot_hold_is_refused(scene: Any, options: dict[str, Any], error: type, text: str) -> None:
    with pytest.raises(error, match=text):
        spz.settled(scene, WriteOptions(**options))


def test_version_4_has_the_streams_of_version_3() -> None:
    scene = Scene(random_splats(3000, sh_degree=2), antialiased=True)
    files = {version: encode(spz, scene, WriteOptions(spz_version=version)) for version in (3, 4)}
    raw = by_hand.unpacked(files[4])
    fields = struct.unpack_from("<IIIBBBBI12s", files[4])
    assert fields == (0x5053474E, 4, 3000, 2, *gzip.decompress(files[3])[13:15], 6, 32, bytes(12))
    streams, at = [], 32
    while at < len(raw):
        (size,) = struct.unpack_from("<Q", raw, at)
        streams.append(raw[at + 8 : at + 8 + size])
        at += 8 + size
    assert b"".join(streams) == gzip.decompress(files[3])[16:]


@pytest.mark.parametrize("up", ["y", "-y", "z", "-z"])
def test_version_4_notes_what_is_up_as_a_coordinate_system(up: str) -> None:
    data = encode(spz, Scene(random_splats(3), up=up), VERSION_4)
    system = {"y": 4, "-y": 6, "z": 12, "-z": 14}[up]
    assert (data[14], struct.unpack_from("<I", data, 16), data[32:44]) == (
        0x02,
        (44,),
        by_hand.spz_extension(0xADBE0003, struct.pack("<I", system)),
    )
    assert decode(spz, data).up == up


def test_fractional_bits_are_chosen_by_the_leaves_alone() -> None:
    """A tree gets those of its leaves: its inner nodes are larger, and may lie farther out only by the extent."""
    leaves = spread(scale=0.01, count=20)
    root = leaves.take(np.zeros(400, np.int64))
    root.scale[:] = 1e-5
    count = np.zeros(420, np.uint16)
    count[:400], start = 1, np.arange(1, 421, dtype=np.uint32)
    count[399], start[400:] = 20, 0
    tree = Scene(Splats.concat([root, leaves]), LodTree(count, start))
    assert spz.settled(tree, WriteOptions()).fractional_bits == bits_of(leaves) == 11
    root.center[0] = 4000
    assert spz.settled(Scene(Splats.concat([root, leaves]), tree.tree), WriteOptions()).fractional_bits == 11
    root.center[0] = 5000
    assert spz.settled(Scene(Splats.concat([root, leaves]), tree.tree), WriteOptions()).fractional_bits == 10


def test_settled_options_are_settled_and_default_to_those_of_the_file() -> None:
    scene = Scene(random_splats(50))
    once = spz.settled(scene, WriteOptions())
    assert None not in (once.spz_version, once.fractional_bits)
    assert spz.settled(scene, once) == once
    assert encode(spz, scene, once) == encode(spz, scene)
    header = decode(spz, encode(spz, scene, WriteOptions(2, 9))).header
    assert spz.like(header, WriteOptions()) == WriteOptions(2, 9)
    assert spz.like(header, WriteOptions(3, 0, 7)) == WriteOptions(3, 0, 7)
    assert spz.like({"version": 4, "fractional_bits": 12}, WriteOptions()) == WriteOptions(3, 12)
    assert spz.like({}, WriteOptions()) == WriteOptions()


def test_clamped_values_are_counted_by_splat() -> None:
    splats = random_splats(8, sh_degree=1)
    splats.scale[:] = 1
    low, high = math.exp(-10 - 1 / 32), math.exp(255.5 / 16 - 10)
    splats.scale[0] = low * 1.001  # rounds to the last code that is in
    splats.scale[1] = high * 0.999
    assert clamps_in(splats) == ({}, ())
    splats.scale[2, 1] = low * 0.999
    splats.scale[3, 2] = high * 1.001
    splats.scale[4] = 0  # a splat counts once, however many of its axes are out
    splats.rgb[5] = -0.5
    splats.sh[6:, 2] = 1.1
    assert clamps_in(splats, threads=2)[0] == {"scale": 3, "rgb": 1, "sh": 2}
    found = {(at.column, at.above): (at.splats, at.farthest) for at in clamps_in(splats)[1]}
    assert found == {
        ("scale", False): (2, 0.0),
        ("scale", True): (1, pytest.approx(high * 1.001)),
        ("rgb", False): (1, -0.5),
        ("sh", True): (2, pytest.approx(1.1)),
    }


@pytest.mark.parametrize(("name", "decode"), [("scale", quantize.decode_log_scale), ("rgb", quantize.decode_color)])
def test_the_ends_that_are_counted_are_the_ends_of_the_codes(name: str, decode: Callable) -> None:
    low, high = quantize.CLAMPS[name]
    first, second, before, last = decode(np.array([0, 1, 254, 255], np.uint8))
    middle = np.log if name == "scale" else np.copy  # half a step is half a factor for logarithms
    assert middle(first) - middle(low) == pytest.approx((middle(second) - middle(first)) / 2, rel=1e-4)
    assert middle(high) - middle(last) == pytest.approx((middle(last) - middle(before)) / 2, rel=1e-4)


# --- What is refused --------------------------------------------------------------------------------------------------


def gzipped(
    version: int = 2, count: int = 3, degree: int = 0, bits: int = 12, flags: int = 0, more: bytes = b""
) -> bytes:
    return by_hand.spz_gzip(version, count, degree, bits, flags, [*by_hand.hand_streams(version, degree), more])


def zstd(**changed: object) -> bytes:
    settings = {"count": 3, "sh_degree": 0, "fractional_bits": 12, "flags": 0, "streams": by_hand.hand_streams(4, 0)}
    return by_hand.spz_zstd(**(settings | changed))  # type: ignore[arg-type]


def with_byte(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + bytes([value]) + data[at + 1 :]


REST = by_hand.hand_streams(4, 0)[1:]
REFUSED: dict[str, tuple[bytes, str]] = {
    "version 0": (gzipped(0), "SPZ version 0 is unknown"),
    "version 5": (gzipped(5), "SPZ version 5 is unknown"),
    "version 3 without gzip": (zstd(version=3), "version 3 must be gzipped"),
    "SH degree 4 before version 4": (gzipped(3, degree=4), "SPZ version 3 has no SH degree 4"),
    "SH degree 5": (with_byte(zstd(), 12, 5), "SPZ version 4 has no SH degree 5"),
    "32 fractional bits": (gzipped(bits=32), "32 fractional bits"),
    "more splats than data": (gzipped(count=4), "cut short after 1 of 4 scales"),
    "more data than splats": (gzipped(more=b"!"), "more data than its header announces"),
    "gzip of something else": (gzip.compress(b"something else that is long"), "not of SPZ"),
    "gzip of little": (gzip.compress(b"NGSP"), "inside the SPZ header"),
    "wrong checksum": (with_byte(gzipped(), len(gzipped()) - 8, gzipped()[-8] ^ 1), "corrupt gzip data"),
    "no checksum": (gzipped()[:-8], "checksum is missing"),
    "a table past the end": (with_byte(zstd(), 18, 1), "inside the table of streams"),
    "a table in the header": (with_byte(zstd(), 16, 31), "begins at byte 31, inside the header"),
    "too few streams": (with_byte(zstd(), 15, 4), "4 streams, but"),
    "a wrong size in the table": (zstd(sizes=[27, 4, 9, 9, 12]), "stream alphas has 4 bytes"),
    "a short frame": (zstd(streams=[b"", *REST], sizes=[27, 3, 9, 9, 12]), "cut short after 0 of 3 positions"),
    "a long frame": (zstd(streams=[bytes(28), *REST], sizes=[27, 3, 9, 9, 12]), "positions is longer than its table"),
    "no tree": (gzipped(flags=0x80, more=struct.pack("<3H3I", *[0] * 6)), "Level-of-Detail tree is broken"),
    "a tree without splats": (by_hand.spz_gzip(2, 0, 0, 12, 0x80, []), "Level-of-Detail tree is broken"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_broken_spz_is_refused_with_a_reason(what: str) -> None:
    data, reason = REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        decode(spz, data)


KNOWN, UNKNOWN = 0xADBE0003, 0x12340001
record = by_hand.spz_extension

#: Extension records, the axis that they say points up, and a word for each note on them.
EXTENSIONS: dict[str, tuple[bytes, str | None, list[str]]] = {
    "none": (b"", "y", []),
    "y down": (record(KNOWN, b"\6\0\0\0"), "-y", []),
    "the first counts": (record(KNOWN, b"\x0c\0\0\0") + record(KNOWN, b"\6\0\0\0"), "z", []),
    "left-handed": (record(KNOWN, b"\x08\0\0\0"), "y", [r"left-handed \(RUF\)"]),
    "unspecified": (record(KNOWN, bytes(4)), None, ["system 0 is unknown"]),
    "beyond the last": (record(KNOWN, b"\x11\0\0\0"), None, ["system 17 is unknown"]),
    "beyond the last, often": (record(KNOWN, b"\x11\0\0\0") * 99, None, ["system 17 is unknown"]),
    "too short": (record(KNOWN, b"\6"), None, ["system 0 is unknown"]),
    "a camera": (record(0xADBE0002, bytes(12)), "y", [r"SPZ_ADOBE_safe_orbit_camera \(12 bytes\)"]),
    "others first": (record(UNKNOWN, b"x" * 9) * 2 + record(KNOWN, b"\4\0\0\0"), "y", [r"0x12340001 \(18 bytes\)"]),
    "many": (b"".join(record(UNKNOWN + n, b"") for n in range(99)), "y", [*["0 bytes"] * 8, "91 more kinds"]),
    "a payload past the end": (record(KNOWN, b"\6\0\0\0") + struct.pack("<II", UNKNOWN, 1), "-y", ["last 8 bytes"]),
    "no records": (b"an extension", "y", ["last 12 bytes"]),
}


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("what", EXTENSIONS)
def test_extension_records_say_what_is_up(what: str, version: int) -> None:
    records, up, notes = EXTENSIONS[what]
    data = zstd(flags=0x02, extension=records) if version == 4 else gzipped(version, flags=0x02, more=records)
    scene, plain = decode(spz, data), decode(spz, zstd() if version == 4 else gzipped(version))
    assert_same(scene.splats, plain.splats)
    assert (scene.up, scene.up_by) == (up, "SPZ" if up and records.find(struct.pack("<I", KNOWN)) < 0 else "")
    for note, pattern in zip(scene.notes, notes, strict=True):
        assert re.search(pattern, note)
        assert note.isprintable()


@pytest.mark.parametrize("version", [3, 4])
def test_records_beyond_a_megabyte_are_left_out(version: int) -> None:
    records = record(UNKNOWN, bytes(MOST_EXTENSION_BYTES)) + EXTENSIONS["y down"][0]
    data = zstd(flags=0x02, extension=records) if version == 4 else gzipped(flags=0x02, more=records)
    scene = decode(spz, data)
    assert (scene.up, scene.up_by) == ("y", "SPZ")
    assert "bytes of its extensions are no records that can be read" in scene.notes[-1]


def test_extension_records_without_the_flag_and_unknown_streams_say_nothing() -> None:
    scene = decode(spz, zstd(extension=EXTENSIONS["y down"][0]))
    assert (scene.up, scene.up_by, scene.notes) == ("y", "SPZ", ())
    assert len(decode(spz, zstd(streams=[*by_hand.hand_streams(4, 0), b"more"])).splats) == 3
