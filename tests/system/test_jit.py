"""How kernels are compiled and run."""

from __future__ import annotations

import ast
import inspect
import itertools
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from sparklod_cli.system import jit
from sparklod_cli.system.jit import Type, as_declared, b1, example, f4, fields, i8, out, u2, u4
from sparklod_cli.system.jit import prefetch as jit_prefetch
from sparklod_cli.system.kernel_cache import cache_folders, sources_of
from sparklod_cli.warmup import Unit, units
from tests.conftest import ROOT

PACKAGE = ROOT / "sparklod_cli"


def add(a: float, b: float) -> float:
    return a + b


def test_a_kernel_works_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)
    assert jit.kernel()(add)(1.0, 2.0) == 3


def test_the_cache_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    given = cache_folders(Path(jit.__file__))[0]
    assert given is not None
    assert given.parent == tmp_path / "given"
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/dev/null/no/folder")
    assert cache_folders(Path(jit.__file__)) == (None, (), ())
    assert cache_folders(Path(jit.__file__).parent / "not-there.py") == (None, (), ())  # as in a zip


def imported(path: Path) -> set[Path]:
    """The modules of the package that a module imports when it runs."""
    found = set()
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.parse(path.read_text()).body:  # not those under `if TYPE_CHECKING`
        if isinstance(node, ast.ImportFrom) and node.level:
            base = ROOT.joinpath(*package[: len(package) + 1 - node.level], *(node.module or "").split("."))
            found |= {base.with_suffix(".py"), *(base / f"{name.name}.py" for name in node.names)}
    return {path for path in found if path.is_file()}


@pytest.mark.parametrize("kernels", sorted(PACKAGE.glob("*/kernels/*.py")), ids=lambda path: path.stem)
def test_a_kernel_depends_on_all_that_its_module_imports(kernels: Path) -> None:
    made_of, new = set(), {kernels}
    while new:
        made_of |= new
        new = set().union(*map(imported, new)) - made_of
    assert set(sources_of(kernels)) == made_of
    assert kernels.stem == "__init__" or PACKAGE / "system/jit.py" in made_of


def test_modules_may_import_each_other(tmp_path: Path) -> None:
    modules = [tmp_path / "a.py", tmp_path / "b.py"]
    for path, other in zip(modules, "ba", strict=True):
        path.write_text(f"from .{other} import x\n")
    assert set(sources_of(modules[0])) == set(modules)


def test_a_change_of_a_kernel_or_constant_changes_the_names_of_those_that_depend_on_it(tmp_path: Path) -> None:
    copy = tmp_path / "sparklod_cli"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    names = ("geometry", "sort", "node_rows", "cut_statistics")
    code = "from sparklod_cli.system.kernel_cache import *; " + "".join(
        f"print(digest_of(PACKAGE / 'lod/kernels/{name}.py')); " for name in names
    )
    digests = []
    for changed in ("model/falloff.py", "lod/kernels/geometry.py", "system/jit.py", "README.md"):
        command = [sys.executable, "-c", code]
        found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()
        digests.append(dict(zip(names, found, strict=True)))
        with (copy / changed).open("a") as file:
            file.write("# changed\n")
    changes = [{name for name in names if now[name] != before[name]} for before, now in itertools.pairwise(digests)]
    assert changes == [{"geometry", "node_rows", "cut_statistics"}, {"geometry", "node_rows"}, set(names)]


@fields(f4[:, :], out(i8[:]), b1)
class Columns(NamedTuple):
    first: Any
    second: Any
    third: Any


RECORD = np.dtype([("a", "<f4"), ("b", "<i8", (3,))])


def readonly(values: Any) -> Any:
    values.flags.writeable = False
    return values


def test_arguments_are_passed_as_the_declared_types() -> None:
    declared = [u4, f4[:], f4[:, :, :], out(u2[:]), Columns, out(Columns), Type(RECORD)[:]]
    writeable = np.zeros((1, 1), "f4")
    arguments = [
        *(np.uint32(1), np.zeros(3, "f4"), np.zeros((1, 2, 3), "f4"), np.zeros(2, "u2")),
        *(Columns(writeable, np.zeros(1, "i8"), True), Columns(writeable, np.zeros(1, "i8"), False)),
        np.zeros(2, RECORD),
    ]
    passed = list(map(as_declared, declared, arguments))
    frozen = Columns(readonly(np.zeros((2, 2), "f4")), np.zeros(1, "i8"), True)
    expected = [
        *(np.uint32(1), readonly(np.zeros(3, "f4")), readonly(np.zeros((1, 2, 3), "f4")), np.zeros(2, "u2"), frozen),
        *(arguments[5], readonly(np.zeros(2, RECORD))),
    ]
    types = list(map(numba.typeof, expected))
    assert list(map(numba.typeof, passed)) == list(map(numba.typeof, map(example, declared))) == types
    assert writeable.flags.writeable
    assert np.shares_memory(passed[4].first, writeable)


@jit.kernel(f4[:], out(f4[:]))
def double(values: Any, doubled: Any) -> None:
    for index in range(len(values)):
        doubled[index] = values[index] * 2


