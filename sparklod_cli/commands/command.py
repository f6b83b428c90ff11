"""Commands with headings in `--help`, and their options as fields of dataclasses."""

from __future__ import annotations

import functools
import inspect
import itertools
import math
import os
import re
import string
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from .. import __version__
from ..system.setting_fields import MOST_WHOLE, Quantity, Range, Setting, setting, settings_in
from .console import Verbosity
from .rules import check

#: Headings of several commands: options that most users need, and options of every command.
COMMON, GENERAL = "Common options", "General"

#: Most options of a command whose `--help` lists all; paragraphs and examples in the `--help` of others.
MOST_LISTED, FEW_PARAGRAPHS, FEW_EXAMPLES = 12, 2, 5

#: Options that print help.
HELP = {"--help", "--help-all"}

#: Columns of the longest option with its help beside it instead of below.
TERM_WIDTH = 24

#: Units that may follow a number after a blank by mistake.
UNIT = re.compile(r"%|[kmgt]i?b?|ms|s|[kmg]bit(?:/s)?", re.IGNORECASE)

#: The parameter of the output, and parameters that replace it.
OUTPUT, NO_OUTPUT = "output", ("output_dir", "scene")

#: Other parameters of outputs, and the suffixes of these.
OTHER_OUTPUTS = {"html": (".html", ".htm"), "export": ("",)}

#: Suffixes that inputs and outputs of build-lod and simplify may share.
TREES = (".spz", ".rad")


class Option(click.Option):
    """Option that is listed under a heading of `--help`.

    Attributes:
        bare: value of the option alone, which takes another one only after "="; None for other options.
    """

    declared: Setting
    heading: str
    bare: str | None


class _Formatter(click.HelpFormatter):
    """Formatter of help that breaks lines at blanks only, never inside --an-option."""

    #: Hyphen at which no line is broken, in place of "-" until the text is complete.
    HYPHEN = "\u2011"

    def write_text(self, text: str) -> None:
        super().write_text(text.replace("-", self.HYPHEN))

    def write_dl(self, rows: Iterable[tuple[str, str]], *arguments: Any, **attributes: Any) -> None:
        super().write_dl([(term, text.replace("-", self.HYPHEN)) for term, text in rows], *arguments, **attributes)

    def getvalue(self) -> str:
        return super().getvalue().replace(self.HYPHEN, "-")


