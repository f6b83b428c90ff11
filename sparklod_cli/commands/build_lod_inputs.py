"""Inputs of `sparklod build-lod`: files that are baked one by one, or merged into one scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..support.addresses import Place
from .build_lod_outputs import Outputs
from .command import COMMON, option, with_options
from .options.common import Command
from .paths import InputPath
from .usage import exclude

if TYPE_CHECKING:
    from ..bake.sources import Source
    from ..model.instances import Instance


@dataclass(frozen=True)
class Inputs:
    """What is read.

    Attributes:
        inputs: files.
        merge: they are one scene.
        scene: an instances file, which names them instead; they are one scene then.
    """

    inputs: tuple[Place, ...]
    merge: bool
    scene: Path | None

    @property
    def is_merged(self) -> bool:
        """Whether all of them are one scene."""
        return self.merge or self.scene is not None

    def instances(self) -> list[Instance]:
        """Those of the instances file; none without one.

        Raises:
            InstancesFileError: it cannot be read.
        """
        if self.scene is None:
            return []
        from ..scenes.instances_file import read_instances

        return read_instances(self.scene)

    def jobs(
        self, instances: Sequence[Instance], outputs: Outputs, say: Callable[[str], None]
    ) -> list[tuple[Source, Place]]:
        """What is baked, and the output of each; says what of an instance is left out."""
        from ..bake.sources import Merged

        if not self.is_merged:
            return [(place, outputs.target(place)) for place in self.inputs]
        assert outputs.output is not None  # see `check_inputs`
        if any(each.lod_scale != 1 or each.foveation is not None for each in instances):
            say(f"{self.scene}: lod_scale and foveation of instances are for viewers, and no part of a tree")
        merged = Merged.of(self.inputs) if self.scene is None else Merged.of_instances(instances)
        return [(merged, outputs.output)]


def input_options(command: Command) -> Command:
    """The inputs, and how several become one."""
    return with_options(
        command,
        click.argument("inputs", metavar="INPUT...", nargs=-1, type=InputPath(stdin=True, addresses=True)),
        option(
            "--merge",
            heading=COMMON,
            is_flag=True,
            help="Bake all INPUTs as one scene, into the file that --output names: tiles of a city, each where its own"
            " coordinates put it.",
        ),
        option(
            "--scene",
            heading=COMMON,
            metavar="FILE",
            type=InputPath(),
            help="Merge the files of an instances file, each where it stands there, in place of INPUTs (see"
            " docs/build-lod.md).",
        ),
    )


def check_inputs(ctx: click.Context, given: Inputs, outputs: Outputs) -> None:
    """Raises a `click.UsageError` where there are no inputs, or merging them contradicts other options."""
    if not given.inputs and given.scene is None:
        raise click.MissingParameter(ctx=ctx, param=next(each for each in ctx.command.params if each.name == "inputs"))
    if given.inputs and given.scene is not None:
        raise click.UsageError("INPUT cannot be used with --scene, which names the files")
    if not given.is_merged:
        return
    flag = "--merge" if given.merge else "--scene"
    exclude(ctx, ("output_dir", "unlod", "rgba"), flag)
    if outputs.output is None:
        raise click.UsageError(f"{flag} makes one file of all inputs; name it with --output")


def record_of(source: Source) -> dict[str, Any]:
    """What a line of JSON calls the input: "input", or "inputs" where several are one scene."""
    from ..bake.sources import Merged

    if isinstance(source, Merged):
        return {"inputs": [str(each.file) for each in source.files]}
    return {"input": str(source)}
