"""PLY in all the shapes that writers give it, and as it is written in Inria's layout; compressed PLY, word by word."""

from __future__ import annotations

import io
import math
import re
import struct
import tracemalloc
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from fixtures import by_hand, by_hand_compressed_ply
from sparklod_cli.codecs import ply
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import FormatError, NotSplatsError
from tests.codecs import cases
from tests.codecs.cases import assert_same, linear
from tests.conftest import FIXTURES
from tests.scenes import random_splats, splat_columns

SH_C0 = 0.28209479177387814


def columns(count: int = 5, sh_degree: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    sh = rng.normal(size=(count, by_hand.SH_COEFFICIENTS[sh_degree], 3))
    values = [rng.normal(size=(count, width)) for width in (3, 3, 4, 1, 3)]
    return by_hand.ply_columns(values[0], values[1], values[2], values[3][:, 0], values[4], sh)


def decode(data: bytes) -> Scene:
    return cases.decode(ply, data)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3, 4])
def test_f_rest_has_all_of_red_first(sh_degree: int) -> None:
    coefficients = by_hand.SH_COEFFICIENTS[sh_degree]
    given = columns()
    given |= {f"f_rest_{index}": np.full(5, index) for index in range(3 * coefficients)}
    scene = decode(by_hand.ply(given))
    kept = min(coefficients, 15)
    assert scene.splats.sh.shape == (5, kept, 3)
    expected = np.arange(3 * coefficients).reshape(3, coefficients).T[:kept]
    np.testing.assert_array_equal(scene.splats.sh, np.broadcast_to(expected, (5, kept, 3)))
    assert scene.notes == (("SH degree 4 is cut to 3",) if sh_degree == 4 else ())


def some_faces(count: int = 3) -> PlyElement:
    faces = np.empty(count, [("vertex_indices", "O"), ("flag", "u1")])
    faces["vertex_indices"] = [list(range(index)) for index in range(count)]
    return PlyElement.describe(faces, "face", len_types={"vertex_indices": "u1"}, val_types={"vertex_indices": "i4"})


def some_cameras(count: int = 4) -> PlyElement:
    return PlyElement.describe(np.ones(count, [("view", "f8"), ("id", "u1")]), "camera")


def shuffled(given: dict[str, Any]) -> dict[str, Any]:
    names = np.random.default_rng(8).permutation(sorted(given))
    return {name: given[name] for name in names}


LAYOUTS: dict[str, Callable[[dict[str, Any], bool], bytes]] = {
    "shuffled": lambda c, text: by_hand.ply(shuffled(c), text=text),
    "no normals": lambda c, text: by_hand.ply({k: v for k, v in c.items() if k[0] != "n"}, text=text),
    "extra properties": lambda c, text: by_hand.ply(
        {"red": [255] * 5, **c, "label": [-7] * 5}, text=text, types={"red": "u1", "label": "i2"}
    ),
    "mixed types": lambda c, text: by_hand.ply(c, text=text, types={"x": "f8", "f_rest_3": "f8", "opacity": "f8"}),
    "scalars before": lambda c, text: by_hand.ply(c, text=text, before=[some_cameras()]),
    "scalars after": lambda c, text: by_hand.ply(c, text=text, after=[some_cameras()]),
    "lists before": lambda c, text: by_hand.ply(c, text=text, before=[some_faces()]),
    "lists after": lambda c, text: by_hand.ply(c, text=text, after=[some_faces()]),
    "all around": lambda c, text: by_hand.ply(
        c, text=text, before=[some_cameras(), some_faces()], after=[PlyElement.describe(np.ones(2, [("a", "i4")]), "b")]
    ),
    "comments": lambda c, text: by_hand.ply(c, text=text).replace(
        b"element vertex", b"comment element vertex 99\nobj_info made by hand\ncomment\nelement vertex"
    ),
    "comments of any encoding": lambda c, text: by_hand.ply(c, text=text).replace(
        b"element vertex", b"comment by J\xfcrgen, element vertex 3\nobj_info \xff\xfe\nelement vertex"
    ),
    "spaces": lambda c, text: by_hand.ply(c, text=text).replace(b"element vertex 5", b"  element \t vertex  5 "),
    "CRLF": lambda c, text: with_crlf(by_hand.ply(c, text=text), everywhere=text),
    "CRLF header": lambda c, text: with_crlf(by_hand.ply(c, text=text)),
}


