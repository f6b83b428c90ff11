"""`.ci/run` runs, with the extras, what the README's line leaves out."""

from __future__ import annotations

import re
from pathlib import Path

from tests.conftest import ROOT

#: How a test says that it wants a package.
WANTS = re.compile(r"pytest\.importorskip\(|def test_\w+\((?:[^)]*\W)?(?:charting|drawing)\W")


def test_tests_that_want_an_extra_are_slow_ones_which_ci_runs() -> None:
    assert re.search("-m pytest .*-m slow$", (ROOT / ".ci" / "run").read_text("utf-8"), re.MULTILINE)
    paths = [path for path in (ROOT / "tests").rglob("test_*.py") if path != Path(__file__)]
    texts = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in paths}
    wanting = {name: text for name, text in texts.items() if WANTS.search(text)}
    assert "tests/images/test_figures.py" in wanting
    assert [name for name, text in wanting.items() if "pytest.mark.slow" not in text] == []
