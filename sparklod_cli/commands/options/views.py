"""Types of the parameters that are about cameras: views and sizes of pictures."""

from __future__ import annotations

from typing import Any

import click

from .types import Numbers

#: Pixels along a side of a picture, and digits of no more than a few times that.
MAX_SIDE, DIGITS = 1 << 16, 6


class View(click.ParamType):
    """Where a camera is and what it looks at, as (eye, target), two tuples of three numbers."""

    name = "x,y,z:x,y,z"
    _point = Numbers("x", "y", "z")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        eye, colon, target = value.partition(":")
        if not colon:
            self.fail(f"{value!r} is not EYE:TARGET, x,y,z:x,y,z", param, ctx)
        view = self._point.convert(eye, param, ctx), self._point.convert(target, param, ctx)
        if view[0] == view[1]:
            self.fail(f"{value!r} looks at its own eye; give a target elsewhere", param, ctx)
        return view

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "EYE:TARGET"


class Views(View):
    """Two or more views, with spaces or semicolons between."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        views = tuple(super(Views, self).convert(view, param, ctx) for view in value.replace(";", " ").split())
        if len(views) < 2:
            self.fail(f"{value!r} has fewer than two keyframes, EYE:TARGET EYE:TARGET", param, ctx)
        return views

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "'EYE:TARGET ...'"


class Size(click.ParamType):
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

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return self.name
