"""Hard input through the real command line.

The law: exit code 0 and a valid tree of finite splats, or exit code 1, one line that begins with `error:` and names the
file, and no file left. Never a traceback, a warning, a hang or gigabytes. The decoders' own share of this, in more
detail, is tests/codecs/test_damaged.py; what wants memory is in tests/codecs/test_bombs.py.
"""

from __future__ import annotations

import gzip
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand
from sparklod_cli.cli import run
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.splats import COLUMNS
from tests.conftest import FIXTURES, Capture
from tests.scenes import splat_columns

Columns = dict[str, Any]
Bake = Callable[..., list[str]]

pytestmark = pytest.mark.filterwarnings("error")  # pytest catches what would be printed on standard error

PROPERTIES = [name for name in splat_columns(1, sh_degree=1) if name[0] != "n"]


@pytest.fixture
def bake(tmp_path: Path, capfd: Capture) -> Bake:
    """Bakes files of these contents in one call; gives an error's text or what was reported of each, law checked."""

    def bake_all(*contents: bytes, options: Iterable[str] = ()) -> list[str]:
        sources = [tmp_path / f"scene{index}.bin" for index in range(len(contents))]
        for source, content in zip(sources, contents, strict=True):
            source.write_bytes(content)
        code = run(["build-lod", *map(str, sources), "--overwrite", *options])
        results = results_of(sources, capfd.readouterr().err)
        assert code == int(any(result.startswith("error:") for result in results))
        check_outputs(tmp_path, sources, results)
        return results

    return bake_all


def results_of(sources: list[Path], err: str) -> list[str]:
    """What standard error says about each file, without its name; an error takes one line, a report may take more."""
    lines = [line for line in err.splitlines() if not line.lower().startswith(("compiling", "compiled"))]
    results: list[str] = []
    for line in lines:
        if line.startswith("  ") and results and not results[-1].startswith("error:"):
            results[-1] += line
            continue
        source = str(sources[len(results)]) if len(results) < len(sources) else "nothing more"
        assert line.startswith((f"error: {source}: ", f"{source}  ")), f"expected about {source}:\n{err[-2000:]}"
        results.append(line.replace(source, "", 1))
    assert len(results) == len(sources), err[-2000:]
    return results


def check_outputs(directory: Path, sources: list[Path], results: list[str]) -> None:
    good = [source for source, result in zip(sources, results, strict=True) if not result.startswith("error:")]
    outputs = {source.with_name(f"{source.stem}-lod.spz") for source in good}
    assert set(directory.iterdir()) == {*sources, *outputs}
    for output in outputs:
        scene = read_scene(output)
        assert scene.tree is not None
        scene.tree.validate()
        for column in COLUMNS:
            assert np.isfinite(getattr(scene.splats, column)).all(), column


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
    (dropped,) = bake(data, options=["--on-invalid", "drop"])
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