def with_crlf(data: bytes, *, everywhere: bool = False) -> bytes:
    at = len(data) if everywhere else data.index(b"end_header\n") + len(b"end_header\n")
    return data[:at].replace(b"\n", b"\r\n") + data[at:]


@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_ply_hold_the_same_scene(layout: str, text: bool) -> None:
    given = columns(sh_degree=1)
    given = {name: np.asarray(values, np.float32) for name, values in given.items()}  # so that doubles are no better
    assert_same(decode(LAYOUTS[layout](given, text)).splats, decode(by_hand.ply(given)).splats)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
def test_infinite_logits_and_log_scales_become_their_limits(text: bool) -> None:
    given = columns()
    given["opacity"][:] = [np.inf, -np.inf, 1000, -1000, 0]
    given["scale_1"][:] = [-np.inf, -1000, 0, 0, 0]
    splats = decode(by_hand.ply(given, text=text)).splats
    assert splats.opacity.tolist() == [1, 0, 1, 0, 0.5]
    assert splats.scale[:, 1].tolist() == [0, 0, 1, 1, 1]


@pytest.mark.filterwarnings("error")
def test_values_that_are_not_finite_are_passed_on_without_a_warning() -> None:
    """Whether it is an error is for `selection` to say; a reader that warned would print on standard error."""
    given = columns()
    rows = bytearray(by_hand.ply(given))
    signalling = (0x7FA00000).to_bytes(4, "little")  # a NaN that raises a flag when it is used
    rows[-4 * len(given) :] = signalling * len(given)
    splats = decode(bytes(rows)).splats
    for column in ("center", "scale", "quat_xyzw", "opacity", "rgb"):
        assert np.isnan(getattr(splats, column)[-1]).all(), column
        assert np.isfinite(getattr(splats, column)[:-1]).all(), column


def test_rotations_of_any_length_become_unit_and_those_of_zeros_nan() -> None:
    given = columns()
    for length, name in enumerate(["rot_0", "rot_1", "rot_2", "rot_3"]):
        given[name][:] = np.array([1e-30, 1e-3, 1, 1e3, 1e30]) * (length + 1)
    quats = decode(by_hand.ply(given)).splats.quat_xyzw
    np.testing.assert_allclose(quats, np.tile([2, 3, 4, 1], (5, 1)) / 30**0.5, rtol=1e-6)
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        given[name][2] = 0
    quats = decode(by_hand.ply(given)).splats.quat_xyzw
    assert np.isnan(quats).any(axis=1).tolist() == [False, False, True, False, False]


INCOMPLETE = "^Gaussian splats that are not complete: its vertices have no "
CLOUD = "a point cloud or a mesh, not Gaussian splats"


@pytest.mark.parametrize(
    ("missing", "text"),
    [
        *(((name,), f"{INCOMPLETE}{name}$") for name in sorted({*ply.REQUIRED} - {"scale_2"})),
        (("f_dc_0", "f_dc_1", "f_dc_2"), f"{INCOMPLETE}f_dc_0, f_dc_1, f_dc_2$"),
        (("opacity", "scale_0", "scale_1", "scale_2"), f"{INCOMPLETE}opacity, scale_0, scale_1, scale_2$"),
        (("rot_0", "rot_1", "rot_2", "rot_3"), f"{INCOMPLETE}rot_1, rot_2, rot_3, rot_0$"),
        (ply.REQUIRED[3:], f"{CLOUD}: its vertices have no f_dc_0, .* and 7 more$"),
    ],
)
def test_properties_that_are_missing_are_named(missing: tuple[str, ...], text: str) -> None:
    given = {name: values for name, values in columns().items() if name not in missing}
    with pytest.raises(NotSplatsError, match=text):
        decode(by_hand.ply(given))
    colored = given | {name: [9] * 5 for name in ply.PLAIN_RGB}
    if len(missing) > 4:
        with pytest.raises(NotSplatsError, match=CLOUD):
            decode(by_hand.ply(colored, types=dict.fromkeys(ply.PLAIN_RGB, "u1")))