class Command(click.Command):
    """A command whose help lists options under headings, and ends with examples.

    With many options, `--help` lists those under `COMMON`, in a sentence each, and `--help-all` lists all.

    Args:
        options: dataclass whose fields, and those of its groups, are the options, see `setting`; `--version` follows.
        examples: command lines, the most useful ones first.
        headings: the first headings, in order; others follow in the order of their first options, `GENERAL` last.
        replaced: options of earlier versions and their replacements.
    """

    def __init__(
        self,
        *arguments: Any,
        options: type[Any] | None = None,
        examples: str = "",
        headings: Sequence[str] = (COMMON,),
        replaced: Mapping[str, str] | None = None,
        **attributes: Any,
    ) -> None:
        super().__init__(*arguments, **attributes)
        self.replaced = replaced or {}
        if options is not None:
            self.context_settings["show_default"] = True
            self.params += _parameters(options, GENERAL)
            click.version_option(__version__, package_name="sparklod")(self)
        self.examples = examples.splitlines()
        self.headings = headings
        self.abridged = len(self.params) > MOST_LISTED
        how: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False, "callback": _print_help_all}
        text = "Print the help of all options, and more examples."
        self.params.append(click.Option(["--help-all"], help=text, hidden=not self.abridged, **how))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        options = [param for param in self.params if isinstance(param, Option) and param.bare is not None]
        bare = {name: f"{name}={param.bare}" for param in options for name in param.opts}
        end = args.index("--") if "--" in args else len(args)
        for before, unit in itertools.pairwise(args[:end]):
            number = re.fullmatch(r"(?:-{1,2}[\w-]+=)?([0-9]+(?:\.[0-9]*)?)", before)
            if number and UNIT.fullmatch(unit) and not os.path.exists(unit):  # noqa: PTH110  # an input, otherwise
                raise click.UsageError(f"{before} {unit} has a blank before its unit; write {before}{unit}", ctx)
        try:
            rest = super().parse_args(ctx, [*(bare.get(arg, arg) for arg in args[:end]), *args[end:]])
        except click.MissingParameter as error:
            if error.param is None or error.param.name != OUTPUT:
                raise
            refuse_output_among_inputs(ctx, missing=True)
            raise
        if not ctx.resilient_parsing:
            refuse_output_among_inputs(ctx)
            check(ctx)
        verbosity = ctx.find_object(Verbosity)
        if verbosity is not None:
            verbosity.verbose = ctx.params.get("verbose", False)
        return rest

    def by_heading(self, ctx: click.Context, *, whole: bool = True) -> dict[str, list[click.Parameter]]:
        """Return the options by heading, both in order: all, or only the common ones and those that print help."""
        params = [param for param in self.get_params(ctx) if isinstance(param, click.Option) and not param.hidden]
        if not whole:
            params = [each for each in params if HELP & {*each.opts} or getattr(each, "heading", "") == COMMON]
        listed: dict[str, list[click.Parameter]] = {heading: [] for heading in self.headings}
        last: list[click.Parameter] = []
        for param in params:
            heading = getattr(param, "heading", GENERAL)
            (last if heading == GENERAL else listed.setdefault(heading, [])).append(param)
        return {heading: params for heading, params in (*listed.items(), (GENERAL, last)) if params}

    def get_help(self, ctx: click.Context, *, whole: bool = False) -> str:
        whole = whole or not self.abridged
        formatter = _Formatter(width=ctx.terminal_width, max_width=ctx.max_content_width)
        self.format_usage(ctx, formatter)
        paragraphs = inspect.cleandoc(self.help or "").split("\n\n")
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_text("\n\n".join(paragraphs if whole else paragraphs[:FEW_PARAGRAPHS]))
        for heading, params in self.by_heading(ctx, whole=whole).items():
            rows = [record for param in params if (record := param.get_help_record(ctx))]
            with formatter.section(heading):
                formatter.write_dl(rows if whole else [(term, _brief(text)) for term, text in rows], col_max=TERM_WIDTH)
        if self.examples:
            with formatter.section("Examples"):
                formatter.write("".join(f"{line}\n" for line in self.examples[: None if whole else FEW_EXAMPLES]))
        return formatter.getvalue().rstrip("\n")


def _brief(text: str) -> str:
    """Return the first sentence of an option's help, and its default up to a semicolon."""
    about, _, default = text.partition("  [")
    sentence = about.split(". ")[0].rstrip(".") + "."
    return f"{sentence}  [{re.split('[];]', default)[0]}]" if default else sentence


