"""The tree that tests of `sparklod render` share."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparklod_cli.cli import run
from tests.commands.render.runs import DEMO, PLAIN, SIZE, TOWN, render


@pytest.fixture(scope="package", autouse=True)
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A baked tree; from here on nothing is compiled any more, which would be said."""
    folder = tmp_path_factory.mktemp("baked")
    assert run(["build-lod", str(DEMO), "--output-dir", str(folder), "-q"]) == 0
    assert render(PLAIN, TOWN, *SIZE, "-q", "-o", folder / "warm.png") == 0
    assert render(TOWN, *SIZE, "-q", "--style", "billboards", "-o", folder / "warm2.png") == 0
    return folder / "demo-lod.spz"
