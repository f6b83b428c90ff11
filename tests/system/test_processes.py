"""Processes: what signals do to a run, standard streams that cannot be written, and what children may import."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import sparklod_cli
from sparklod_cli import cli
from sparklod_cli.cli import run
from sparklod_cli.commands import installation as doctor
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.machine_code import SUFFIX
from sparklod_cli.system.python_process import check_current_folder, module_command, program_command
from sparklod_cli.system.stdio import write_stdout
from tests.conftest import FIXTURES, ROOT
from tests.signals import heed_signals
from tests.system.test_machine_code import is_whole

# --- Signals end a run, whatever it is doing --------------------------------------------------------------------------


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_compilation_at_once_and_leaves_a_whole_cache(
    tmp_path: Path, how: signal.Signals, again: bool
) -> None:
    cache = tmp_path / "cache"
    command = [sys.executable, "-m", "sparklod_cli", "build-lod", str(FIXTURES / "demo.ply"), "--method", "quality"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    process = subprocess.Popen(
        [*command, "-o", str(tmp_path / "tree.spz")],
        cwd=ROOT,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(how, signal.SIG_DFL),  # a shell has what it runs in the background ignore some
    )
    assert process.stderr is not None
    assert "Compiling" in process.stderr.readline()
    while not list(cache.rglob(f"*{SUFFIX}")):  # until the first of many is compiled
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(how)
    if again:
        process.send_signal(signal.SIGTERM)
    rest = process.stderr.read()
    assert process.wait() in ((130, -signal.SIGTERM) if again else (130,))  # a second one need not wait for anything
    assert rest.count("interrupted") <= 1
    assert again or rest.endswith("interrupted\n")
    assert "->" not in rest  # as of a bake that is done
    assert not (tmp_path / "tree.spz").exists()
    kept = list(cache.rglob(f"*{SUFFIX}"))
    assert len(kept) < 9  # it did not go on to the end: a bake has several times as many
    assert all(is_whole(path.read_bytes()) for path in kept)


#: A run of `inspect` whose reading is replaced by a function of a test.
SCRIPT = """
import os, signal, sys, time
from sparklod_cli import cli
from sparklod_cli.io import reading
from sparklod_cli.system import interrupts, jit
{work}
reading.open_splats = work
interrupts.handle()
sys.exit(cli.run(["inspect", "fixtures/one.ply"]))
"""

#: What imports of C modules do: a `KeyboardInterrupt` inside of them becomes an error of another kind.
SWALLOW = """
def work(*args, **kwargs):
    try:
        os.kill(os.getpid(), signal.SIGHUP)
        signal.pause()
    except KeyboardInterrupt:
        raise {error} from None
"""

#: Two signals at once: Python prints an error of the second one, whose handler the first one has reset.
TWO = """
def work(*args, **kwargs):
    signal.pthread_sigmask(signal.SIG_BLOCK, interrupts.ENDING)
    os.kill(os.getpid(), signal.SIGINT)
    os.kill(os.getpid(), signal.SIGTERM)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, interrupts.ENDING)
"""

#: A library that forgets an interruption, as some do of what an import raises; compilation comes next.
FORGET = """
def work(*args, **kwargs):
    try:
        os.kill(os.getpid(), signal.SIGHUP)
        signal.pause()
    except KeyboardInterrupt:
        jit.listeners[0][0]("kernel")
    print("went on")
"""

#: An object that is interrupted while it is deleted, where Python prints exceptions and goes on.
LOSE = """
class Deleted:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(60)

def work(*args, **kwargs):
    item = Deleted()
    del item
    time.sleep(60)
