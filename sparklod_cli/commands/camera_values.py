"""Parameter types of the options that are about cameras."""

from __future__ import annotations

from typing import Any

import click

from .options import Numbers

#: Pixels along a side of a picture, and digits of no more than a few times that.
MAX_SIDE, DIGITS = 1 << 16, 6


class View(click.ParamType):
    """Where a camera is and what it looks at, as (eye, target), two tuples of three numbers."""

    name = "x,y,z:x,y,z"
    _point = Numbers("x", "y", "z")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        eye, colon, target = value.partition(":")
        if not colon:
            self.fail(f"{value!r} is not eye:target, x,y,z:x,y,z", param, ctx)
        view = self._point.convert(eye, param, ctx), self._point.convert(target, param, ctx)
        if view[0] == view[1]:
            self.fail(f"{value!r} looks at the point where it is", param, ctx)
        return view

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "EYE:TARGET"


class Views(View):
    """Two or more views, with spaces or semicolons between."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        views = tuple(super(Views, self).convert(view, param, ctx) for view in value.replace(";", " ").split())
        if len(views) < 2:
            self.fail("a path takes two keyframes, or more", param, ctx)
        return views

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "'EYE:TARGET ...'"


class Size(click.ParamType):
    """Width and height in pixels, as a tuple."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        parts = value.lower().split("x")
        if len(parts) != 2 or not all(part.isascii() and part.isdigit() and part.strip("0") for part in parts):
            self.fail(f"{value!r} is not a width and a height in pixels, such as 1280x720", param, ctx)
        if any(len(part.lstrip("0")) > DIGITS or int(part) > MAX_SIDE for part in parts):
            self.fail(f"{value!r} is too large; a picture has at most {MAX_SIDE:,} pixels along a side", param, ctx)
        return int(parts[0]), int(parts[1])

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return self.name
