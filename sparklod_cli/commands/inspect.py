"""`sparklod inspect`: tells what is in splat files, and holds them to it."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..support.defaults import MAX_SH_DEGREE, PLOT_BY
from ..support.units import parse_size
from .command import Command
from .console import Console
from .inspect_job import Job
from .options.common import common_options, overwrite_option
from .options.types import Quantity, Real
from .paths import InputPath, OutputPath, keep_apart
from .usage import refuse

if TYPE_CHECKING:
    from ..inspection.expectations import Expectations
    from ..inspection.report import Wanted
    from ..model.scene import Scene

#: Options that are expectations, by the names that `Expectations` has for them.
EXPECTED = ("max_bytes", "min_splats", "max_splats", "sh", "max_growth")

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


def _print_schema(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        from importlib.resources import files

        click.echo(files("sparklod_cli.inspection").joinpath("schema.json").read_text("utf-8"), nl=False)
        ctx.exit()


@click.command("inspect", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=InputPath(stdin=True))
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
@click.option("--expect", metavar="FILE", type=InputPath(), help="Expectations as .json or .toml.")
@click.option("--max-bytes", type=Quantity("SIZE", parse_size), help="Expect a file of at most so much, such as 3MB.")
@click.option("--min-splats", metavar="N", type=click.IntRange(0), help="Expect so many splats, or leaves, at least.")
@click.option("--max-splats", metavar="N", type=click.IntRange(0), help="Expect so many splats, or leaves, at most.")
@click.option("--sh", metavar="N", type=click.IntRange(0, MAX_SH_DEGREE), help="Expect this SH degree.")
@click.option("--require-lod", is_flag=True, help="Expect a Level-of-Detail tree.")
@click.option("--max-growth", metavar="N", type=Real(1), help="Expect at most so many nodes a leaf.")
@click.option(
    "--leaves-of",
    metavar="FILE",
    type=InputPath(),
    help="Expect the leaves to be exactly the splats of this file, within the steps of the coding.",
)
@click.option("--plot", metavar="FILE", type=OutputPath(suffixes=[".png"]), help="Draw a .png, with pyvista.")
@click.option("--plot-level", metavar="N", type=click.IntRange(0), help="Draw the nodes so many edges from the root.")
@click.option("--plot-by", type=click.Choice(PLOT_BY), default=PLOT_BY[0], help="What colours mean in the picture.")
@click.option(
    "--html", metavar="FILE", type=OutputPath(suffixes=[".html", ".htm"]), help="Write the reports as one HTML page."
)
@overwrite_option
@click.option(
    "--json-schema",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_schema,
    help="Print the JSON Schema of --json and exit.",
)
@functools.partial(common_options, quiet="Print what is asked for by name, and errors, but no report for a person.")
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
    With -q, only what --json, --field, --histogram, --check or an expectation asks for is printed.

    A file that cannot be read is a finding, too; it does not stop the others.
    """
    _check_usage(ctx, files, settings, as_json)
    with Console(quiet=quiet, verbose=verbose) as console:
        from ..io import check_writable
        from ..support import jit

        jit.use_threads(settings["threads"])
        console.announce_compiling("inspect")
        for target in (settings["plot"], settings["html"]):
            if target is not None:
                check_writable(target, overwrite=settings["overwrite"])
        job = Job(
            console,
            settings,
            as_json,
            _wanted(settings, as_json),
            _expectations(settings),
            _original(settings, console),
        )
        worst = max(job.inspect(file) for file in files)
        job.write_page()
    if worst:
        ctx.exit(worst)


def _check_usage(ctx: click.Context, files: tuple[Path, ...], settings: dict[str, Any], as_json: bool) -> None:
    """A usage error where options exclude each other or would do nothing, or an output would replace an input."""
    keep_apart(ctx)
    if settings["plot"] is not None and len(files) > 1:
        raise click.UsageError(f"--plot takes one file, not {len(files)}")
    if settings["field"] and as_json:
        raise click.UsageError("--field and --json exclude each other")
    for name in settings["histogram"]:
        from ..inspection.values import QUANTITIES, SH_QUANTITIES

        if name not in (*QUANTITIES, *SH_QUANTITIES):
            raise click.UsageError(f"--histogram knows {', '.join((*QUANTITIES, *SH_QUANTITIES))}, not {name}")
    if settings["histogram"] and (settings["field"] or as_json):
        raise click.UsageError("--histogram is for a person, it goes with neither --json nor --field")
    holds = settings["check"] or _asserts(settings)
    if settings["stats"] and holds and not as_json:
        what = "--check prints" if settings["check"] else "expectations print"
        raise click.UsageError(f"{what} findings; with --stats that is possible only as --json")
    if not holds:
        refuse(ctx, ("style", "fail_on"), "needs --check or an expectation")
    if settings["field"] or as_json:
        refuse(ctx, ("style",), "is of findings in lines, which neither --json nor --field prints")
    if settings["plot"] is None and settings["html"] is None:
        refuse(ctx, ("plot_level", "plot_by"), "needs --plot or --html")


def _asserts(settings: dict[str, Any]) -> bool:
    given = any(settings[name] is not None for name in (*EXPECTED, "expect", "leaves_of"))
    return given or bool(settings["require_lod"])


def _expectations(settings: dict[str, Any]) -> Expectations | None:
    """Those of the file and of the options, which win; None where there are none."""
    from ..inspection.expectations import Expectations, read

    given = {name: settings[name] for name in EXPECTED if settings[name] is not None}
    if settings["require_lod"]:
        given["lod"] = True
    if settings["expect"] is None:
        return Expectations(**given) if given else None
    return replace(read(settings["expect"]), **given)


def _wanted(settings: dict[str, Any], as_json: bool) -> Wanted:
    from ..inspection.report import Wanted

    way = settings["field"] or ""
    asserting = _asserts(settings)
    everything = (
        settings["stats"] or settings["expect"] is not None or way.startswith("values") or bool(settings["histogram"])
    )
    drawn = settings["html"] is not None or settings["plot"] is not None
    person = not (as_json or way or settings["check"] or asserting)
    return Wanted(
        values=everything or drawn or person,
        all_quantities=everything or settings["html"] is not None,
        check=settings["check"] or asserting or way.startswith("findings"),
    )


def _original(settings: dict[str, Any], console: Console) -> Scene | None:
    """The scene of --leaves-of."""
    from ..io import read_scene
    from ..support.errors import FormatError

    path = settings["leaves_of"]
    try:
        return path and read_scene(path, threads=settings["threads"], progress=console.progress)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from None
