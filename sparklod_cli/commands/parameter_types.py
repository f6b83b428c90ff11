"""Types of parameters: texts that become numbers, vectors, colours, views and sizes, or say why they cannot."""

from __future__ import annotations

import math
import string
from typing import Any

import click

from ..system.setting_fields import MOST_WHOLE, Quantity, Range

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
