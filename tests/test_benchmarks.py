"""Every benchmark can be started: it imports what it measures, and prints its help."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT

BENCHMARKS = sorted(path.stem for path in (ROOT / "benchmarks").glob("bench_*.py"))


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_prints_its_help(name: str) -> None:
    place = ["-m", f"benchmarks.{name}"] if name == "bench_spark_pictures" else [f"benchmarks/{name}.py"]
    done = subprocess.run([sys.executable, *place, "--help"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")
