"""The doctor finds what is broken, says what to do, and never breaks down itself."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from sparklod_cli import warmup
from sparklod_cli.commands import doctor
from sparklod_cli.commands.doctor import Check, check_all
from sparklod_cli.render import opengl
from sparklod_cli.system import jit, machine
from sparklod_cli.system.packages import Required, install_hint, pip_install

HEALTHY = {"folder": "/nowhere/kernels-1", "distrusted": [], "wanted": 35, "missing": 0}


def answer(monkeypatch: pytest.MonkeyPatch, code: int = 0, out: str = "", err: str = "") -> None:
    """Every program that the doctor runs says the same."""

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[bytes]:
        return subprocess.CompletedProcess(command, code, out.encode(), err.encode())

    monkeypatch.setattr(subprocess, "run", run)


def lack(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Packages that seem not to be installed."""
    known = metadata.version

    def version(name: str) -> str:
        if name in packages:
            raise metadata.PackageNotFoundError(name)
        return known(name)

    monkeypatch.setattr(metadata, "version", version)


def test_this_installation_has_no_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    lack(monkeypatch, "moderngl", "open3d")  # which take many seconds to try
    begun: list[str] = []
    checks = check_all(begun.append)
    assert [check for check in checks if check.state == "problem"] == []
    names = {check.name for check in checks}
    assert {"sparklod", "Python", "numpy", "numba", "processors", "memory", "OpenGL", "Open3D"} <= names
    assert {"kernel cache", "extra render", "extra video", "extra parquet", "Node", "Chromium"} <= names
    extras = metadata.metadata("sparklod").get_all("Provides-Extra") or []
    assert {f"extra {extra}" for extra in extras} - names == {"extra dev", "extra docs", "extra test"}
    assert begun
    for check in checks:
        assert check.value
        assert check.state == "ok" or check.advice, check


def test_the_kernels_are_those_of_this_cache() -> None:
    (cache, *_) = doctor._kernels()
    units, missing = warmup.units(), warmup.missing()
    assert cache.value.startswith(f"{len(units) - len(missing)} of {len(units)} kernels")
    assert str(jit.CACHE_FOLDER) in cache.value


def test_a_package_that_ends_its_process_is_a_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "numba").mkdir()
    (tmp_path / "numba" / "__init__.py").write_text("import os; os.abort()")
    monkeypatch.syspath_prepend(str(tmp_path))
    (check,) = doctor._kernels()
    assert check.state == "problem"
    assert "the modules of bakes cannot be imported" in check.value
    assert check.advice.startswith(install_hint(options=["--force-reinstall"]))


def test_a_package_that_does_not_import_is_a_problem_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("raise ImportError('no such processor')")
    monkeypatch.syspath_prepend(str(tmp_path))
    (check,) = doctor._kernels()
    assert (check.state, check.value) == (
        "problem",
        "the modules of bakes cannot be imported: ImportError: no such processor",
    )


def test_missing_and_old_packages_are_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    required = [Required("numpy", "1.26", "1.20"), Required("numba", "0.60", None), Required("click", "8.1", "8.5")]
    monkeypatch.setattr(doctor, "required_by", lambda name: iter(required))
    assert list(doctor._packages()) == [
        Check("numpy", "problem", "1.20, older than 1.26", pip_install("numpy>=1.26", options=["--upgrade"])),
        Check("numba", "problem", "is missing", pip_install("numba>=0.60", options=["--upgrade"])),
        Check("click", "ok", "8.5"),
    ]


def test_a_missing_extra_is_a_note_that_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    lack(monkeypatch, "pyarrow")
    (check,) = (check for check in doctor._extras() if check.name == "extra parquet")
    assert (check.state, check.value) == ("note", "pyarrow is missing")
    assert check.advice.startswith(install_hint("parquet"))


def test_a_sparklod_that_is_not_installed_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    lack(monkeypatch, "sparklod")
    (check,) = doctor._packages()
    assert check.state == "note"
    assert list(doctor._extras()) == []


