"""`inspect --check` finds no errors in Streamed SOG that splat-transform wrote."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

import sparklod_cli as sparklod
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES

pytestmark = pytest.mark.slow


def test_files_of_splat_transform_have_no_errors(engines_dir: Path, tmp_path: Path) -> None:
    """Two levels in several regions and chunk files, and an environment."""
    programs = engines_dir / "node_modules" / ".bin"
    environment = os.environ | {"PATH": os.pathsep.join([str(programs), os.environ.get("PATH", "")])}
    divided = ["--lod-chunk-count", "8", "--lod-chunk-extent", "4", "--lod-chunk-min", "1"]
    splats = sparklod.read(FIXTURES / "demo.ply").splats
    levels: list[Path | str] = []
    for level, step in enumerate((1, 4)):
        sparklod.write(tmp_path / f"{level}.ply", Scene(splats.take(slice(0, None, step))))
        levels += [tmp_path / f"{level}.ply", "-l", str(level)]
    around = [tmp_path / "1.ply", "-l", "-1"]
    command = [programs / "splat-transform", "-q", "-w", "-g", "cpu", *divided, *levels, *around]
    subprocess.run([*map(str, command), str(tmp_path / "lod-meta.json")], env=environment, check=True, timeout=300)
    report, _ = inspect(tmp_path, ReportSettings(check=True))
    assert report.streamed_sog is not None
    assert len(report.streamed_sog.levels) == 2
    assert report.streamed_sog.files > 2
    assert [found for found in report.findings or [] if found.severity == "error"] == []
    assert report.streamed_sog.environment is not None
