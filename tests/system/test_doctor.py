"""`sparklod doctor`, and how packages are required, found and installed."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

from sparklod_cli import warmup
from sparklod_cli.commands import installation as doctor
from sparklod_cli.commands.installation import Check, check_all
from sparklod_cli.render import opengl
from sparklod_cli.system import jit, machine
from sparklod_cli.system.errors import CameraPathError, SparklodError, optional_import
from sparklod_cli.system.machine import Required, install_hint, pip_install, required_by
from tests.conftest import ROOT

# --- Packages ---------------------------------------------------------------------------------------------------------


class Installed:
    """Distribution of which the origin is known to pip, or not."""

    def __init__(self, origin: object) -> None:
        self._origin = origin

    def read_text(self, name: str) -> str | None:
        assert name == "direct_url.json"
        return None if self._origin is None else json.dumps(self._origin)


def environment(folder: Path, monkeypatch: pytest.MonkeyPatch, *files: str) -> Path:
    """Has this interpreter seem to be that of an environment with pip and some more files; returns its folder."""
    for name in ("bin/python", "bin/pip", *files):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch(0o755)
    monkeypatch.setattr(sys, "prefix", str(folder))
    monkeypatch.setattr(sys, "executable", str(folder / "bin/python"))
    return folder


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> object:
    """Has sparklod seem to be installed from somewhere, in an active environment, with some packages missing."""
    monkeypatch.setattr(machine, "_HOME", tmp_path / "site-packages")
    environment(tmp_path / "venv", monkeypatch)
    monkeypatch.setenv("PATH", str(tmp_path / "venv/bin"))
    required = [Required("numpy", "1.26", "2.0"), Required("pyvista", "0.45", None), Required("pandas", "", None)]
    monkeypatch.setattr(machine, "required_by", lambda name, extra="": iter(required))
    return lambda origin: monkeypatch.setattr(metadata, "distribution", lambda name: Installed(origin))


def test_the_extra_of_a_checkout_is_installed_by_its_path(install, tmp_path: Path) -> None:
    checkout = tmp_path / "a folder"
    checkout.mkdir()
    (checkout / "pyproject.toml").touch()
    install({"url": checkout.as_uri(), "dir_info": {}})
    assert install_hint("render") == f"pip install '{checkout}[render]'"
    assert install_hint() == f"pip install '{checkout}'"


@pytest.mark.parametrize(
    "origin",
    [
        None,  # from an index
        {"url": "file:///nowhere/sparklod-1-py3-none-any.whl", "archive_info": {}},
        {"url": "file:///nowhere/sparklod", "dir_info": {}},  # a checkout that is gone
        {"url": "https://example.org/sparklod.git", "vcs_info": {"vcs": "git", "commit_id": "0" * 40}},
    ],
)
def test_elsewhere_the_missing_packages_are_named(install, origin: object) -> None:
    install(origin)
    assert install_hint("render") == "pip install 'pyvista>=0.45' pandas"


def test_where_no_package_is_missing_all_are_named(install, monkeypatch: pytest.MonkeyPatch) -> None:
    install(None)
    monkeypatch.setattr(machine, "required_by", lambda name, extra="": iter([Required("numpy", "1.26", "2.0")]))
    assert install_hint(options=["--force-reinstall"]) == "pip install --force-reinstall 'numpy>=1.26'"


def test_a_copy_that_is_not_installed_names_the_extra(install, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str, extra: str = "") -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", absent)
    monkeypatch.setattr(machine, "required_by", absent)
    assert "the extra render of sparklod" in install_hint("render")


def test_the_hint_of_this_checkout_names_it() -> None:
    assert shlex.split(install_hint("video"))[-2:] == ["-e", f"{ROOT}[video]"]


def test_the_pip_is_that_of_this_interpreter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = environment(tmp_path / "a venv", monkeypatch)
    monkeypatch.setenv("PATH", "/usr/bin")
    assert pip_install("pandas") == f"'{folder}/bin/pip' install pandas"
    monkeypatch.chdir(tmp_path)
    assert pip_install("pandas", options=["--upgrade"]) == "'a venv/bin/pip' install --upgrade pandas"
    monkeypatch.setenv("PATH", f"{folder}/bin:/usr/bin")
    assert pip_install("pandas>=2") == "pip install 'pandas>=2'"
    (folder / "bin/pip").unlink()
    assert pip_install("pandas") == f"'{folder}/bin/python' -m pip install pandas"


def test_without_an_environment_pip_is_a_module_of_the_interpreter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "prefix", sys.base_prefix)
    assert pip_install("pandas") == f"{sys.executable} -m pip install pandas"


def test_programs_of_uv_and_pipx_are_changed_by_these(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    uv = environment(tmp_path / "tools/sparklod", monkeypatch, "uv-receipt.toml")
    python = f"{uv}/bin/python"
    assert pip_install("a>=1", options=["--upgrade"]) == f"uv pip install --python {python} --upgrade 'a>=1'"
    environment(tmp_path / "venvs/sparklod", monkeypatch, "pipx_metadata.json")
    assert pip_install("a>=1", "b") == "pipx inject sparklod 'a>=1' b"
    assert pip_install("a>=1", options=["--upgrade"]) == "pipx runpip sparklod install --upgrade 'a>=1'"
    assert "inject sparklod" in install_hint("render")  # and not the checkout, which it could not inject


def test_an_environment_of_uv_has_no_pip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = environment(tmp_path / "venv", monkeypatch, "bin/uv")
    monkeypatch.setenv("PATH", str(folder / "bin"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert pip_install("pandas") == f"uv pip install --python {folder}/bin/python pandas"


def test_no_text_names_a_package_that_is_on_no_index() -> None:
    paths = [*(ROOT / "sparklod_cli").rglob("*.py"), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    assert not [path for path in paths if re.search(r"pip install[^.\n]* '?sparklod\b(?!_)", path.read_text())]


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        ({"extra": "video"}, install_hint("video")),
        ({"package": "pandas"}, pip_install("pandas")),
        ({"extra": "render", "package": "matplotlib"}, pip_install("matplotlib>=3.8")),
    ],
)
def test_a_missing_package_says_what_to_install(
    arguments: dict[str, str], hint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "colorsys", None)
    said = rf"^colours are mixed by colorsys: {re.escape(hint)} \(import of colorsys halted"
    with (
        pytest.raises(CameraPathError, match=said) as caught,
        optional_import("colours are mixed by colorsys", error=CameraPathError, **arguments),
    ):
        import colorsys  # noqa: F401
    assert caught.value.__suppress_context__


def test_what_is_installed_is_imported_and_other_errors_pass() -> None:
    with optional_import("colours are mixed by colorsys", "colours"):
        import colorsys
    assert colorsys.rgb_to_hsv(0, 0, 0) == (0, 0, 0)
    with pytest.raises(ZeroDivisionError), optional_import("nothing", "nothing"):
        raise ZeroDivisionError
    with pytest.raises(SparklodError), optional_import("nothing", "nothing"):
        raise ModuleNotFoundError("nothing")


LINES = {
    "sparklod": [
        "numpy>=1.26",
        "any-version",
        "old-python>=1.0; python_version < '3.0'",
        f"this-python>=1.0; python_version < '3.{sys.version_info[1] + 1}'",
        'films[ffmpeg,other]>=2.31; extra == "video"',
        'tests>=1; extra == "test"',
    ],
    "films": ["base", "encoder>=3 ; extra == 'ffmpeg'", "numpy; extra == 'all-plugins'"],
}

VERSIONS = {"numpy": "1.25.9", "any-version": "0", "this-python": "1.1.dev2", "films": "10.0"}


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name not in VERSIONS:
            raise metadata.PackageNotFoundError(name)
        return VERSIONS[name]

    monkeypatch.setattr(metadata, "requires", LINES.get)
    monkeypatch.setattr(metadata, "version", version)


@pytest.mark.usefixtures("installed")
def test_requirements_have_markers_and_extras() -> None:
    assert list(required_by("sparklod")) == [
        Required("numpy", "1.26", "1.25.9"),
        Required("any-version", "", "0"),
        Required("this-python", "1.0", "1.1.dev2"),
    ]
    source = "films[ffmpeg,other]>=2.31"
    assert list(required_by("sparklod", "video")) == [
        Required("films", "2.31", "10.0", source),
        Required("encoder", "3", None, source),
    ]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("films", ["10.0", "1.0", None])
def test_a_hint_keeps_the_extras_of_requirements(films: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without [ffmpeg], whoever follows it gets the next hint."""
    monkeypatch.setattr(machine, "_checkout", lambda: None)
    monkeypatch.setitem(VERSIONS, "films", films) if films else monkeypatch.delitem(VERSIONS, "films")
    assert shlex.split(install_hint("video"))[-1] == "films[ffmpeg,other]>=2.31"
    assert shlex.split(install_hint("video", package="films"))[-1] == "films[ffmpeg,other]>=2.31"


