"""`sparklod warmup` compiles every kernel; while a command runs, a second process compiles what it will need."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli import warmup
from sparklod_cli.cli import run
from sparklod_cli.codecs.kernels import drawable, texels
from sparklod_cli.commands.console import Console
from sparklod_cli.lod.kernels import sort
from sparklod_cli.system import jit
from sparklod_cli.system.machine_code import stem_of
from sparklod_cli.warmup import JOBS, CompileAhead, Unit
from tests.conftest import FIXTURES, ROOT

#: Runs command lines of JSON one after the other; prints their exit statuses, and the kernels that were compiled.
RUN = """
import json, sys
from sparklod_cli.cli import run
from sparklod_cli.system import jit
compiled = []
jit.listeners.append((compiled.append, lambda seconds: None, compiled.append))
print(json.dumps([[run(command) for command in json.loads(sys.argv[1])], compiled]))
"""


def test_all_modules_with_kernels_are_listed() -> None:
    listed = {f"{room}/kernels/{name}" for room, names in warmup.KERNELS.items() for name in names.split()}
    found = set()
    for path in (ROOT / "sparklod_cli").glob("*/kernels/*.py"):
        module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
        declares = [each for each in vars(module).values() if isinstance(each, jit.Kernel) and each.declared]
        if any(each.__module__ == module.__name__ for each in declares):
            found.add("/".join(path.relative_to(ROOT / "sparklod_cli").with_suffix("").parts))
    assert found == listed


def test_commands_that_combine_much_find_all_kernels_compiled(tmp_path: Path) -> None:
    sog, tree = str(tmp_path / "one.sog"), str(tmp_path / "tree.spz")
    scene = str(FIXTURES / "sh1-ascii.ply")
    commands = [
        ["build-lod", scene, "--memory", "1GB", "-o", tree],
        ["convert", tree, sog],
        ["build-lod", sog, sog, "--merge", "-o", tree, "--overwrite"],
        ["build-lod", scene, "--refine", "2", "-o", tree, "--overwrite"],
    ]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    line = [sys.executable, "-c", RUN, json.dumps([[*command, "--quiet"] for command in commands])]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=True, env=environment)
    assert json.loads(done.stdout.splitlines()[-1]) == [[0] * len(commands), []], done.stderr


@pytest.fixture
def few(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Unit]:
    """Three kernels that compile fast, and an empty cache."""
    assert jit.CACHE_FOLDER is not None
    folder = tmp_path / jit.CACHE_FOLDER.name
    folder.mkdir()
    monkeypatch.setattr(jit, "CACHE_FOLDER", folder)
    kernels = [texels.look_up_words, texels.look_up, drawable.count_doubtful]
    units = [Unit(kernel, number) for kernel in kernels for number in range(len(kernel.declared))]
    monkeypatch.setattr(warmup, "units", lambda: units)
    return units


@pytest.mark.parametrize("processes", ["1", "2"])
def test_as_many_kernels_are_compiled_as_are_missing(
    processes: str, few: list[Unit], capsys: pytest.CaptureFixture[str]
) -> None:
    assert warmup.missing() == few
    assert run(["warmup", "--json", "--verbose", "--jobs", processes]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["compiled"] == len(few)
    assert captured.err.count("must be compiled") == len(few)
    assert f"compiled {len(few)} kernels in " in captured.err
    assert warmup.missing() == []
    assert run(["warmup", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["compiled"] == 0
    assert captured.err == f"all kernels are in {jit.CACHE_FOLDER}\n"


def test_a_command_that_compiles_says_how_many_kernels_a_warmup_would(
    few: list[Unit], capsys: pytest.CaptureFixture[str]
) -> None:
    kernel = few[0].kernel
    with Console(quiet=False, verbose=False) as console:
        console.announce_compiling()
        kernel.compile(0)
    first, last = capsys.readouterr().err.splitlines()
    assert first.startswith("Compiling kernels for this machine")
    assert f"sparklod warmup compiles all {len(few)} in advance" in first
    assert last.startswith("compiled 1 kernel in ")


def test_warmup_without_a_cache_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)
    assert run(["warmup"]) == 1
    assert "set NUMBA_CACHE_DIR" in capsys.readouterr().err


def test_a_kernel_that_does_not_compile_is_named_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent() -> None: ...

    absent.__module__ = sort.__name__
    monkeypatch.setattr(warmup, "missing", lambda: [Unit(jit.Kernel(absent), 0)])
    with pytest.raises(warmup.SparklodError, match=r"sort\.absent cannot be compiled: AttributeError: .*absent"):
        warmup.warm_up(processes=1)


def test_kernels_that_do_not_reach_the_cache_are_an_error(few: list[Unit], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warmup, "missing", lambda: few[:1])
    with pytest.raises(warmup.SparklodError, match="1 of 1 kernels are still not in the cache"):
        warmup.warm_up(processes=1)


def test_the_children_import_nothing_from_the_working_directory(
    few: list[Unit], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sparklod_cli.py").write_text("raise SystemExit('planted')")
    monkeypatch.chdir(tmp_path)
    assert warmup.warm_up(processes=1) == len(few)


# --- Compiling ahead --------------------------------------------------------------------------------------------------

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
    assert set(JOBS[job].split()) <= called


@pytest.fixture
def several_processors(few: list[Unit], monkeypatch: pytest.MonkeyPatch) -> list[Unit]:
    """Three kernels that are missing are a job, on a machine of two processors."""
    monkeypatch.setitem(JOBS, "few", " ".join(dict.fromkeys(unit.name for unit in few)))
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
    assert unit.is_kept
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