def test_read_only_arrays_are_read_by_the_same_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)
    kernel = jit.Kernel(double.py_func, double.declared)
    values, doubled = np.arange(5, dtype=np.float32), np.empty(5, np.float32)
    np.save(tmp_path / "values.npy", values)
    frozen = values.copy()
    frozen.flags.writeable = False
    begun: list[str] = []
    jit.listeners.append((begun.append, lambda seconds: None, print))
    for each in (values, frozen, np.load(tmp_path / "values.npy", mmap_mode="r")):
        doubled[:] = 0
        kernel(each, doubled)
        assert np.array_equal(doubled, values * 2)
    jit.listeners.clear()
    assert begun == ["test_jit.double"]
    (signature,) = kernel.signatures
    assert Unit(kernel, 0).is_cached
    assert kernel.dispatcher.signatures == [signature]
    with pytest.raises(numba.TypingError, match="readonly array"):
        kernel(values, frozen)
    assert np.array_equal(frozen, values)


def test_numba_refuses_a_kernel_that_writes_to_what_it_declares_to_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)
    kernel = jit.kernel(out(f4[:]), f4[:])(double.py_func)
    with pytest.raises(numba.TypingError, match="readonly array"):
        kernel(np.zeros(2, np.float32), np.zeros(2, np.float32))


def test_kernels_run_without_compilation() -> None:
    code = "from sparklod_cli.lod.kernels.geometry import ellipsoid_area; print(ellipsoid_area(1.0, 1.0, 1.0))"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(12.566, abs=1e-3)


LOADS = """
import sys
sys.path.insert(0, sys.argv[1])
from sparklod_cli.system import errors, jit
try:
    jit.load_numba()
except errors.SparklodError as error:
    print(error)
else:
    print("loaded")
"""


def loaded(folder: Path, **variables: str) -> str:
    """What a process in a folder says of loading numba, in one line."""
    command = [sys.executable, "-c", LOADS, str(ROOT)]
    environment = {**os.environ, **variables}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    assert (done.stdout.count("\n"), done.stderr) == (1, "")
    return done.stdout.strip()


def test_settings_of_numba_in_the_current_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / ".numba_config.yaml").write_text("CUDA_DRIVER: ./a.so\n")
    assert loaded(tmp_path).startswith(".numba_config.yaml in the current folder can have numba load")


@pytest.mark.parametrize("threads", ["0", "-1", "abc", "1.5", "100000"])
def test_a_number_of_threads_that_numba_cannot_use_is_named(threads: str, tmp_path: Path) -> None:
    assert loaded(tmp_path, NUMBA_NUM_THREADS=threads).startswith(f"NUMBA_NUM_THREADS is '{threads}'; set it to")


@pytest.mark.parametrize("variables", [{"NUMBA_NUM_THREADS": ""}, {"NUMBA_NUM_THREADS": "1"}, {"NUMBA_OPT": "abc"}])
def test_other_settings_of_numba_print_no_traceback(variables: dict[str, str], tmp_path: Path) -> None:
    assert loaded(tmp_path, **variables) == "loaded"


def test_compilations_are_reported_but_not_nested_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)

    @jit.kernel()
    def inner(x: int) -> int:
        return x + 1

    def outer(x: int) -> int:
        result: int = inner(x)
        return result

    begun: list[str] = []
    seconds: list[float] = []
    jit.listeners.append((begun.append, seconds.append, lambda text: None))
    assert jit.kernel()(outer)(1) == 2
    jit.kernel()(add)(1, 2)
    jit.listeners.clear()
    jit.kernel()(add)(1, 2)
    assert begun == ["test_jit.outer", "test_jit.add"]
    assert len(seconds) == 2
    assert all(value > 0 for value in seconds)


def test_prefetch_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)

    @jit.kernel()
    def total(values: Any) -> int:
        found = 0
        for index in range(len(values)):
            jit_prefetch(values, index + 16)  # beyond the end, at last
            found += values[index]["count"]
        return found

    rows = np.zeros(100, [("count", np.int64), ("share", np.float32)])
    rows["count"] = np.arange(100)
    assert total(rows) == total.py_func(rows) == 4950  # as machine code, and as Python
    assert np.array_equal(rows["count"], np.arange(100))


def test_kernels_of_ranges_return_nothing() -> None:
    """What one range returned would be lost."""
    of_ranges = {unit.kernel for unit in units() if unit.kernel.ranges}
    assert len(of_ranges) > 20
    for kernel in of_ranges:
        tree = ast.parse(textwrap.dedent(inspect.getsource(kernel.py_func)))
        assert not [node for node in ast.walk(tree) if isinstance(node, ast.Return)], kernel.py_func.__name__


def test_a_kernel_of_ranges_is_called_with_the_number_of_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(start: int, stop: int, values: Any, squares: Any) -> None:
        for i in range(start, stop):
            squares[i] = values[i] * values[i]

    values = np.arange(10_000.0, dtype=np.float32)
    types = i8, f4[:], out(f4[:])
    compiled = jit.kernel(*types, ranges=True)(fill)
    assert isinstance(compiled, jit.Kernel)
    compiled.dispatcher.compile(compiled.signatures[0])
    with monkeypatch.context() as patched:
        patched.setattr(jit, "DISABLED", True)
        interpreted = jit.kernel(*types, ranges=True)(fill)
    for kernel in (compiled, interpreted):
        squares = np.zeros(len(values), np.float32)
        kernel(len(values) - 1, values, squares)
        assert np.array_equal(squares[:-1], values[:-1] ** 2)
        assert not squares[-1]
    assert len(compiled.dispatcher.overloads) == 1  # what is declared is what the call compiled
