"""Options that every command has, or several have."""

from __future__ import annotations

import contextlib
import itertools
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ...system.setting_fields import setting, whole
from ...system.stdio import DASH
from ..command import COMMON, DIRECTION, flag
from ..console import Console, Verbosity, is_terminal
from ..paths import OutputPath, require_suffix

if TYPE_CHECKING:
    from ...lod.budget import Budget
    from ...tables.assertions import Outcome
    from ...tables.columns import Column, TableOutput

#: Largest accepted number of threads.
MAX_THREADS = 256


def _note_verbosity(ctx: click.Context, param: click.Parameter, value: bool) -> bool:
    verbosity = ctx.find_object(Verbosity)
    if verbosity is not None:
        verbosity.verbose = value
    return value


def processors_to_use() -> int:
    """Return the default of --threads."""
    from ...system.threads import processors

    return min(processors(), MAX_THREADS)


#: Flags of options of every command; `cli.run` reads the verbosity, too.
JSON, QUIET = ("--json",), ("-q", "--quiet")
VERBOSE: dict[str, Any] = {"flags": ("-v", "--verbose"), "callback": _note_verbosity}


@dataclass(frozen=True)
class Messages:
    """Options of every command. Commands override the fields whose help differs."""

    as_json: bool = flag("Print one JSON object on standard output.", flags=JSON)
    quiet: bool = flag("Print nothing but errors.", flags=QUIET)
    verbose: bool = flag("Print how long each stage took, and which settings were chosen.", **VERBOSE)


@dataclass(frozen=True)
class General(Messages):
    """General options of the commands that read splat files."""

    threads: int = setting(
        "Number of threads to work on.", whole(1, MAX_THREADS), processors_to_use, show_default="all processors"
    )
    as_json: bool = flag("Print one JSON object for each file on standard output.", flags=JSON)


def overwrite_flag(**attributes: Any) -> Any:
    """Return the field of `-f`, `--overwrite`."""
    return flag("Replace outputs that exist.", flags=("-f", "--overwrite"), heading=COMMON, **attributes)


def output_option(help: str, *, addresses: bool = False) -> Any:
    """Return the field of `-o`, `--output`, whose help says the default; with `addresses` as of `OutputPath`."""
    return setting(help, OutputPath(addresses=addresses), flags=("-o", "--output"), heading=COMMON)


def assert_option(help: str, **attributes: Any) -> Any:
    """Return the field of `--assert`, which can be given several times."""
    return setting(help, flags=("--assert",), metavar="TEXT", multiple=True, **attributes)


def up_option(about: str = "", besides: str = "") -> Any:
    """Return the field of `--up` of cameras.

    Args:
        about: sentence of the help on the cameras that it applies to.
        besides: phrase on another default, such as that of a camera format.
    """
    return setting(
        f"Axis that is up, such as -y, or a direction x,y,z.{about}  [default: what the files or their formats say, or"
        f" -y, as training leaves scenes{besides}]",
        DIRECTION,
        heading=COMMON,
    )


def plot_option(help: str, **attributes: Any) -> Any:
    """Return the field of `--plot`, a picture of a table or of a file."""
    return setting(help, OutputPath(suffixes=[".png"]), **attributes)


def table_form(flag: str, output: Path | None, form: str | None = None) -> str:
    """Return the format of a table, by its option or by the name of the output; CSV on standard output."""
    from ...codecs.formats import FORMATS
    from ...images.output import MOVING, STILL, SUFFIXES
    from ...tables.columns import FORMS

    suffix = output.suffix.lower() if output is not None else ""
    if output is not None and form is None:
        require_suffix(flag, output, (f".{each}" for each in FORMS))
    if not suffix:
        return form or next(iter(FORMS))
    if form is not None:
        of_splats = (suffix for each in FORMATS for suffix in each.suffixes)
        others = {*FORMS, *STILL, *MOVING, *SUFFIXES, "html", "npz"}
        if suffix[1:] != form and (suffix[1:] in others or suffix in of_splats):
            raise click.UsageError(f"{flag} {output} does not end in .{form}, which --format asks for")
        return form
    if suffix[1:] not in FORMS:
        raise click.UsageError(f"{flag} {output}: tables are written as {', '.join(f'.{form}' for form in FORMS)}")
    return suffix[1:]


def is_summary(output: Any, *, as_json: bool) -> bool:
    """Return whether the summary is printed instead of the table, which would scroll by on a terminal."""
    return output is None and not as_json and is_terminal(sys.stdout)


def table_output(
    output: Path | None, form: str | None, columns: Sequence[Column], *, overwrite: bool, as_json: bool
) -> TableOutput:
    """Return where a table goes: nowhere if --output does not name it and something else is printed."""
    from ...tables.columns import TableOutput

    nowhere = is_summary(output, as_json=as_json) or (output is None and as_json)
    form = None if nowhere else table_form("--output", output, form)
    return TableOutput(None if output == DASH else output, form, columns, overwrite=overwrite)


def report_outcomes(console: Console, outcomes: Sequence[Outcome], places: Iterable[str] = itertools.repeat("")) -> int:
    """Print the outcomes of assertions, each with where it is; return the exit status."""
    for outcome, place in zip(outcomes, places):  # noqa: B905  # places may be endless
        if outcome.held:
            console.detail(f"  holds: {outcome.message()}{place}")
        else:
            console.error(f"{outcome.message()}{place}")
    return 0 if all(outcome.held for outcome in outcomes) else 3


@contextlib.contextmanager
def assert_errors() -> Iterator[None]:
    """Turn the error that an assertion cannot be understood into a usage error that names the option."""
    from ...tables.assertions import BadAssertionError

    try:
        yield
    except BadAssertionError as error:
        raise click.UsageError(f"--assert {error}") from None


def question_budgets(console: Console, *budgets: Budget | None) -> None:
    """Print a question about each count of splats that is too small to be meant."""
    from ...lod.budget import doubt

    for budget in budgets:
        if budget is not None and (question := doubt(budget.count)):
            console.say(question)
