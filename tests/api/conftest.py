"""A scene, its tree, and the tree as its file holds it."""

from __future__ import annotations

from pathlib import Path

import pytest

import sparklod_cli as sparklod
from tests.commands.cli import NAMED
from tests.commands.conftest import cli as cli


@pytest.fixture(scope="package")
def scene() -> sparklod.Scene:
    return sparklod.read(NAMED["demo.ply"])


@pytest.fixture(scope="package")
def tree(scene: sparklod.Scene) -> sparklod.Tree:
    return sparklod.build_lod(scene, method="quality")


@pytest.fixture(scope="package")
def file(tree: sparklod.Tree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tree as a file."""
    path = tmp_path_factory.mktemp("api") / "demo-lod.spz"
    sparklod.write(path, tree)
    return path


@pytest.fixture(scope="package")
def held(file: Path) -> sparklod.Scene:
    """The tree as its file holds it."""
    return sparklod.read(file)
