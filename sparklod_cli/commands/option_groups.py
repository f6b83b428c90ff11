"""Options of commands, declared as fields of dataclasses, whose values they become; and which go together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import click

from .. import __version__
from ..system.setting_fields import setting, settings_in
from .command import COMMON as COMMON
from .command import GENERAL, Command, Option
from .parameter_types import click_type

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
        exclude(ctx, declared.excludes, flag)


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


def exclude(ctx: click.Context, names: Iterable[str], other: str) -> None:
    """Raise a `click.UsageError` where one of some parameters was given, which cannot be used with `other`."""
    refuse(ctx, names, f"cannot be used with {other}")


def require(ctx: click.Context, names: Iterable[str], other: str) -> None:
    """Raise a `click.UsageError` where one of some parameters was given, which means nothing without `other`."""
    refuse(ctx, names, f"can only be used with {other}")
