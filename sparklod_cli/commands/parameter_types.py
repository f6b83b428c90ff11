"""Types of parameters: texts that become numbers, vectors, colours, views and sizes, or say why they cannot."""

from __future__ import annotations

import math
import string
from typing import Any

import click

from ..support.setting_fields import Quantity, Range

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}

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
    base: type[Any] = click.IntRange if kind.whole else Real
    least, most = (kind.least, kind.above), (kind.most, kind.below)
    low, high = (next((end for end in ends if end is not None), None) for ends in (least, most))
    result: click.ParamType = base(low, high, min_open=kind.above is not None, max_open=kind.below is not None)
    return result


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


class _Shown(click.ParamType):
    """A type whose name is the placeholder in `--help`."""

    name = ""

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return self.name


class Text(_Shown):
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


class Numbers(_Shown):
    """`count` finite numbers with commas between, as a tuple of floats."""

    def __init__(self, *names: str) -> None:
        self.name = ",".join(names)
        self._count = len(names)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count or not all(map(math.isfinite, numbers)):
            self.fail(f"{value!r} is not {self.name}, {self._count} numbers with commas between", param, ctx)
        return numbers


POINT = Numbers("x", "y", "z")


class Direction(Numbers):
    """An axis by its name (y, -y, ...), or x,y,z, as a tuple of three floats."""

    def __init__(self) -> None:
        super().__init__("x", "y", "z")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        axes = {f"{sign}{name}" for name in "xyz" for sign in ("", "-")}
        if value not in axes:
            numbers: tuple[float, ...] = super().convert(value, param, ctx)
            return numbers
        return tuple((-1.0 if value[0] == "-" else 1.0) if name == value[-1] else 0.0 for name in "xyz")

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "AXIS|x,y,z"


class Ball(Numbers):
    """x, y, z and a positive radius, as ((x, y, z), radius)."""

    def __init__(self) -> None:
        super().__init__("x", "y", "z", "radius")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        *center, radius = super().convert(value, param, ctx)
        if radius <= 0:
            self.fail(f"radius {radius:g} is not positive", param, ctx)
        return tuple(center), radius


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


class Background(_Shown):
    """A colour as (red, green, blue), 0..1; None for none."""

    name = "COLOR"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        if value.lower() in COLORS:
            return COLORS[value.lower()]
        digits = value[1:]
        if not value.startswith("#") or len(digits) not in (3, 6) or set(digits) - set(string.hexdigits):
            self.fail(f"{value!r} is not a colour: '#rrggbb', {', '.join(COLORS)}", param, ctx)
        if len(digits) == 3:
            digits = "".join(2 * digit for digit in digits)
        return tuple(byte / 255 for byte in bytes.fromhex(digits))


class View(_Shown):
    """Camera position and target, as (eye, target), two tuples of three numbers."""

    name = "EYE:TARGET"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        eye, colon, target = value.partition(":")
        if not colon:
            self.fail(f"{value!r} is not EYE:TARGET, x,y,z:x,y,z", param, ctx)
        view = POINT.convert(eye, param, ctx), POINT.convert(target, param, ctx)
        if view[0] == view[1]:
            self.fail(f"{value!r} looks at its own eye; give a target elsewhere", param, ctx)
        return view


class Views(View):
    """Two or more views, with spaces or semicolons between."""

    name = "'EYE:TARGET ...'"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        views = tuple(super(Views, self).convert(view, param, ctx) for view in value.replace(";", " ").split())
        if len(views) < 2:
            self.fail(f"{value!r} has fewer than two keyframes, EYE:TARGET EYE:TARGET", param, ctx)
        return views


class Size(_Shown):
    """Width and height in pixels, as a tuple."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        sides = [side.lstrip("0") for side in value.lower().split("x")]
        if len(sides) != 2 or not all(side.isascii() and side.isdigit() for side in sides):
            self.fail(f"{value!r} is not a width and a height in pixels, such as 1280x720", param, ctx)
        if any(len(side) > DIGITS or int(side) > MAX_SIDE for side in sides):
            most = f"{MAX_SIDE:,} pixels along a side"
            self.fail(f"{value!r} is too large; give at most {most}, such as 1280x720", param, ctx)
        return int(sides[0]), int(sides[1])