@pytest.mark.parametrize(
    ("about", "name", "state", "says", "advice"),
    [
        ({}, "kernel cache", "ok", "35 of 35 kernels are compiled", ""),
        ({"missing": 3}, "kernel cache", "note", "32 of 35 kernels are compiled", "sparklod warmup"),
        ({"folder": None}, "kernel cache", "note", "no folder can be written to", "NUMBA_CACHE_DIR"),
    ],
)
def test_the_check_of_the_cache_counts_kernels(
    about: dict[str, object], name: str, state: str, says: str, advice: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer(monkeypatch, out=f"a warning\n{json.dumps({**HEALTHY, **about})}\n")
    (check,) = (check for check in doctor._kernels() if check.name == name)
    assert check.state == state
    assert says in check.value
    assert advice in check.advice
    assert bool(advice) == bool(check.advice)


def test_caches_of_other_versions_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size in (("kernels-1", 3_000_000), ("kernels-2", 2_000_000), ("kernels-3", 500_000)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "one.kernel").write_bytes(bytes(size))
    answer(monkeypatch, out=json.dumps({**HEALTHY, "folder": str(tmp_path / "kernels-1")}))
    cache, old = doctor._kernels()
    assert "3.0 MB" in cache.value
    assert old.value == "2 of other versions of sparklod, 2.5 MB"
    assert str(tmp_path) in old.advice


def test_a_limit_of_the_container_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "processors", lambda: 8)
    cases = ((None, "ok", ""), (8.0, "ok", ""), (1.5, "note", "--threads 2"), (0.1, "note", "--threads 1"))
    for quota, state, advice in cases:
        monkeypatch.setattr(machine, "processor_quota", lambda quota=quota: quota)
        (check,) = doctor._processors()
        assert check.state == state
        assert check.advice.startswith(advice)


def test_little_memory_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "total_memory", lambda: 8 * 10**9)
    for available, state in ((5 * 10**9, "ok"), (10**8, "note"), (None, "ok")):
        monkeypatch.setattr(machine, "available_memory", lambda available=available: available)
        (check,) = doctor._memory()
        assert check.state == state
        assert "8.0 GB" in check.value


@pytest.mark.parametrize("broken", [(), ("osmesa",), ("egl",), ("osmesa", "egl")])
def test_one_opengl_is_enough(broken: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_is_installed", lambda package: True)
    monkeypatch.setattr(opengl, "probe", lambda kind: "no library" if kind in broken else "")
    (check,) = doctor._opengl()
    assert check.state == ("note" if len(broken) == 2 else "ok")
    assert ("libosmesa6" in check.advice) == (len(broken) == 2)
    assert check.value.count("no library") == len(broken)


@pytest.mark.parametrize(
    ("code", "out", "err", "state", "value"),
    [
        (0, '{"array": null}\n', "", "ok", "draws"),
        (0, '{"error": "no Vulkan", "array": null}\n', "", "note", "no Vulkan"),
        (-11, "", "", "note", "it has crashed: ended by signal 11"),
        (1, "", "a\nno device\n", "note", "it has crashed: no device"),
    ],
)
def test_answers_of_open3d_become_checks(
    code: int, out: str, err: str, state: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "_is_installed", lambda package: True)
    answer(monkeypatch, code, out, err)
    (check,) = doctor._open3d()
    assert (check.state, check.value) == (state, value)
    assert bool(check.advice) == (state == "note")


def test_an_ffmpeg_that_is_not_found_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_is_installed", lambda package: True)
    answer(monkeypatch, 1, err="RuntimeError: No ffmpeg exe could be found\n")
    (check,) = doctor._ffmpeg()
    assert (check.state, check.value) == ("note", "RuntimeError: No ffmpeg exe could be found")


def test_programs_of_the_tests_that_are_missing_or_broken_are_notes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    for check in doctor._programs():
        assert check.state == "note"
        assert "apt install" in check.advice
        assert "only sparklod's own tests" in check.advice
    program = tmp_path / "no program"
    program.write_text("nothing that can be run")
    monkeypatch.setattr(shutil, "which", lambda name: str(program))
    for check in doctor._programs():
        assert check.state == "note"
        assert "does not run" in check.value
        assert check.advice


def test_a_program_that_never_answers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PATIENCE", 0.2)
    code, _, err = doctor._run([sys.executable, "-c", "import time; time.sleep(60)"])
    assert (code, err) == (1, "no answer within 0.2 seconds")


def test_an_unexpected_error_in_a_check_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    answer(monkeypatch, out="no JSON")
    lack(monkeypatch, "moderngl", "open3d")

    def fail() -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(machine, "total_memory", fail)
    checks = {check.name: check for check in check_all()}
    assert checks["memory"].value == "cannot be checked (ZeroDivisionError: by zero)"
    assert checks["kernels"].state == "problem"
    assert "Chromium" in checks


def test_a_cache_that_others_can_write_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    about = HEALTHY | {"distrusted": ["compiled code in /nowhere is not used; remove it"]}
    answer(monkeypatch, out=json.dumps(about))
    check = next(iter(doctor._kernels()))
    assert (check.state, check.value, check.advice) == ("problem", "compiled code in /nowhere is not used", "remove it")
