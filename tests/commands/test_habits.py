"""Habits of other programs and mistakes with numbers are answered in one line, before any work."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from tests.conftest import FIXTURES, Capture


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with two scenes."""
    for name in ("scene.ply", "tree.spz"):
        shutil.copy(FIXTURES / "sh0.ply", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(line: str, capsys: Capture) -> str:
    """Return the error of a command line that is wrong usage, which has written nothing."""
    before = set(Path().iterdir())
    assert run(line.split()) == 2
    assert set(Path().iterdir()) == before
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("line", "output"),
    [
        ("build-lod scene.ply out.spz", "out.spz"),
        ("build-lod scene.ply out.rad --method quality", "out.rad"),
        ("build-lod tree.spz out.spz", "out.spz"),
        ("build-lod scene.ply out/lod-meta.json", "out/lod-meta.json"),
        ("build-lod scene.ply tree.spz out.rad", "out.rad"),
        ("build-lod scene.ply tree.spz out.rad --merge", "out.rad"),
        ("simplify scene.ply small.ply --to 10%", "small.ply"),
        ("simplify --to 10% scene.ply small.sog", "small.sog"),
        ("render scene.ply out.png", "out.png"),
        ("traverse tree.spz frames.csv", "frames.csv"),
    ],
)
def test_an_output_named_as_of_cp_is_recognised(line: str, output: str, capsys: Capture) -> None:
    assert refused(line, capsys) == f"error: {output} does not exist; did you mean -o {output}?"


def test_an_output_that_exists_is_recognised(capsys: Capture) -> None:
    said = "out.spz exists, and is taken for an input; did you mean -o out.spz?"
    for source in (FIXTURES / "sh0.ply", FIXTURES / "golden" / "tree-v3.spz"):
        shutil.copy(source, "out.spz")
        assert refused("build-lod scene.ply out.spz", capsys) == f"error: {said}"
        assert refused("build-lod scene.ply out.spz --method quality", capsys) == f"error: {said}"


@pytest.mark.parametrize(
    ("line", "flag", "output"),
    [
        ("inspect scene.ply report.html", "--html", "report.html"),
        ("inspect scene.ply tree.spz report.HTM", "--html", "report.HTM"),
        ("view scene.ply site/", "--export", "site"),
    ],
)
def test_a_page_or_a_site_named_as_of_cp_is_recognised(line: str, flag: str, output: str, capsys: Capture) -> None:
    assert refused(line, capsys) == f"error: {output} does not exist; did you mean {flag} {output}?"


def test_an_input_whose_name_is_wrong_is_an_input(capsys: Capture) -> None:
    assert run(["build-lod", "scene.ply", "scene2.ply"]) == 1
    assert "scene2.ply: cannot be read: no such file or directory" in capsys.readouterr().err
    assert run(["build-lod", "scene.ply", "other.spz", "--output-dir", "out"]) == 1
    assert "other.spz: cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("simplify scene.ply --to 10 % -o a.ply", "10 % has a blank before its unit; write 10%"),
        ("simplify scene.ply --to=10 % -o a.ply", "--to=10 % has a blank before its unit; write --to=10%"),
        ("render scene.ply --budget 50 k", "50 k has a blank before its unit; write 50k"),
        ("simplify scene.ply --max-bytes 8 MB -o a.ply", "8 MB has a blank before its unit; write 8MB"),
        ("traverse scene.ply --bandwidth 20 Mbit", "20 Mbit has a blank before its unit; write 20Mbit"),
        ("traverse scene.ply --latency 60 ms", "60 ms has a blank before its unit; write 60ms"),
        ("render scene.ply --budget 500.000", "'500.000' has digits in groups; did you mean 500000 or 500k?"),
        ("render scene.ply --budget 500,000", "'500,000' has digits in groups; did you mean 500000 or 500k?"),
        ("traverse scene.ply --budget 250,500", "'250,500' has digits in groups; did you mean 250500?"),
        ("view scene.ply --budget 500.000", "'500.000' has digits in groups; did you mean 500000 or 500k?"),
        ("simplify scene.ply --to 0.5 -o a.ply", "nor a count such as 500k; did you mean 50%?"),
        ("render scene.ply --budget .05", "nor a count such as 500k; did you mean 5%?"),
        ("build-lod scene.ply --tile-splats 50.000", "'50.000' has digits in groups; did you mean 50000 or 50k?"),
    ],
)
def test_a_number_that_is_written_otherwise_is_refused(line: str, said: str, capsys: Capture) -> None:
    assert refused(line, capsys).endswith(said)


def test_a_file_may_have_the_name_of_a_unit(folder: Path, capsys: Capture) -> None:
    line = "render -o a.png --size 8x8 --orbit 1 k"
    assert refused(line, capsys) == "error: 1 k has a blank before its unit; write 1k"
    shutil.copy(folder / "scene.ply", folder / "k")
    assert run(line.split()) == 0


@pytest.mark.parametrize("quiet", [False, True])
@pytest.mark.parametrize(
    "line",
    [
        "simplify scene.ply --to 20 -o a.ply",
        "render tree.spz --budget 20 -o a.png --size 8x8",
        "traverse tree.spz --budget 20 -o a.csv --orbit 2",
    ],
)
def test_a_budget_of_few_splats_is_questioned_and_taken(line: str, quiet: bool, capsys: Capture) -> None:
    assert run(["build-lod", "scene.ply", "-o", "tree.spz", "--overwrite", "-q"]) == 0
    assert run([*line.split(), *["-q"] * quiet]) == 0
    question = "20 means 20 splats; did you mean 20k or 20%?"
    assert capsys.readouterr().err.splitlines().count(question) == (not quiet)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_read_as_standard_input(folder: Path, capsys: Capture) -> None:
    os.mkfifo(folder / "pipe.ply")
    assert run(["build-lod", "pipe.ply"]) == 1
    assert "give - to build-lod, simplify or inspect: - reads standard input" in capsys.readouterr().err