def _print_help_all(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        assert isinstance(ctx.command, Command)
        click.echo(ctx.command.get_help(ctx, whole=True))
        ctx.exit()


def refuse_output_among_inputs(ctx: click.Context, *, missing: bool = False) -> None:
    """Raise a `click.UsageError` if the last input was probably meant as the output, as in `cp IN OUT`.

    Such an input does not exist, or is a .spz or .rad that follows one file of another format.
    """
    *others, last = ctx.params.get("inputs") or ctx.params.get("files") or (None,)
    if not others or not isinstance(last, Path):
        return
    error = "{} does not exist; did you mean {} {}?"
    if last.exists():
        is_tree = last.suffix.lower() in TREES and len(others) == 1 and others[0].suffix.lower() not in TREES
        if ctx.command.name != "build-lod" or not is_tree:
            return
        error = "{} exists, so it is an input; did you mean {} {}? To bake both files, give --output-dir"
    import shlex  # needed after a mistake only

    for name, suffixes in OTHER_OUTPUTS.items():
        if name in ctx.params and not ctx.params[name] and last.suffix.lower() in suffixes:
            raise click.UsageError(error.format(last, f"--{name}", shlex.quote(str(last))), ctx)
    if (not missing and OUTPUT not in ctx.params) or any(ctx.params.get(name) for name in (OUTPUT, *NO_OUTPUT)):
        return
    if not last.suffix:
        return
    alike = {other.suffix.lower() for other in others if other.suffix} - set(TREES if "inputs" in ctx.params else ())
    if last.suffix.lower() in alike and not missing:
        return  # a second input whose name is wrong
    raise click.UsageError(error.format(last, "-o", shlex.quote(str(last))), ctx)


Options = TypeVar("Options")


#: Make fields that are options without a value, and options under `COMMON`, see `setting`.
flag = functools.partial(setting, default=False)
common = functools.partial(setting, heading=COMMON)


def _parameters(group: type[Any], heading: str) -> Iterator[click.Parameter]:
    """Yield the parameters of a group, under its class attribute `HEADING`, or else the heading of its outer group."""
    heading = getattr(group, "HEADING", heading)
    for field, declared in settings_in(group):
        if declared is None:
            yield from _parameters(field.default_factory, heading)  # type: ignore[arg-type]
            continue
        name, attributes, kind = declared.name or field.name, dict(declared.attributes), declared.kind
        if attributes.pop("argument", False):
            yield click.Argument([name], type=kind, **attributes)
            continue
        flags = attributes.pop("flags", None) or (f"--{name.replace('_', '-')}",)
        own_heading, bare = attributes.pop("heading", heading), attributes.pop("bare", None)
        if field.default is False:
            attributes["is_flag"] = True
        else:
            attributes.setdefault("metavar", getattr(kind, "unit", None))
            if isinstance(kind, Quantity):
                kind = Text()
            elif isinstance(kind, tuple):
                kind = (click.Choice if isinstance(kind[0], str) else Choice)(list(map(str, kind)))
            elif isinstance(kind, Range):
                least, most = (kind.least, kind.above), (kind.most, kind.below)
                low, high = (next((end for end in ends if end is not None), None) for ends in (least, most))
                base: type[Any] = Whole if kind.whole else Real
                kind = base(low, high, min_open=kind.above is not None, max_open=kind.below is not None)
            attributes["type"] = kind
        if "[default" in declared.help:
            attributes["show_default"] = False
        if not attributes.get("required"):  # click 8.3 and later take a default of None for a value
            attributes["default"] = () if attributes.get("multiple") else field.default
        option = Option([*flags, name], help=declared.help, **attributes)
        option.declared, option.heading, option.bare = declared, own_heading, bare
        yield option


def values_of(ctx: click.Context, kind: type[Options]) -> Options:
    """Return a group of options with the values given on the command line."""
    values: dict[str, Any] = {}
    for field, declared in settings_in(kind):
        if declared is None:
            values[field.name] = values_of(ctx, field.default_factory)  # type: ignore[arg-type]
        else:
            values[field.name] = ctx.params[declared.name or field.name]
    try:
        return kind(**values)
    except ValueError as error:
        raise click.UsageError(str(error)) from None


COLORS: dict[str, tuple[float, ...] | None] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}

#: Pixels along a side of a picture, and digits of no more than a few times that.
MAX_SIDE, DIGITS = 1 << 16, 6


class _Number(click.ParamType):
    """Number in a range that, unlike click's, fits into arrays and is not NaN."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if isinstance(number, int) and abs(number) > MOST_WHOLE:
            self.fail(f"a number of {len(str(abs(number)))} digits is too large", param, ctx)
        if number != number:
            self.fail(f"{value!r} is not a number", param, ctx)
        return number


class Whole(_Number, click.IntRange):
    """Integer in a range."""


class Real(_Number, click.FloatRange):
    """Number in a range."""


class Choice(click.Choice):
    """Choice among the values of a `Setting` that are not strings."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        text = super().convert(str(value), param, ctx)
        assert isinstance(param, Option)
        return next(each for each in param.declared.kind if str(each) == text)


