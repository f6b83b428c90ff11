"""Options that say what stands in the world and how a viewer is set, shared by the commands that look at it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..support import defaults
from ..support.units import parse_bandwidth, parse_count, parse_latency
from .options.common import Command
from .options.types import Quantity, Real
from .paths import InputPath, file_of
from .usage import exclude, is_given

if TYPE_CHECKING:
    from ..lod.settings import LodSettings
    from ..model.instances import Instance
    from ..simulation.streaming import StreamingSettings

#: Options of the cones, which --outside-foveate leaves no room for.
CONES = ("cone_fov0", "cone_fov", "cone_foveate")

#: Options of streaming over a network, which need --bandwidth.
OF_BANDWIDTH = ("latency", "fetchers")

#: Options of numbers that the traversal multiplies in float32, and the most that it can take.
MULTIPLIED = ("lod_render_scale", "pixel_scale_limit", "cone_foveate", "outside_foveate", "behind_foveate")
LARGEST = 1e12

#: Budgets are below this, so that they are whole numbers in every format of the table.
BUDGETS = 1 << 53


def world_options(command: Command) -> Command:
    """The files, `--scene` and `--precision`."""
    for option in (
        click.option(
            "--precision",
            type=click.Choice(defaults.PRECISIONS),
            default=defaults.PRECISIONS[0],
            help="Of centres and sizes: as in the file, or rounded to halves, which is nearly, but not exactly, what"
            " Spark holds after loading it.",
        ),
        click.option(
            "--scene",
            metavar="FILE",
            type=InputPath(),
            help="Files and where they stand, as JSON; see docs/traverse.md.",
        ),
        click.argument("files", metavar="[FILE]...", nargs=-1, type=InputPath()),
    ):
        command = option(command)
    return command


def placements_from(settings: Mapping[str, Any]) -> list[Instance]:
    """What stands where: each FILE once, as it is, and all that --scene says."""
    from ..model.instances import instances_of
    from ..scenes.instances_file import read_instances

    files, scene = settings["files"], settings["scene"]
    if not files and scene is None:
        raise click.UsageError("a FILE is missing, or --scene")
    if files and scene is not None:
        raise click.UsageError("--scene names the files; leave out FILE")
    if scene is not None:
        return read_instances(scene)
    return instances_of(files)


def files_meant(settings: Mapping[str, Any], placements: Sequence[Instance]) -> dict[str, list[Path]]:
    """For `paths.keep_apart`, files that are read without being parameters themselves."""
    matrix = settings["world_transform"] and file_of(settings["world_transform"])
    return {"scene": [place.file for place in placements if place.file], "world_transform": [matrix] if matrix else []}


def viewer_options(command: Command) -> Command:
    """How many splats are drawn and which, and how they get there."""
    return cut_options(_streaming_options(command))


def cut_options(command: Command, *, budgets: Quantity | None = None) -> Command:
    """How many splats are drawn, and which; for a viewer that has all of a file.

    Args:
        command: takes the options.
        budgets: type of --budget where it can be several.
    """
    several = "; with --compare several, such as 5%,500k" if budgets else ""
    for option in reversed(
        (
            click.option(
                "--budget",
                type=budgets or Quantity("N", parse_count),
                help=f"Splats to draw at most, such as 500k{several}.  [default: of --preset]",
            ),
            click.option(
                "--preset",
                type=click.Choice(list(defaults.PRESETS)),
                default="desktop",
                help="Budget of a device: Spark 2's, or with preview-desktop and mobile those of its LoD design.",
            ),
            click.option(
                "--lod-splat-scale",
                metavar="X",
                type=Real(0, min_open=True),
                default=1.0,
                help="Multiplies the budget.",
            ),
            click.option(
                "--lod-render-scale",
                metavar="X",
                type=Real(0),
                default=1.0,
                help="Divide down to so many pixels.",
            ),
            click.option(
                "--pixel-scale-limit",
                metavar="X",
                type=Real(0),
                help="Divide down to this size over distance.  [default: a pixel's, times --lod-render-scale]",
            ),
            click.option(
                "--cone-fov0",
                metavar="DEGREES",
                type=Real(0, 180),
                default=defaults.CONE_FOV0,
                help="Full weight inside.",
            ),
            click.option(
                "--cone-fov",
                metavar="DEGREES",
                type=Real(0, 180),
                default=defaults.CONE_FOV,
                help="There the weight has fallen to --cone-foveate.",
            ),
            click.option(
                "--cone-foveate", metavar="X", type=Real(0), default=defaults.CONE_FOVEATE, help="Weight at --cone-fov."
            ),
            click.option(
                "--outside-foveate",
                metavar="X",
                type=Real(0),
                help="Weight beside the picture, in place of the cones; as in Spark's LoD design.",
            ),
            click.option(
                "--behind-foveate",
                metavar="X",
                type=Real(0),
                help=f"Weight behind the camera.  [default: {defaults.BEHIND_FOVEATE:g}; 1 with --outside-foveate]",
            ),
        )
    ):
        command = option(command)
    return command


def _streaming_options(command: Command) -> Command:
    """What of a file is there."""
    for option in reversed(
        (
            click.option(
                "--chunk-cache",
                metavar="N",
                type=click.IntRange(1),
                help="Chunks of 65,536 nodes that fit into memory.  [default: all]",
            ),
            click.option(
                "--bandwidth",
                type=Quantity("RATE", parse_bandwidth),
                help="Simulate streaming over a network of so much, such as 20Mbit.  [default: all is there]",
            ),
            click.option(
                "--latency",
                type=Quantity("TIME", parse_latency),
                help="From asking to the first byte, such as 60ms.  [default: 0ms]",
            ),
            click.option(
                "--fetchers",
                metavar="N",
                type=click.IntRange(1, 1000),
                help=f"Chunks that are fetched at a time.  [default: {defaults.FETCHERS}]",
            ),
        )
    ):
        command = option(command)
    return command


def viewer_from(ctx: click.Context, settings: Mapping[str, Any]) -> LodSettings:
    """The viewer that the options of `viewer_options`, or of `cut_options`, ask for."""
    from ..lod.settings import LodSettings
    from ..model.foveation import Cones, Frustum

    behind, outside = settings["behind_foveate"], settings["outside_foveate"]
    if outside is not None:
        exclude(ctx, CONES, "--outside-foveate")
    for name in OF_BANDWIDTH:
        if settings.get(name) is not None and settings["bandwidth"] is None:
            raise click.UsageError(f"--{name} only means something with --bandwidth")
    for name in MULTIPLIED:
        if settings[name] is not None and settings[name] > LARGEST:
            raise click.UsageError(f"--{name.replace('_', '-')} {settings[name]:g} is beyond {LARGEST:g}")
    if settings["budget"] is not None and is_given(ctx, "preset"):
        raise click.UsageError("--budget and --preset exclude each other")
    if settings["pixel_scale_limit"] is not None and is_given(ctx, "lod_render_scale"):
        raise click.UsageError("--pixel-scale-limit and --lod-render-scale exclude each other")
    foveation: Cones | Frustum
    if outside is not None:
        foveation = Frustum(outside, 1.0 if behind is None else behind)
    else:
        behind = defaults.BEHIND_FOVEATE if behind is None else behind
        foveation = Cones(settings["cone_fov0"], settings["cone_fov"], settings["cone_foveate"], behind)
    budget = defaults.PRESETS[settings["preset"]] if settings["budget"] is None else settings["budget"]
    if not 0 < budget * settings["lod_splat_scale"] < BUDGETS:
        raise click.UsageError("the budget is to be more than 0, and no more than people can count")
    return LodSettings(
        budget=max(1, int(budget * settings["lod_splat_scale"])),
        foveation=foveation,
        pixel_scale_limit=settings["pixel_scale_limit"],
        render_scale=settings["lod_render_scale"],
    )


def streaming_from(settings: Mapping[str, Any]) -> StreamingSettings:
    """How chunks get to the viewer that the options of `viewer_options` ask for."""
    from ..simulation.streaming import Network, StreamingSettings

    network = Network()
    if settings["bandwidth"] is not None:
        network = Network(settings["bandwidth"], settings["latency"] or 0.0, settings["fetchers"] or defaults.FETCHERS)
    return StreamingSettings(network, settings["chunk_cache"])
