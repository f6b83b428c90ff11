"""Inspects a file and checks it against expectations, as `sparklod inspect` does with each of its files."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from ..io import read_scene
from ..model.scene import Scene
from ..support.errors import FormatError
from ..support.progress import Progress, silent
from . import expectations, leaves, report
from .expectations import Expectations
from .findings import Finding
from .report import Report, ReportSettings


@dataclass(frozen=True)
class CheckSettings:
    """Settings of the checks of a file.

    Attributes:
        report: contents of the report.
        expected: expectations that the file must meet.
        original: the scene whose splats the leaves must equal.
        everything: report findings of all severities; otherwise a file with expectations has errors only.
    """

    report: ReportSettings
    expected: Expectations | None = None
    original: Scene | None = None
    everything: bool = False

    @property
    def holds(self) -> bool:
        """Whether the file is checked, rather than only reported on."""
        return self.everything or self.expected is not None or self.original is not None


def inspect(
    path: Path, settings: CheckSettings, *, threads: int = 1, progress: Progress = silent
) -> tuple[Report, Scene | None]:
    """Return the report on a file, whose findings include unmet expectations, and the scene as far as it was read.

    Args:
        path: path of the file, see `report.inspect`.
    """
    found, scene = report.inspect(path, settings.report, threads=threads, progress=progress)
    if not settings.holds or found.format is None:
        return found, scene
    findings = [each for each in found.findings or [] if settings.everything or each.severity == "error"]
    if settings.expected is not None:
        findings += expectations.check(found, settings.expected)
    if settings.original is not None:
        nothing = [Finding("expect.leaves", "the file does not contain all of its splats, so they cannot be compared")]
        findings += nothing if scene is None else leaves.check(scene, settings.original, found.rad)
    return dataclasses.replace(found, findings=findings), scene


def read_original(path: Path, *, threads: int = 1, progress: Progress = silent) -> Scene:
    """Read the scene whose splats the leaves must equal.

    Raises:
        FormatError: the file cannot be read; names it.
    """
    try:
        return read_scene(path, threads=threads, progress=progress)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from None
