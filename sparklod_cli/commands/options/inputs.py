"""The splat files that a command reads, and where they stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..command import option, with_options
from ..paths import InputPath
from .common import Command

if TYPE_CHECKING:
    from ...model.instances import Instance

HEADING = "Inputs"


@dataclass(frozen=True)
class Inputs:
    """The values of the options of `input_options`.

    Attributes:
        files: splat files, each an instance.
        scene: an instances file; None for none.
    """

    files: tuple[Path, ...]
    scene: Path | None

    @property
    def first(self) -> Path | None:
        """The file that outputs are named after; None where there is no input."""
        return self.scene or next(iter(self.files), None)

    def instances(self) -> list[Instance]:
        """The instances: each FILE once, untransformed, or those of the instances file.

        Raises:
            click.UsageError: there is neither, or there are both.
            InstancesFileError: the instances file cannot be read.
        """
        from ...model.instances import instances_of
        from ...scenes.instances_file import read_instances

        if not self.files and self.scene is None:
            raise click.UsageError("a FILE is missing; name one, or an instances file with --scene")
        if self.files and self.scene is not None:
            raise click.UsageError("FILE cannot be used with --scene, which names the files")
        if self.scene is not None:
            return read_instances(self.scene)
        return instances_of(self.files)

    def read(self, instances: Sequence[Instance]) -> list[Path]:
        """The splat files of instances, for `keep_apart`: an instances file names them in place of the command line."""
        return [instance.file for instance in instances if instance.file is not None]


def input_options(command: Command) -> Command:
    """The files and `--scene`."""
    return with_options(
        command,
        click.argument("files", metavar="[FILE]...", nargs=-1, type=InputPath()),
        option(
            "--scene",
            heading=HEADING,
            metavar="FILE",
            type=InputPath(),
            help="Read an instances file: JSON that lists splat files and where they stand (see docs/traverse.md).",
        ),
    )
