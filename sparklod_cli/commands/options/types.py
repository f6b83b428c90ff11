"""Types of parameters: texts that become numbers, vectors, balls and quantities, or say why they cannot."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import click


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


class Direction(Numbers):
    """An axis by its name (y, -y, ...), or x,y,z, as a tuple of three floats."""

    def __init__(self) -> None:
        super().__init__("x", "y", "z")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        axes = {f"{sign}{name}" for name in "xyz" for sign in ("", "-")}
        if value not in axes:
            return super().convert(value, param, ctx)
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


class Codes(click.IntRange):
    """A number that may be left out, so that an input after its option is taken for it; says what to do then.

    Args:
        least, most: of the number.
        example: of it, for that message; the most unless given.
    """

    def __init__(self, least: int, most: int, *, example: int | None = None) -> None:
        super().__init__(least, most)
        self.example = most if example is None else example

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, str) and not value.lstrip("-").isdigit() and param is not None:
            flag = param.opts[0]
            example = f"{flag}={self.example}"
            self.fail(f"{value!r} is no number; put {flag} after the inputs, or write {example}", param, ctx)
        number: int = super().convert(value, param, ctx)
        return number

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "[N]"


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
