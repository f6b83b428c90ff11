"""Questions about a command line that every command asks: which options were given, and which go together."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, TypeVar

import click

Options = TypeVar("Options")


def options_of(ctx: click.Context, kind: type[Options]) -> Options:
    """A group of options as a dataclass, whose fields have the names of the parameters that they are taken from."""
    fields: tuple[Any, ...] = dataclasses.fields(kind)  # type: ignore[arg-type]
    return kind(**{field.name: ctx.params[field.name] for field in fields})


def is_given(ctx: click.Context, name: str) -> bool:
    """Whether somebody set a parameter, be it to its default."""
    return ctx.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT)


def flag_of(ctx: click.Context, name: str) -> str:
    """What people type for a parameter, such as --lod-splat-scale for lod_splat_scale."""
    return next(max(param.opts, key=len) for param in ctx.command.params if param.name == name)


def given(ctx: click.Context, names: Iterable[str]) -> list[str]:
    """The flags of those parameters that were given."""
    return [flag_of(ctx, name) for name in names if is_given(ctx, name)]


def refuse(ctx: click.Context, names: Iterable[str], why: str) -> None:
    """Raises a `click.UsageError`, "--flag WHY", where one of some parameters was given."""
    for flag in given(ctx, names):
        raise click.UsageError(f"{flag} {why}", ctx)


def exclude(ctx: click.Context, names: Iterable[str], other: str) -> None:
    """Raises a `click.UsageError` where one of some parameters was given, which cannot be used with `other`."""
    refuse(ctx, names, f"cannot be used with {other}")


def require(ctx: click.Context, names: Iterable[str], other: str) -> None:
    """Raises a `click.UsageError` where one of some parameters was given, which means nothing without `other`."""
    refuse(ctx, names, f"can only be used with {other}")
