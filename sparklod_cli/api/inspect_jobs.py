"""The whole-file jobs of `inspect`, from reading to writing."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..inspection import expectations, leaves
from ..inspection.findings import Finding
from ..inspection.report import Report, ReportSettings, inspect
from ..io import read_scene
from ..model.scene import Scene
from ..system.errors import FormatError, SparklodError, memory_errors_translated, naming
from ..system.output import check_writable, write_file
from ..system.progress import Progress
from ..system.threads import on_threads
from ..tables.assertions import Assertion
from ..tables.columns import TableOutput

if TYPE_CHECKING:
    from ..figures.tree_plot import DescribedPicture
    from ..inspection.html import FileSection


#: Width and height of the thumbnail on a page, pixels; the splats of the cut that it shows; and the most splats of a
#: scene without a tree that is drawn for it: more take seconds.
THUMBNAIL, THUMBNAIL_BUDGET, MOST_SPLATS = (512, 384), 200_000, 3_000_000


@dataclass(frozen=True)
class InspectSettings:
    """Settings of reports and checks, and of their outputs: histograms, a picture, a page, a table of chunks.

    Attributes:
        expected: assertions that must hold of a file.
        original: the scene whose splats the leaves must equal.
        everything: report findings of all severities; otherwise a file with expectations has errors only.
        histograms: quantities that are drawn as text.
        plot: file of a picture.
        depth: of the nodes in the picture; None for the leaves.
        by: what its colours show, one of `PLOT_BY`.
        html: file of a page, which `write_page` writes.
        chunks: where the table of the chunks goes; None for nowhere.
    """

    report: ReportSettings
    expected: Sequence[Assertion] | None
    original: Scene | None
    everything: bool
    histograms: tuple[str, ...]
    plot: Path | None
    depth: int | None
    by: str
    html: Path | None
    overwrite: bool
    chunks: TableOutput | None
    threads: int
    progress: Progress


def check_outputs(plot: Path | None, html: Path | None, chunks: TableOutput | None, *, overwrite: bool) -> None:
    """Raise a `SparklodError` where a file cannot be written or drawn, before anything is read."""
    if chunks is not None:
        chunks.check()
    for target in (plot, html):
        if target is not None:
            check_writable(target, overwrite=overwrite)
    if plot is not None:
        from ..figures.pyvista_scene import load_pyvista

        load_pyvista()


def read_original(path: Path, *, threads: int, progress: Progress) -> Scene:
    """Read the scene whose splats the leaves must equal; a `FormatError` names the file."""
    with naming(path, FormatError):
        return read_scene(path, threads=threads, progress=progress)


@dataclass(frozen=True)
class Inspected:
    """Result of an inspection.

    Attributes:
        histograms: as text, by quantity; only quantities that the file has.
        picture: in words, and the bytes of its file; None where none was written.
        section: of the page; None without a page.
        problem: why a requested picture is missing.
    """

    report: Report
    histograms: dict[str, str]
    picture: tuple[str, int] | None
    section: FileSection | None
    problem: str | None


def inspect_file(path: Path, settings: InspectSettings) -> Inspected:
    """Report on a file, check it and draw it.

    Args:
        path: of a file that is read, or of a .npz of arrays; - is standard input.

    Raises:
        OutOfMemoryError: it does not fit into memory.
        OutputError: `settings.plot` cannot be written.
    """
    with memory_errors_translated(), on_threads(settings.threads):
        report, scene = inspect(path, settings.report, threads=settings.threads, progress=settings.progress)
        report = _checked(report, scene, settings)
        if settings.chunks is not None and report.chunks is not None:
            settings.chunks.write(report.chunks)
        picture, problem = _picture(report, scene, settings)
        size = None
        if picture is not None and settings.plot is not None:
            size = picture.description, write_file(settings.plot, [picture.png], overwrite=settings.overwrite)
        section = None
        if settings.html is not None:
            from ..inspection.html import section_of

            thumbnail = None if scene is None else _thumbnail(report, scene, settings.threads)
            section = section_of(report, scene, picture, thumbnail)
        return Inspected(report, _histograms(scene, settings.histograms), size, section, problem)


def _checked(report: Report, scene: Scene | None, settings: InspectSettings) -> Report:
    expected, original = settings.expected, settings.original
    if report.format is None or not (settings.everything or expected is not None or original is not None):
        return report
    findings = [each for each in report.findings or [] if settings.everything or each.severity == "error"]
    if expected is not None:
        findings += expectations.check(report, expected)
    if original is not None:
        nothing = [Finding("expect.leaves", "the file does not contain all of its splats, so they cannot be compared")]
        findings += nothing if scene is None else leaves.check(scene, original, report.rad)
    return dataclasses.replace(report, findings=findings)


def _picture(
    report: Report, scene: Scene | None, settings: InspectSettings
) -> tuple[DescribedPicture | None, str | None]:
    if (settings.plot is None and settings.html is None) or report.format is None:
        return None, None
    if scene is None:
        return None, "it does not hold all of its splats, so they cannot be drawn"
    from ..figures import tree_plot

    try:
        return tree_plot.plot(scene, by=settings.by, depth=settings.depth), None
    except SparklodError as error:
        return None, str(error)


def _thumbnail(report: Report, scene: Scene, threads: int) -> DescribedPicture | None:
    """Return the scene as a viewer draws it; None where it is broken, or too large to be drawn at once."""
    from ..figures.tree_plot import DescribedPicture
    from ..inspection.report import NO_CHILDREN
    from .files import as_tree
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


def _histograms(scene: Scene | None, names: Sequence[str]) -> dict[str, str]:
    if scene is None or not names:
        return {}
    from ..inspection import values
    from ..tables.histograms import as_text

    held = values.names_of(scene.splats)
    return {name: as_text(values.histogram_of(scene.splats, name)) for name in names if name in held}


def write_page(path: Path, sections: Sequence[FileSection], *, overwrite: bool) -> int:
    """Write the page of some files, and return its bytes."""
    from ..inspection.html import page

    return write_file(path, [page(sections).encode()], overwrite=overwrite)
