"""The scene that tests of `sparklod build-lod` bake."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.commands.build_lod.runs import SMALL


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    path.write_bytes(SMALL.read_bytes())
    return path
