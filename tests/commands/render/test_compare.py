"""`sparklod render --compare` and `--continuous` as a shell sees them."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.api.comparison import COLUMNS
from sparklod_cli.cli import run
from tests.conftest import FIXTURES, ROOT, Capture

TOWN = FIXTURES / "traverse" / "town.spz"
VIEW = ("--size", "160x90", "--look-at", "0,-3,9:0,0,0")


def render(*arguments: object) -> int:
    return run(["render", *map(str, arguments)])


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """From here on nothing is compiled any more, which would be said."""
    assert render(TOWN, *VIEW, "--compare", "--budget", "1k", "-q", "-o", "-") == 0


def table(capsys: Capture) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(capsys.readouterr().out)))


def test_larger_budgets_come_nearer_to_full_detail(capsys: Capture) -> None:
    assert render(TOWN, *VIEW, "--compare", "--budget", "0.5%,5%,100%") == 0
    rows = table(capsys)
    assert len(rows) == 3
    psnr = [float(row["psnr"]) for row in rows]
    assert psnr == sorted(psnr)
    assert psnr[-1] == 100  # the same picture
    assert [float(row["ssim"]) for row in rows][-1] == 1


def test_an_assertion_of_a_comparison_that_fails_is_exit_code_3(capsys: Capture, tmp_path: Path) -> None:
    how = (TOWN, *VIEW, "--compare", "--budget", "1%,100%", "--overwrite", "-o", tmp_path / "rows.csv")
    assert render(*how, "--assert", "100%:psnr>99", "-q") == 0
    capsys.readouterr()
    assert render(*how, "--assert", "psnr>99", "-q") == 3
    assert "psnr>99" in capsys.readouterr().err
    assert render(*how, "--assert", "7%:psnr>99") == 2
    assert render(*how, "--assert", "pnsr>99") == 2


@pytest.fixture
def huge(tmp_path: Path) -> Path:
    """A scene beyond where the far plane is by default, in an instances file."""
    (tmp_path / "town.spz").write_bytes(TOWN.read_bytes())
    path = tmp_path / "huge.json"
    path.write_text(json.dumps({"instances": [{"file": "town.spz", "scale": 5000}]}))
    return path


@pytest.mark.parametrize("source", [(), ("--dolly", "--every", "20")])
@pytest.mark.slow
def test_a_scene_of_any_size_is_compared_as_it_is_drawn(source: tuple[str, ...], huge: Path, capsys: Capture) -> None:
    """Wherever cameras are chosen for the scene, near and far are, too."""
    size = ("--size", "160x90")
    assert render("--scene", huge, *size, *source, "--compare", "--budget", "0.5%,100%") == 0
    rows = table(capsys)
    assert all(float(row["psnr"]) < 60 for row in rows[::2]), "something was in the pictures"
    one = {row["frame"]: row for row in rows[::2]}
    assert render(TOWN, *size, *source, "--compare", "--budget", "0.5%,100%") == 0
    for row in table(capsys)[::2]:
        assert float(row["psnr"]) == pytest.approx(float(one[row["frame"]]["psnr"]), abs=0.2)


@pytest.mark.parametrize("look", [("--look-at", "0,-3,9:0,-3,18"), ("--look-at", "0,-3,9:0,0,0", "--far", "0.02")])
def test_a_comparison_without_a_covered_pixel_is_refused(
    look: tuple[str, ...], tmp_path: Path, capsys: Capture
) -> None:
    for how in (("--compare", "-o", tmp_path / "out.csv"), ("--diff", TOWN, "-o", tmp_path / "out.png")):
        assert render(TOWN, "--size", "64x48", *look, *how) == 1
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert "covers no pixel, so there is nothing to compare with" in err
    assert list(tmp_path.iterdir()) == []


def test_json_of_a_comparison_is_its_summary(capsys: Capture) -> None:
    assert render(TOWN, *VIEW, "--compare", "--budget", "1k,5%", "--json", "-q") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frames"] == 1
    assert len(summary["budgets"]) == 2


@pytest.mark.parametrize(
    "arguments",
    [
        ("--budget", "1k,2k"),
        ("--assert", "psnr>1"),
        ("--max-sh", "0"),
        ("--compare", "--color-by", "level"),
        ("--compare", "--full"),
        ("--compare", "--jobs", "3"),
        ("--compare", "--budget", "much"),
        ("--blend", "2"),
        ("--continuous", "--blend", "1"),
        ("--sorting", "counting16"),
        ("--sort-throttle", "0.01"),
    ],
)
def test_options_that_cannot_be_used_with_compare_are_refused(
    arguments: tuple[str, ...], tmp_path: Path, capsys: Capture
) -> None:
    name = "x.csv" if "--compare" in arguments else "x.png"
    assert render(TOWN, *VIEW, *arguments, "-o", tmp_path / name) == 2
    assert not list(tmp_path.iterdir())
    assert "error:" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["table.png", "table.xlsx", "table.txt"])
def test_the_suffix_decides_the_format_of_a_comparison_table(name: str, tmp_path: Path, capsys: Capture) -> None:
    assert render(TOWN, *VIEW, "--compare", "-o", tmp_path / name) == 2
    assert f"{name}: tables are written as .csv, .json, .parquet" in capsys.readouterr().err
    assert render(TOWN, *VIEW, "--compare", "--plot", tmp_path / "charts.svg") == 2
    assert "charts.svg' does not end in .png" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_continuous_cut_is_nearly_the_ordinary_one(tmp_path: Path) -> None:
    how = (TOWN, *VIEW, "--budget", "5k", "-q", "--overwrite")
    for name, more in (
        ("ordinary", ()),
        ("blended", ("--continuous",)),
        ("hardly", ("--continuous", "--blend", 1.0001)),
    ):
        assert render(*how, *more, "-o", tmp_path / f"{name}.npy") == 0
    ordinary, blended, hardly = (np.load(tmp_path / f"{name}.npy") for name in ("ordinary", "blended", "hardly"))
    assert 0 < np.abs(blended - ordinary).mean() < 0.05
    assert np.abs(hardly - ordinary).mean() < np.abs(blended - ordinary).mean()


def test_the_page_about_comparing_lists_the_columns() -> None:
    page = (ROOT / "docs" / "compare.md").read_text()
    rows = [f"| `{column.name}` | {column.unit} | {column.meaning} |" for column in COLUMNS]
    assert "\n".join(rows) in page
