"""A file, reported on and held to what is expected of it: what `sparklod inspect` does with each of its files."""

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
    """What to look for in a file.

    Attributes:
        report: what the report has.
        expected: what the file should be.
        original: a scene of which the leaves should be the splats.
        everything: findings of all severities; without it, those of a file that is held to expectations are errors.
    """

    report: ReportSettings
    expected: Expectations | None = None
    original: Scene | None = None
    everything: bool = False

    @property
    def holds(self) -> bool:
        """Whether findings are what is asked for, rather than a report."""
        return self.everything or self.expected is not None or self.original is not None


def inspect(
    path: Path, settings: CheckSettings, *, threads: int = 1, progress: Progress = silent
) -> tuple[Report, Scene | None]:
    """The report on a file, with what falls short of expectations among its findings; and what was read of the scene.

    Args:
        path: of the file, see `report.inspect`.
        settings: what to look for.
        threads: to decode on.
        progress: is told how much is done.
    """
    found, scene = report.inspect(path, settings.report, threads=threads, progress=progress)
    if not settings.holds or found.format is None:
        return found, scene
    findings = [each for each in found.findings or [] if settings.everything or each.severity == "error"]
    if settings.expected is not None:
        findings += expectations.check(found, settings.expected)
    if settings.original is not None:
        nothing = [Finding("expect.leaves", "the file does not hold all of its splats, so they cannot be compared")]
        findings += nothing if scene is None else leaves.check(scene, settings.original)
    return dataclasses.replace(found, findings=findings), scene


def read_original(path: Path, *, threads: int = 1, progress: Progress = silent) -> Scene:
    """The scene whose splats the leaves should be.

    Raises:
        FormatError: it cannot be read; names the file.
    """
    try:
        return read_scene(path, threads=threads, progress=progress)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from None
