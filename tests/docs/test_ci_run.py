"""`.ci/run` repeats, with the extras, what the README's line skips without them."""

from __future__ import annotations

import re

from tests.conftest import ROOT

#: Tests that skip for want of something that no extra brings, and those that .ci/run starts by themselves.
OTHERS = {"tests/images/test_metrics.py", "tests/docs/test_notebook.py", "tests/docs/test_ci_run.py"}

#: How a test says that it wants a package.
WANTS = re.compile(r"pytest\.importorskip\(|def test_\w+\((?:[^)]*\W)?(?:charting|drawing)\W")


def test_with_the_extras_every_test_that_wants_one_is_run() -> None:
    named = set(re.findall(r"tests/[\w/.]+", (ROOT / ".ci" / "run").read_text()))
    assert all((ROOT / name).exists() for name in named)
    wanting = {path for path in (ROOT / "tests").rglob("*.py") if WANTS.search(path.read_text("utf-8"))}
    names = {path.relative_to(ROOT).as_posix(): path for path in wanting}
    assert "tests/figures/test_charts.py" in names and "tests/bake/out_of_core/test_cluster.py" in names
    left = {
        name
        for name, path in names.items()
        if path.name.startswith("test_") and name not in named and not any(name.startswith(f"{at}/") for at in named)
    }
    assert left <= OTHERS
