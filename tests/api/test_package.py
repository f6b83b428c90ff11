"""What importing the package brings, and what it costs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import sparklod_cli as sparklod
from tests.api.runs import DEMO


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, sparklod_cli; print(*(name for name in ('numpy', 'numba', 'click') if name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == []


def test_reading_loads_no_numba() -> None:
    code = f"import sys, sparklod_cli as s; s.read({str(DEMO)!r}); print('numba' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["False"]


def test_every_public_name_exists_and_is_typed() -> None:
    """The stub names every public name of the package."""
    for name in sparklod.__all__:
        assert getattr(sparklod, name).__name__ == name
    assert set(sparklod.__all__) <= set(dir(sparklod))
    assert sparklod.__file__ is not None
    assert (Path(sparklod.__file__).parent / "py.typed").is_file()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        sparklod.nothing  # noqa: B018


def test_functions_stay_where_modules_have_their_names() -> None:
    code = "import sparklod_cli as s; import sparklod_cli.render.render_settings; print(s.render)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.startswith("<function ")


def test_every_public_function_and_class_says_what_it_is() -> None:
    for name in sparklod.__all__:
        assert getattr(sparklod, name).__doc__, name
