"""`sparklod inspect`: tells what is in splat files, and holds them to it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..limits import MAX_SH_DEGREE, PLOT_BY
from .console import Console, count_of
from .inspect_text import lines
from .options import Real, common_options

if TYPE_CHECKING:
    from ..inspection.expectations import Expectations
    from ..inspection.findings import Finding
    from ..inspection.report import Report, Wanted
    from ..scene import Scene

EXAMPLES = """
\b
Examples:
  sparklod inspect scene-lod.spz
  sparklod inspect web/*.spz --check --format github      # exit status 3 if one is broken
  sparklod inspect scene-lod.spz --require-lod --max-growth 1.4 --max-bytes 40000000
  sparklod inspect scene-lod.spz --check --leaves-of scene.ply
  sparklod inspect scene-lod.spz --field tree.leaves
  sparklod inspect scene-lod.spz --html report.html
"""


@click.command("inspect", epilog=EXAMPLES, context_settings={"show_default": True})
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--stats", is_flag=True, help="Statistics of all quantities, not only of the main ones.")
@click.option("--histogram", metavar="NAME", multiple=True, help="Text bars of a quantity that --stats names.")
@click.option("--field", metavar="NAME", help="Print one value of the JSON report, such as tree.leaves.")
@click.option("--check", is_flag=True, help="Look for everything that can be wrong; a line for each finding.")
@click.option(
    "--fail-on",
    type=click.Choice(["error", "warning"]),
    default="error",
    help="The least severity of a finding that makes the exit status 3.",
)
@click.option(
    "--format",
    "style",
    type=click.Choice(["text", "github"]),
    default="text",
    help="How findings are printed; github makes annotations of GitHub Actions.",
)
@click.option("--expect", metavar="FILE", type=click.Path(path_type=Path), help="Expectations as .json or .toml.")
@click.option("--max-bytes", metavar="N", type=click.IntRange(0), help="Expect a file of at most so many bytes.")
@click.option("--min-splats", metavar="N", type=click.IntRange(0), help="Expect so many splats, or leaves, at least.")
@click.option("--max-splats", metavar="N", type=click.IntRange(0), help="Expect so many splats, or leaves, at most.")
@click.option("--sh", metavar="N", type=click.IntRange(0, MAX_SH_DEGREE), help="Expect this SH degree.")
@click.option("--require-lod", is_flag=True, help="Expect a Level-of-Detail tree.")
@click.option("--max-growth", metavar="N", type=Real(1), help="Expect at most so many nodes a leaf.")
@click.option(
    "--leaves-of",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Expect the leaves to be exactly the splats of this file, within the steps of the coding.",
)
@click.option("--plot", metavar="FILE", type=click.Path(path_type=Path), help="Draw a .png, with pyvista.")
@click.option("--plot-level", metavar="N", type=click.IntRange(0), help="Draw the nodes so many edges from the root.")
@click.option("--plot-by", type=click.Choice(PLOT_BY), default=PLOT_BY[0], help="What colours mean in the picture.")
@click.option("--html", metavar="FILE", type=click.Path(path_type=Path), help="Write the reports as one page.")
@click.option("--overwrite", is_flag=True, help="Replace pictures and pages that exist.")
@common_options
@click.pass_context
def inspect(
    ctx: click.Context,
    /,
    files: tuple[Path, ...],
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **settings: Any,
) -> None:
    """Tell what is in splat files, and hold them to it.

    Reads every format that build-lod reads. Without --check a report is printed; with it, and with expectations, a line
    for each finding, and the exit status is 3 if there is one of level error (or warning, with --fail-on warning).

    A file that cannot be read is a finding, too; it does not stop the others.
    """
    if settings["plot"] is not None and len(files) > 1:
        raise click.UsageError(f"--plot takes one file, not {len(files)}")
    if settings["field"] and as_json:
        raise click.UsageError("--field and --json exclude each other")
    with Console(quiet=quiet, verbose=verbose) as console:
        from .. import jit
        from ..inspection.report import inspect as look

        jit.use_threads(settings["threads"])
        expected, wanted = _expectations(settings), _wanted(settings, as_json)
        holds = wanted.check or expected is not None or settings["leaves_of"] is not None
        worst, pages = 0, []
        for file in files:
            report, scene = look(file, wanted, threads=settings["threads"], progress=console.progress)
            report = _with_expectations(report, scene, expected, settings["leaves_of"], holds)
            console.clear()
            if report.format is None and not holds:
                console.error(f"{file}: {report.findings[0].message}" if report.findings else str(file))
                worst = max(worst, 1)
            elif holds and _fails(report.findings or [], settings["fail_on"]):
                worst = max(worst, 3)
            _print(console, report, scene, settings, as_json=as_json, holds=holds)
            if scene is not None:
                pages.append((report, scene))
    if worst:
        ctx.exit(worst)


def _expectations(settings: dict[str, Any]) -> Expectations | None:
    """Those of the file and of the options, which win; None where there are none."""
    from dataclasses import replace

    from ..inspection.expectations import Expectations, read

    names = ("max_bytes", "min_splats", "max_splats", "sh", "max_growth")
    given = {name: settings[name] for name in names if settings[name] is not None}
    if settings["require_lod"]:
        given["lod"] = True
    if settings["expect"] is None:
        return Expectations(**given) if given else None
    return replace(read(settings["expect"]), **given)


def _wanted(settings: dict[str, Any], as_json: bool) -> Wanted:
    from ..inspection.report import Wanted

    field = settings["field"] or ""
    asserting = settings["expect"] is not None or settings["leaves_of"] is not None
    everything = settings["stats"] or asserting or field.startswith("values.") or bool(settings["histogram"])
    drawn = settings["html"] is not None or settings["plot"] is not None
    person = not (as_json or field or settings["check"])
    return Wanted(
        values=everything or drawn or person,
        all_quantities=everything or settings["html"] is not None,
        check=settings["check"] or field.startswith("findings"),
    )


def _with_expectations(
    report: Report, scene: Scene | None, expected: Expectations | None, original: Path | None, holds: bool
) -> Report:
    """The report with what falls short of expectations among its findings."""
    from dataclasses import replace

    from ..inspection import expectations, leaves
    from ..io import read_scene

    if not holds or scene is None:
        return report
    findings = list(report.findings or [])
    if expected is not None:
        findings += expectations.check(report, expected)
    if original is not None:
        findings += leaves.check(scene, read_scene(original))
    return replace(report, findings=findings)


def _fails(findings: list[Finding], fail_on: str) -> bool:
    return any(found.severity in ("error", fail_on) for found in findings)


def _print(
    console: Console,
    report: Report,
    scene: Scene | None,
    settings: dict[str, Any],
    *,
    as_json: bool,
    holds: bool,
) -> None:
    """What belongs on standard output of one file."""
    plain = report.as_dict()
    if as_json:
        click.echo(json.dumps(plain, allow_nan=False))
    elif settings["field"]:
        if report.format is not None:
            from ..inspection.expectations import value_at

            value = value_at(plain, settings["field"])
            click.echo(value if isinstance(value, str) else json.dumps(value))
    elif holds:
        for found in report.findings or []:
            click.echo(_finding(report.file, found, settings["style"]))
        if not report.findings:
            console.say(f"{report.file}: nothing is wrong with its {count_of(report.splats or 0, _noun(report))}")
    elif report.format is not None:
        click.echo("\n".join(lines(plain)))
    if scene is not None and settings["histogram"] and not as_json:
        _print_histograms(scene, settings["histogram"])


def _noun(report: Report) -> str:
    return "node" if report.tree is not None else "splat"


def _finding(file: str, found: Finding, style: str) -> str:
    if style == "text":
        return f"{file}: {found.severity}: {found.code}: {found.message}"
    kind = {"note": "notice"}.get(found.severity, found.severity)
    return f"::{kind} file={_escaped(file, ':,')},title={found.code}::{_escaped(found.message)}"


def _escaped(text: str, more: str = "") -> str:
    """As workflow commands of GitHub Actions want it."""
    for mark in "%\r\n" + more:
        text = text.replace(mark, f"%{ord(mark):02X}")
    return text


def _print_histograms(scene: Scene, names: tuple[str, ...]) -> None:
    from ..inspection import values
    from ..inspection.histograms import as_text, histogram

    for name in names:
        if name not in values.names_of(scene.splats):
            raise click.UsageError(f"--histogram knows {', '.join(values.names_of(scene.splats))}, not {name}")
        click.echo(f"\n  {name}")
        click.echo(as_text(histogram(values.quantity(scene.splats, name))))
