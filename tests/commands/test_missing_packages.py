"""A package that an output needs is looked for before anything is read: the inputs here do not even exist."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.figures.pyvista_scene import load_pyvista
from tests.conftest import Capture


@pytest.mark.parametrize(
    ("package", "command"),
    [
        ("matplotlib", ["traverse", "missing.spz", "--plot", "x.png"]),
        ("matplotlib", ["render", "missing.spz", "--compare", "--plot", "x.png"]),
        ("pyvista", ["inspect", "missing.spz", "--plot", "x.png"]),
        ("pyarrow", ["traverse", "missing.spz", "-o", "x.parquet"]),
        ("pyarrow", ["render", "missing.spz", "--compare", "-o", "x.parquet"]),
        ("pyarrow", ["inspect", "missing.spz", "--chunks-out", "x.parquet"]),
    ],
)
def test_a_missing_package_is_reported_before_the_work(
    package: str,
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    load_pyvista.cache_clear()
    assert run(command) == 1
    err = capsys.readouterr().err
    assert f" by {package}: " in err
    assert "missing.spz" not in err
    assert not any(tmp_path.iterdir())
