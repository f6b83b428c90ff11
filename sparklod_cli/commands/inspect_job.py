"""What `sparklod inspect` prints and draws of each of its files."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..support.errors import OutOfMemoryError, SparklodError, StdoutError, memory_told
from ..support.printable import printable
from ..support.stdin import name_of
from .console import Console, count_of, size_of
from .inspect_text import finding_line, lines

if TYPE_CHECKING:
    from ..inspection.checking import CheckSettings
    from ..inspection.html import Section
    from ..inspection.report import Report
    from ..model.scene import Scene
    from .options.common import General
    from .options.inspecting import Output


@dataclass
class Job:
    """What is done with every file, and the page that grows meanwhile."""

    console: Console
    general: General
    output: Output
    settings: CheckSettings
    fail_on: str
    sections: list[Section] = field(default_factory=list)

    def inspect(self, file: Path) -> int:
        """Prints what is asked for of a file; its exit status. One too large for memory does not stop the others."""
        try:
            with memory_told():
                return self._inspect(file)
        except OutOfMemoryError as error:
            self.console.error(f"{name_of(file)}: {error}")
            return 1

    def _inspect(self, file: Path) -> int:
        from ..inspection import checking

        start = time.perf_counter()
        report, scene = checking.inspect(
            file, self.settings, threads=self.general.threads, progress=self.console.progress
        )
        self.console.clear()
        holds, name = self.settings.holds, name_of(file)
        status = 3 if holds and checking.fails(report, self.fail_on) else 0
        if report.format is None and not holds:
            status = 1
            for found in report.findings or []:
                self.console.error(f"{name}: {found.message}")
        try:
            self._print(name, report, scene)
        except StdoutError:
            raise  # of no file
        except SparklodError as error:
            self.console.error(f"{name}: {error}")
            status = 1
        self._draw(name, report, scene)
        self.console.detail(f"  {name}: {report.format or 'not read'}, {time.perf_counter() - start:.2f} s")
        return status

    def _print(self, name: str, report: Report, scene: Scene | None) -> None:
        """What belongs on standard output of one file."""
        plain = report.as_dict()
        if self.general.as_json:
            click.echo(json.dumps(plain, allow_nan=False))
        elif self.output.field:
            if report.format is not None:
                from ..inspection.expectations import value_at

                value = value_at(plain, self.output.field)
                click.echo(printable(value) if isinstance(value, str) else json.dumps(value))
        elif self.settings.holds:
            for found in report.findings or []:
                click.echo(finding_line(name, found, self.output.style))
            if not report.findings:
                noun = "node" if report.tree is not None else "splat"
                self.console.say(f"{name}: nothing is wrong with its {count_of(report.splats or 0, noun)}")
        elif report.format is not None and not self.console.quiet:
            click.echo("\n".join(lines(name, plain)))
        if scene is not None and self.output.histogram:
            _print_histograms(scene, self.output.histogram)

    def _draw(self, name: str, report: Report, scene: Scene | None) -> None:
        """The picture, and this file's part of the page."""
        plot, html = self.output.plot, self.output.html
        if plot is None and html is None:
            return
        from ..figures import tree_plot
        from ..inspection.html import section_of
        from ..io import write_whole

        picture = None
        if scene is not None:
            try:
                picture = tree_plot.plot(scene, by=self.output.plot_by, depth=self.output.plot_level)
            except SparklodError as error:
                if plot is not None:
                    raise
                self.console.say(f"{name}: no picture on the page: {error}")
        if plot is not None and picture is not None:
            size = write_whole(plot, [picture.png], overwrite=self.output.overwrite)
            self.console.say(f"{plot}  {picture.description.partition(';')[0]}, {size_of(size)}")
        if html is not None:
            self.sections.append(section_of(report, scene, picture))

    def write_page(self) -> None:
        """Writes the page, if one is wanted."""
        target = self.output.html
        if target is None:
            return
        from ..inspection.html import page
        from ..io import write_whole

        size = write_whole(target, [page(self.sections).encode()], overwrite=self.output.overwrite)
        self.console.say(f"{target}  page of {count_of(len(self.sections), 'file')}, {size_of(size)}")


def _print_histograms(scene: Scene, names: tuple[str, ...]) -> None:
    from ..inspection import values
    from ..tables.histograms import as_text

    for name in names:
        if name not in values.names_of(scene.splats):
            continue  # SH of a degree that this file does not have
        click.echo(f"\n  {name}")
        click.echo(as_text(values.histogram_of(scene.splats, name)))
