"""Processes that start at once and share an empty cache of kernels."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sparklod_cli.system.kernel_cache import SUFFIX
from tests.conftest import ROOT
from tests.faults.runs import ENVIRONMENT

pytestmark = pytest.mark.slow

#: Calls a few kernels that call each other; prints the cache folder, the number of compilations, and the results.
SCRIPT = """
import numpy as np
from sparklod_cli.system import jit
from sparklod_cli.lod.kernels.geometry import find_bounds
from sparklod_cli.render.kernels.shade import add_sh

begun = []
jit.listeners.append((begun.append, lambda seconds: None, print))
center = np.arange(12, dtype=np.float32).reshape(4, 3)
rgb, low, high = np.zeros((4, 3), np.float32), np.zeros((1, 4)), np.zeros((1, 4))
add_sh(4, center, np.ones((4, 3, 3), np.float32), np.zeros(3, np.float32), 1, rgb)
find_bounds(1, center, center + 1, low, high)
print(jit.CACHE_FOLDER, len(begun), rgb.sum(), low.sum() + high.sum())
"""


def start(cache: Path) -> subprocess.Popen[str]:
    environment = {**ENVIRONMENT, "NUMBA_CACHE_DIR": str(cache)}
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> tuple[str, int, str]:
    """Returns the folder of the cache, the number of compilations, and the results of a process."""
    out, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")
    folder, count, results = out.strip().split(" ", 2)
    return folder, int(count), results


def test_first_runs_side_by_side_share_an_empty_cache(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    ends = [finish(process) for process in [start(cache) for _ in range(3)]]
    assert len({(folder, results) for folder, _, results in ends}) == 1
    assert Path(ends[0][0]).parent == cache
    assert any(count for _, count, _ in ends)
    assert finish(start(cache)) == (ends[0][0], 0, ends[0][2])  # the cache that they left is complete
    assert not [path for path in cache.rglob("*") if path.suffix != SUFFIX and path.is_file()]
