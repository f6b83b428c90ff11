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
from sparklod_cli.system import jit
from sparklod_cli.system.fast_math import exp2, log2
from sparklod_cli.system.jit import Type, add_values, b1, f4, f8, fields, i8, out, parameters_of, u4
from sparklod_cli.system.jit import prefetch as jit_prefetch
from sparklod_cli.system.machine_code import PACKAGE, SUFFIX, sources_of
from sparklod_cli.warmup import units
from tests.conftest import ROOT
from tests.scenes import random_splats
from tests.signals import heed_signals

#: Modules that kernels import without influence on machine code.
WITHOUT_INFLUENCE = {PACKAGE / "system" / f"{name}.py" for name in ("errors", "machine_code", "threads")}


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
        new = set().union(*map(imported, new)) - made_of - WITHOUT_INFLUENCE
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
    code = "from sparklod_cli.system.machine_code import *; " + "".join(
        f"print(digest_of(PACKAGE / 'lod/kernels/{name}.py')); " for name in names
    )
    digests = []
    for changed in (
        "model/falloff.py",
        "lod/kernels/geometry.py",
        "system/errors.py",
        "system/compiler.py",
        "README.md",
    ):
        command = [sys.executable, "-c", code]
        found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()
        digests.append(dict(zip(names, found, strict=True)))
        with (copy / changed).open("a") as file:
            file.write("# changed\n")
    changes = [{name for name in names if now[name] != before[name]} for before, now in itertools.pairwise(digests)]
    assert changes == [{"geometry", "node_rows", "cut_statistics"}, {"geometry", "node_rows"}, set(), set(names)]


@fields(f4[:, :], out(i8[:]), b1)
class Columns(NamedTuple):
    first: Any
    second: Any
    third: Any


RECORD = np.dtype([("a", "<f4"), ("b", "<i8", (3,))])


def readonly(values: Any) -> Any:
    values.flags.writeable = False
    return values


def test_arguments_become_numbers_addresses_and_lengths() -> None:
    declared = [u4, f4[:, :, :], Columns, Type(RECORD)[:], b1]
    cube, first, second, rows = np.zeros((1, 2, 3), "f4"), np.ones((4, 1), "f4"), np.zeros(5, "i8"), np.zeros(2, RECORD)
    values: list[Any] = []
    for each, argument in zip(
        declared, [7, readonly(cube), Columns(first, second, np.True_), rows, False], strict=True
    ):
        add_values(each, argument, values)
    at = [array.__array_interface__["data"][0] for array in (cube, first, second, rows)]
    assert values == [7, at[0], 1, 2, 3, at[1], 4, 1, at[2], 5, True, at[3], 2, False]
    assert len(values) == sum(len(parameters_of(each)) for each in declared)


WRONG: dict[str, tuple[Any, Any]] = {
    "type": (f4[:], np.zeros(2, "f8")),
    "byte order": (f4[:], np.zeros(2, ">f4")),
    "axes": (f4[:], np.zeros((2, 1), "f4")),
    "strides": (f4[:], np.zeros(4, "f4")[::2]),
    "order": (f4[:, :], np.zeros((2, 3), "f4").T),
    "address": (f4[:], np.frombuffer(bytes(9), np.uint8)[1:].view("f4")),
    "no array": (f4[:], [1.0, 2.0]),
    "read-only": (out(f4[:]), readonly(np.zeros(2, "f4"))),
    "read-only field": (out(Columns), Columns(np.zeros((1, 1), "f4"), readonly(np.zeros(1, "i8")), True)),
    "a fraction": (i8, 1.5),
    "an array for a number": (f4, np.zeros(2, "f4")),
}


@pytest.mark.parametrize(("declared", "argument"), WRONG.values(), ids=WRONG)
def test_arguments_of_other_types_are_refused(declared: Any, argument: Any) -> None:
    with pytest.raises(TypeError):
        add_values(declared, argument, [])


def example(declared: Any, is_out: bool = False) -> Any:
    """An argument of a declared type, with empty arrays."""
    if isinstance(declared, out):
        return example(declared.declared, is_out=True)
    if not isinstance(declared, Type):
        return declared(*(example(each, is_out) for each in declared.kernel_types))
    if not declared.axes:
        return declared.dtype.type(0)
    array = np.empty((0,) * declared.axes, declared.dtype)
    return array if is_out else readonly(array)


