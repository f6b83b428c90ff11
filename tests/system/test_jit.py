"""How kernels are declared, compiled and run, as machine code and by Python, in threads, forks and processes."""

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

import sparklod_cli as sparklod
from sparklod_cli.cli import run as run_command
from sparklod_cli.model.scene import Scene
from sparklod_cli.system import fast_math, jit
from sparklod_cli.system.jit import Type, as_declared, b1, example, f4, fields, i8, out, u2, u4
from sparklod_cli.system.jit import prefetch as jit_prefetch
from sparklod_cli.system.kernel_cache import SUFFIX, sources_of
from sparklod_cli.warmup import Unit, units
from tests.conftest import ROOT
from tests.scenes import random_splats
from tests.signals import heed_signals

PACKAGE = ROOT / "sparklod_cli"


def add(a: float, b: float) -> float:
    return a + b


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


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        *(
            ({"NUMBA_NUM_THREADS": threads}, f"NUMBA_NUM_THREADS is '{threads}'; set it to")
            for threads in ("0", "-1", "abc", "1.5", "100000")
        ),
        ({"NUMBA_NUM_THREADS": ""}, "loaded\n"),
        ({"NUMBA_NUM_THREADS": "1"}, "loaded\n"),
        ({"NUMBA_OPT": "abc"}, "loaded\n"),
        ({}, ".numba_config.yaml in the current folder can have numba load"),
    ],
)
def test_settings_of_numba_are_used_or_refused_in_a_line(variables: dict[str, str], said: str, tmp_path: Path) -> None:
    if not variables:
        (tmp_path / ".numba_config.yaml").write_text("CUDA_DRIVER: ./a.so\n")
    command = [sys.executable, "-c", LOADS, str(ROOT)]
    environment = {**os.environ, **variables}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(said)
    assert (done.stdout.count("\n"), done.stderr) == (1, "")


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


# --- Polynomials in place of numpy's functions ------------------------------------------------------------------------


def test_exp2_is_that_of_numpy_to_six_digits() -> None:
    t = -np.concatenate([np.linspace(0, 20, 20_001), np.arange(126), [1e-7, 125.999]]).astype(np.float32)
    got = np.array([fast_math.exp2(value) for value in t], np.float64)
    np.testing.assert_allclose(got, np.exp2(t.astype(np.float64)), rtol=5e-7)


def test_log2_is_that_of_numpy_to_six_digits_also_near_1() -> None:
    """Near 1 it must be exact relative to what little it is there: it is multiplied by up to 6,836."""
    v = np.concatenate([np.linspace(0, 1, 20_001)[1:], 1 - np.geomspace(1e-7, 0.5, 500), np.geomspace(1e-30, 1, 2_000)])
    v = v.astype(np.float32)
    got = np.array([fast_math.log2(value) for value in v], np.float64)
    np.testing.assert_allclose(got, np.log2(v.astype(np.float64)), rtol=4e-7)


# --- Without compilation ----------------------------------------------------------------------------------------------

#: A command a line; each reads files of those before it.
COMMANDS = """
build-lod scene.ply -o quick.spz
build-lod scene.ply -o quick.rad
build-lod scene.ply --method quality -o quality.spz
inspect quick.rad --json
traverse quick.spz --orbit 2 --size 32x32 --budget 12 -o whole.csv
traverse quick.rad --orbit 2 --size 32x32 --bandwidth 1Mbit -o streamed.csv
render quick.spz --budget 12 --size 16x16 -o cut.png
simplify scene.ply --to 12 -o few.ply
"""

#: Runs the lines of standard input; a warning of numpy is a failure.
SCRIPT = """
import sys
from sparklod_cli.cli import run
for line in sys.stdin:
    assert run(line.split()) == 0, line
"""


def contents(path: Path) -> object:
    """Return the bytes of a file; of a table, its cells but for times that the machine needs."""
    if path.suffix != ".csv":
        return path.read_bytes()
    header, *rows = (line.split(",") for line in path.read_text("utf-8").splitlines())
    at = header.index("traverse_ms")
    return [row[:at] + row[at + 1 :] for row in rows]


def test_commands_make_the_same_files_without_compilation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [tmp_path / name for name in ("compiled", "interpreted")]
    for folder in folders:
        folder.mkdir()
        sparklod.write(folder / "scene.ply", Scene(random_splats(24, sh_degree=1)))
    lines = COMMANDS.strip()
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error::RuntimeWarning", "-c", SCRIPT]
    subprocess.run(command, cwd=folders[1], env=environment, input=lines, text=True, check=True)
    monkeypatch.chdir(folders[0])
    assert [run_command(line.split()) for line in lines.splitlines()] == [0] * len(lines.splitlines())
    made, expected = ({path.name: contents(path) for path in folder.iterdir()} for folder in folders)
    assert made == expected
    assert len(made) == 8