class Text(click.ParamType):
    """Text that is parsed by the `Quantity` of a `Setting`."""

    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        assert isinstance(param, Option)
        quantity = param.declared.kind
        try:
            parsed = quantity.parse(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)
        try:
            if parsed is not None and quantity.range is not None and abs(parsed) <= MOST_WHOLE:  # or the settings fail
                quantity.range.check("", parsed)
        except ValueError:
            self.fail(f"{value!r} is out of range; give {quantity.range}", param, ctx)
        return parsed


def _numbers(text: str, names: str = "x,y,z") -> tuple[float, ...]:
    """Parse finite numbers with commas between, as many as there are names."""
    count = names.count(",") + 1
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{text!r} is not {names}, {count} numbers with commas between")
    return numbers


def _direction(text: str) -> tuple[float, ...]:
    """Parse a direction: the name of an axis, such as -y, or x,y,z."""
    if text.removeprefix("-") not in ("x", "y", "z"):
        numbers = _numbers(text)
        if not any(numbers):
            raise ValueError(f"{text} is no direction; give another one")
        return numbers
    return tuple((-1.0 if text[0] == "-" else 1.0) if name == text[-1] else 0.0 for name in "xyz")


def _ball(text: str) -> tuple[tuple[float, ...], float]:
    *center, radius = _numbers(text, "x,y,z,radius")
    if radius <= 0:
        raise ValueError(f"radius {radius:g} is not positive")
    return tuple(center), radius


def _color(text: str) -> tuple[float, ...] | None:
    """Parse a colour as (red, green, blue), 0..1; None for transparent."""
    if text.lower() in COLORS:
        return COLORS[text.lower()]
    digits = text[1:]
    if not text.startswith("#") or len(digits) not in (3, 6) or set(digits) - set(string.hexdigits):
        raise ValueError(f"{text!r} is not a colour: '#rrggbb', {', '.join(COLORS)}")
    if len(digits) == 3:
        digits = "".join(2 * digit for digit in digits)
    return tuple(byte / 255 for byte in bytes.fromhex(digits))


def _view(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    eye, colon, target = text.partition(":")
    if not colon:
        raise ValueError(f"{text!r} is not EYE:TARGET, x,y,z:x,y,z, such as 0,1,5:0,0,0")
    view = _numbers(eye), _numbers(target)
    if view[0] == view[1]:
        raise ValueError(f"{text!r} looks at its own eye; give a target elsewhere")
    return view


def _views(text: str) -> tuple[Any, ...]:
    views = tuple(map(_view, text.replace(";", " ").split()))
    if len(views) < 2:
        raise ValueError(f"{text!r} has fewer than two keyframes, EYE:TARGET EYE:TARGET")
    return views


def _size(text: str) -> tuple[int, int]:
    sides = [side.lstrip("0") for side in text.lower().split("x")]
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() for side in sides):
        raise ValueError(f"{text!r} is not a width and a height in pixels, such as 1280x720")
    if any(len(side) > DIGITS or int(side) > MAX_SIDE for side in sides):
        raise ValueError(f"{text!r} is too large; give at most {MAX_SIDE:,} pixels along a side, such as 1280x720")
    return int(sides[0]), int(sides[1])


POINT, DIRECTION, BALL = (
    Quantity("x,y,z", _numbers),
    Quantity("AXIS|x,y,z", _direction),
    Quantity("x,y,z,radius", _ball),
)
COLOR, SIZE = Quantity("COLOR", _color), Quantity("WxH", _size)
VIEW, VIEWS = Quantity("EYE:TARGET", _view), Quantity("'EYE:TARGET ...'", _views)