@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
@pytest.mark.parametrize("kind", ["u1", "f4", "i4"])
def test_colours_of_point_clouds_stand_in_for_those_of_sh(kind: str, text: bool) -> None:
    plain = {"red": [0, 1, 51, 128, 255], "green": [255] * 5, "blue": [0, 0, 0, 0, 102]}
    given = {name: values for name, values in columns().items() if not name.startswith("f_dc")} | plain
    scene = decode(by_hand.ply(given, text=text, types=dict.fromkeys(plain, kind)))
    np.testing.assert_allclose(scene.splats.rgb, np.transpose(list(plain.values())) / 255, atol=1e-7)
    assert scene.notes == ()
    # Beside colours of SH they are a copy for viewers of point clouds.
    both = decode(by_hand.ply(columns() | plain, text=text, types=dict.fromkeys(plain, kind)))
    np.testing.assert_array_equal(both.splats.rgb, decode(by_hand.ply(columns(), text=text)).splats.rgb)
    assert both.notes == ()


@pytest.mark.parametrize("turned", [False, True])
def test_splats_of_one_scale_are_balls(turned: bool) -> None:
    left = {"scale_1", "scale_2"} | (set() if turned else {"rot_0", "rot_1", "rot_2", "rot_3"})
    scene = decode(by_hand.ply({name: values for name, values in columns().items() if name not in left}))
    whole = decode(by_hand.ply(columns())).splats
    np.testing.assert_array_equal(scene.splats.scale, np.repeat(whole.scale[:, :1], 3, axis=1))
    np.testing.assert_array_equal(scene.splats.quat_xyzw, whole.quat_xyzw if turned else [[0, 0, 0, 1]] * 5)
    assert scene.notes == ()


def test_names_of_cloudcompare_are_read() -> None:
    given = columns(sh_degree=1)
    renamed = {name if len(name) <= 2 else f"scalar_{name}": values for name, values in given.items()}
    scene = decode(by_hand.ply(renamed | {"scalar_label": [1] * 5}))
    assert_same(scene.splats, decode(by_hand.ply(given)).splats)
    assert scene.notes == ("its property label is left out",)
    assert_same(decode(by_hand.ply(given | {"scalar_x": [7] * 5, "scalar_opacity": [7] * 5})).splats, scene.splats)


# --- Data that are left out, and the filter of Mip-Splatting ---


@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
@pytest.mark.parametrize(
    ("names", "note"),
    [
        (["label"], "its property label is left out"),
        (["trbf_scale", "trbf_center"], "its properties trbf_center and trbf_scale are left out"),
        (
            [f"motion_{index}" for index in (3, 8, 1, 0, 2, 4, 5, 6, 7)] + ["omega_1", "omega_0", "t"],
            "its properties motion_0 to motion_8, omega_0, omega_1 and t are left out",
        ),
        (
            [f"{letter}_" for letter in "abcdefghijk"],
            "its properties a_, b_, c_, d_, e_, f_, g_, h_ and 3 more are left out",
        ),
        (["normal_x", "state", "alpha"], None),
    ],
)
def test_properties_that_are_left_out_are_named(names: list[str], note: str | None, text: bool) -> None:
    scene = decode(by_hand.ply(columns() | {name: [1] * 5 for name in names}, text=text))
    assert_same(scene.splats, decode(by_hand.ply(columns(), text=text)).splats)
    assert scene.notes == ((note,) if note else ())


def test_names_cannot_control_a_terminal() -> None:
    (note,) = decode(edited(PLAIN, "property float ny", f"property float \x1b[31m{'a' * 900}")).notes
    assert note.isprintable() and len(note) < 100


@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
def test_elements_that_are_left_out_are_named(text: bool) -> None:
    empty = PlyElement.describe(np.empty(0, [("a", "i4")]), "none")
    scene = decode(by_hand.ply(columns(), text=text, before=[some_cameras(), empty], after=[some_faces()]))
    assert scene.notes == ("its elements camera and face are left out",)


