"""How kernels are compiled and run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from sparklod_cli import jit

from .conftest import ROOT


def add(a: float, b: float) -> float:
    return a + b


def test_a_kernel_works_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)
    assert jit.kernel()(add)(1.0, 2.0) == 3


def test_where_compiled_code_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    given = jit._cache_folder()
    assert given is not None
    assert given.parent == tmp_path / "given"
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/dev/null/no/folder")
    assert jit._cache_folder() is None


def test_a_change_of_any_kernel_or_constant_is_a_new_cache(tmp_path: Path) -> None:
    copy = tmp_path / "sparklod_cli"
    shutil.copytree(ROOT / "sparklod_cli", copy, ignore=shutil.ignore_patterns("__pycache__"))
    code = "from sparklod_cli import jit; print(jit.CACHE_FOLDER)"
    folders = []
    for name in ("gaussian.py", "gaussian.py", "lod/kernels/merge.py"):
        command = [sys.executable, "-c", code]
        folders.append(subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout)
        (copy / name).write_text((copy / name).read_text() + "# changed\n")
    assert str(copy) in folders[0]
    assert len(set(folders)) == 3


def test_kernels_can_be_debugged() -> None:
    code = "from sparklod_cli.lod.kernels.geometry import ellipsoid_area; print(ellipsoid_area(1.0, 1.0, 1.0))"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(12.566, abs=1e-3)


def test_the_first_compilation_is_told_and_only_that() -> None:
    told = []
    jit.on_first_compile(lambda: told.append(True))
    numba.njit(lambda x: x + 1)(1)
    numba.njit(lambda x: x + 2)(1)
    assert told == [True]


def test_small_work_runs_on_one_thread_and_large_on_all() -> None:
    before = numba.get_num_threads()
    with jit.threads_for(jit.SMALL - 1) as threads:
        assert threads == numba.get_num_threads() == 1
        with jit.threads_for(10 * jit.SMALL) as inner:
            assert inner == 1
    with jit.threads_for(jit.SMALL) as threads:
        assert threads == before
    with pytest.raises(KeyError), jit.threads_for(1):
        raise KeyError
    assert numba.get_num_threads() == before
