"""A shell in the folder of a test."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from .shell import Shell


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    """Return a shell in the folder of the test."""
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("there is no bash")
    return Shell(tmp_path, bash)
