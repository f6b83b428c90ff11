"""The trees that tests of `sparklod traverse` share."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparklod_cli.cli import run
from tests.commands.traverse.runs import ORBIT, TOWN, TREE, traverse
from tests.conftest import FIXTURES


@pytest.fixture(scope="package", autouse=True)
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two baked trees; from here on nothing is compiled any more, which would be said."""
    folder = tmp_path_factory.mktemp("baked")
    sources = [str(FIXTURES / name) for name in ("demo.ply", "sh3.ply")]
    assert run(["build-lod", *sources, "--output-dir", str(folder), "-q"]) == 0
    settings = ("--budget", "2k", "--per-instance", "--indices-out", folder / "cuts", "-o", folder / "out.csv", "-q")
    assert traverse(TOWN, TREE, *ORBIT, *settings) == 0
    return folder
