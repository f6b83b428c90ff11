"""Every benchmark can be started: it imports what it measures, and prints its help."""

from __future__ import annotations

import importlib
import runpy
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

BENCHMARKS = [*sorted(path.stem for path in (ROOT / "benchmarks").glob("bench_*.py")), "digests", "run_all"]


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_prints_its_help(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    of_tests = name in ("bench_engines", "bench_spark_pictures")  # which import the tests' programs
    with pytest.raises(SystemExit) as ended:
        if of_tests:
            runpy.run_module(f"benchmarks.{name}", run_name="__main__")
        else:
            runpy.run_path(str(ROOT / "benchmarks" / f"{name}.py"), run_name="__main__")
    assert not ended.value.code
    assert capsys.readouterr().out.startswith("usage: ")


@pytest.fixture
def benchmark_module(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module of the benchmarks by its name."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def test_digests_that_differ_are_named(benchmark_module: Any) -> None:
    digests = benchmark_module("digests")
    before = {"a.ply: quick": "1", "a.ply: cuts": "2", "a.ply: picture": "3"}
    after = {"a.ply: quick": "1", "a.ply: cuts": "4", "a.ply: report": "5"}
    assert digests.differences(before, before) == []
    assert digests.differences(before, after) == ["changed: a.ply: cuts", "lost: a.ply: picture", "new: a.ply: report"]
    assert dict(digests.digests_of_report('{"nodes": 3, "seconds": 1}')) == dict(
        digests.digests_of_report('{"nodes": 3}')
    )


#: By budget, what pictures of a tree come to.
FIGURES: dict[str, dict[str, float | None]] = {
    "2%": {"psnr": 20.0, "ssim": 0.5, "edge_psnr": None, "popping": None, "popping_max": None},
    "5%": {"psnr": 30.0, "ssim": 0.75, "edge_psnr": 15.0, "popping": 2.0, "popping_max": 3.0},
}


def record(*cameras: str) -> dict[str, Any]:
    """Return a record of `bench_fidelity.py` of four builders of one scene, each with 1 more in every figure."""
    methods = {}
    for gain, (method, nodes) in enumerate(
        {"spark-tiny": 26, "spark-quality": 30, "quality": 28, "refined": 28}.items()
    ):
        figures = {
            budget: {name: value and value + gain for name, value in each.items()} for budget, each in FIGURES.items()
        }
        methods[method] = {"nodes": nodes, "leaves": 20, "views": dict.fromkeys(cameras, figures)}
    settings = {"size": [8, 8], "budgets": ["2%", "5%"], "budgets_of_paths": ["5%"]}
    return settings | {"cameras": list(cameras), "moving": ["orbit"], "scenes": {"text-wall.ply": methods}}


def test_tables_of_fidelity_say_what_was_measured(benchmark_module: Any) -> None:
    tables = benchmark_module("fidelity_report").tables(record("around", "near", "orbit"))
    expected = {"builders", "differences", "thin", "refined", "edges", "ssim", "cameras", "popping"}
    assert set(tables) == expected, "blocks were not measured"
    assert "| text-wall.ply | Spark quality | 1.50 | 21.00 | 31.00 |" in tables["builders"]
    assert "| text-wall.ply | our quality | 1.40 | 22.00 | 32.00 |" in tables["builders"]
    assert tables["differences"].endswith("| text-wall.ply | our quality - Spark quality | +1.00 | +1.00 |")
    assert "| text-wall.ply | all | +1.00 | +1.00 |" in tables["thin"], "less the better of two"
    assert "| text-wall.ply | edges |  | +1.00 |" in tables["thin"]
    assert "| text-wall.ply | near | edges |  | +1.00 |" in tables["refined"]
    assert "| text-wall.ply | Spark quality |  | 16.00 |" in tables["edges"]
    assert "| text-wall.ply | our quality - Spark quality | +1.00 | +1.00 |" in tables["cameras"]
    assert "| text-wall.ply | our quality | 4.00 / 5.00 |" in tables["popping"]


def test_the_pages_about_fidelity_have_a_place_for_every_table(benchmark_module: Any, tmp_path: Path) -> None:
    report = benchmark_module("fidelity_report")
    tables = report.tables(record("around", "near", "orbit", "around SH"))
    assert len(tables) == 9
    docs = _copied(tmp_path)
    report.put_into(docs, tables | {"blocks": "| blocks |", "rounding": "| rounding |"})
    text = "".join(page.read_text() for page in docs.glob("*.md"))
    assert all(table in text for table in tables.values())


def test_the_scene_of_thin_things_is_the_same_for_a_seed_and_thin(benchmark_module: Any) -> None:
    make = benchmark_module("fine_structure").fine_structure
    splats, again, other = make(), make(), make(1)
    assert 50_000 < len(splats) < 150_000
    for name in ("center", "scale", "quat_xyzw", "opacity", "rgb"):
        column = getattr(splats, name)
        assert np.isfinite(column).all()
        assert (column == getattr(again, name)).all()
    assert len(other) != len(splats) or (other.center != splats.center).any()
    assert np.allclose(np.linalg.norm(splats.quat_xyzw, axis=1), 1, atol=1e-6)
    assert splats.scale.min() > 0
    assert 0 < splats.opacity.min() <= splats.opacity.max() < 1
    ratio = splats.scale.max(axis=1) / splats.scale.min(axis=1)
    assert np.mean(ratio > 3) > 0.5, "most splats are far longer than wide"


def test_the_glossy_knot_is_the_same_for_a_seed_and_has_highlights(benchmark_module: Any) -> None:
    make = benchmark_module("glossy_knot").glossy_knot
    splats, again, other = make(), make(), make(1)
    assert (splats.sh_degree, len(splats)) == (3, 70_000)
    assert (splats.sh == again.sh).all() and (splats.center == again.center).all()
    assert (splats.center != other.center).any()
    assert 0.1 < np.mean(np.log(splats.scale.min(axis=1)) < -10) < 0.9, "some are thinner than SPZ holds"
    bright = [sparklod.render(sparklod.Scene(each), camera(splats)) for each in (splats, splats.with_max_sh(0))]
    assert np.abs(bright[0] - bright[1]).max() > 0.2


def camera(splats: sparklod.Splats) -> sparklod.Camera:
    """A camera that sees the splats from where the light comes."""
    middle = splats.center.mean(axis=0)
    return sparklod.Camera.look_at(middle + np.array([0.14, -0.24, -0.11]), middle, size=(96, 54))


def _copied(folder: Path) -> Path:
    """Return a copy of the folder of pages."""
    docs = folder / "docs"
    docs.mkdir()
    for page in (ROOT / "docs").glob("*.md"):
        shutil.copy(page, docs)
    return docs
