"""What tests of figures need, or skip without."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sparklod_cli.errors import SparklodError
from sparklod_cli.render import stage


@pytest.fixture
def charting() -> None:
    """Skips where charts cannot be drawn."""
    pytest.importorskip("matplotlib", reason="charts need the extra `render`")


@pytest.fixture
def drawing() -> None:
    """Skips where pictures cannot be drawn."""
    pytest.importorskip("pyvista", reason="pictures need the extra `render`")
    try:
        stage.load_pyvista()
    except SparklodError as error:
        pytest.skip(str(error))


@pytest.fixture
def fresh() -> Iterator[None]:
    """Makes pyvista be looked for again."""
    stage.load_pyvista.cache_clear()
    yield
    stage.load_pyvista.cache_clear()
