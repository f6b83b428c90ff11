"""Options of commands, declared as fields of dataclasses, whose values they become; and which go together."""

from __future__ import annotations

import math
import string
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import click

from .. import __version__
from ..system.setting_fields import MOST_WHOLE, Quantity, Range, setting, settings_in
from .command import COMMON as COMMON
from .command import GENERAL, Command, Option

Group = TypeVar("Group")


def option(help: str, kind: Any = None, default: Any = None, **attributes: Any) -> Any:
    """Return a field that is an option, see `setting`; `flags` replaces the flag, `heading` the group's."""
    return setting(default, help, kind, **attributes)


def flag(help: str, **attributes: Any) -> Any:
    """Return a field that is an option without a value."""
    return setting(False, help, **attributes)


def argument(kind: click.ParamType, **attributes: Any) -> Any:
    """Return a field that holds the arguments which are no options."""
    return setting((), "", kind, argument=True, nargs=-1, **attributes)


def command(
    name: str, options: type[Any], *, examples: str, headings: Sequence[str] = (COMMON,)
) -> Callable[[Callable[..., None]], click.Command]:
    """Return the decorator that makes a command of a function of the context.

    The options are those of a group and of the groups in it, and `--version`; `headings` are as for `Command`.
    """

    def decorate(function: Callable[..., None]) -> click.Command:
        decorated = click.version_option(__version__, package_name="sparklod")(click.pass_context(function))
        for decorator in reversed(list(_options(options, GENERAL))):
            decorated = decorator(decorated)
        how: dict[str, Any] = {"headings": headings, "examples": examples, "context_settings": {"show_default": True}}
        return click.command(name, cls=Command, **how)(decorated)

    return decorate


def _options(kind: type[Any], heading: str) -> Iterator[Callable[[Any], Any]]:
    """Yield the decorators of a group; its heading is its class attribute `HEADING`, or that of the group around it."""
    heading = getattr(kind, "HEADING", heading)
    for field, declared in settings_in(kind):
        if declared is None:
            yield from _options(field.default_factory, heading)  # type: ignore[arg-type]
            continue
        name, attributes = declared.name or field.name, dict(declared.attributes)
        if attributes.pop("argument", False):
            yield click.argument(name, type=declared.kind, **attributes)
            continue
        flags = attributes.pop("flags", None) or (f"--{name.replace('_', '-')}",)
        attributes.setdefault("heading", heading)
        if field.default is False:
            attributes["is_flag"] = True
        else:
            unit = getattr(declared.kind, "unit", None)
            attributes = {"type": click_type(declared.kind), "metavar": unit} | attributes
        if "[default" in declared.help:
            attributes["show_default"] = False
        if not attributes.get("required"):  # click 8.3 and later take a default of None for a value
            attributes["default"] = () if attributes.get("multiple") else field.default
        yield click.option(*flags, name, cls=Option, declared=declared, help=declared.help, **attributes)


def values_of(ctx: click.Context, kind: type[Group]) -> Group:
    """Return a group of options with the values of a command line.

    Raises:
        click.UsageError: the values do not go together.
    """
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


def parameters_of(*kinds: type[Any]) -> tuple[str, ...]:
    """Return the names of the parameters of groups, without those of groups in them."""
    return tuple(
        declared.name or field.name for kind in kinds for field, declared in settings_in(kind) if declared is not None
    )


def check_declared(ctx: click.Context) -> None:
    """Raise a `click.UsageError` where an option was given without one that it needs, or with one that it excludes."""
    for param in ctx.command.params:
        if not isinstance(param, Option) or not is_set(ctx, param.name or ""):
            continue
        flag, declared = flag_of(ctx, param.name or ""), param.declared
        needed, _, value = declared.needs.partition("=")
        if needed and (str(ctx.params[needed]) != value if value else not is_set(ctx, needed)):
            raise click.UsageError(f"{flag} can only be used with {flag_of(ctx, needed)} {value}".rstrip(), ctx)
        refuse(ctx, declared.excludes, f"cannot be used with {flag}")


def is_set(ctx: click.Context, name: str) -> bool:
    """Return whether somebody set a parameter, be it to its default."""
    return ctx.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT)


def flag_of(ctx: click.Context, name: str) -> str:
    """Return what people type for a parameter, such as --lod-splat-scale for lod_splat_scale."""
    return next(max(param.opts, key=len) for param in ctx.command.params if param.name == name)


def flags_set(ctx: click.Context, names: Iterable[str]) -> list[str]:
    """Return the flags of those parameters that were given."""
    return [flag_of(ctx, name) for name in names if is_set(ctx, name)]


def refuse(ctx: click.Context, names: Iterable[str], why: str) -> None:
    """Raise a `click.UsageError`, "--flag WHY", where one of some parameters was given."""
    for flag in flags_set(ctx, names):
        raise click.UsageError(f"{flag} {why}", ctx)


COLORS: dict[str, tuple[float, ...] | None] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}

