"""What is said where an optional package is missing, and what is required, by the metadata of what is installed."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import sys
from importlib import metadata
from pathlib import Path

import pytest

from sparklod_cli.system import packages
from sparklod_cli.system.errors import CameraPathError, SparklodError, optional_import
from sparklod_cli.system.packages import Required, install_hint, pip_install, required_by
from tests.conftest import ROOT


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
    monkeypatch.setattr(packages, "_HOME", tmp_path / "site-packages")
    environment(tmp_path / "venv", monkeypatch)
    monkeypatch.setenv("PATH", str(tmp_path / "venv/bin"))
    required = [Required("numpy", "1.26", "2.0"), Required("pyvista", "0.45", None), Required("pandas", "", None)]
    monkeypatch.setattr(packages, "required_by", lambda name, extra="": iter(required))
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
    monkeypatch.setattr(packages, "required_by", lambda name, extra="": iter([Required("numpy", "1.26", "2.0")]))
    assert install_hint(options=["--force-reinstall"]) == "pip install --force-reinstall 'numpy>=1.26'"


def test_a_copy_that_is_not_installed_names_the_extra(install, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str, extra: str = "") -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", absent)
    monkeypatch.setattr(packages, "required_by", absent)
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
def test_markers_decide_what_is_required() -> None:
    assert list(required_by("sparklod")) == [
        Required("numpy", "1.26", "1.25.9"),
        Required("any-version", "", "0"),
        Required("this-python", "1.0", "1.1.dev2"),
    ]


@pytest.mark.usefixtures("installed")
def test_an_extra_requires_its_own_and_the_extras_of_those() -> None:
    source = "films[ffmpeg,other]>=2.31"
    assert list(required_by("sparklod", "video")) == [
        Required("films", "2.31", "10.0", source),
        Required("encoder", "3", None, source),
    ]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("films", ["10.0", "1.0", None])
def test_a_hint_keeps_the_extras_of_requirements(films: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without [ffmpeg], whoever follows it gets the next hint."""
    monkeypatch.setattr(packages, "_checkout", lambda: None)
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
