"""Options that every command has, or several have."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from ... import __version__
from ...codecs.formats import FORMATS
from ...images.defaults import MOVING, STILL, SUFFIXES
from ...support.defaults import MAX_THREADS
from ...tables.files import FORMS
from ..command import COMMON, GENERAL, option, with_options
from ..console import Console, Verbosity
from ..paths import OutputPath, require_suffix

#: Suffixes, without a point, of what is no table, whatever format is asked for: splats, pictures, pages and arrays.
NO_TABLES = {suffix[1:] for form in FORMATS for suffix in form.suffixes} - {*FORMS}
NO_TABLES |= {*STILL, *MOVING, *SUFFIXES, "html", "npz"}

Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(frozen=True)
class General:
    """What `common_options` were given.

    Attributes:
        threads: to work on.
        as_json: print JSON on standard output.
        quiet, verbose: say less or more on standard error.
    """

    threads: int
    as_json: bool
    quiet: bool
    verbose: bool

    def console(self) -> Console:
        """What says as much as is wanted."""
        return Console(quiet=self.quiet, verbose=self.verbose)


def table_form(flag: str, output: Path | None, form: str | None = None) -> str:
    """The format of a table that is asked for, or by a name; CSV where it goes to standard output.

    Raises:
        click.UsageError: nothing is written by that suffix, or it promises something else than `form`, or there is
            neither.
    """
    suffix = output.suffix.lower() if output is not None else ""
    if output is not None and form is None:
        require_suffix(flag, output, (f".{each}" for each in FORMS))
    if not suffix:
        return form or next(iter(FORMS))
    if form is not None:
        if suffix[1:] != form and suffix[1:] in (*FORMS, *NO_TABLES):
            raise click.UsageError(f"{flag} {output} does not end in .{form}, which --format asks for")
        return form
    if suffix[1:] not in FORMS:
        raise click.UsageError(f"{flag} {output}: tables are written as {', '.join(f'.{form}' for form in FORMS)}")
    return suffix[1:]


def _note_verbosity(ctx: click.Context, param: click.Parameter, value: bool) -> bool:
    verbosity = ctx.find_object(Verbosity)
    if verbosity is not None:
        verbosity.verbose = value
    return value


def verbose_option(text: str) -> Callable[[Command], Command]:
    """`-v`, with its help; whoever ends the run hears of it, too."""
    return option("-v", "--verbose", heading=GENERAL, is_flag=True, callback=_note_verbosity, help=text)


def overwrite_option(command: Command) -> Command:
    """`-f`, `--overwrite`."""
    return option("-f", "--overwrite", heading=COMMON, is_flag=True, help="Replace outputs that exist.")(command)


def output_option(text: str, *, addresses: bool = False) -> Callable[[Command], Command]:
    """`-o`, `--output`, with its help, which says the default; with `addresses` as of `OutputPath`."""
    kind = OutputPath(addresses=addresses)
    return option("-o", "--output", heading=COMMON, metavar="FILE", type=kind, help=text, show_default=False)


def assert_option(text: str, heading: str = COMMON) -> Callable[[Command], Command]:
    """`--assert`, which can be given several times, with its help."""
    return option("--assert", "asserts", heading=heading, metavar="TEXT", multiple=True, help=text)


@contextlib.contextmanager
def assert_errors() -> Iterator[None]:
    """Turns the error that an assertion cannot be understood into a usage error that names the option."""
    from ...tables.assertions import BadAssertionError

    try:
        yield
    except BadAssertionError as error:
        raise click.UsageError(f"--assert {error}") from None


def plot_option(text: str, heading: str = COMMON) -> Callable[[Command], Command]:
    """`--plot`, a picture of a table or of a file, with its help."""
    return option("--plot", heading=heading, metavar="FILE", type=OutputPath(suffixes=[".png"]), help=text)


def processors_to_use() -> int:
    """What --threads is by default."""
    from ...support.parallel import processors

    return min(processors(), MAX_THREADS)


def common_options(
    command: Command,
    *,
    json: str = "Print one JSON object for each file on standard output.",
    quiet: str = "Print nothing but errors.",
    verbose: str = "Print how long each stage took, and which settings were chosen.",
) -> Command:
    """`--threads`, `--json`, `-q`, `-v`, `--version`, of which `General` has the values.

    Args:
        command: that gets them.
        json, quiet, verbose: help texts of the options of these names.
    """
    return with_options(
        command,
        option(
            "--threads",
            heading=GENERAL,
            metavar="N",
            type=click.IntRange(1, MAX_THREADS),
            default=processors_to_use,
            show_default="all processors",
            help="Number of threads to work on.",
        ),
        option("--json", "as_json", heading=GENERAL, is_flag=True, help=json),
        option("-q", "--quiet", heading=GENERAL, is_flag=True, help=quiet),
        verbose_option(verbose),
        click.version_option(__version__, package_name="sparklod"),
    )