@pytest.mark.parametrize(("value", "notes"), [(0, 0), (1, 1)])
def test_the_colour_space_of_sharp_is_read(value: int, notes: int) -> None:
    space = PlyElement.describe(np.array([(value,)], [("color_space", "u1")]), "color_space")
    scene = decode(by_hand.ply(columns(), after=[space]))
    assert len(scene.notes) == notes and all("linear" in note for note in scene.notes)
    for other in (
        by_hand.ply(columns(), after=[space], text=True),
        by_hand.ply(columns(), after=[space], before=[some_faces()]),
    ):
        assert "color_space" in decode(other).notes[0] and "left out" in decode(other).notes[0]


def smoothed(log_scale: list[float], logit: float, size: float) -> tuple[list[float], float]:
    """Returns scales and opacity of a splat as Mip-Splatting draws it, number by number."""
    scales = [math.exp(each) for each in log_scale]
    after = [math.sqrt(scale**2 + size**2) for scale in scales]
    before_2, after_2 = (math.prod(scale**2 for scale in each) for each in (scales, after))
    return after, math.sqrt(before_2 / after_2) / (1 + math.exp(-logit))


@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
@pytest.mark.parametrize("scales", [1, 2, 3])
def test_the_filter_of_mip_splatting_is_applied(scales: int, text: bool) -> None:
    given = columns() | {"filter_3D": np.array([0, 1e-3, 0.5, 1, 20])}
    for name in ply.SCALES[scales:]:
        del given[name]
    scene = decode(by_hand.ply(given, text=text, types="f8"))
    splats = scene.splats
    for row in range(5):
        log_scale = [given[ply.SCALES[min(axis, scales - 1)]][row] for axis in range(2 if scales == 2 else 3)]
        scale, opacity = smoothed(log_scale, given["opacity"][row], given["filter_3D"][row])
        np.testing.assert_allclose(splats.scale[row, : len(scale)], scale, rtol=1e-5)
        np.testing.assert_allclose(splats.opacity[row], opacity, rtol=1e-5)
    noted = "the 3D filter of Mip-Splatting (filter_3D) is applied to its scales and opacities"
    assert noted in scene.notes and not any("left out" in note for note in scene.notes)


@pytest.mark.filterwarnings("error")
def test_the_filter_leaves_splats_without_size_as_they_are() -> None:
    given = columns() | {"filter_3D": np.array([0, 0, 1, np.nan, -1])}
    for name in ply.SCALES:
        given[name][:3] = [-np.inf, 1000, -np.inf]
    splats = decode(by_hand.ply(given)).splats
    assert splats.scale[0].tolist() == [0, 0, 0] and splats.opacity[0] > 0
    assert splats.scale[2].tolist() == [1, 1, 1] and splats.opacity[2] == 0
    assert splats.invalid()["non_finite"].tolist() == [False, True, False, True, False]


# --- Numbers that are none ---


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("word", ["-nan(ind)", "-1.#IND00", "1.#QNAN", "none", "200.0", "0x10", "-inf", "1e999"])
def test_words_in_properties_that_nobody_needs_do_not_matter(word: str) -> None:
    given = columns() | {"red": [7] * 5, "label": [7] * 5}
    data = by_hand.ply(given, text=True, types={"nx": "u1", "label": "i4", "red": "u1"})
    lines = data.split(b"\n")
    for at in (-2, -4):
        words = lines[at].split()
        for name in ("nx", "ny", "red", "label"):
            words[list(given).index(name)] = word.encode()
        lines[at] = b" ".join(words)
    assert_same(decode(b"\n".join(lines)).splats, decode(data).splats)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("word", "value"),
    [
        *[
            (word, np.nan)
            for word in ("-nan(ind)", "nan(snan)", "NaN(0x7f)", "-nan", "1.#QNAN", "-1.#IND", "1.#SNAN00")
        ],
        *[(word, np.nan) for word in ("-1.#J", "1.#R", "1,#QNAN0")],
        *[("1.#INF", np.inf), ("-1.#INF00", -np.inf), ("-inf", -np.inf), ("Infinity", np.inf)],
    ],
)
def test_numbers_of_windows_that_are_none_are_read(word: str, value: float) -> None:
    given = columns()
    given["y"][2] = value
    data = by_hand.ply(columns(), text=True)
    lines = data.split(b"\n")
    words = lines[-4].split()
    words[1] = word.encode()
    lines[-4] = b" ".join(words)
    np.testing.assert_array_equal(decode(b"\n".join(lines)).splats.center, decode(by_hand.ply(given)).splats.center)


