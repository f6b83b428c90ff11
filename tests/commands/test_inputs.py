"""Hard inputs of `build-lod`: numbers, damaged files and colours of `--rgba`.

The law: exit status 0 and a valid tree of finite splats, or exit status 1, one line that begins with `error:` and names
the file, and no file left. Never a traceback, a warning, a hang or gigabytes. Decoders have more of this in
tests/codecs/test_damaged.py, and memory in tests/codecs/test_bombs.py.
"""

from __future__ import annotations

import contextlib
import gzip
import re
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fixtures import by_hand
from sparklod_cli.io.files import read_rgba
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.splats import COLUMNS
from sparklod_cli.system.errors import FormatError
from tests.commands.cli import NAMED, Cli
from tests.conftest import FIXTURES
from tests.scenes import splat_columns

Columns = dict[str, Any]
Bake = Callable[..., list[str]]

pytestmark = pytest.mark.filterwarnings("error")  # pytest catches what would be printed on standard error

PROPERTIES = [name for name in splat_columns(1, sh_degree=1) if name[0] != "n"]


@pytest.fixture
def bake(cli: Cli) -> Bake:
    """Bakes files of these contents in one call; returns the error or the report of each, after checks of the law."""

    def bake_all(*contents: bytes, options: str = "") -> list[str]:
        names = [f"scene{index}.bin" for index in range(len(contents))]
        for name, content in zip(names, contents, strict=True):
            cli.put(name, content)
        done = cli("build-lod --overwrite", *options.split(), *names, status=None)
        results = results_of(names, done.err)
        good = [name for name, result in zip(names, results, strict=True) if not result.startswith("error:")]
        assert done.status == int(len(good) < len(names))
        assert cli.made() == sorted(f"{Path(name).stem}-lod.spz" for name in good)
        for name in cli.made():
            scene = read_scene(Path(name))
            assert scene.tree is not None
            scene.tree.validate()
            for column in COLUMNS:
                assert np.isfinite(getattr(scene.splats, column)).all(), column
        return results

    return bake_all


def results_of(names: list[str], err: str) -> list[str]:
    """Return the messages about each file, without its name; an error takes one line, a report may take more."""
    results: list[str] = []
    for line in err.splitlines():
        if line.startswith("  ") and results and not results[-1].startswith("error:"):
            results[-1] += line
            continue
        name = names[len(results)] if len(results) < len(names) else "nothing more"
        assert line.startswith((f"error: {name}: ", f"{name}  ")), f"expected about {name}:\n{err[-2000:]}"
        results.append(line.replace(name, "", 1))
    assert len(results) == len(names), err[-2000:]
    return results


# --- Numbers ----------------------------------------------------------------------------------------------------------


def with_values(count: int = 20, **values: Any) -> bytes:
    """Splats whose properties of these names have these values, in row 3 or, if it is a tuple of one, in all rows."""
    columns = splat_columns(count, sh_degree=1)
    for name, value in values.items():
        columns[name][slice(None) if isinstance(value, tuple) else 3] = value
    return by_hand.ply(columns)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", PROPERTIES)
def test_a_value_that_is_not_finite_is_refused_dropped_or_its_limit(name: str, value: float, bake: Bake) -> None:
    (result,) = bake(data := with_values(**{name: value}))
    (dropped,) = bake(data, options="--on-invalid drop")
    if (name == "opacity" or name.startswith("scale")) and value == -np.inf:
        expected = "  left out: 1 zero opacity" if name == "opacity" else "20 splats"
        assert expected in result
        assert expected in dropped
    elif name == "opacity" and value == np.inf:
        assert "20 splats, SH 1" in result
        assert "dropped" not in result + dropped
    else:
        assert result.startswith("error: : 1 of 20 splats is not finite")
        assert "--on-invalid drop" in result
        assert "19 splats, SH 1" in dropped
        assert "  left out: 1 not finite" in dropped


ALL_SCALES, ALL_ROTATIONS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")


