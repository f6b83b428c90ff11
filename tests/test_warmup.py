"""`sparklod warmup`: afterwards nothing is left to compile."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sparklod_cli import warmup
from sparklod_cli.cli import run
from sparklod_cli.support import jit, jit_link
from tests.conftest import ROOT

#: Runs a command line of JSON and prints which kernels Python has called, and whether numba was loaded.
CALLED = """
import json, sys
from sparklod_cli.cli import run
from sparklod_cli.support.jit import Kernel
from sparklod_cli.support.jit_cache import stem_of
code = run(json.loads(sys.argv[1]))
kernels = {f for name, module in list(sys.modules.items()) if ".kernels." in name for f in vars(module).values()
           if isinstance(f, Kernel) and f.called}
print(json.dumps([code, sorted(stem_of(kernel.py_func) for kernel in kernels), "numba" in sys.modules]))
"""


@pytest.mark.parametrize("job", warmup.JOBS)
def test_the_table_has_just_the_kernels_that_a_job_calls(job: str, tmp_path: Path) -> None:
    warmup._write_inputs(tmp_path)
    called: set[str] = set()
    for command in warmup.JOBS[job].commands:
        line = [sys.executable, "-c", CALLED, json.dumps([*command.split(), "--quiet"])]
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        done = subprocess.run(
            line, cwd=tmp_path, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": path}
        )
        code, kernels, needs_numba = json.loads(done.stdout.splitlines()[-1])
        assert code == 0, done.stderr
        assert needs_numba == (not jit_link.is_tested())
        called |= set(kernels)
    assert called == set(warmup.JOBS[job].kernels)


def test_a_second_warmup_compiles_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["warmup", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["compiled"] == 0
    assert captured.err == f"all kernels are in {jit.CACHE_FOLDER}\n"


def test_warmup_without_a_cache_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)
    assert run(["warmup"]) == 1
    assert "set NUMBA_CACHE_DIR" in capsys.readouterr().err


def test_a_job_that_fails_says_why(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)
    monkeypatch.setattr(warmup, "JOBS", {"none": warmup.Job(("no.kernel",), ("inspect no-such-file.spz",))})
    with pytest.raises(warmup.SparklodError, match=r"sparklod inspect failed while it compiled: .*no-such-file"):
        warmup.warm_up(processes=1)


def test_a_job_that_compiles_nothing_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)
    monkeypatch.setattr(warmup, "JOBS", {"none": warmup.Job(("no.kernel",), ("inspect scene.ply",))})
    with pytest.raises(warmup.SparklodError, match="1 of 1 kernels are still not in the cache"):
        warmup.warm_up(processes=1)
