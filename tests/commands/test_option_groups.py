"""The law of declared options: a command and the Python API refuse the same values, and say what is allowed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import click
import pytest

from sparklod_cli.cli import COMMANDS, cli, run
from sparklod_cli.codecs.options import RadOptions, SogOptions, WriteOptions
from sparklod_cli.commands.command import Option
from sparklod_cli.fitting.settings import FitSettings
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.render.render_settings import RasterSettings, RenderSettings
from sparklod_cli.system.setting_fields import CheckedSettings, Range, Setting, setting, settings_in
from sparklod_cli.viewers.viewer_settings import DetailRule, LodSettings, Network, StreamingSettings
from tests.conftest import Capture

SETTINGS = (
    *(RasterSettings, RenderSettings, LodSettings, DetailRule, DetailSettings, Network, StreamingSettings),
    *(FitSettings, RadOptions, WriteOptions),
)
DECLARED = [
    pytest.param(kind, field.name, declared, id=f"{kind.__name__}.{field.name}")
    for kind in SETTINGS
    for field, declared in settings_in(kind)
    if declared is not None
]


def options() -> list[Any]:
    """Every option of every command, with the name of the command."""
    commands = {name: cli.get_command(click.Context(cli), name) for name in COMMANDS}
    return [
        pytest.param(name, param, id=f"{name}-{param.name}")
        for name, command in commands.items()
        for param in (command.params if command is not None else ())
        if isinstance(param, Option) and isinstance(param.declared.kind, (Range, tuple))
    ]


def outside(kind: Any) -> list[Any]:
    """Values that a range, a quantity or a choice does not allow."""
    if isinstance(kind, tuple):
        return ["none of them"]
    bounds: Range | None = getattr(kind, "range", kind)
    if not isinstance(bounds, Range):
        return []
    ends = [(bounds.least, -1), (bounds.most, 1), (bounds.above, 0), (bounds.below, 0)]
    beyond = [end + (step if abs(end) < 2**53 else step * abs(end)) for end, step in ends if end is not None]
    return [*beyond, 10**400 if bounds.whole else math.nan]


@pytest.mark.parametrize(("command", "option"), options())
def test_a_command_refuses_other_values(command: str, option: Option, capsys: Capture) -> None:
    for value in (*outside(option.declared.kind), "word"):
        assert run([command, f"{option.opts[0]}={value}", "a.spz"]) == 2
        assert "--" + option.opts[0].lstrip("-") in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(("kind", "name", "declared"), DECLARED)
def test_the_api_refuses_other_values(kind: type[Any], name: str, declared: Setting) -> None:
    for value in outside(declared.kind):
        with pytest.raises(ValueError, match=r"is|there is no"):
            kind(**{name: value})
    for value in (True, "5") if not isinstance(declared.kind, tuple) else ():
        if getattr(declared.kind, "range", declared.kind) is not None:
            with pytest.raises(TypeError, match=f"^{name} is {value!r}; give a"):
                kind(**{name: value})
    assert kind(**{name: getattr(kind(), name)}) == kind()


@pytest.mark.parametrize("kind", SETTINGS)
def test_the_help_documents_the_fields(kind: type[Any]) -> None:
    for field, declared in settings_in(kind):
        if declared is not None:
            assert f"    {field.name}: {declared.help}" in (kind.__doc__ or "").splitlines()


def test_what_is_no_option_of_its_own_is_checked_too() -> None:
    for kind in (RadOptions, SogOptions):
        with pytest.raises(ValueError, match="sh_codes is 1; give 2 to 65536"):
            kind(sh_codes=1)
    with pytest.raises(ValueError, match="center_bits is 150; give -149 to 149"):
        RadOptions(center_bits=150)
    with pytest.raises(TypeError, match=r"center_bits is 1\.5; give a whole number"):
        RadOptions(center_bits=1.5)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Example(CheckedSettings):
    """An example.

    Attributes:
        plain: not declared.
    """

    plain: int = 0
    share: float | None = setting("Share of the splats.", Range(above=0, most=1))
    angle: float = setting("Field of view.", Range(above=0, below=180), 60.0)


def test_ranges_say_what_they_allow() -> None:
    about = ("Attributes:", "    plain: not declared.", "    share: Share of the splats.", "    angle: Field of view.")
    assert Example.__doc__ == "\n".join(("An example.", "", *about))
    for name, value, allowed in (
        ("share", 0, "more than 0 and at most 1"),
        ("angle", 180, "more than 0 and less than 180"),
    ):
        with pytest.raises(ValueError, match=f"^{name} is {value}; give {allowed}$"):
            Example(**{name: value})  # type: ignore[arg-type]
    assert str(Range(2)) == "2 or more"
