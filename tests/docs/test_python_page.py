"""docs/python.md: its examples run, one after the other, and it describes all that is public."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import sparklod_cli
from tests.conftest import FIXTURES, ROOT

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")


def test_the_examples_run_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scene.ply").write_bytes((FIXTURES / "sh1.ply").read_bytes())
    (tmp_path / "path.json").write_bytes((FIXTURES / "cameras" / "sparklod.json").read_bytes())
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(block, names)
    assert (tmp_path / "scene-lod.spz").exists()
    assert {"scene", "tree", "cut", "image", "frames", "report", "table"} <= names.keys()


def test_all_that_is_public_is_described() -> None:
    assert [name for name in sparklod_cli.__all__ if not re.search(rf"\b{re.escape(name)}\b", PAGE)] == []