def each(names: Iterable[str], *values: Any) -> Columns:
    return dict(zip(names, values * len(tuple(names)), strict=False))


#: Values of properties, options, and the expected message.
NUMBERS: dict[str, tuple[Columns, str, str]] = {
    "rotation of no length": (each(ALL_ROTATIONS, 0), "", r"^error: : 1 of 20 splats is not finite .*length 0"),
    "rotation of no length, dropped": (each(ALL_ROTATIONS, 0), "--on-invalid drop", "left out: 1 not finite"),
    "all rotations of no length": (each(ALL_ROTATIONS, (0,)), "--on-invalid drop", "error: : no splat is left"),
    "tiny rotations": (each(ALL_ROTATIONS, (1e-38,)), "", "20 splats"),
    "huge rotations": (each(ALL_ROTATIONS, (3e38,)), "", "20 splats"),
    "no scale": (each(ALL_SCALES, -1000), "", "left out: 1 zero scale"),
    "no scale at all": (each(ALL_SCALES, (-1000,)), "", "error: : no splat is left of 20 .20 zero scale"),
    "discs": ({"scale_2": (-1000,)}, "", "20 splats"),
    "tiny scales": (each(ALL_SCALES, (-100,)), "", "20 splats.*than SPZ can hold"),
    "scales a little above nothing": (each(ALL_SCALES, (-103,)), "--base 1.1", "20 splats.*than SPZ can hold"),
    "a tiny scale among ordinary ones": (each(ALL_SCALES, -100), "--base 1.1", "20 splats.*than SPZ can hold"),
    "a splat as large as a planet": (each(ALL_SCALES, 16), "", "20 splats.*than SPZ can hold"),
    "huge scales": (each(ALL_SCALES, (40,)), "", "20 splats.*than SPZ can hold"),
    "scales of every size": ({"scale_0": tuple(np.linspace(-100, 40, 20))}, "--base 1.1", "than SPZ can hold"),
    "scales whose squares overflow": (each(ALL_SCALES, (60,)), "", "20 splats.*than SPZ can hold"),
    "scales that almost overflow": (each(ALL_SCALES, (88.5,)), "", "splats|^error"),
    "scales that overflow": (each(ALL_SCALES, (89,)), "", "^error: : 20 of 20 splats are not finite"),
    "extreme logits": ({"opacity": tuple(1000 * (-1) ** np.arange(20))}, "", "left out: 10 zero opacity"),
    "opacities of nothing": ({"opacity": (-1000,)}, "", "error: : no splat is left of 20 .20 zero opacity"),
    "opacities near nothing": ({"opacity": (-85,)}, "", "20 splats"),
    "glaring colours": ({"f_dc_0": 3e38, "f_dc_1": -3e38}, "", "20 splats"),
    "glaring coefficients": ({"f_rest_0": 3e38, "f_rest_8": -3e38}, "", "20 splats"),
    "normals, which nobody reads": ({"nx": np.nan, "ny": (np.inf,)}, "", "20 splats"),
    "far away": ({"x": 1e7}, "", r"^error: : coordinates reach 1e\+07, SPZ holds at most 8388606: scale the scene"),
    "all far away": (each("xyz", (1e38,)), "", "^error: : coordinates reach"),
    "as far as SPZ holds": (each("xyz", -8388606), "", "20 splats"),
    "a unit farther": (each("xyz", -8388607), "", "^error: : coordinates reach 8388607, SPZ holds at most 8388606"),
    "one place": (each("xyz", (0.1,)), "", "20 splats"),
    "one place, far away": (each("xyz", (8e6,)), "", "20 splats"),
    "places that differ by the least": ({"x": (np.nextafter(np.float32(1), 2, dtype="f4"),)}, "", "20"),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("what", NUMBERS)
def test_hard_numbers_give_a_valid_tree_or_one_error(what: str, method: str, bake: Bake) -> None:
    values, options, expected = NUMBERS[what]
    if method != METHODS[0] and "--base" in options:
        pytest.skip("the base is the other method's")
    (result,) = bake(with_values(**values), options=f"{options} --method {method}")
    assert re.search(expected, result), result


@pytest.mark.parametrize("method", METHODS)
def test_a_hundred_thousand_splats_at_one_place_are_baked(method: str, bake: Bake) -> None:
    columns = splat_columns(100_000)
    for name in "xyz":
        columns[name][:] = 0.25
    start = time.process_time()
    (result,) = bake(by_hand.ply(columns), options=f"--method {method}")
    assert "100,000 splats" in result
    assert time.process_time() - start < 30


# --- Files ------------------------------------------------------------------------------------------------------------

WHOLE = ("one.ply", "sh1.ply", "sh1-ascii.ply", *(f"golden/hand-{name}.spz" for name in ("v1", "v2", "v3", "v4")))


@pytest.mark.parametrize("name", WHOLE)
def test_a_truncated_file_is_one_error(name: str, bake: Bake) -> None:
    data = (FIXTURES / name).read_bytes()
    header = data.index(b"end_header") if name.endswith("ply") else len(data)
    end = len(data) - 24 if "ascii" in name else len(data)  # a number that lost its last digits is still one
    places = sorted({*range(0, min(header, end), 5), *range(header, end, max(1, (end - header) // 20))})
    results = bake(*(data[:place] for place in places))
    assert all(result.startswith("error: ") for result in results), results


@pytest.mark.parametrize("name", WHOLE)
def test_flipped_bits_give_a_valid_tree_or_one_error(name: str, bake: Bake) -> None:
    data = (FIXTURES / name).read_bytes()
    rng = np.random.default_rng(13)
    contents = []
    for bit in rng.choice(8 * len(data), 60, replace=False):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        contents.append(bytes(changed))
    bake(*contents)


MESH = (
    b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n%send_header\n0\n0\n"
    % b"element face 1\nproperty list uchar int v\n"
)
PLY = by_hand.ply(splat_columns(20))
FILES: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "the file is empty"),
    "no vertices": (PLY[: PLY.index(b"end_header") + 11].replace(b"vertex 20", b"vertex 0"), "it has no splats"),
    "no splats": (by_hand.spz_gzip(3, 0, 0, 12, 0, []), "it has no splats"),
    "no splats in zstd": (by_hand.spz_zstd(0, 0, 12, 0, [b""] * 5), "it has no splats"),
    "point cloud": ((FIXTURES / "points.ply").read_bytes(), "a point cloud or a mesh"),
    "mesh": (MESH, "a point cloud or a mesh"),
    "tree": ((FIXTURES / "golden" / "tree-v3.spz").read_bytes(), "Level-of-Detail file already"),
    "gzip of PLY": (gzip.compress(PLY), "a gzip file, but not of SPZ"),
    "list properties": (PLY.replace(b"property float nx", b"property list uchar float nx"), "list properties"),
    "negative count": (PLY.replace(b"vertex 20", b"vertex -20"), "bad PLY header"),
    "one property twice": (PLY.replace(b"float ny", b"float nx"), "bad PLY header"),
    "one element twice": (PLY.replace(b"end_h", b"element vertex 1\nproperty int x\nend_h"), "bad PLY header"),
    "a count of twenty digits": (PLY.replace(b"vertex 20", b"vertex 1" + b"0" * 20), "cut short"),
    "text": (b"a line of text\n" * 100, "not a splat file"),
    "random": (np.random.default_rng(14).bytes(1000), "not a splat file"),
    "random PLY": (b"ply\n" + np.random.default_rng(15).bytes(1000), ""),
    "random gzip": (b"\x1f\x8b\x08\0" + np.random.default_rng(16).bytes(1000), "corrupt gzip data"),
    "random SPZ": (b"NGSP" + np.random.default_rng(17).bytes(1000), "SPZ version"),
}


@pytest.mark.parametrize("what", FILES)
def test_files_that_are_no_scene_are_refused_with_a_reason(what: str, bake: Bake) -> None:
    content, reason = FILES[what]
    (result,) = bake(content)
    assert result.startswith("error: ")
    assert reason in result


# --- Colours ----------------------------------------------------------------------------------------------------------

SCENE = NAMED["sh2.ply"]
COUNT = len(read_scene(SCENE).splats)


def bytes_of(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 256, (COUNT, 4)).astype(np.uint8)


def save(path: Path, values: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        path.write_bytes(values.tobytes())
    return path


@pytest.mark.parametrize("kind", [np.uint8, "<f2", "<f4", "<f8", ">f4", ">f8"])
def test_colours_are_read_from_npy_and_raw_of_bytes_and_floats(kind: Any, tmp_path: Path) -> None:
    codes = bytes_of()
    values = codes if kind is np.uint8 else (codes / 255).astype(kind)
    expected = codes / 255 if kind is np.uint8 else values
    names = ["C.npy", "F.npy"] + ["C.rgba"] * (kind in (np.uint8, "<f4"))
    for name in names:
        path = save(tmp_path / name, np.asarray(values, order=name[0]))  # type: ignore[call-overload]
        found = read_rgba(path, COUNT)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, atol=1e-7)
        assert np.array_equal(read_rgba(path, COUNT, slice(3, COUNT - 2)), found[3:-2])


def test_colours_replace_those_of_the_splats(cli: Cli) -> None:
    """A leaf is drawn in its new colour; SH stay, and alpha 0 removes."""
    codes = bytes_of()
    codes[:7, 3] = 0
    save(cli.folder / "colors.npy", codes)
    record = cli("build-lod sh2.ply --rgba colors.npy -o a.spz --json").json
    assert (record["read"], record["splats"], record["dropped"]) == (COUNT, COUNT - 7, {"zero_opacity": 7})
    scene, source = read_scene(Path("a.spz")), read_scene(SCENE).splats
    assert scene.tree is not None
    leaves = scene.splats.take(scene.tree.is_leaf)
    nearest = [int(np.argmin(((source.center - center) ** 2).sum(axis=1))) for center in leaves.center]
    assert sorted(nearest) == list(range(7, COUNT))
    expected = codes[nearest] / 255
    np.testing.assert_allclose(leaves.rgb, expected[:, :3], atol=0.0038)
    # Opacities make up for the rounding of scales, by up to 1 / 32 an axis.
    np.testing.assert_allclose(leaves.opacity, expected[:, 3], rtol=0.07, atol=1.001 / 255)
    np.testing.assert_allclose(leaves.sh, source.sh[nearest], atol=0.07)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("a.npy", np.zeros((5, 4), np.uint8), f"has colours for 5 splats, the scene has {COUNT}"),
        ("a.rgba", np.zeros((5, 4), np.uint8), f"has colours for 5 splats, the scene has {COUNT}"),
        ("a.rgba", np.zeros(7, np.uint8), "has 7 bytes, which are not four a splat"),
        ("a.npy", np.zeros((COUNT, 3), np.uint8), r"uint8\[60, 3\], expected uint8 or floats \[60, 4\]"),
        ("a.npy", np.zeros((COUNT, 4), np.int32), "int32"),
        *(
            ("a.npy", np.where(np.arange(4) == 2, value, np.full((COUNT, 4), 0.5)), r"values that are not 0\.\.1")
            for value in (1.5, 1e300, -1e300, np.inf, -np.inf, np.nan, -1e-30)
        ),
        ("a.npy", np.array([{}] * COUNT), "is not a .npy file"),
    ],
)
def test_colours_of_another_shape_are_refused(name: str, values: np.ndarray, message: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=message):
        read_rgba(save(tmp_path / name, values), COUNT)


def test_a_npy_file_that_is_cut_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npy", bytes_of())
    whole = path.read_bytes()
    for cut in (6, 8, 60, 130, 200):
        path.write_bytes(whole[:cut])
        with pytest.raises(FormatError):
            read_rgba(path, COUNT)


def npy(header: str, data: bytes = b"", version: int = 1) -> bytes:
    """A .npy file of which the header says anything."""
    size = len(header).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + size + header.encode("latin-1") + data


GOOD = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({COUNT}, 4), }}"
HEADERS = {
    "misspelt": GOOD.replace("fortran_order': False", "fortran_oder':F(lse"),
    "not a dictionary": "[]",
    "empty": "",
    "a program": "__import__('os').abort()",
    "deep": "(" * 4000,
    "minuses": "-" * 4000 + "1",
    "long": GOOD + " " * 60_000,
    "a negative side": GOOD.replace("4)", "-4)"),
    "a huge side": GOOD.replace("4)", "9" * 190 + ")"),
    "huge sides": GOOD.replace(f"({COUNT}", "(" + "9" * 190),
    "a side of letters": GOOD.replace("4)", "four)"),
    "no sides": GOOD.replace(f"({COUNT}, 4)", "()"),
    "many sides": GOOD.replace(f"({COUNT}, 4)", "(" + "1," * 99 + ")"),
    "no shape": GOOD.replace("'shape'", "'shap'"),
    "an order of bytes": GOOD.replace("False", "b''"),
    "no type": GOOD.replace("<f4", ""),
    "a type that is none": GOOD.replace("<f4", "<f3"),
    "a type of nothing": GOOD.replace("<f4", "|V0"),
    "objects": GOOD.replace("<f4", "|O8"),
    "texts": GOOD.replace("<f4", "<U4"),
    "dates": GOOD.replace("<f4", "<M8"),
    "complex numbers": GOOD.replace("<f4", "<c8"),
    "texts by an old name": GOOD.replace("<f4", "a1"),
    "a record": GOOD.replace("'<f4'", "[('a', '<f4')]"),
    "control characters": GOOD.replace("<f4", "\x1b[31m\n"),
}


