"""`sparklod help`: prints the help of a command."""

from __future__ import annotations

import click

from .command import Command, Group


@click.command("help", cls=Command)
@click.argument("command", required=False)
@click.pass_context
def help(ctx: click.Context, command: str | None) -> None:
    """Print the help of COMMAND, or of sparklod itself, as --help does."""
    parent = ctx.parent
    assert parent is not None and isinstance(parent.command, Group)
    if command is None:
        click.echo(parent.get_help())
        return
    found = parent.command.get_command(parent, command)
    if found is None:
        raise click.UsageError(parent.command.unknown(command), parent)
    with found.make_context(command, [], parent=parent, resilient_parsing=True) as child:
        click.echo(child.get_help())
