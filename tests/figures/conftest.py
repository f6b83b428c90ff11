"""What tests of figures need, or skip without."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sparklod_cli.figures import pyvista_scene
from sparklod_cli.system.errors import SparklodError


@pytest.fixture
def charting() -> None:
    """Skips where charts cannot be drawn."""
    pytest.importorskip("matplotlib", reason="charts need the extra `render`")


@pytest.fixture
def drawing() -> None:
    """Skips where pictures cannot be drawn."""
    pytest.importorskip("pyvista", reason="pictures need the extra `render`")
    try:
        pyvista_scene.load_pyvista()
    except SparklodError as error:
        pytest.skip(str(error))


@pytest.fixture
def fresh() -> Iterator[None]:
    """Makes pyvista be looked for again."""
    pyvista_scene.load_pyvista.cache_clear()
    yield
    pyvista_scene.load_pyvista.cache_clear()
