"""The files in fixtures/ are what its script makes, small, and listed."""

from __future__ import annotations

import subprocess
import sys

from tests.conftest import FIXTURES

SCRIPT = FIXTURES / "make_fixtures.py"


def test_fixtures_are_what_the_script_makes() -> None:
    done = subprocess.run([sys.executable, SCRIPT, "--check"], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "all as they should be\n", "")


def test_fixtures_are_small_and_listed_in_the_table() -> None:
    files = [path for path in FIXTURES.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc", ".md")]
    assert len(files) > 20
    assert sum(path.stat().st_size for path in files) < 3e6
    assert (FIXTURES / "demo.ply").stat().st_size < 1.6e6
    table = (FIXTURES / "README.md").read_text()
    for path in files:
        assert f"`{path.relative_to(FIXTURES).as_posix()}`" in table, path