"""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("work", "said"),
    [
        (SWALLOW.format(error="ImportError('numpy')"), "interrupted"),
        (SWALLOW.format(error="OSError(5, 'of a library')"), "error: fixtures/one.ply: cannot be read: of a library"),
        (SWALLOW.format(error="KeyboardInterrupt"), "interrupted"),
        (TWO, "interrupted"),
        (FORGET, "interrupted"),
        (LOSE, "interrupted"),
    ],
    ids=["import error", "system error", "interruption", "two signals", "forgotten", "lost"],
)
def test_an_interruption_ends_the_run_whoever_catches_it(work: str, said: str) -> None:
    command = [sys.executable, "-c", SCRIPT.format(work=work)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, preexec_fn=heed_signals, check=False, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr.strip()) == (130, "", said)


# --- Standard streams -------------------------------------------------------------------------------------------------

TREE, PLAIN = FIXTURES / "golden" / "tree-v3.spz", FIXTURES / "one.ply"

PRINTING = [
    ("--help",),
    ("--version",),
    ("inspect", "--json-schema"),
    ("inspect", TREE),
    ("inspect", TREE, TREE, "--json"),
    ("inspect", TREE, "--histogram", "x"),
    ("inspect", "missing.spz", "--check"),
    ("traverse", TREE, "--look-at", "0,-1,4:0,0,0"),
    ("build-lod", "missing.ply", "--json"),
    ("build-lod", "-o", "-", PLAIN),
    ("render", TREE, "--size", "16x12", "-o", "-"),
]


def sparklod(arguments: tuple[object, ...], shell: str) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "sparklod_cli", *map(str, arguments)]
    return subprocess.run(["bash", "-c", f'"$@" {shell}', "bash", *words], capture_output=True, text=True, cwd=ROOT)


def errors(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in done.stderr.splitlines() if line.startswith("error: ") and "missing" not in line]


FULL = pytest.param(
    "> /dev/full",
    "cannot write standard output: no space left on device",
    marks=pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here"),
    id="full",
)


@pytest.mark.slow
@pytest.mark.parametrize("arguments", PRINTING, ids=lambda words: " ".join(map(str, words)))
@pytest.mark.parametrize(("shell", "said"), [pytest.param(">&-", "standard output is closed", id="closed"), FULL])
def test_standard_output_that_cannot_be_written_is_a_failure(
    arguments: tuple[object, ...], shell: str, said: str
) -> None:
    done = sparklod(arguments, shell)
    assert done.returncode == 1
    (line,) = errors(done)
    assert line.endswith(said)
    assert "Exception" not in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_work_goes_on_without_a_standard_error(tmp_path: Path) -> None:
    assert sparklod(("build-lod", PLAIN, "-o", tmp_path / "out.spz"), "2> /dev/full").returncode == 0
    assert (tmp_path / "out.spz").exists()
    assert sparklod(("build-lod", tmp_path / "missing.ply"), "2> /dev/full").returncode == 1
    assert sparklod(("build-lod", PLAIN, "--best"), "2> /dev/full").returncode == 2


@pytest.mark.slow
def test_a_reader_that_stops_early_causes_no_message() -> None:
    done = sparklod(("inspect", *[TREE] * 50), "| head -n 1")
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


@pytest.mark.slow
def test_characters_outside_the_encoding_are_escaped(tmp_path: Path) -> None:
    tree = tmp_path / "café 漢.spz"
    tree.write_bytes(TREE.read_bytes())
    done = sparklod(("inspect", tree), "").stdout
    assert "café 漢.spz  SPZ 3" in done
    words = [sys.executable, "-m", "sparklod_cli", "inspect", str(tree)]
    env = {**os.environ, "PYTHONIOENCODING": "latin-1"}
    plain = subprocess.run(words, capture_output=True, cwd=ROOT, env=env)
    assert (plain.returncode, plain.stderr) == (0, b"")
    assert "café \\u6f22.spz  SPZ 3".encode("latin-1") in plain.stdout


@pytest.mark.slow
@pytest.mark.parametrize("filename", ["/cache/kernel.nbi", None])
def test_other_system_errors_are_not_blamed_on_standard_output(
    filename: str | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device", filename)

    monkeypatch.setattr(cli.cli, "main", fails)
    assert run([]) == 1
    where = f"{filename}: " if filename else ""
    assert capsys.readouterr().err == f"error: cannot go on: {where}no space left on device\n"


@pytest.mark.slow
def test_an_error_while_making_the_output_is_not_one_of_standard_output() -> None:
    def pieces() -> list[bytes]:
        raise OSError(5, "Input/output error")

    with pytest.raises(OSError, match="Input/output error"):
        write_stdout(piece for piece in pieces())


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="a shell of POSIX")
def test_no_file_gets_the_number_of_a_closed_stream() -> None:
    code = "import os; from sparklod_cli.system import stdio; stdio.reserve(); "
    code += "os._exit(os.open(os.devnull, os.O_RDONLY))"
    for closed in ("<&-", ">&-", "2>&-", "<&- >&- 2>&-"):
        done = subprocess.run(["sh", "-c", f"{sys.executable} -c '{code}' {closed}"], cwd=ROOT, check=False)
        assert done.returncode > 2


# --- Processes of Python import nothing from the current folder -------------------------------------------------------

#: Modules of each kind that a process may import: of the package, of the standard library, and of others.
PLANTED = (
    *("sparklod_cli", "json", "runpy", "multiprocessing", "pickle", "numpy", "numba", "dask", "distributed"),
    *("moderngl", "open3d", "vtkmodules", "imageio_ffmpeg"),
)


def probe_opengl() -> None:
    pytest.importorskip("moderngl")
    from sparklod_cli.render import opengl

    opengl.probe.__wrapped__("osmesa")


def probe_pyvista() -> None:
    pytest.importorskip("pyvista")
    from sparklod_cli.images import pyvista_scene

    pyvista_scene.load_pyvista.__wrapped__()


def start_open3d() -> None:
    pytest.importorskip("open3d")
    from sparklod_cli.render import open3d_backend as backend

    backend.Child().close()


def find_ffmpeg() -> None:
    pytest.importorskip("imageio_ffmpeg")
    (check,) = doctor._ffmpeg()
    assert check.state == "ok"


def check_kernels() -> None:
    assert all(check.state != "problem" for check in doctor._kernels())


def start_warmup() -> None:
    line = module_command("sparklod_cli", "--version")
    assert (
        subprocess.run(line, capture_output=True, text=True, check=True).stdout.split()[-1] == sparklod_cli.__version__
    )


def start_workers() -> None:
    pytest.importorskip("distributed")
    from sparklod_cli.bake.cluster import cluster

    with cluster(workers=1, threads=1):
        pass


def import_numba_without_forks() -> None:
    code = "import multiprocessing; multiprocessing.set_start_method('forkserver')\n"
    code += "from sparklod_cli.system import jit; jit.load_compiler()"
    subprocess.run(program_command(code), check=True)


#: All that starts a process of Python, by the module that does.
STARTED: dict[str, list[Callable[[], object]]] = {
    "bake/cluster": [start_workers],
    "commands/installation": [check_kernels, find_ffmpeg],
    "images/pyvista_scene": [probe_pyvista],
    "render/opengl": [probe_opengl],
    "render/open3d_backend": [start_open3d],
    "warmup": [start_warmup, import_numba_without_forks],
}


@pytest.mark.slow
@pytest.mark.parametrize("start", [start for each in STARTED.values() for start in each])
def test_nothing_in_the_current_folder_is_executed(
    start: Callable[[], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in PLANTED:
        (tmp_path / name).mkdir()
        for file in ("__init__.py", "__main__.py"):
            (tmp_path / name / file).write_text(f"open({str(tmp_path / 'executed')!r}, 'a').write({name!r} + ' ')")
    monkeypatch.chdir(tmp_path)
    start()
    assert not (tmp_path / "executed").exists(), (tmp_path / "executed").read_text()


@pytest.mark.slow
def test_the_package_run_as_a_module_takes_nothing_from_the_current_folder(tmp_path: Path) -> None:
    # Python itself imports a few modules before ours, such as types; `python -P -m` keeps the folder out of these, too.
    for name in ("pathlib", "typing", "json", "multiprocessing", "click", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit({name!r})")
    line = [sys.executable, "-m", "sparklod_cli", "inspect", str(ROOT / "fixtures" / "one.ply")]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info >= (3, 11), reason="Python 3.11 has PYTHONSAFEPATH")
def test_python_3_10_refuses_a_folder_that_its_workers_would_execute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.py").touch()
    check_current_folder()
    (tmp_path / "multiprocessing.py").touch()
    with pytest.raises(SparklodError, match=r"would execute multiprocessing\.py"):
        check_current_folder()


@pytest.mark.slow
def test_every_process_of_python_is_started_in_this_way() -> None:
    package = ROOT / "sparklod_cli"
    texts = {
        path.relative_to(package).with_suffix("").as_posix(): path.read_text(encoding="utf-8")
        for path in package.rglob("*.py")
    }
    helper = "system/python_process"
    calls = re.compile(r"\b(program_command|module_command|safe_path)\(")
    users = {name for name, text in texts.items() if calls.search(text)}
    assert users - {helper, "system/jit"} == set(STARTED)
    shown = {"commands/installation", "system/machine"}  # its path, by which they start nothing
    assert {name for name, text in texts.items() if "sys.executable" in text} == {helper, *shown}


@pytest.mark.slow
def test_a_process_finds_what_this_process_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "known \udcff'" / "known"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "part.py").write_text("import sys; print(__name__, __package__, sys.argv[1:])")
    (tmp_path / "relative.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(package.parent), "", *sys.path])
    for line, output in [
        (module_command("known.part", "a", "b c"), "__main__ known ['a', 'b c']"),
        (program_command("import known.part, relative, sys; print(sys.path[1])"), f"known.part known []\n{tmp_path}"),
    ]:
        done = subprocess.run(line, capture_output=True, text=True, check=False, cwd="/")
        assert (done.returncode, done.stdout.strip(), done.stderr) == (0, output, "")
