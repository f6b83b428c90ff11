"""New colours and opacities for the splats of a scene."""

from __future__ import annotations

import contextlib
import json
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.cli import run
from sparklod_cli.io.local_files import read_rgba
from sparklod_cli.io.reading import read_scene
from sparklod_cli.system.errors import FormatError
from tests.conftest import FIXTURES, Capture

SCENE = FIXTURES / "sh2.ply"
COUNT = len(read_scene(SCENE).splats)


def bytes_of(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 256, (COUNT, 4)).astype(np.uint8)


def save(path: Path, values: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        path.write_bytes(values.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".npy", ".rgba"])
@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_colours_are_read_from_npy_and_raw_of_bytes_and_floats(suffix: str, kind: type, tmp_path: Path) -> None:
    codes = bytes_of()
    values = codes if kind is np.uint8 else (codes / 255).astype(kind)
    got = read_rgba(save(tmp_path / f"colors{suffix}", values), COUNT)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, codes / 255, atol=1e-7)
    for order in ("C", "F") if suffix == ".npy" else ("C",):
        path = save(tmp_path / f"{order}{suffix}", np.asarray(values, order=order))
        assert np.array_equal(read_rgba(path, COUNT, slice(3, COUNT - 2)), got[3:-2])


def test_colours_replace_those_of_the_splats(tmp_path: Path, capsys: Capture) -> None:
    """What is drawn of a leaf is its new colour; SH stay, and alpha 0 removes."""
    codes = bytes_of()
    codes[:7, 3] = 0
    colors = save(tmp_path / "colors.npy", codes)
    assert run(["build-lod", str(SCENE), "--rgba", str(colors), "-o", str(tmp_path / "a.spz"), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["read"], record["splats"], record["dropped"]) == (COUNT, COUNT - 7, {"zero_opacity": 7})
    scene, source = read_scene(tmp_path / "a.spz"), read_scene(SCENE).splats
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
        ("a.npy", np.full((COUNT, 4), 1.5), "values that are not 0..1"),
        ("a.npy", np.full((COUNT, 4), np.nan), "values that are not 0..1"),
        ("a.npy", np.array([{}] * COUNT), "is not a .npy file"),
    ],
)
def test_colours_of_a_wrong_shape_or_type_are_refused(
    name: str, values: np.ndarray, message: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError, match=message):
        read_rgba(save(tmp_path / name, values), COUNT)


@pytest.mark.parametrize("cut", [6, 8, 60, 130, 200])
def test_a_npy_file_that_is_cut_is_refused(cut: int, tmp_path: Path) -> None:
    path = save(tmp_path / "a.npy", bytes_of())
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(FormatError):
        read_rgba(path, COUNT)


def test_a_missing_file_is_named(tmp_path: Path, capsys: Capture) -> None:
    missing = tmp_path / "missing.npy"
    assert run(["build-lod", str(SCENE), "--rgba", str(missing), "-o", str(tmp_path / "a.spz")]) == 1
    assert f"{missing} cannot be read: no such file" in capsys.readouterr().err


def test_one_file_of_colours_is_for_one_scene(capsys: Capture) -> None:
    assert run(["build-lod", str(SCENE), str(FIXTURES / "sh1.ply"), "--rgba", "a.npy"]) == 2
    assert "--rgba takes one input, not 2" in capsys.readouterr().err


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


@pytest.mark.filterwarnings("error")
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


@pytest.mark.parametrize("kind", ["<f2", "<f8", ">f4", ">f8"])
def test_colours_are_read_from_floats_of_every_width(kind: str, tmp_path: Path) -> None:
    values = np.asfortranarray(bytes_of() / 255).astype(kind)
    np.testing.assert_allclose(read_rgba(save(tmp_path / "a.npy", values), COUNT), values, atol=1e-7)


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


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1e300, -1e300, np.inf, -np.inf, np.nan, -1e-30])
def test_floats_outside_of_0_to_1_are_refused(value: float, tmp_path: Path) -> None:
    values = np.full((COUNT, 4), 0.5)
    values[3, 2] = value
    with pytest.raises(FormatError, match=r"values that are not 0\.\.1"):
        read_rgba(save(tmp_path / "a.npy", values), COUNT)


def test_devices_and_folders_are_not_read_as_colours() -> None:
    for path in (Path("/dev/zero"), Path("/dev/null"), FIXTURES):
        with pytest.raises(
            FormatError, match=re.escape(f"{path} cannot be read: it is a directory, a pipe or a device")
        ):
            read_rgba(path, COUNT)
