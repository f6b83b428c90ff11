"""What is said where an optional package is missing."""

from __future__ import annotations

import re
import sys

import pytest

from sparklod_cli.support.errors import CameraPathError, SparklodError
from sparklod_cli.support.optional import optional_import


@pytest.mark.parametrize(("requirement", "typed"), [("sparklod[video]", "'sparklod[video]'"), ("pandas", "pandas")])
def test_a_missing_package_says_what_to_install(requirement: str, typed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "colorsys", None)
    said = rf"^colours are mixed by colorsys: pip install {re.escape(typed)} \(import of colorsys halted"
    with (
        pytest.raises(CameraPathError, match=said) as caught,
        optional_import("colours are mixed by colorsys", requirement, CameraPathError),
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
