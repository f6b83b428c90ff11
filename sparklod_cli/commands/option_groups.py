"""Options of several commands: general ones, and those of tables."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..system.errors import CHECK_FAILED
from ..system.setting_fields import setting, whole
from ..system.stdio import DASH
from .command import COMMON, GENERAL, flag
from .console import Console, is_terminal
from .outputs import NamedPath, require_suffix

if TYPE_CHECKING:
    from ..tables.assertions import Assertion, Outcome
    from ..tables.columns import Column, TableOutput

#: Largest accepted number of threads.
MAX_THREADS = 256


def processors_to_use() -> int:
    """Return the default of --threads."""
    from ..system.threads import processors

    return min(processors(), MAX_THREADS)


#: Attributes of options that several commands have, see `setting`.
JSON: dict[str, Any] = {"flags": ("--json",), "heading": GENERAL}
QUIET: dict[str, Any] = {"flags": ("-q", "--quiet")}
VERBOSE: dict[str, Any] = {"flags": ("-v", "--verbose")}
OUTPUT: dict[str, Any] = {"flags": ("-o", "--output"), "heading": COMMON}
OVERWRITE: dict[str, Any] = {"help": "Replace outputs that exist.", "flags": ("-f", "--overwrite"), "heading": COMMON}
ASSERT: dict[str, Any] = {"flags": ("--assert",), "metavar": "TEXT", "multiple": True}

#: Type of a picture of a table or of a file.
PNG = NamedPath(output=True, suffixes=[".png"])

#: Help of `--up` of cameras, and its default.
UP = "Axis that is up, such as -y, or a direction x,y,z."
DEFAULT_UP = "  [default: what the files or their formats say, or -y, as training leaves scenes"

#: Help of `--json` of commands that print an object for each file.
EACH_AS_JSON = "Print one JSON object for each file on standard output."


@dataclass(frozen=True)
class General:
    """General options of the commands that read splat files."""

    HEADING: ClassVar[str] = GENERAL

    quiet: bool = flag("Print nothing but errors.", **QUIET)
    verbose: bool = flag("Print how long each stage took, and which settings were chosen.", **VERBOSE)
    threads: int = setting(
        "Number of threads to work on.", whole(1, MAX_THREADS), processors_to_use, show_default="all processors"
    )


def table_output(
    output: Path | None,
    columns: Sequence[Column],
    *,
    overwrite: bool,
    as_json: bool = False,
    flag: str = "--output",
    form: str | None = None,
) -> TableOutput:
    """Return the output of a table, in the format of --format, or else of its name; CSV without a name.

    Without an output, the table goes to standard output, but is not written (form None) with --json, or to a terminal,
    which gets the summary.
    """
    from ..tables.columns import FORMS, TableOutput

    if output is None and (as_json or is_terminal(sys.stdout)):
        return TableOutput(None, None, columns, overwrite=overwrite)
    if output is not None and form is None:
        require_suffix(flag, output, (f".{each}" for each in FORMS))
    suffix = output.suffix.lower()[1:] if output is not None else ""
    if suffix and form is None and suffix not in FORMS:
        raise click.UsageError(f"{flag} {output}: tables are written as {', '.join(f'.{form}' for form in FORMS)}")
    if suffix and form is not None:
        from ..codecs.formats import FORMATS
        from ..images.picture_files import MOVING, STILL, SUFFIXES

        of_splats = (suffix for each in FORMATS for suffix in each.suffixes)
        others = {*FORMS, *STILL, *MOVING, *SUFFIXES, "html", "npz"}
        if suffix != form and (suffix in others or f".{suffix}" in of_splats):
            raise click.UsageError(f"{flag} {output} does not end in .{form}, which --format asks for")
    form = form or suffix or next(iter(FORMS))
    return TableOutput(None if output == DASH else output, form, columns, overwrite=overwrite)


def report_outcomes(console: Console, outcomes: Sequence[Outcome], places: Iterable[str] = itertools.repeat("")) -> int:
    """Print the outcomes of assertions, each followed by its place; return the exit status."""
    for outcome, place in zip(outcomes, places):  # noqa: B905  # places may be endless
        if outcome.held:
            console.detail(f"  holds: {outcome.message()}{place}")
        else:
            console.error(f"{outcome.message()}{place}")
    return 0 if all(outcome.held for outcome in outcomes) else CHECK_FAILED


def parse_asserts(texts: Sequence[str], columns: Sequence[Column]) -> list[Assertion]:
    """Parse the values of --assert; raise a `click.UsageError` for an invalid one."""
    if not texts:
        return []
    from ..tables.assertions import BadAssertionError, parse

    try:
        return [parse(text, columns) for text in texts]
    except BadAssertionError as error:
        raise click.UsageError(f"--assert {error}") from None
