"""`sparklod warmup`: afterwards nothing is left to compile."""

from __future__ import annotations

import ast
import importlib
import itertools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli import warmup
from sparklod_cli.cli import run
from sparklod_cli.codecs.kernels import drawable, texels
from sparklod_cli.commands.console import Console
from sparklod_cli.lod.kernels import sort
from sparklod_cli.system import jit
from sparklod_cli.system.kernel_cache import start_of, stem_of
from sparklod_cli.warmup import Unit
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

PACKAGE = ROOT / "sparklod_cli"


def kernels_in(path: Path) -> set[jit.Kernel]:
    """The kernels that a module of the package imports or uses as attributes of modules of kernels."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    found, nodes = set(), list(ast.walk(ast.parse(path.read_text())))
    attributes = [node for node in nodes if isinstance(node, ast.Attribute)]
    uses = [(node.value.id, node.attr) for node in attributes if isinstance(node.value, ast.Name)]
    for node in nodes:
        if not (isinstance(node, ast.ImportFrom) and node.level and "kernels" in (node.module or "").split(".")):
            continue
        module = ".".join([*package[: len(package) + 1 - node.level], str(node.module)])
        for alias in node.names:
            name = alias.asname or alias.name
            if module.endswith(".kernels"):
                members = vars(importlib.import_module(f"{module}.{alias.name}"))
                found |= {members.get(attribute) for of, attribute in uses if of == name}
            else:
                found.add(getattr(importlib.import_module(module), alias.name))
    return {each for each in found if isinstance(each, jit.Kernel)}


def kernels_of_functions(path: Path) -> set[jit.Kernel]:
    """The kernels that the plain functions of a module of kernels use."""
    members = vars(importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts)))
    functions = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)]
    nodes = itertools.chain.from_iterable(ast.walk(each) for each in functions if not each.decorator_list)
    found = [members.get(node.id) for node in nodes if isinstance(node, ast.Name)]
    return {each for each in found if isinstance(each, jit.Kernel)}


def test_every_kernel_that_the_package_calls_declares_its_types_and_no_other() -> None:
    called: set[jit.Kernel] = set()
    for path in PACKAGE.rglob("*.py"):
        if path.parent.name == "cuda":  # those are compiled for cards, which need no types for the processor
            continue
        called |= (kernels_of_functions if path.parent.name == "kernels" else kernels_in)(path)
    declared = {unit.kernel for unit in warmup.units()}
    assert sorted(stem_of(kernel.py_func) for kernel in called) == sorted(
        stem_of(kernel.py_func) for kernel in declared
    )


def test_a_call_with_types_that_are_not_declared_fails_in_tests() -> None:
    """Thus no run of the tests calls what a warm-up does not compile; see `tests.conftest`."""
    package: dict[str, Any] = {"__name__": "sparklod_cli.somewhere"}
    exec("def call(kernel, *arguments): return kernel(*arguments)", package)
    words, rest = np.zeros((3, 3), np.uint32), (np.zeros((3, 1 << 16), np.float32), np.zeros((3, 3), np.float32))
    package["call"](texels.look_up_words, words, *rest)
    for wrong in (words.astype(np.int32), words.T[:2], words[0]):
        with pytest.raises(AssertionError, match="types that it does not declare"):
            package["call"](texels.look_up_words, wrong, *rest)


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
        again = jit.Kernel(kernel.py_func, kernel.declared, ranges=kernel.ranges, options=kernel.options)
        again.dispatcher.compile(again.signatures[0])
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
    monkeypatch.setattr(warmup, "missing", lambda: [Unit(jit.Kernel(absent, sort.split_box.options), 0)])
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


@pytest.mark.slow
def test_the_tests_say_that_they_compile(tmp_path: Path) -> None:
    assert jit.CACHE_FOLDER is not None
    ignore = shutil.ignore_patterns(f"{start_of(texels.look_up_words.py_func)}*")
    shutil.copytree(jit.CACHE_FOLDER, tmp_path / jit.CACHE_FOLDER.name, ignore=ignore)
    line = [sys.executable, "-m", "pytest", "tests/system/test_units.py", "-q", "-p", "no:cacheprovider"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    how: dict[str, Any] = {"cwd": ROOT, "capture_output": True, "text": True, "check": True, "env": environment}
    said = subprocess.run([*line, "-n1"], **how).stdout
    assert "compiling 1 kernel for this machine" in said
    assert "compiled 1 kernel in " in said
    assert "ompil" not in subprocess.run(line, **how).stdout
