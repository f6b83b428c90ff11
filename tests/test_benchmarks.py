"""Every benchmark can be started: it imports what it measures, and prints its help."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest

from tests.conftest import ROOT

BENCHMARKS = sorted(path.stem for path in (ROOT / "benchmarks").glob("bench_*.py"))


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_prints_its_help(name: str) -> None:
    of_tests = name in ("bench_engines", "bench_spark_pictures")  # which import the tests' programs
    place = ["-m", f"benchmarks.{name}"] if of_tests else [f"benchmarks/{name}.py"]
    done = subprocess.run([sys.executable, *place, "--help"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")


@pytest.mark.parametrize(("workers", "seconds"), [(1, 16), (2, 10), (3, 8), (64, 8)])
def test_the_model_of_workers_keeps_to_what_tasks_need(workers: int, seconds: float) -> None:
    """Three parts, then two blocks that need all of them, and a join that needs both."""
    spec = importlib.util.spec_from_file_location("scale_report", ROOT / "benchmarks" / "scale_report.py")
    assert spec is not None
    assert spec.loader is not None
    report = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(report)
    parts = [{"name": f"part/{number}", "needs": [], "seconds": 2} for number in range(3)]
    needs = [part["name"] for part in parts]
    blocks = [{"name": f"block/{number}", "needs": needs, "seconds": 4} for number in range(2)]
    join = {"name": "join", "needs": ["block/0", "block/1", "unknown"], "seconds": 2}
    assert report.makespan([*parts, *blocks, join], workers) == seconds
