"""What `sparklod inspect` does with each of its files."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..support.errors import OutOfMemoryError, SparklodError, StdoutError, memory_told
from ..support.printable import printable
from .console import Console, count_of, size_of
from .inspect_text import finding_line, lines

if TYPE_CHECKING:
    from ..inspection.expectations import Expectations
    from ..inspection.findings import Finding
    from ..inspection.html import Section
    from ..inspection.report import Report, Wanted
    from ..model.scene import Scene


@dataclass
class Job:
    """What is to be done with every file, and the page that grows meanwhile."""

    console: Console
    settings: dict[str, Any]
    as_json: bool
    wanted: Wanted
    expected: Expectations | None
    original: Scene | None
    sections: list[Section] = field(default_factory=list)

    @property
    def holds(self) -> bool:
        """Whether findings are what is asked for."""
        return bool(self.settings["check"]) or self.expected is not None or self.original is not None

    def inspect(self, file: Path) -> int:
        """Looks at a file and says what is asked for; its exit status. One too large for memory stops no others."""
        try:
            with memory_told():
                return self._inspect(file)
        except OutOfMemoryError as error:
            self.console.error(f"{file}: {error}")
            return 1

    def _inspect(self, file: Path) -> int:
        from ..inspection import report as reports

        start = time.perf_counter()
        report, scene = reports.inspect(
            file, self.wanted, threads=self.settings["threads"], progress=self.console.progress
        )
        if self.holds and scene is not None:
            report = self._held_to_expectations(report, scene)
        self.console.clear()
        status = 3 if self.holds and _fails(report.findings or [], self.settings["fail_on"]) else 0
        if report.format is None and not self.holds:
            status = 1
            for found in report.findings or []:
                self.console.error(f"{file}: {found.message}")
        try:
            self._print(report, scene)
        except StdoutError:
            raise  # of no file
        except SparklodError as error:
            self.console.error(f"{file}: {error}")
            status = 1
        self._draw(report, scene)
        self.console.detail(f"  {file}: {report.format or 'not read'}, {time.perf_counter() - start:.2f} s")
        return status

    def _held_to_expectations(self, report: Report, scene: Scene) -> Report:
        """The report with what falls short of expectations among its findings.

        An expectation implies that nothing is wrong; of what else is found only --check asks.
        """
        from ..inspection import expectations, leaves

        everything = self.settings["check"]
        findings = [found for found in report.findings or [] if everything or found.severity == "error"]
        if self.expected is not None:
            findings += expectations.check(report, self.expected)
        if self.original is not None:
            findings += leaves.check(scene, self.original)
        return replace(report, findings=findings)

    def _print(self, report: Report, scene: Scene | None) -> None:
        """What belongs on standard output of one file."""
        plain = report.as_dict()
        if self.as_json:
            click.echo(json.dumps(plain, allow_nan=False))
        elif self.settings["field"]:
            if report.format is not None:
                from ..inspection.expectations import value_at

                value = value_at(plain, self.settings["field"])
                click.echo(printable(value) if isinstance(value, str) else json.dumps(value))
        elif self.holds:
            for found in report.findings or []:
                click.echo(finding_line(report.file, found, self.settings["style"]))
            if not report.findings:
                noun = "node" if report.tree is not None else "splat"
                self.console.say(f"{report.file}: nothing is wrong with its {count_of(report.splats or 0, noun)}")
        elif report.format is not None and not self.console.quiet:
            click.echo("\n".join(lines(plain)))
        if scene is not None and self.settings["histogram"]:
            _print_histograms(scene, self.settings["histogram"])

    def _draw(self, report: Report, scene: Scene | None) -> None:
        """The picture, and this file's part of the page."""
        plot, html = self.settings["plot"], self.settings["html"]
        if plot is None and html is None:
            return
        from ..figures import tree_plot as plots
        from ..inspection import html as pages
        from ..inspection import values
        from ..io import write_whole

        picture = None
        if scene is not None:
            try:
                picture = plots.plot(scene, by=self.settings["plot_by"], depth=self.settings["plot_level"])
            except SparklodError as error:
                if plot is not None:
                    raise
                self.console.say(f"{report.file}: no picture on the page: {error}")
        if plot is not None and picture is not None:
            size = write_whole(plot, [picture.png], overwrite=self.settings["overwrite"])
            self.console.say(f"{plot}  {picture.description.partition(';')[0]}, {size_of(size)}")
        if html is not None:
            drawn = {}
            if scene is not None and len(scene.splats):
                names = values.names_of(scene.splats)
                drawn = {name: values.histogram_of(scene.splats, name) for name in names}
            self.sections.append(pages.Section(report.as_dict(), picture, drawn))

    def write_page(self) -> None:
        """Writes the page, if one is wanted."""
        if self.settings["html"] is None:
            return
        from ..inspection.html import page
        from ..io import write_whole

        target, content = self.settings["html"], page(self.sections).encode()
        size = write_whole(target, [content], overwrite=self.settings["overwrite"])
        self.console.say(f"{target}  page of {count_of(len(self.sections), 'file')}, {size_of(size)}")


def _fails(findings: list[Finding], fail_on: str) -> bool:
    return any(found.severity in ("error", fail_on) for found in findings)


def _print_histograms(scene: Scene, names: tuple[str, ...]) -> None:
    from ..inspection import values
    from ..tables.histograms import as_text

    for name in names:
        if name not in values.names_of(scene.splats):
            continue  # SH of a degree that this file has not
        click.echo(f"\n  {name}")
        click.echo(as_text(values.histogram_of(scene.splats, name)))
