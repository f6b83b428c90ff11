"""Reports on splat files: contents, findings, and pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..inspection import leaves
from ..inspection.findings import Finding
from ..inspection.report import NO_CHILDREN, Report, ReportSettings, check_expectations
from ..inspection.report import inspect as report_on
from ..io.reading import read_scene
from ..model.scene import Scene
from ..system.errors import FormatError, SparklodError, memory_errors_translated, naming
from ..system.output import check_writable
from ..system.progress import Progress
from ..system.threads import thread_count
from ..tables.assertions import Assertion
from .arguments import ProgressLike, progress_callback

if TYPE_CHECKING:
    from ..images.scene_plots import DescribedPicture


#: Thumbnail of a page: width and height, pixels; budget of the cut that it shows; and the largest scene without a tree,
#: splats, that it shows: larger ones take seconds.
THUMBNAIL, THUMBNAIL_BUDGET, MOST_SPLATS = (512, 384), 200_000, 3_000_000


def inspect(
    path: Path | str,
    *,
    values: bool = False,
    all_quantities: bool = False,
    check: bool = False,
    threads: int | None = None,
    progress: ProgressLike = None,
) -> Report:
    """Report the contents and faults of a file; `inspect --json` prints `Report.as_dict`.

    Args:
        path: of a splat file, or of a folder that holds an unpacked SOG.
        values: report statistics of the splats.
        all_quantities: report statistics of every quantity.
        check: search for faults. An unreadable file is a finding, not an error.
    """
    wanted = ReportSettings(values=values or all_quantities, all_quantities=all_quantities, check=check)
    with progress_callback(progress) as callback, memory_errors_translated():
        found, _ = report_on(Path(path), wanted, threads=thread_count(threads), progress=callback)
    return found


def check_outputs(plot: Path | None, html: Path | None, *, overwrite: bool) -> None:
    """Raise a `SparklodError` if a picture or a page cannot be written or drawn; called before inputs are read."""
    for target in filter(None, (plot, html)):
        check_writable(target, overwrite=overwrite)
    if plot is not None:
        from ..images.pyvista_scene import load_pyvista

        load_pyvista()


def read_original(path: Path, *, threads: int, progress: Progress) -> Scene:
    """Read the scene whose splats the leaves of a file must equal; a `FormatError` names the scene's file."""
    with naming(path, FormatError):
        return read_scene(path, threads=threads, progress=progress)


def inspect_file(
    path: Path,
    settings: ReportSettings,
    expected: Sequence[Assertion] | None,
    original: Scene | None,
    *,
    everything: bool,
    threads: int,
    progress: Progress,
) -> tuple[Report, Scene | None]:
    """Report on a file as `inspection.report.inspect` does, and check it.

    Args:
        expected: assertions on the report.
        original: scene whose splats the leaves must equal.
        everything: report findings of all severities; otherwise, with expectations, only errors.
    """
    report, scene = report_on(path, settings, threads=threads, progress=progress)
    if report.format is None or not (everything or expected is not None or original is not None):
        return report, scene
    findings = [each for each in report.findings or [] if everything or each.severity == "error"]
    if expected is not None:
        findings += check_expectations(report, expected)
    if original is not None:
        nothing = [Finding("expect.leaves", "the file does not contain all of its splats, so they cannot be compared")]
        findings += nothing if scene is None else leaves.check(scene, original, report.rad)
    return dataclasses.replace(report, findings=findings), scene


def picture_of(scene: Scene | None, by: str, depth: int | None) -> tuple[DescribedPicture | None, str | None]:
    """Draw the structure of a scene, see `scene_plots.plot`; return the picture, or why it cannot be drawn."""
    if scene is None:
        return None, "it does not hold all of its splats, so they cannot be drawn"
    from ..images import scene_plots

    try:
        return scene_plots.plot(scene, by=by, depth=depth), None
    except SparklodError as error:
        return None, str(error)


def thumbnail_of(report: Report, scene: Scene, threads: int) -> DescribedPicture | None:
    """Draw a scene as a viewer does; return None if it is broken or too large."""
    from ..images.scene_plots import DescribedPicture
    from .splat_files import as_tree
    from .views import cut, orbit, render, show

    count = len(scene.splats)
    if not count or scene.splats.invalid() or NO_CHILDREN in report.notes:
        return None
    if scene.tree is None and count > MOST_SPLATS:
        return None
    try:
        if scene.tree is not None:
            scene.tree.validate()
        viewed = as_tree(scene)
        (camera,) = orbit(viewed, count=1, size=THUMBNAIL).cameras
        drawn = viewed if scene.tree is None else cut(viewed, camera, budget=THUMBNAIL_BUDGET, threads=threads)
        image = render(drawn, camera, threads=threads)
    except SparklodError:
        return None
    what = "all splats" if scene.tree is None else f"a cut of at most {THUMBNAIL_BUDGET:,} splats"
    return DescribedPicture(show(image).png, f"The scene from its front; {what}")