@jit.kernel(f4[:], out(f4[:]))
def double(values: Any, doubled: Any) -> None:
    for index in range(len(values)):
        doubled[index] = values[index] * 2


def test_read_only_arrays_are_read_by_the_same_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)
    kernel = jit.Kernel(double.py_func, double.declared)
    values, doubled = np.arange(5, dtype=np.float32), np.empty(5, np.float32)
    np.save(tmp_path / "values.npy", values)
    begun: list[str] = []
    jit.listeners.append((begun.append, lambda seconds: None, print))
    for each in (values, readonly(values.copy()), np.load(tmp_path / "values.npy", mmap_mode="r")):
        doubled[:] = 0
        kernel(each, doubled)
        assert np.array_equal(doubled, values * 2)
    jit.listeners.clear()
    assert begun == ["test_jit.double"]
    assert kernel.is_kept(0)
    with pytest.raises(TypeError, match="read-only"):
        kernel(values, readonly(doubled))


@pytest.mark.slow
@pytest.mark.parametrize("module", sorted({unit.kernel.__module__ for unit in units()}))
def test_kernels_write_to_no_array_that_they_declare_to_read(module: str) -> None:
    """Machine code could, as it takes addresses; numba refuses to compile it for arrays that are read-only."""
    for kernel, number in units():
        if kernel.__module__ == module:
            start = (numba.int64,) if kernel.ranges else ()
            types = start + tuple(numba.typeof(example(each)) for each in kernel.declared[number])
            kernel.inner_on(jit.load_compiler()).compile(types)


def test_numba_refuses_a_kernel_that_writes_to_what_it_declares_to_read() -> None:
    kernel = jit.kernel(out(f4[:]), f4[:])(double.py_func)
    with pytest.raises(numba.TypingError, match="readonly array"):
        kernel.inner_on(jit.load_compiler()).compile(tuple(map(numba.typeof, map(example, kernel.declared[0]))))


