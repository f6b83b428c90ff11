"""`sparklod inspect`: reports on splat files and checks them."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .command import Command
from .inspect_job import Job
from .options.common import General, common_options, overwrite_option
from .options.inspecting import Checks, Output, check_usage, inspect_options
from .paths import InputPath, keep_apart, name_outputs
from .usage import options_of

if TYPE_CHECKING:
    from ..inspection.expectations import Expectations
    from ..inspection.report import ReportSettings

EXAMPLES = """
\b
Examples:
  sparklod inspect scene-lod.spz
  sparklod inspect web/*.spz --check --format github      # exit status 3 if one is broken
  sparklod inspect scene-lod.spz --assert 'nodes<5M' --assert 'growth<=1.4' --assert 'bytes<40MB'
  sparklod inspect scene-lod.spz --check --leaves-of scene.ply
  sparklod inspect scene-lod.spz --field tree.leaves
  sparklod inspect scene-lod.spz --html report.html
  curl -s https://example.org/scene.spz | sparklod inspect -
"""


@click.command("inspect", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=InputPath(stdin=True))
@inspect_options
@overwrite_option
@functools.partial(common_options, quiet="Print only what other options ask for, and errors.")
@click.pass_context
def inspect(ctx: click.Context, /, files: tuple[Path, ...], **_: Any) -> None:
    """Report on splat files and check them.

    Reads every format that build-lod reads, and the .npz files that build-lod --encoding writes; a FILE of - is
    standard input. Without --check or an expectation, prints a report. With them, prints a line for each finding;
    the exit status is 3 if one is an error (or a warning, with --fail-on warning).

    A file that cannot be read is a finding, too, and does not stop the others.
    """
    name_outputs(ctx, files[0])
    general = options_of(ctx, General)
    checks, output = options_of(ctx, Checks), options_of(ctx, Output)
    keep_apart(ctx)
    check_usage(ctx, len(files), checks, output, as_json=general.as_json)
    with general.console() as console:
        from ..api.inspect_jobs import CheckSettings, DrawSettings
        from ..inspection.checking import read_original

        console.announce_compiling()
        drawn = DrawSettings(
            histograms=output.histogram,
            plot=output.plot,
            depth=output.plot_level,
            by=output.plot_by,
            html=output.html,
            overwrite=output.overwrite,
            chunks=output.table(),
        )
        drawn.check()
        expected = checks.expectations()
        original = None
        if checks.leaves_of is not None:
            original = read_original(checks.leaves_of, threads=general.threads, progress=console.progress)
        settings = CheckSettings(
            _report_settings(checks, output, expected, as_json=general.as_json), expected, original, checks.check
        )
        job = Job(console, general, output, settings, drawn, checks.fail_on)
        worst = max(job.inspect(file) for file in files)
        job.write_page()
    if worst:
        ctx.exit(worst)


def _report_settings(checks: Checks, output: Output, expected: Expectations | None, *, as_json: bool) -> ReportSettings:
    """What the report must have for what is printed and checked."""
    from ..inspection.report import HEADER_FIELDS, ReportSettings

    field = output.field or ""
    about = [condition.name for condition in expected.conditions()] if expected else []
    everything = (
        output.stats
        or bool(output.histogram)
        or checks.expect is not None
        or any(name.startswith("values") for name in (field, *about))
    )
    drawn = output.html is not None or output.plot is not None
    printed = not (as_json or field or checks.holds)
    return ReportSettings(
        headers_only=field.partition(".")[0] in HEADER_FIELDS
        and not (drawn or everything or checks.holds or output.chunks_out),
        values=everything or drawn or printed,
        all_quantities=everything or output.html is not None,
        check=checks.holds or field.startswith("findings"),
        chunks=output.chunks or output.chunks_out is not None or field.startswith("chunks"),
        at_once=True if drawn or output.histogram or checks.leaves_of is not None else None,
    )