#: What is done to the splats, options, and what must be said.
NUMBERS: dict[str, tuple[Columns, list[str], str]] = {
    "rotation of no length": (each(ALL_ROTATIONS, 0), [], r"^error: : 1 of 20 splats is not finite .*length 0"),
    "rotation of no length, dropped": (each(ALL_ROTATIONS, 0), ["--on-invalid", "drop"], "left out: 1 not finite"),
    "all rotations of no length": (each(ALL_ROTATIONS, (0,)), ["--on-invalid", "drop"], "error: : no splat is left"),
    "tiny rotations": (each(ALL_ROTATIONS, (1e-38,)), [], "20 splats"),
    "huge rotations": (each(ALL_ROTATIONS, (3e38,)), [], "20 splats"),
    "no scale": (each(ALL_SCALES, -1000), [], "left out: 1 zero scale"),
    "no scale at all": (each(ALL_SCALES, (-1000,)), [], "error: : no splat is left of 20 .20 zero scale"),
    "discs": ({"scale_2": (-1000,)}, [], "20 splats"),
    "tiny scales": (each(ALL_SCALES, (-100,)), [], "20 splats.*than SPZ can hold"),
    "scales a little above nothing": (each(ALL_SCALES, (-103,)), ["--base", "1.1"], "20 splats.*than SPZ can hold"),
    "a tiny scale among ordinary ones": (each(ALL_SCALES, -100), ["--base", "1.1"], "20 splats.*than SPZ can hold"),
    "a splat as large as a planet": (each(ALL_SCALES, 16), [], "20 splats.*than SPZ can hold"),
    "huge scales": (each(ALL_SCALES, (40,)), [], "20 splats.*than SPZ can hold"),
    "scales of every size": (
        {"scale_0": tuple(np.linspace(-100, 40, 20))},
        ["--base", "1.1"],
        "20 splats.*than SPZ can hold",
    ),
    "scales whose squares overflow": (each(ALL_SCALES, (60,)), [], "20 splats.*than SPZ can hold"),
    "scales that almost overflow": (each(ALL_SCALES, (88.5,)), [], "splats|^error"),
    "scales that overflow": (each(ALL_SCALES, (89,)), [], "^error: : 20 of 20 splats are not finite"),
    "certain and impossible logits": (
        {"opacity": tuple(1000 * (-1) ** np.arange(20))},
        [],
        "left out: 10 zero opacity",
    ),
    "opacities of nothing": ({"opacity": (-1000,)}, [], "error: : no splat is left of 20 .20 zero opacity"),
    "opacities near nothing": ({"opacity": (-85,)}, [], "20 splats"),
    "glaring colours": ({"f_dc_0": 3e38, "f_dc_1": -3e38}, [], "20 splats"),
    "glaring coefficients": ({"f_rest_0": 3e38, "f_rest_8": -3e38}, [], "20 splats"),
    "normals, which nobody reads": ({"nx": np.nan, "ny": (np.inf,)}, [], "20 splats"),
    "far away": ({"x": 1e7}, [], r"^error: : coordinates reach 1e\+07, SPZ holds at most 8388606: scale the scene"),
    "all far away": (each("xyz", (1e38,)), [], "^error: : coordinates reach"),
    "as far as SPZ holds": (each("xyz", -8388606), [], "20 splats"),
    "a unit farther": (each("xyz", -8388607), [], "^error: : coordinates reach 8388607, SPZ holds at most 8388606"),
    "one place": (each("xyz", (0.1,)), [], "20 splats"),
    "one place, far away": (each("xyz", (8e6,)), [], "20 splats"),
    "places that differ by the least": (
        {"x": tuple(np.nextafter(np.float32(1), 2, dtype="f4") + np.zeros(20))},
        [],
        "20",
    ),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("what", NUMBERS)
def test_hard_numbers_give_a_valid_tree_or_one_error(what: str, method: str, bake: Bake) -> None:
    values, options, expected = NUMBERS[what]
    if method != METHODS[0] and "--base" in options:
        pytest.skip("the base is the other method's")
    (result,) = bake(with_values(**values), options=[*options, "--method", method])
    assert re.search(expected, result), result


@pytest.mark.parametrize("method", METHODS)
def test_a_hundred_thousand_splats_at_one_place_are_baked(method: str, bake: Bake) -> None:
    columns = splat_columns(100_000)
    for name in "xyz":
        columns[name][:] = 0.25
    start = time.process_time()
    (result,) = bake(by_hand.ply(columns), options=["--method", method])
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
    "one element twice": (
        PLY.replace(b"end_header", b"element vertex 1\nproperty int x\nend_header"),
        "bad PLY header",
    ),
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


def test_paths_that_are_not_files_are_one_error(tmp_path: Path, capfd: Capture) -> None:
    (tmp_path / "directory").mkdir()
    for name in ("directory", "missing.ply", "n" * 250 + ".ply", "n" * 300):
        source = tmp_path / name
        assert run(["build-lod", str(source)]) == 1
        (line,) = capfd.readouterr().err.splitlines()
        if len(name) < 100:
            assert line.startswith(f"error: {source}: ")
        else:  # long names are shortened
            assert line.startswith(f"error: {source}"[:200]) and line.endswith(": file name too long")
        assert [path.name for path in tmp_path.iterdir()] == ["directory"]


@pytest.mark.parametrize("name", ["points.ply", "golden/tree-v3.spz"])
def test_the_process_says_one_line_and_exits_with_1(name: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sparklod_cli", "build-lod", FIXTURES / name, "--output-dir", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=os.environ | {"NO_COLOR": "1"})
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith(f"error: {FIXTURES / name}: ")
    assert list(tmp_path.iterdir()) == []
