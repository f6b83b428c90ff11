"""`sparklod simplify`: writes a scene with fewer splats, for all cameras."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click

from ..codecs.formats import WRITABLE
from ..fitting import FIT_DEVICE_HELP, SEED, SEED_HELP, STEPS
from ..lod.budget import Budget, doubt, parse_budget
from ..lod.tree_settings import DETAIL_GROWTH
from ..render import DEVICES
from ..system.addresses import Place
from ..system.errors import FormatError, SparklodError, naming
from ..system.setting_fields import Quantity, Range, setting, whole
from ..system.stdio import DASH, name_of
from ..system.units import parse_size
from .build_lod import BY_SIZE, EXAMPLE_STEPS, QUALITY, report
from .command import Command, common, flag, values_of
from .console import Console
from .option_groups import OVERWRITE
from .outputs import NamedPath, name_outputs
from .rules import GOALS, is_set
from .writing_options import MEMORY, SCENE_HEADINGS, OptionalNumber, Writing, check_outputs, form_of

EXAMPLES = """\
  sparklod simplify scene.ply --to 10% -o small.ply
  sparklod simplify scene.ply --to 100k -o small.spz
  sparklod simplify scene.ply --max-bytes 8MB -o small.sog  # as many as fit
  sparklod simplify scene.ply --psnr 40 -o small.spz        # to hold 40 dB
  sparklod simplify scene.ply --to 1% --refine -o small.ply # in minutes
  sparklod simplify scene.ply --psnr 35 --camera-path path.json -o small.ply
  sparklod simplify scene.ply \\
    --to 500k --up -y -o small.glb --glb-profile cesium
  sparklod simplify tiles/*.ply --to 1M --up -y -o city.sog # one scene of all
  sparklod simplify scene-lod.rad --to 5% -o small.ply      # a cut of its tree
"""


@dataclass(frozen=True)
class SimplifyOptions:
    """Options of simplify."""

    inputs: tuple[Place, ...] = setting(
        "", NamedPath(stdin=True, addresses=True), (), argument=True, nargs=-1, metavar="INPUT...", required=True
    )
    to: Budget | None = common(
        "Number of splats, such as 100k, or share of the INPUT's, such as 10%.", Quantity("N|P%", parse_budget)
    )
    max_bytes: int | None = common(
        "Largest size of the file, such as 8MB, which keeps as many splats as fit.",
        Quantity("SIZE", parse_size, whole(1)),
    )
    psnr: float | None = common(
        "Least PSNR of pictures against the INPUT's in dB, such as 40, which keeps as few splats as reach it.",
        Range(above=0, below=100, unit="DB"),
    )
    camera_path: Path | None = common(
        "Cameras of --psnr and --refine, in the coordinates of the output and any format that render reads."
        "  [default: cameras around and inside the scene]",
        NamedPath(),
    )
    refine: int | None = common(
        "Fit the splats to STEPS pictures of the INPUT, which takes a minute or more and gains some dB."
        "  [default, without STEPS: by the size of the scene]",
        OptionalNumber(STEPS, placeholder="STEPS", example=EXAMPLE_STEPS, zero=BY_SIZE),
        is_flag=False,
        flag_value=BY_SIZE,
    )
    seed: int = setting(SEED_HELP, SEED, 0)
    device: str = setting(FIT_DEVICE_HELP, DEVICES, "cpu")
    output: Place = common(
        "Output, whose name chooses the format: .ply, .spz, .sog, DIR/meta.json (an unpacked SOG), .glb, .rad or"
        " .splat (without SH); DIR/ is DIR/NAME-small.spz, - is standard output, as SPZ.",
        NamedPath(output=True, addresses=True),
        flags=("-o", "--output"),
        required=True,
    )
    overwrite: bool = flag(**OVERWRITE)
    memory: int | None = setting(
        "Memory that the tree may take, such as 4G; a scene that needs more is refused."
        "  [default: 75 % of what is available]",
        MEMORY,
    )
    writing: Writing = field(default_factory=Writing)


@click.command("simplify", cls=Command, options=SimplifyOptions, examples=EXAMPLES, headings=SCENE_HEADINGS)
@click.pass_context
def simplify(ctx: click.Context, /, **_: Any) -> None:
    """Write a scene with fewer splats, the same for all cameras. Give one of --to, --max-bytes and --psnr.

    Reads all that build-lod reads, builds its quality tree, and writes the cut of it that loses least, without a tree:
    a file that every viewer of plain splats shows. Several INPUTs become one scene, each where its own coordinates put
    it; an INPUT of - is standard input. A Level-of-Detail file is cut as it is.
    """
    name_outputs(ctx, ctx.params["inputs"][0], "-small.spz")
    options = values_of(ctx, SimplifyOptions)
    writing, general, inputs, output = options.writing, options.writing.general, options.inputs, options.output
    form = form_of(output)
    if not any(is_set(ctx, name) for name in GOALS):
        raise click.UsageError("say how many splats to keep: give one of --to, --max-bytes and --psnr")
    if form.suffix not in WRITABLE:
        raise click.UsageError(f"--output writes {', '.join(WRITABLE)}, not {form.suffix}")
    if DASH in inputs and len(inputs) > 1:
        raise click.UsageError("standard input cannot be merged with files; save it to a file first")
    check_outputs(ctx, form, [output], WRITABLE, count=len(inputs))
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..api.bake_jobs import bake_files, merged_source
        from ..bake.simplifying import SimplifyGoal
        from ..fitting.fit_settings import FitSettings

        steps = options.refine
        settings = writing.settings(
            ctx,
            form,
            method=QUALITY,
            growth=DETAIL_GROWTH,
            simplify=SimplifyGoal(options.to, options.max_bytes, options.psnr),
            refine=None if steps is None else FitSettings(steps or None, options.seed, device=options.device),
            camera_path=options.camera_path,
            converts=True,
        )
        if options.to is not None and (question := doubt(options.to.count)):
            console.say(question)
        console.announce_compiling(settings)
        source = inputs[0] if len(inputs) == 1 else merged_source(inputs)
        (outcome,) = bake_files(
            [(source, output)],
            settings,
            overwrite=options.overwrite,
            threads=general.threads,
            progress=console.progress,
            memory=options.memory,
            job=console.job,
            say=console.say,
        )
        if isinstance(outcome, SparklodError):
            # Errors about one of several inputs name it already.
            with naming(name_of(source), FormatError) if len(inputs) == 1 else contextlib.nullcontext():
                raise outcome
        report(ctx, console, source, output, outcome, as_json=writing.as_json)
