"""Processes of Python import what this process imports, and nothing from the current folder."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import sparklod_cli
from sparklod_cli.commands import doctor
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.python_process import check_current_folder, module_command, program_command
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

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
    from sparklod_cli.bake.out_of_core.cluster import cluster

    with cluster(workers=1, threads=1):
        pass


def import_numba_without_forks() -> None:
    code = "import multiprocessing; multiprocessing.set_start_method('forkserver')\n"
    code += "from sparklod_cli.system import jit; jit.load_numba()"
    subprocess.run(program_command(code), check=True)


#: All that starts a process of Python, by the module that does.
STARTED: dict[str, list[Callable[[], object]]] = {
    "bake/out_of_core/cluster": [start_workers],
    "commands/doctor": [check_kernels, find_ffmpeg],
    "images/pyvista_scene": [probe_pyvista],
    "render/opengl": [probe_opengl],
    "render/open3d_backend": [start_open3d],
    "warmup": [start_warmup, import_numba_without_forks],
}


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


def test_the_package_run_as_a_module_takes_nothing_from_the_current_folder(tmp_path: Path) -> None:
    # Python itself imports a few modules before ours, such as types; `python -P -m` keeps the folder out of these, too.
    for name in ("pathlib", "typing", "json", "multiprocessing", "click", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit({name!r})")
    line = [sys.executable, "-m", "sparklod_cli", "inspect", str(ROOT / "fixtures" / "one.ply")]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


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
    shown = {"commands/completion", "commands/doctor", "system/packages"}  # its path, by which they start nothing
    assert {name for name, text in texts.items() if "sys.executable" in text} == {helper, *shown}


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
