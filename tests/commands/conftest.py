"""The runner of command lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.commands.cli import Cli


@pytest.fixture
def cli(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsysbinary: pytest.CaptureFixture[bytes]) -> Cli:
    """Runs command lines with a new folder as the current one."""
    monkeypatch.chdir(tmp_path)
    return Cli(tmp_path, capsysbinary)