def edited(data: bytes, old: str, new: str) -> bytes:
    assert old.encode() in data
    return data.replace(old.encode(), new.encode(), 1)


def with_rest(numbers: Iterable[int]) -> bytes:
    return by_hand.ply(columns() | {f"f_rest_{number}": [0] * 5 for number in numbers})


PLAIN, TEXT = by_hand.ply(columns()), by_hand.ply(columns(), text=True)
#: What is wrong: the text that replaces another one, and the reason.
EDITS = {
    "list property": ("property float nx", "property list uchar float nx", "list properties"),
    "two of a property": ("property float ny", "property float nx", "bad PLY header"),
    "two of an element": ("end_header", "element vertex 0\nproperty int a\nend_header", "bad PLY header"),
    "unknown type": ("property float ny", "property half ny", "bad PLY header"),
    "unknown format": ("binary_little_endian", "binary_middle_endian", "bad PLY header"),
    "no end of the header": ("end_header", "end_heading", "does not end"),
    "not ascii": ("property float nx", "property float ü", "bad PLY header"),
    **{
        f"a count of {count!r}": ("vertex 5", f"vertex {count}", "a name and a count")
        for count in ("5_0", "+5", "-5", "0x5", "5.0", "five", "", "5 5")
    },
    **{
        f"a count of {digits:,} digits": ("vertex 5", "vertex " + "9" * digits, f"a count of {digits:,} digits")
        for digits in (101, 5_000, 900_000)
    },
}
REFUSED = {name: (edited(PLAIN, old, new), reason) for name, (old, new, reason) in EDITS.items()} | {
    "not PLY": (b"plain text\nthat goes on\n", "not a PLY file"),
    "no vertex": (b"ply\nformat ascii 1.0\nelement face 1\nproperty int a\nend_header\n1\n", "no element vertex"),
    "point cloud": ((FIXTURES / "points.ply").read_bytes(), CLOUD),
    "five f_rest": (with_rest(range(5)), "5 f_rest properties"),
    "six f_rest": (with_rest(range(6)), "2 SH coefficients"),
    "f_rest from 1": (with_rest(range(1, 10)), "expected f_rest_0"),
    "cut short": (PLAIN[:-1], "cut short: 1 bytes are missing"),
    "ascii cut short": (TEXT[: TEXT.rindex(b"\n", 0, -1) + 1], "cut short after 4 of 5 vertices"),
    "a short row": (TEXT[:-3].rsplit(b" ", 2)[0], "bad PLY data"),
    "rows of spaces": (TEXT[: TEXT.index(b"end_header") + 11] + (b" " * 60 + b"\n") * 5, "an empty line"),
    "a word": (TEXT[:-5] + b" nul\n", "bad PLY data"),
    "a word like none": (TEXT[:-5] + b" 1.#2.5\n", "bad PLY data"),
    "two words in one": (TEXT[:-5] + b" nan(ind)2\n", "bad PLY data"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("what", REFUSED)
def test_broken_ply_is_refused_with_a_reason(what: str) -> None:
    data, reason = REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        decode(data)


def with_comments(*comments: str) -> bytes:
    return edited(PLAIN, "element vertex", "".join(f"comment {comment}\n" for comment in comments) + "element vertex")


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        (("Exported from Brush", "SH degree: 0", "SplatRenderMode: mip"), True),
        (("SPLATRENDERMODE:  MIP ",), True),
        (("antialiased 1",), True),
        (("SplatRenderMode: default", "antialiased 1"), True),
        (("antialiased 1", "SplatRenderMode: default"), False),
        (("antialiased 0",), False),
        (("SplatRenderMode: none that is known",), False),
        (("it is antialiased 1",), False),
        ((), False),
    ],
)
def test_comments_of_trainers_tell_antialiased_splats(comments: tuple[str, ...], antialiased: bool) -> None:
    scene = decode(with_comments(*comments))
    assert scene.antialiased is antialiased and not scene.notes
    assert_same(scene.splats, decode(by_hand.ply(columns())).splats)


