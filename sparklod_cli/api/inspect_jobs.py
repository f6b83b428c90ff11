"""The whole-file jobs of `inspect`, from reading to writing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..inspection import checking
from ..inspection.checking import CheckSettings as CheckSettings
from ..io import check_writable, write_whole
from ..support.errors import SparklodError, memory_errors_translated
from ..support.parallel import on_threads
from ..support.progress import Progress, silent
from ..tables.output import TableOutput

if TYPE_CHECKING:
    from ..figures.tree_plot import Picture
    from ..inspection.html import Section
    from ..inspection.report import Report
    from ..model.scene import Scene


#: Width and height of the thumbnail on a page, pixels; the splats of the cut that it shows; and the most splats of a
#: scene without a tree that is drawn for it: more take seconds.
THUMBNAIL, THUMBNAIL_BUDGET, MOST_SPLATS = (512, 384), 200_000, 3_000_000


@dataclass(frozen=True)
class DrawSettings:
    """Outputs of an inspection besides the report: histograms, a picture, a section of the page, a table of chunks.

    Attributes:
        histograms: quantities that are drawn as text.
        plot: file of a picture.
        depth: of the nodes in the picture; None for the leaves.
        by: what its colours show, one of `PLOT_BY`.
        html: file of a page, which `write_page` writes.
        overwrite: replace files that exist.
        chunks: where the table of the chunks goes; None for nowhere.
    """

    histograms: tuple[str, ...]
    plot: Path | None
    depth: int | None
    by: str
    html: Path | None
    overwrite: bool
    chunks: TableOutput | None = None

    def check(self) -> None:
        """Raise a `SparklodError` where a file cannot be written or drawn, before anything is read."""
        if self.chunks is not None:
            self.chunks.check()
        for target in (self.plot, self.html):
            if target is not None:
                check_writable(target, overwrite=self.overwrite)
        if self.plot is not None:
            from ..figures.pyvista_scene import load_pyvista

            load_pyvista()


@dataclass(frozen=True)
class Inspected:
    """Result of an inspection.

    Attributes:
        report: on it.
        histograms: as text, by quantity; those that the file does not have are left out.
        picture: in words, and the bytes of its file; None where none was written.
        section: of the page; None where none is wanted.
        problem: why there is no picture, where one is wanted.
    """

    report: Report
    histograms: dict[str, str]
    picture: tuple[str, int] | None
    section: Section | None
    problem: str | None


def inspect_file(
    path: Path, settings: CheckSettings, drawn: DrawSettings, *, threads: int = 1, progress: Progress = silent
) -> Inspected:
    """Report on a file, check it and draw it.

    Args:
        path: of a file that is read, or of a .npz of arrays; - is standard input.

    Raises:
        OutOfMemoryError: it does not fit into memory.
        OutputError: `drawn.plot` cannot be written.
    """
    with memory_errors_translated(), on_threads(threads):
        report, scene = checking.inspect(path, settings, threads=threads, progress=progress)
        if drawn.chunks is not None and report.chunks is not None:
            drawn.chunks.write(report.chunks)
        picture, problem = _picture(report, scene, drawn)
        size = None
        if picture is not None and drawn.plot is not None:
            size = picture.description, write_whole(drawn.plot, [picture.png], overwrite=drawn.overwrite)
        section = None
        if drawn.html is not None:
            from ..inspection.html import section_of

            thumbnail = None if scene is None else _thumbnail(report, scene, threads)
            section = section_of(report, scene, picture, thumbnail)
        return Inspected(report, _histograms(scene, drawn.histograms), size, section, problem)


def _picture(report: Report, scene: Scene | None, drawn: DrawSettings) -> tuple[Picture | None, str | None]:
    """Return the picture that is wanted, or why there is none."""
    if (drawn.plot is None and drawn.html is None) or report.format is None:
        return None, None
    if scene is None:
        return None, "it does not hold all of its splats, so they cannot be drawn"
    from ..figures import tree_plot

    try:
        return tree_plot.plot(scene, by=drawn.by, depth=drawn.depth), None
    except SparklodError as error:
        return None, str(error)


def _thumbnail(report: Report, scene: Scene, threads: int) -> Picture | None:
    """Return the scene as a viewer draws it; None where it is broken, or too large to be drawn at once."""
    from ..figures.tree_plot import Picture
    from ..inspection.arrays import NO_CHILDREN
    from .cameras import orbit
    from .files import as_tree
    from .results import show
    from .views import cut, render

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
    return Picture(show(image).png, f"The scene from its front; {what}")


def _histograms(scene: Scene | None, names: Sequence[str]) -> dict[str, str]:
    if scene is None or not names:
        return {}
    from ..inspection import values
    from ..tables.histograms import as_text

    held = values.names_of(scene.splats)
    return {name: as_text(values.histogram_of(scene.splats, name)) for name in names if name in held}


def write_page(path: Path, sections: Sequence[Section], *, overwrite: bool) -> int:
    """Write the page of some files, and return its bytes."""
    from ..inspection.html import page

    return write_whole(path, [page(sections).encode()], overwrite=overwrite)
