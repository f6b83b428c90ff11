"""A second process compiles what a command will need, and no kernel twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sparklod_cli import warmup
from sparklod_cli.cli import run
from sparklod_cli.system import jit
from sparklod_cli.system.kernel_cache import stem_of
from sparklod_cli.warmup import JOBS, CompileAhead, Unit
from tests.conftest import FIXTURES
from tests.test_warmup import few as few

#: A command that does each job.
COMMANDS = {
    "quick": ["build-lod", "{scene}", "-o", "{out}/a.spz"],
    "quality": ["build-lod", "{scene}", "--method", "quality", "-o", "{out}/a.spz"],
    "chunks": ["build-lod", "{scene}", "-o", "{out}/a.rad"],
    "levels": ["build-lod", "{scene}", "-o", "{out}/lod-meta.json"],
    "fit": ["build-lod", "{scene}", "--refine", "2", "-o", "{out}/a.spz"],
    "cuts": ["traverse", "{tree}", "--orbit", "2", "--budget", "10%"],
    "pictures": ["render", "{tree}", "--budget", "10%", "--size", "64x64", "-o", "{out}/a.png"],
}


@pytest.mark.parametrize("job", JOBS)
def test_a_command_calls_all_kernels_of_its_job(job: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called, call = set[str](), jit.Kernel.__call__

    def noted(kernel: jit.Kernel, *arguments: Any) -> Any:
        called.add(stem_of(kernel.py_func))
        return call(kernel, *arguments)

    monkeypatch.setattr(jit.Kernel, "__call__", noted)
    places = {"scene": FIXTURES / "demo.ply", "tree": FIXTURES / "golden" / "tree-v3.spz", "out": tmp_path}
    line = [part.format(**places) for part in COMMANDS[job]]
    assert run([*line, "--quiet"]) == 0
    assert set(JOBS[job]) <= called


@pytest.fixture
def several_processors(few: list[Unit], monkeypatch: pytest.MonkeyPatch) -> list[Unit]:
    """Three kernels that are missing are a job, on a machine of two processors."""
    monkeypatch.setitem(JOBS, "few", tuple(dict.fromkeys(unit.name for unit in few)))
    monkeypatch.setattr(warmup, "processors", lambda: 2)
    return few


def test_kernels_that_are_not_claimed_are_compiled_by_another_process(several_processors: list[Unit]) -> None:
    mine = several_processors[0]
    ahead = CompileAhead(several_processors, ["few"], "drawable.count_doubtful")
    try:
        ahead.claim(mine.kernel)  # as Python calls it, before the other process has come to it, or after
        others = {unit.name for unit in several_processors} - {mine.name, "drawable.count_doubtful"}
        for unit in several_processors:
            if unit.name in others:
                ahead.claim(unit.kernel)
        left = {unit.name for unit in warmup.missing()}
        assert "drawable.count_doubtful" in left
    finally:
        ahead.close()
    assert jit.before_first_call is None
    assert ahead.compiled == len(several_processors) - len(warmup.missing())


def test_a_kernel_that_is_being_compiled_is_waited_for(several_processors: list[Unit]) -> None:
    ahead = CompileAhead(several_processors, ["few"], "")
    with ahead._changed:
        ahead._changed.wait_for(lambda: ahead._current is not None)
        unit = ahead._current
    assert unit is not None
    ahead.claim(unit.kernel)
    assert unit.is_cached
    ahead.close()


@pytest.mark.parametrize("job", [[], ["few"]])
def test_one_processor_or_no_job_needs_no_process(
    job: list[str], several_processors: list[Unit], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warmup, "processors", lambda: 1 if job else 2)
    ahead = CompileAhead(several_processors, job, "")
    ahead.close()
    assert ahead.compiled == 0
    assert len(warmup.missing()) == len(several_processors)
