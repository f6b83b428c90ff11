"""Options and parameter types that commands share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from .. import __version__
from ..support.defaults import MAX_THREADS, TABLES
from ..support.parallel import processors

#: Suffixes, without a point, of what is no table, whatever format is asked for.
NO_TABLES = ("gif", "html", "ksplat", "mp4", "npy", "npz", "ply", "png", "sog", "splat", "spz", "webp")

Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass
class Verbosity:
    """Whether -v was given, for who ends a run after its command is gone; `cli.run` hands one to click."""

    verbose: bool = False


def is_given(ctx: click.Context, name: str) -> bool:
    """Whether a parameter is not what it is by default because somebody said so."""
    return ctx.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT)


def flag_of(ctx: click.Context, name: str) -> str:
    """What people type for a parameter, such as --lod-splat-scale for lod_splat_scale."""
    return next(max(param.opts, key=len) for param in ctx.command.params if param.name == name)


def refuse(ctx: click.Context, why: str, names: Iterable[str]) -> None:
    """Raises a `click.UsageError` where one of some parameters was given, which cannot be used with `why`."""
    for name in names:
        if is_given(ctx, name):
            raise click.UsageError(f"{flag_of(ctx, name)} cannot be used with {why}")


def table_form(flag: str, output: Path | None, form: str | None = None) -> str:
    """The format of a table that is asked for, or by a name; CSV where that has no suffix, or goes to standard output.

    Raises:
        click.UsageError: nothing is written by that suffix, or it promises something else than `form`.
    """
    suffix = output.suffix.lower() if output is not None else ""
    if not suffix:
        return form or TABLES[0]
    if form is not None:
        if suffix[1:] != form and suffix[1:] in (*TABLES, *NO_TABLES):
            raise click.UsageError(f"{flag} {output} does not end in .{form}, which --format asks for")
        return form
    if suffix[1:] not in TABLES:
        raise click.UsageError(f"{flag} {output}: tables are written as {', '.join(f'.{form}' for form in TABLES)}")
    return suffix[1:]


class Numbers(click.ParamType):
    """`count` finite numbers with commas between, as a tuple of floats."""

    def __init__(self, *names: str) -> None:
        self.name = ",".join(names)
        self._count = len(names)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count or not all(map(math.isfinite, numbers)):
            self.fail(f"{value!r} is not {self.name}, {self._count} numbers with commas between", param, ctx)
        return numbers

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return self.name


class Ball(Numbers):
    """x, y, z and a positive radius, as ((x, y, z), radius)."""

    def __init__(self) -> None:
        super().__init__("x", "y", "z", "radius")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        *center, radius = super().convert(value, param, ctx)
        if radius <= 0:
            self.fail(f"radius {radius:g} is not positive", param, ctx)
        return tuple(center), radius


class Real(click.FloatRange):
    """A number of a range; unlike its base it knows that NaN is in none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number: float = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail(f"{value!r} is not a number", param, ctx)
        return number


class AutoOr(click.IntRange):
    """An integer of a range, or the word auto, which becomes None."""

    name = "auto|N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return None if value == "auto" else super().convert(value, param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "auto|N"


class Quantity(click.ParamType):
    """A text such as 20Mbit that a function of the library makes a number of, or says in a `ValueError` why not."""

    def __init__(self, name: str, parse: Callable[[str], Any]) -> None:
        self.name = name
        self._parse = parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return self._parse(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return self.name


def _note_verbosity(ctx: click.Context, param: click.Parameter, value: bool) -> bool:
    verbosity = ctx.find_object(Verbosity)
    if verbosity is not None:
        verbosity.verbose = value
    return value


def verbose_option(text: str) -> Callable[[Command], Command]:
    """`-v`, with its help; whoever ends the run hears of it, too."""
    return click.option("-v", "--verbose", is_flag=True, callback=_note_verbosity, help=text)


def common_options(
    command: Command,
    *,
    json: str = "Print one JSON object a file on standard output.",
    quiet: str = "Say nothing but errors.",
) -> Command:
    """`--threads`, `--json`, `-q`, `-v`, `--version`; `json` and `quiet` are the help of theirs."""
    for option in (
        click.version_option(__version__, package_name="sparklod"),
        verbose_option("Say how long each stage took, and what was chosen."),
        click.option("-q", "--quiet", is_flag=True, help=quiet),
        click.option("--json", "as_json", is_flag=True, help=json),
        click.option(
            "--threads",
            metavar="N",
            type=click.IntRange(1, MAX_THREADS),
            default=lambda: min(processors(), MAX_THREADS),
            show_default="all",
            help="Threads to work on.",
        ),
    ):
        command = option(command)
    return command