@pytest.mark.parametrize(
    ("least", "version", "found"),
    [
        ("1.26", "1.26", "1.26"),
        ("1.26", "1.26.4", "1.26.4"),
        ("", "0", "0"),
        ("2.9", "2.10", "2.10"),
        ("1.26", "1.25.9", "1.25.9, older than 1.26"),
        ("1.26", None, "is missing"),
    ],
)
def test_versions_compare_as_numbers(least: str, version: str | None, found: str) -> None:
    required = Required("numpy", least, version)
    assert required.state == found
    assert required.missing == (found != version)


# --- Doctor -----------------------------------------------------------------------------------------------------------

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


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("numba/__init__.py", "import os; os.abort()", "the modules of bakes cannot be imported"),
        ("numpy.py", "raise ImportError('no such processor')", "ImportError: no such processor"),
    ],
)
def test_a_package_that_does_not_import_is_a_problem_with_its_reason(
    file: str, text: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    (check,) = doctor._kernels()
    assert check.state == "problem"
    assert reason in check.value
    assert check.advice.startswith(install_hint(options=["--force-reinstall"]))


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


def test_caches_of_other_versions_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size in (("kernels-1", 3_000_000), ("kernels-2", 2_000_000), ("kernels-3", 500_000)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "one.kernel").write_bytes(bytes(size))
    answer(monkeypatch, out=json.dumps({**HEALTHY, "folder": str(tmp_path / "kernels-1")}))
    cache, old = doctor._kernels()
    assert "3.0 MB" in cache.value
    assert old.value == "2 of other versions of sparklod, 2.5 MB"
    assert str(tmp_path) in old.advice


@pytest.mark.parametrize("broken", [(), ("osmesa",), ("egl",), ("osmesa", "egl")])
def test_one_opengl_is_enough(broken: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_is_installed", lambda package: True)
    monkeypatch.setattr(opengl, "probe", lambda kind: "no library" if kind in broken else "")
    (check,) = doctor._opengl()
    assert check.state == ("note" if len(broken) == 2 else "ok")
    assert ("libosmesa6" in check.advice) == (len(broken) == 2)
    assert check.value.count("no library") == len(broken)


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


def of_kernels(**about: object) -> str:
    """What the process that counts kernels prints."""
    return f"a warning\n{json.dumps(HEALTHY | about)}\n"


@pytest.mark.parametrize(
    ("check", "code", "out", "err", "expected", "advice"),
    [
        (doctor._kernels, 0, of_kernels(), "", "ok: 35 of 35 kernels are compiled", ""),
        (doctor._kernels, 0, of_kernels(missing=3), "", "note: 32 of 35 kernels are compiled", "sparklod warmup"),
        (doctor._kernels, 0, of_kernels(folder=None), "", "note: no folder can be written to", "NUMBA_CACHE_DIR"),
        (
            doctor._kernels,
            0,
            of_kernels(distrusted=["a is not used; remove it"]),
            "",
            "problem: a is not used",
            "remove it",
        ),
        (doctor._open3d, 0, '{"array": null}\n', "", "ok: draws", ""),
        (doctor._open3d, 0, '{"error": "no Vulkan", "array": null}\n', "", "note: no Vulkan", " "),
        (doctor._open3d, -11, "", "", "note: it has crashed: ended by signal 11", " "),
        (doctor._open3d, 1, "", "a\nno device\n", "note: it has crashed: no device", " "),
        (
            doctor._ffmpeg,
            1,
            "",
            "RuntimeError: No ffmpeg exe could be found\n",
            "note: RuntimeError: No ffmpeg exe",
            " ",
        ),
    ],
)
def test_answers_of_programs_become_checks(
    check: Callable[[], Iterator[Check]],
    code: int,
    out: str,
    err: str,
    expected: str,
    advice: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(doctor, "_is_installed", lambda package: True)
    answer(monkeypatch, code, out, err)
    found = next(iter(check()))
    assert f"{found.state}: {found.value}".startswith(expected)
    assert advice in found.advice
    assert bool(advice) == bool(found.advice)


@pytest.mark.parametrize(
    ("quota", "available", "states", "advice"),
    [
        (None, 5 * 10**9, ("ok", "ok"), ""),
        (8.0, None, ("ok", "ok"), ""),
        (1.5, 10**8, ("note", "note"), "--threads 2"),
        (0.1, 10**8, ("note", "note"), "--threads 1"),
    ],
)
def test_limits_of_a_container_are_notes(
    quota: float | None,
    available: int | None,
    states: tuple[str, str],
    advice: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(doctor, "processors", lambda: 8)
    monkeypatch.setattr(machine, "processor_quota", lambda: quota)
    monkeypatch.setattr(machine, "total_memory", lambda: 8 * 10**9)
    monkeypatch.setattr(machine, "available_memory", lambda: available)
    (processors,), (memory,) = doctor._processors(), doctor._memory()
    assert (processors.state, memory.state) == states
    assert processors.advice.startswith(advice)
    assert "8.0 GB" in memory.value
