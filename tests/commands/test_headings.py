"""The law of `--help`: every option stands once, under a heading of its own group, and the common ones come first."""

from __future__ import annotations

import re

import click
import pytest

from sparklod_cli.commands.command import COMMON, GENERAL, Command
from sparklod_cli.commands.render import render
from sparklod_cli.commands.traverse import traverse

HEADINGS = {
    "render": [
        COMMON,
        "Inputs",
        "Cameras",
        "Cut",
        "Streamed SOG",
        "Streaming",
        "Appearance",
        "Comparison",
        "Output",
        GENERAL,
    ],
    "traverse": [COMMON, "Inputs", "Cameras", "Cut", "Streamed SOG", "Streaming", "Output", GENERAL],
}


@pytest.mark.parametrize("command", [render, traverse], ids=lambda command: command.name)
def test_options_stand_under_headings_the_common_ones_first(command: Command) -> None:
    assert command.name is not None
    ctx = click.Context(command, info_name=command.name)
    text = command.get_help(ctx)
    found = re.findall(r"^(\w[\w ]*):$", text, re.MULTILINE)
    assert found == HEADINGS[command.name]
    groups = command.by_heading(ctx)
    assert len(groups[COMMON]) == 10
    every = [param.name for params in groups.values() for param in params]
    assert len(every) == len(set(every)) == sum(isinstance(param, click.Option) for param in command.get_params(ctx))
    general = {"--threads", "--json", "--quiet", "--verbose", "--version", "--help"}
    assert {max(param.opts, key=len) for param in groups[GENERAL]} == general


@pytest.mark.parametrize("command", [render, traverse], ids=lambda command: command.name)
def test_help_texts_are_phrases_that_end_in_a_point(command: Command) -> None:
    for param in command.params:
        if isinstance(param, click.Option):
            assert param.help, param.name
            text = param.help.partition("  [default")[0]
            assert text[0].isupper(), param.name
            assert text.endswith((".", "design)")), text
            assert not re.search(r"\bso (much|many)\b|\bwhat is\b|\bthere\b[.]", text), text