@pytest.mark.parametrize("text", [False, True])
def test_disks_get_a_thin_third_scale(text: bool) -> None:
    given = columns()
    whole = decode(by_hand.ply(given, text=text)).splats
    comment = "comment SplatRenderMode: 2dgs\nelement vertex"
    by_comment = edited(by_hand.ply(given, text=text), "element vertex", comment)
    del given["scale_2"]
    for data in (by_hand.ply(given, text=text), by_comment):
        scene = decode(data)
        splats = scene.splats
        assert scene.notes and not scene.antialiased
        assert np.array_equal(splats.scale[:, :2], whole.scale[:, :2])
        assert np.allclose(splats.scale[:, 2], splats.scale[:, :2].min(axis=1) / 1000)
        for name in ("center", "quat_xyzw", "opacity", "rgb", "sh"):
            assert np.array_equal(getattr(splats, name), getattr(whole, name))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", ["4000000000", "18446744073709551615", "1" + "0" * 30])
@pytest.mark.parametrize("element", ["vertex", "camera", "face"])
@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
def test_an_impossible_count_is_refused_before_memory_is_allocated(text: bool, element: str, count: str) -> None:
    data = by_hand.ply(columns(), text=text, before=[some_cameras(), some_faces()])
    data = re.sub(rf"element {element} \d+".encode(), f"element {element} {count}".encode(), data)
    tracemalloc.start()
    try:
        with pytest.raises(FormatError):
            decode(data)
        assert tracemalloc.get_traced_memory()[1] < 1e7
    finally:
        tracemalloc.stop()


# --- Written ---


def vertices(data: bytes) -> np.ndarray:
    return PlyData.read(io.BytesIO(data))["vertex"].data


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_the_properties_are_in_the_order_of_inrias_trainer(sh_degree: int) -> None:
    splats = random_splats(7, sh_degree=sh_degree)
    data = cases.encode(ply, Scene(splats, antialiased=sh_degree == 1))
    rows = vertices(data)
    comment = b"comment SplatRenderMode: mip\n" if sh_degree == 1 else b""  # as Brush notes it
    assert data.startswith(
        b"ply\nformat binary_little_endian 1.0\n" + comment + b"element vertex 7\nproperty float x\n"
    )
    assert rows.dtype == np.dtype([(name, "<f4") for name in splat_columns(1, sh_degree=sh_degree)])
    assert len(rows) == 7
    rest = [[rows[f"f_rest_{index}"][row] for index in range(3 * splats.sh.shape[1])] for row in range(7)]
    np.testing.assert_array_equal(rest, splats.sh.transpose(0, 2, 1).reshape(7, -1))


@pytest.mark.filterwarnings("error")
def test_scales_and_opacities_of_0_are_written_finite_and_come_back() -> None:
    splats = random_splats(4)
    splats.opacity[:] = [0, 1, 1e-45, np.nextafter(np.float32(1), np.float32(0))]
    splats.scale[:, 1] = [0, 1e-45, 1e38, 1]
    data = cases.encode(ply, splats)
    assert all(np.isfinite(vertices(data)[name]).all() for name in ("opacity", "scale_1"))
    back = decode(data).splats
    np.testing.assert_allclose(back.opacity, splats.opacity, atol=1e-7)
    assert back.opacity[:2].tolist() == [0, 1]
    np.testing.assert_allclose(back.scale[:, 1], splats.scale[:, 1], rtol=1e-4, atol=2e-45)
    assert back.scale[0, 1] == 0


# --- Compressed PLY ---------------------------------------------------------------------------------------------------

COMPRESSED = FIXTURES / "golden" / "sh3-compressed.ply"
GOLDEN = COMPRESSED.read_bytes()


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


def other_order(data: bytes) -> bytes:
    """SH, vertices, chunks."""
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].split(b"element ")
    sizes = [72, 60 * 16, 60 * 45]
    parts = [data[end + sum(sizes[:index]) : end + sum(sizes[: index + 1])] for index in range(3)]
    sh = lines[3].removesuffix(b"end_header\n")
    return b"element ".join([lines[0], sh, lines[2], lines[1] + b"end_header\n"]) + b"".join(parts[::-1])


