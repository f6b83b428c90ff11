"""Arrays that `convert --layout` writes are reported by what they hold."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import ENCODINGS
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io.opening import read_arrays
from tests.conftest import FIXTURES, Capture
from tests.inspection.test_schema import VALIDATOR

SCENE = FIXTURES / "sh3.ply"
ALL = ReportSettings(values=True, all_quantities=True, check=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same tree as SPZ and in every encoding."""
    folder = tmp_path_factory.mktemp("arrays")
    tree = str(folder / "tree.spz")
    assert run(["build-lod", str(SCENE), "-q", "-o", tree]) == 0
    for each in ENCODINGS:
        assert run(["convert", tree, str(folder / f"{each}.npz"), "-q", "--layout", each]) == 0
    return folder


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_has_as_many_splats_as_the_tree_and_nothing_is_wrong(encoding: str, folder: Path) -> None:
    nodes = inspect(folder / "tree.spz", ALL)[0].splats
    report, _ = inspect(folder / f"{encoding}.npz", ALL)
    assert report.splats == nodes
    assert report.findings == []
    assert report.bytes == (folder / f"{encoding}.npz").stat().st_size
    assert len(report.notes) == 1  # on what the arrays lack
    VALIDATOR.validate(json.loads(json.dumps(report.as_dict())))


@pytest.mark.parametrize("encoding", ["packed", "ext"])
def test_arrays_of_whole_splats_have_their_values(encoding: str, folder: Path) -> None:
    tree, arrays = (inspect(folder / name, ALL)[0] for name in ("tree.spz", f"{encoding}.npz"))
    assert tree.values is not None
    assert arrays.values is not None
    assert (arrays.sh_degree, arrays.tree) == (3, None)
    for name in ("scale", "opacity", "x"):
        for statistic in ("min", "p50", "max"):
            expected = tree.values.quantities[name][statistic]
            assert arrays.values.quantities[name][statistic] == pytest.approx(expected, rel=0.06, abs=0.02)


def test_arrays_of_nodes_have_the_facts_of_the_tree(folder: Path) -> None:
    tree, arrays = (inspect(folder / name, ALL)[0].tree for name in ("tree.spz", "lodtree.npz"))
    assert tree is not None
    assert arrays is not None
    for name in ("leaves", "inner", "growth", "depth", "children", "chunks"):
        assert getattr(arrays, name) == getattr(tree, name)
    assert arrays.more_than_opaque is None
    for mine, other in zip(arrays.levels, tree.levels, strict=True):
        assert (mine.nodes, mine.leaves) == (other.nodes, other.leaves)
        assert mine.size == pytest.approx(other.size, rel=0.05)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.slow
def test_the_command_prints_reports_pages_and_json(
    encoding: str, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    path = str(folder / f"{encoding}.npz")
    for options in ([], ["--check"], ["--json", "--stats"], ["--assert", "nodes>1"]):
        assert run(["inspect", path, *options]) == 0
    out = capsys.readouterr().out
    assert any(note in out for note in ("has no child indices", "it has centres"))
    assert run(["inspect", path, "--html", str(tmp_path / "page.html"), "-q"]) == 0


def test_what_arrays_do_not_hold_is_not_checked_silently(folder: Path, capsys: Capture) -> None:
    for encoding in ("lodtree", "texture"):
        assert run(["inspect", str(folder / f"{encoding}.npz"), "--leaves-of", str(SCENE)]) == 3
        assert "expect.leaves: the file does not contain all of its splats" in capsys.readouterr().out
    assert run(["inspect", str(folder / "texture.npz"), "--assert", "growth<2"]) == 3
    assert "growth<2: the file has no tree" in capsys.readouterr().out


def test_other_commands_say_that_they_are_no_scene(folder: Path, capsys: Capture) -> None:
    for command in ("build-lod", "traverse", "render"):
        assert run([command, str(folder / "packed.npz")]) == 1
        assert (
            "it holds arrays for a viewer and no scene; use the file that they were made of" in capsys.readouterr().err
        )


def test_words_alone_tell_nothing(tmp_path: Path, capsys: Capture) -> None:
    for suffix in (".bin", ".raw"):
        path = tmp_path / f"tree{suffix}"
        assert run(["convert", str(SCENE), str(path), "-q", "--layout", "ext"]) == 0
        assert run(["inspect", str(path)]) == 1
        assert "a file with this suffix has only words, as convert --layout writes them, without a header" in (
            capsys.readouterr().err
        )


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": np.zeros((3, 4), np.uint32)}, "its arrays (other) match no layout"),
        ({"packed": np.zeros((3, 5), np.uint32)}, "packed is uint32[3, 5], expected uint32[3, 4]"),
        ({"packed": np.zeros((3, 4))}, "packed is float64[3, 4], expected uint32[3, 4]"),
        ({"ext0": np.zeros((3, 4), np.uint32)}, "no array ext1"),
        ({"lod_tree": np.uint32(3)}, "lod_tree is uint32[], expected"),
        ({"texture": np.zeros((3, 4), np.uint32)}, "texture is uint32[3, 4], expected"),
        ({"packed": np.array([None])}, "not a .npy file of plain numbers"),
    ],
)
def test_arrays_of_another_shape_are_refused(
    arrays: dict[str, np.ndarray], message: str, tmp_path: Path, capsys: Capture
) -> None:
    np.savez(tmp_path / "odd.npz", **arrays)
    assert run(["inspect", str(tmp_path / "odd.npz")]) == 1
    assert message in capsys.readouterr().err
    assert run(["inspect", str(tmp_path / "odd.npz"), "--check"]) == 3


def test_empty_arrays_are_a_finding_or_a_report(tmp_path: Path) -> None:
    for name in ("packed", "lod_tree"):
        np.savez(tmp_path / "empty.npz", **{name: np.zeros((0, 4), np.uint32)})
        report, _ = inspect(tmp_path / "empty.npz", ALL)
        assert [found.code for found in report.findings or []] == ["values.empty"]


@pytest.mark.parametrize("seed", range(20))
def test_damaged_files_are_errors_of_a_line(seed: int, folder: Path, tmp_path: Path) -> None:
    data = bytearray((folder / "ext.npz").read_bytes())
    rng = np.random.default_rng(seed)
    for place in rng.integers(0, len(data), 8):
        data[place] = rng.integers(256)
    (tmp_path / "damaged.npz").write_bytes(data[: int(rng.integers(len(data) // 2, len(data) + 1))])
    assert run(["inspect", str(tmp_path / "damaged.npz"), "--check", "--json"]) in (0, 3)


def test_compressed_arrays_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "bomb.npz", packed=np.zeros((1 << 20, 4), np.uint32))
    report, _ = inspect(tmp_path / "bomb.npz", ALL)
    assert "is compressed" in (report.findings or [])[0].message


def test_what_is_no_npz_has_no_arrays(folder: Path, tmp_path: Path) -> None:
    for path in (SCENE, FIXTURES / "golden" / "sh3-v2.sog", folder / "tree.spz", tmp_path / "missing.npz", tmp_path):
        assert read_arrays(path) is None