#: Pixels along a side of a picture, and digits of no more than a few times that.
MAX_SIDE, DIGITS = 1 << 16, 6


def click_type(kind: Any) -> click.ParamType | None:
    """Return the parameter type for the kind of a `Setting`."""
    if isinstance(kind, Range):
        return _range_type(kind)
    if isinstance(kind, Quantity):
        return Text(kind)
    return Choice(kind) if isinstance(kind, tuple) else kind


def _range_type(kind: Range) -> click.ParamType:
    base: type[Any] = Whole if kind.whole else Real
    least, most = (kind.least, kind.above), (kind.most, kind.below)
    low, high = (next((end for end in ends if end is not None), None) for ends in (least, most))
    result: click.ParamType = base(low, high, min_open=kind.above is not None, max_open=kind.below is not None)
    return result


class Whole(click.IntRange):
    """An integer of a range; unlike its base it takes none that arrays cannot hold."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        number: int = super().convert(value, param, ctx)
        if abs(number) > MOST_WHOLE:
            self.fail(f"a number of {len(str(abs(number)))} digits is too large", param, ctx)
        return number


class Real(click.FloatRange):
    """A number of a range; unlike its base it knows that NaN is in none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number: float = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail(f"{value!r} is not a number", param, ctx)
        return number


class Choice(click.Choice):
    """One of some texts or numbers."""

    def __init__(self, values: tuple[Any, ...]) -> None:
        super().__init__([str(value) for value in values])
        self._values = {str(value): value for value in values}

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return self._values[super().convert(str(value), param, ctx)]


class Text(click.ParamType):
    """A text that a `Quantity` parses."""

    def __init__(self, quantity: Quantity) -> None:
        self.name = quantity.unit
        self._quantity = quantity

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        try:
            parsed = self._quantity.parse(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)
        if parsed is not None and self._quantity.range is not None and parsed not in self._quantity.range:
            self.fail(f"{value!r} is out of range; give {self._quantity.range}", param, ctx)
        return parsed


class OptionalNumber(click.IntRange):
    """A number that may be left out, so that an input after its option is taken for it; says what to do then."""

    def __init__(self, range: Range, *, placeholder: str = "N", example: int) -> None:
        super().__init__(range.least, range.most)  # type: ignore[arg-type]  # whole numbers
        self.placeholder, self.example = placeholder, example

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, str) and not value.lstrip("-").isdigit() and param is not None:
            flag = param.opts[0]
            example = f"{flag}={self.example}"
            self.fail(f"{value!r} is no number; put {flag} after the inputs, or write {example}", param, ctx)
        number: int = super().convert(value, param, ctx)
        return number

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"[{self.placeholder}]"


def _numbers(text: str, names: str = "x,y,z") -> tuple[float, ...]:
    """Parse finite numbers with commas between."""
    count = names.count(",") + 1
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{text!r} is not {names}, {count} numbers with commas between")
    return numbers


def _direction(text: str) -> tuple[float, ...]:
    """Parse an axis by its name (y, -y, ...), or x,y,z."""
    if text.removeprefix("-") not in ("x", "y", "z"):
        return _numbers(text)
    return tuple((-1.0 if text[0] == "-" else 1.0) if name == text[-1] else 0.0 for name in "xyz")


def _ball(text: str) -> tuple[tuple[float, ...], float]:
    """Parse x, y, z and a positive radius."""
    *center, radius = _numbers(text, "x,y,z,radius")
    if radius <= 0:
        raise ValueError(f"radius {radius:g} is not positive")
    return tuple(center), radius


def _color(text: str) -> tuple[float, ...] | None:
    """Parse a colour as (red, green, blue), 0..1; None for none."""
    if text.lower() in COLORS:
        return COLORS[text.lower()]
    digits = text[1:]
    if not text.startswith("#") or len(digits) not in (3, 6) or set(digits) - set(string.hexdigits):
        raise ValueError(f"{text!r} is not a colour: '#rrggbb', {', '.join(COLORS)}")
    if len(digits) == 3:
        digits = "".join(2 * digit for digit in digits)
    return tuple(byte / 255 for byte in bytes.fromhex(digits))


def _view(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Parse camera position and target."""
    eye, colon, target = text.partition(":")
    if not colon:
        raise ValueError(f"{text!r} is not EYE:TARGET, x,y,z:x,y,z, such as 0,1,5:0,0,0")
    view = _numbers(eye), _numbers(target)
    if view[0] == view[1]:
        raise ValueError(f"{text!r} looks at its own eye; give a target elsewhere")
    return view


def _views(text: str) -> tuple[Any, ...]:
    """Parse two or more views, with spaces or semicolons between."""
    views = tuple(map(_view, text.replace(";", " ").split()))
    if len(views) < 2:
        raise ValueError(f"{text!r} has fewer than two keyframes, EYE:TARGET EYE:TARGET")
    return views


def _size(text: str) -> tuple[int, int]:
    """Parse width and height in pixels."""
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