def big_endian(data: bytes) -> bytes:
    data = edited(data, "little_endian", "big_endian")
    end = data.index(b"end_header\n") + len(b"end_header\n")
    words = np.frombuffer(data[end : end + 72 + 960], "<u4").astype(">u4").tobytes()
    return data[:end] + words + data[end + len(words) :]


def padded_vertices(data: bytes) -> bytes:
    data = edited(data, "property uint packed_scale", "property uchar flag\nproperty uint packed_scale")
    begin = data.index(b"end_header\n") + len(b"end_header\n") + 72
    rows = [data[at : at + 8] + b"!" + data[at + 8 : at + 16] for at in range(begin, begin + 960, 16)]
    return data[:begin] + b"".join(rows) + data[begin + 960 :]


COMPRESSED_LAYOUTS: dict[str, Callable[[bytes], bytes]] = {
    "comments": lambda data: edited(data, "element chunk", "comment element chunk 7\nelement chunk"),
    "long comments": lambda data: edited(data, "element chunk", f"comment {'x' * 9000}\nelement chunk"),
    "other order": other_order,
    "big-endian": big_endian,
    "another property": padded_vertices,
    "something behind": lambda data: data + b"more",
    "CRLF header": with_crlf,
}


@pytest.mark.parametrize("layout", COMPRESSED_LAYOUTS)
def test_layouts_of_compressed_ply_hold_the_same_scene(layout: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(COMPRESSED_LAYOUTS[layout](GOLDEN))
    one, other = read_scene(path), read_scene(COMPRESSED)
    assert one.format == other.format == "compressed PLY"
    assert_same(one.splats, other.splats)


def test_a_comment_does_not_make_a_ply_a_compressed_one(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    plain = (FIXTURES / "one.ply").read_bytes()
    path.write_bytes(edited(plain, "element vertex", "comment was packed_position before\nelement vertex"))
    assert read_scene(path).format == "PLY"


COMPRESSED_EDITS = {
    "ascii": ("binary_little_endian", "ascii", "ascii compressed PLY"),
    "no rotations": ("packed_rotation", "packed_rotations", "element vertex has no packed_rotation"),
    "float positions": ("uint packed_position", "float packed_position", "has no packed_position of type uint32"),
    "no chunks": ("element chunk", "element chunks", "element chunk has no"),
    "bounds of another type": ("float min_x", "int min_x", "element chunk has no min_x of type float32"),
    "bounds of one color": ("float min_r", "float min_red", "element chunk has no min_r"),
    "too few chunks": ("element chunk 1", "element chunk 0", "0 chunks of 256 cannot hold 60 splats"),
    "chunks for one less": ("element vertex 60", "element vertex 257", "1 chunk of 256 cannot hold 257 splats"),
    "SH of fewer splats": ("element sh 60", "element sh 59", "59 rows of 45 values for 60 splats"),
    "SH of another type": ("uchar f_rest_7", "char f_rest_7", "element sh has no f_rest_7"),
    "44 SH": ("property uchar f_rest_44\n", "", "60 rows of 44 values"),
    "lists": ("property uchar f_rest_0\n", "property list uchar uchar f_rest_0\n", "element sh has no"),
}
COMPRESSED_REFUSED = {name: (edited(GOLDEN, old, new), why) for name, (old, new, why) in COMPRESSED_EDITS.items()} | {
    "42 SH": (re.sub(rb"property uchar f_rest_4[234]\n", b"", GOLDEN), "14 SH coefficients per channel"),
    "cut short": (GOLDEN[:-1], "cut short: 1 bytes are missing"),
}


@pytest.mark.parametrize("what", COMPRESSED_REFUSED)
def test_broken_compressed_ply_is_refused_with_a_reason(what: str) -> None:
    data, reason = COMPRESSED_REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        decode(data)


def test_what_is_left_out_of_compressed_ply_is_named() -> None:
    plain = PlyData.read(COMPRESSED)
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
    assert decode(GOLDEN).notes == ()
    assert_same(scene.splats, decode(GOLDEN).splats)