@pytest.mark.parametrize("header", HEADERS.values(), ids=HEADERS)
def test_a_malformed_npy_header_is_refused_in_one_line(header: str, tmp_path: Path) -> None:
    for version in (1, 2, 3):
        path = tmp_path / f"{version}.npy"
        path.write_bytes(npy(header, bytes(16 * COUNT), version))
        with pytest.raises(FormatError) as caught:
            read_rgba(path, COUNT)
        assert str(caught.value).startswith(f"{path} ")
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < len(str(path)) + 500


@pytest.mark.parametrize("version", [1, 2, 3])
def test_npy_headers_of_other_writers_are_read(version: int, tmp_path: Path) -> None:
    values = (bytes_of() / 255).astype("<f4")
    rows, columns = values.tobytes(), values.tobytes(order="F")
    for header, data in {
        GOOD: rows,
        GOOD + " " * 20 + "\n": rows,
        GOOD.replace(", }", "}").replace(" ", "").replace("'", '"'): rows,
        f"{{'shape': ({COUNT}, 4), 'fortran_order': True, 'descr': '<f4'}}": columns,
    }.items():
        path = tmp_path / "a.npy"
        path.write_bytes(npy(header, data, version))
        np.testing.assert_array_equal(read_rgba(path, COUNT), values)


@given(st.data())
@settings(max_examples=300)
def test_changed_bytes_give_colours_or_a_format_error(data: st.DataObject) -> None:
    """Colours or a `FormatError`, whatever is done to a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = save(Path(folder) / "a.npy", bytes_of())
        content = bytearray(path.read_bytes())
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(6, 130))] = data.draw(st.integers(0, 255))
        path.write_bytes(content)
        with contextlib.suppress(FormatError):
            assert read_rgba(path, COUNT).shape == (COUNT, 4)


def test_devices_and_folders_are_not_read_as_colours() -> None:
    for path in (Path("/dev/zero"), Path("/dev/null"), FIXTURES):
        with pytest.raises(FormatError, match=f"{path} cannot be read: it is a directory, a pipe or a device"):
            read_rgba(path, COUNT)
