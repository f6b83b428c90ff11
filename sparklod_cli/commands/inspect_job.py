"""What `sparklod inspect` prints of each of its files."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..support.errors import OutOfMemoryError, SparklodError, StdoutError
from ..support.printable import printable
from ..support.stdin import name_of
from .console import Console, count_of, size_of
from .inspect_text import finding_line, lines

if TYPE_CHECKING:
    from ..api.inspect_jobs import DrawSettings, Inspected
    from ..inspection.checking import CheckSettings
    from ..inspection.html import Section
    from ..inspection.report import Report
    from .options.common import General
    from .options.inspecting import Output


@dataclass
class Job:
    """What is done with every file, and the page that grows meanwhile."""

    console: Console
    general: General
    output: Output
    settings: CheckSettings
    drawn: DrawSettings
    fail_on: str
    sections: list[Section] = field(default_factory=list)

    def inspect(self, file: Path) -> int:
        """Prints what is asked for of a file; its exit status. One too large for memory does not stop the others."""
        from ..api.inspect_jobs import inspect_file

        start, name = time.perf_counter(), name_of(file)
        try:
            found = inspect_file(
                file, self.settings, self.drawn, threads=self.general.threads, progress=self.console.progress
            )
        except OutOfMemoryError as error:
            self.console.error(f"{name}: {error}")
            return 1
        self.console.clear()
        status = self._report(name, found)
        if found.section is not None:
            self.sections.append(found.section)
        self.console.detail(f"  {name}: {found.report.format or 'not read'}, {time.perf_counter() - start:.2f} s")
        return status

    def _report(self, name: str, found: Inspected) -> int:
        """Prints and says what came of a file; the exit status."""
        report, holds = found.report, self.settings.holds
        status = 3 if holds and report.fails(self.fail_on) else 0
        if report.format is None and not holds:
            status = 1
            for finding in report.findings or []:
                self.console.error(f"{name}: {finding.message}")
        try:
            self._print(name, report)
        except StdoutError:
            raise  # of no file
        except SparklodError as error:
            self.console.error(f"{name}: {error}")
            status = 1
        if report.format is not None and self.settings.report.chunks:
            status = max(status, self._print_chunks(name, report))
        for quantity, text in found.histograms.items():
            click.echo(f"\n  {quantity}\n{text}")
        if found.picture is not None:
            description, size = found.picture
            self.console.say(f"{self.drawn.plot}  {description.partition(';')[0]}, {size_of(size)}")
        elif found.problem is not None and self.drawn.plot is not None:
            self.console.error(f"{name}: {found.problem}")
            status = max(status, 1)
        elif found.problem is not None:
            self.console.say(f"{name}: no picture on the page: {found.problem}")
        return status

    def _print_chunks(self, name: str, report: Report) -> int:
        """Prints the table of the chunks, or says where it is; the exit status."""
        from ..inspection.chunks import lines as lines_of_chunks

        if report.chunks is None:
            self.console.error(f"{name}: its chunks cannot be told, for it does not hold all of its splats")
            return 1
        if self.output.chunks and not self.general.as_json:
            click.echo("\n".join(lines_of_chunks(report.chunks)))
        if self.drawn.chunks is not None:
            self.console.say(f"{self.drawn.chunks.path}  table of {count_of(len(report.chunks), 'chunk')}")
        return 0

    def _print(self, name: str, report: Report) -> None:
        """What belongs on standard output of one file."""
        plain = report.as_dict()
        if self.general.as_json:
            click.echo(json.dumps(plain, allow_nan=False))
        elif self.output.field:
            if report.format is not None:
                value = report.value_at(self.output.field)
                click.echo(printable(value) if isinstance(value, str) else json.dumps(value))
        elif self.settings.holds:
            for found in report.findings or []:
                click.echo(finding_line(name, found, self.output.style))
            if not report.findings:
                noun = "node" if report.tree is not None else "splat"
                self.console.say(f"{name}: nothing is wrong with its {count_of(report.splats or 0, noun)}")
        elif report.format is not None and not self.console.quiet:
            click.echo("\n".join(lines(name, plain)))

    def write_page(self) -> None:
        """Writes the page, if one is wanted."""
        if self.drawn.html is None:
            return
        from ..api.inspect_jobs import write_page

        size = write_page(self.drawn.html, self.sections, overwrite=self.drawn.overwrite)
        self.console.say(f"{self.drawn.html}  page of {count_of(len(self.sections), 'file')}, {size_of(size)}")