LOADS = """
import sys
sys.path.insert(0, sys.argv[1])
from sparklod_cli.system import errors, jit
try:
    jit.load_compiler()
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
    assert jit.kernel(i8, returns=i8)(outer)(1) == 2
    assert jit.kernel(f8, f8, returns=f8)(add)(1, 2.5) == 3.5
    jit.listeners.clear()
    jit.kernel(f8, f8, returns=f8)(add)(1, 2)
    assert begun == ["test_jit.outer", "test_jit.add"]
    assert len(seconds) == 2
    assert all(value > 0 for value in seconds)


def test_several_numbers_are_returned_as_a_tuple(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)

    def divided(a: int, b: int) -> tuple[int, float]:
        return a // b, np.float32(a / b)

    assert jit.kernel(i8, i8, returns=(i8, f4))(divided)(7, 2) == (3, 3.5)


@jit.kernel()
def sorted_copy(values: Any) -> Any:
    """Uses what numba has of memory: arrays, views in other shapes, and the list of a sort."""
    return np.sort(values.copy().reshape(-1)).reshape(values.shape)


def test_kernels_allocate_and_release_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)

    def fill(values: Any, times: int, found: Any) -> None:
        for _ in range(times):
            copy = sorted_copy(values)
        for i in range(len(values)):
            for k in range(values.shape[1]):
                found[i, k] = copy[i, k]

    kernel = jit.kernel(f8[:, :], i8, out(f8[:, :]))(fill)
    values = np.random.default_rng(1).random((300, 100))
    found = np.empty_like(values)
    kernel(values, 3_000, found)  # 720 MB, unless each array is released
    assert np.array_equal(found.ravel(), np.sort(values.ravel()))
    if sys.platform == "linux":
        kilobytes = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())["VmRSS"]
        kernel(values, 3_000, found)
        after = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())["VmRSS"]
        assert int(after.split()[0]) - int(kilobytes.split()[0]) < 100_000


@pytest.mark.skipif(sys.platform != "linux", reason="others promise memory that they do not have")
def test_memory_that_a_kernel_cannot_get_is_a_memory_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)

    def fill(size: int, found: Any) -> None:
        found[0] = np.full(size, 2.0)[-1]

    kernel = jit.kernel(i8, out(f8[:]))(fill)
    found = np.zeros(1)
    with pytest.raises(MemoryError):
        kernel(1 << 46, found)
    kernel(3, found)
    assert found[0] == 2


def test_an_error_in_a_kernel_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)

    def refuse(number: int) -> None:
        if number > 2:
            raise ValueError("too many")

    kernel = jit.kernel(i8)(refuse)
    kernel(2)
    with pytest.raises(RuntimeError, match="a kernel failed"):
        kernel(3)
    kernel(2)
    with pytest.raises(TypeError, match="takes 1 arguments but 2 were given"):
        kernel(1, 2)


def test_machine_code_that_would_call_python_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)

    def speak(number: int) -> None:
        print(number)

    with pytest.raises(NotImplementedError, match=r"test_jit\.speak.* needs Python"):
        jit.kernel(i8)(speak)(1)


def test_prefetch_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)
    rows = np.zeros(100, [("count", np.int64), ("share", np.float32)])
    rows["count"] = np.arange(100)

    @jit.kernel(Type(rows.dtype)[:], returns=i8)
    def total(values: Any) -> int:
        found = 0
        for index in range(len(values)):
            jit_prefetch(values, index + 16)  # beyond the end, at last
            found += values[index]["count"]
        return found

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
    with monkeypatch.context() as patched:
        patched.setattr(jit, "DISABLED", True)
        interpreted = jit.kernel(*types, ranges=True)(fill)
    for kernel in (compiled, interpreted):
        squares = np.zeros(len(values), np.float32)
        kernel(len(values) - 1, values, squares)
        assert np.array_equal(squares[:-1], values[:-1] ** 2)
        assert not squares[-1]


# --- Polynomials in place of numpy's functions ------------------------------------------------------------------------


@jit.kernel(f4[:], out(f4[:]))
def fill_exp2(values: Any, found: Any) -> None:
    for i in range(len(values)):
        found[i] = exp2(values[i])


@jit.kernel(f4[:], out(f4[:]))
def fill_log2(values: Any, found: Any) -> None:
    for i in range(len(values)):
        found[i] = log2(values[i])


def test_exp2_is_that_of_numpy_to_six_digits() -> None:
    t = -np.concatenate([np.linspace(0, 20, 20_001), np.arange(126), [1e-7, 125.999]]).astype(np.float32)
    got = np.empty(len(t), np.float32)
    fill_exp2(t, got)
    np.testing.assert_allclose(got, np.exp2(t.astype(np.float64)), rtol=5e-7)


def test_log2_is_that_of_numpy_to_six_digits_also_near_1() -> None:
    """Near 1 it must be exact relative to what little it is there: it is multiplied by up to 6,836."""
    v = np.concatenate([np.linspace(0, 1, 20_001)[1:], 1 - np.geomspace(1e-7, 0.5, 500), np.geomspace(1e-30, 1, 2_000)])
    v = v.astype(np.float32)
    got = np.empty(len(v), np.float32)
    fill_log2(v, got)
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

@kernel(f8[:], returns=f8)
def total(values):
    found = 0.0
    for value in values:
        found += value
    return found

@kernel(f8[:], i8, out(f8[:]))
def slow(values, times, found):
    found[:] = 1
    for _ in range(times):
        for i in range(len(values)):
            found[i] = found[i] / 3 + values[i]

values = np.arange(20_000.0)
expected = values * values
"""

#: Fills the cache: the process that compiles.
FILL = """
assert (squares(values) == expected).all() and total(values) == values.sum()
slow(values, 1, squares(values))
"""

#: What holds in a process that finds everything in the cache.
SCRIPTS = {
    "threads, and arrays that outlive modules": """
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
from sparklod_cli.system import machine_code
load, loaded = machine_code.load, []
machine_code.load = lambda *arguments: loaded.append(arguments) or load(*arguments)
for _ in range(3):
    assert (squares(values) == expected).all()
assert len(loaded) == 1 and "numba" not in sys.modules
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
    "an interruption while a kernel runs": """
def interrupt():
    time.sleep(0.02)
    os.kill(os.getpid(), signal.SIGINT)
found = squares(values)
slow(values, 1, found)
for _ in range(3):
    thread = threading.Thread(target=interrupt)
    try:
        thread.start()
        slow(values, 3000, found)
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
    assert len(list((folder / "cache").rglob(f"*{SUFFIX}"))) == 3
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