# --- In processes of their own ----------------------------------------------------------------------------------------

#: Kernels, and what scripts call them with.
KERNELS = """
import os, signal, sys, threading, time, warnings
import numpy as np
from sparklod_cli.system import jit
from sparklod_cli.system.jit import kernel
from sparklod_cli.system.jit import f8, i8, out
from sparklod_cli.system.threads import on_threads, threads_in_use

@kernel(i8, f8[:], out(f8[:]), ranges=True)
def fill_squares(start, stop, values, found):
    for i in range(start, stop):
        found[i] = values[i] * values[i]

def squares(values):
    found = np.empty(len(values), np.float64)
    fill_squares(len(values), values, found)
    return found

@kernel(f8[:], nogil=True)
def total(values):
    found = 0.0
    for value in values:
        found += value
    return found

@kernel(i8)
def refuse(number):
    if number > 2:
        raise ValueError("too many")
    return number

@kernel(f8[:], i8, nogil=True)
def slow(values, times):
    found = values + 1
    for _ in range(times):
        for i in range(len(values)):
            found[i] = found[i] / 3 + values[i]
    return found, values * 2

values = np.arange(20_000.0)
expected = values * values
"""

#: Fills the cache: the process that compiles.
FILL = """
assert (squares(values) == expected).all() and total(values) == values.sum() and refuse(1) == 1
slow(values, 1)
"""

#: What holds in a process that finds everything in the cache.
SCRIPTS = {
    "errors, threads and arrays that outlive modules": """
for number in (3, 4):
    try:
        refuse(number)
    except ValueError as error:
        assert str(error) == "too many"
    else:
        raise SystemExit("nothing was raised")
for arguments in [(), (1, 2)]:
    try:
        refuse(*arguments)
    except TypeError:
        continue
    raise SystemExit("nothing was raised")
right = []
def call():
    for _ in range(20):
        right.append((squares(values) == expected).all() and total(values) == values.sum())
threads = [threading.Thread(target=call) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert len(right) == 160 and all(right)
import builtins
builtins.kept = squares(values)[::2]
""",
    "a kernel is loaded once": """
from sparklod_cli.system.kernel_cache import KernelCache
load, loaded = KernelCache.load_overload, []
KernelCache.load_overload = lambda cache, *more: loaded.append(cache) or load(cache, *more)
for _ in range(3):
    assert (squares(values) == expected).all()
assert len(loaded) == 1
""",
    "a forked process": """
assert total(values) == values.sum()
warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 advises against forks
child = os.fork()
if not child:
    right = total(values) == values.sum() and (squares(values) == expected).all() and threads_in_use() == 2
    os._exit(0 if right else 1)
assert os.waitpid(child, 0)[1] == 0
""",
    "a process forked from one that used all threads": """
assert (squares(values) == expected).all()
warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 advises against forks
child = os.fork()
if not child:
    right = True
    for count in (1, 2):
        with on_threads(count):
            right &= (squares(values) == expected).all()
    thread = threading.Thread(target=lambda: seen.append((squares(values) == expected).all()))
    seen = []
    thread.start(); thread.join()
    os._exit(0 if right and seen == [True] else 1)
assert os.waitpid(child, 0)[1] == 0
assert (squares(values) == expected).all()
""",
    "an interruption while a result is returned": """
def interrupt():
    time.sleep(0.02)
    os.kill(os.getpid(), signal.SIGINT)
slow(values, 1)
for _ in range(3):
    thread = threading.Thread(target=interrupt)
    try:
        thread.start()
        slow(values, 3000)
        time.sleep(60)
    except KeyboardInterrupt:
        thread.join()
    else:
        raise SystemExit("nothing was raised")
""",
}


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the module of kernels and a cache that has them."""
    folder = tmp_path_factory.mktemp("kernels")
    (folder / "scripted.py").write_text(KERNELS)
    run(folder, FILL)
    assert len(list((folder / "cache").rglob(f"*{SUFFIX}"))) == 4
    return folder


def run(folder: Path, script: str) -> None:
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(folder / "cache"),
        "NUMBA_NUM_THREADS": "2",
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)]),
    }
    command = [sys.executable, "-c", f"from scripted import *\n{script}"]
    ways: dict[str, Any] = {"preexec_fn": heed_signals} if os.name == "posix" else {}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, **ways)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_in_a_process_that_finds_everything_in_the_cache(kernels: Path, script: str) -> None:
    run(kernels, script)
