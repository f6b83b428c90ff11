"""Rules for options that exclude or need each other: one table for all commands, and the check of a command line.

A row names parameters, from which flags are made. Facts, which a command passes to `check`, are known only after names,
formats or files have been examined. A condition is the name of a parameter, which holds if the option was given; or
NAME=VALUE, which holds if a parameter or fact has that value.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import click

from .console import is_terminal


class Rule(NamedTuple):
    """Row of the table: options that a command refuses, each on its own, under some conditions.

    Attributes:
        commands, options: names of commands, and of the parameters that the row is about.
        needs: conditions of which one must hold.
        excludes: conditions of which none may hold.
        only_for: conditions on facts of which one must hold; without an effect before the facts are known.
        when: conditions of which one must hold for the row to apply; empty for rows that always do.
        why: end of the message, after the flag and the usual words where it begins with a comma or a semicolon, or
            else after the flag; with {other}, the flag it is about, and the values of parameters and facts.
    """

    commands: tuple[str, ...]
    options: tuple[str, ...]
    needs: tuple[str, ...] = ()
    excludes: tuple[str, ...] = ()
    only_for: tuple[str, ...] = ()
    when: tuple[str, ...] = ()
    why: str = ""


BUILD, CONVERT, SIMPLIFY = ("build-lod",), ("convert",), ("simplify",)
INSPECT, TRAVERSE, RENDER, VIEW = ("inspect",), ("traverse",), ("render",), ("view",)
FITS, BAKES, CAMERAS = BUILD + SIMPLIFY, BUILD + CONVERT + SIMPLIFY, TRAVERSE + RENDER

RAD = ("rad_center", "rad_alpha", "rad_rgb", "rad_scales", "rad_orientation", "rad_sh")
STREAMED_SOG = ("levels", "chunk_splats", "region_extent", "region_min_splats", "environment", "environment_beyond")
TILES_3D = ("tile_splats", "lat", "lon", "height", "heading", "transform")

#: Ways to say how many splats simplify leaves.
GOALS = ("to", "max_bytes", "psnr")

#: Conditions under which inspect checks files.
EXPECTATIONS = ("asserts", "expect", "leaves_of")

#: Sources of cameras, and those whose cameras follow each other in time.
SOURCES = ("camera_path", "orbit", "dolly", "look_at", "keyframes", "views")
PATHS = ("camera_path", "orbit", "dolly", "keyframes")

#: Options of the size on the screen, which 3D Tiles have, too; of foveation cones; of nodes; and of cuts.
PIXELS, CONES = ("lod_render_scale", "pixel_scale_limit"), ("cone_fov0", "cone_fov", "cone_foveate")
NODES = (*CONES, "outside_foveate", "behind_foveate", "precision", "continuous", "blend")
CUTS = ("budget", "preset", "lod_splat_scale", *PIXELS, *NODES)

#: Options of the choice of detail levels, of the network, and of the nodes that traverse writes.
LEVELS = ("budget_mode", "lod_base_distance", "lod_multiplier", "lod_behind_penalty", "lod_underfill")
NETWORK = ("after", "bandwidth", "latency", "fetchers", "chunk_cache")
INDICES = ("indices_out", "padded")

#: Options without an effect on the table of render --compare, and on a thumbnail.
NOT_COMPARED = (
    *("full", "preset", "lod_splat_scale", "background", "alpha", "supersample", "style", "color_by", "no_bar"),
    *("through", "diff", "gain", "sheet", "jobs", "thumbnail", "jpeg_quality"),
)
NOT_OF_THUMBNAILS = ("size", "supersample", *SOURCES, "center", "distance", "sheet", "fps", "every")

NAMES_FILES = ", which names the files"
STILL = "cannot be used with a camera that does not move; give a path, such as --orbit"
OF_ORBITS = "cannot be used with --seconds of an orbit, which decides it"
STYLED = "cannot be used with --style {style}"
OF_NUMBERS = "cannot be used with a .npy, which holds numbers"
PLAIN = "is for Level-of-Detail files, and no file is one, so that all splats are drawn; bake one with build-lod"
OF_TREES = "is for trees; use --budget, --budget-mode and --lod-multiplier for Streamed SOG"
OF_LEVELS = "is for Streamed SOG, and no file is; --budget and --preset are for trees, too"
NO_BUDGET = "is not for 3D Tiles, which CesiumJS draws without a budget; --lod-render-scale 2 halves their detail"

RULES = (
    # Inputs and outputs
    Rule(BUILD, ("inputs",), excludes=("scene",), why=NAMES_FILES),
    Rule(CAMERAS, ("files",), excludes=("scene",), why=NAMES_FILES),
    Rule(BUILD, ("output",), excludes=("output_dir",)),
    Rule(
        BUILD,
        ("output",),
        only_for=("count=1", "merge", "scene", "place=folder"),
        why="takes one input, not {count}; add --merge to bake them as one scene, or name a folder",
    ),
    Rule(
        BAKES + CAMERAS,
        ("output",),
        excludes=("as_json",),
        when=("output=-",),
        why="- and --json cannot both go to standard output; name a file",
    ),
    Rule(
        BAKES,
        ("output",),
        excludes=("stdout=terminal",),
        when=("output=-",),
        why="- writes binary data; redirect it to a file or a pipe",
    ),
    Rule(BUILD, ("output_dir", "rgba"), excludes=("merge", "scene")),
    Rule(
        BUILD,
        ("merge", "scene"),
        only_for=("place=file", "place=standard output"),
        why="makes one file of all inputs; name it with --output",
    ),
    Rule(BUILD, ("skip_existing",), excludes=("place=standard output",), why="needs an output file; name one"),
    Rule(FITS, ("rgba",), only_for=("count=1",), why="takes one input, not {count}"),
    Rule(INSPECT, ("plot", "chunks_out"), only_for=("count=1",), why="takes one file, not {count}"),
    Rule(
        BUILD,
        ("workers", "scheduler"),
        excludes=("source=standard input",),
        why="cannot be used with standard input, which workers cannot read; save it to a file first",
    ),
    Rule(BUILD, ("workers",), excludes=("scheduler",), why=", whose workers run already"),
    Rule(VIEW, ("host", "port", "cors", "no_open"), excludes=("export",)),
    Rule(VIEW, ("overwrite",), needs=("export",)),
    # Trees, and smaller scenes
    Rule(BUILD, ("base",), only_for=("method=quick",), why="is an option of --method quick, not of {method}"),
    Rule(BUILD, ("growth",), only_for=("method=quality",), why="is an option of --method quality, not of {method}"),
    Rule(FITS, ("seed", "device"), needs=("refine",)),
    Rule(FITS, ("camera_path",), needs=("psnr", "refine")),
    Rule(BUILD, ("scratch_dir", "resume"), excludes=("refine",), why=", which needs the whole tree in memory"),
    Rule(SIMPLIFY, GOALS, excludes=GOALS, why="and {other} cannot be used together; give one of them"),
    Rule(SIMPLIFY, ("max_bytes",), excludes=("refine",)),
    # Formats
    Rule(BAKES, ("spz_version", "fractional_bits"), only_for=("format=SPZ",)),
    Rule(BAKES, ("compression_level",), only_for=("format=SPZ", "format=RAD")),
    Rule(BUILD, RAD, only_for=("format=RAD",), why="; name the output .rad, or add --format rad"),
    Rule(CONVERT + SIMPLIFY, RAD, only_for=("format=RAD",)),
    Rule(
        BUILD,
        ("cluster_sh",),
        only_for=("format=RAD", "format=Streamed SOG"),
        why="is an option of RAD and SOG, not of {format}; name the output .rad, or add --format rad",
    ),
    Rule(CONVERT + SIMPLIFY, ("cluster_sh",), only_for=("format=RAD", "format=SOG")),
    Rule(
        BUILD,
        ("glb_profile",),
        only_for=("format=3D Tiles",),
        why="is an option of GLB and 3D Tiles, not of {format}; GLB is written by convert and simplify",
    ),
    Rule(CONVERT + SIMPLIFY, ("glb_profile",), only_for=("format=GLB",)),
    Rule(
        BUILD,
        STREAMED_SOG,
        only_for=("format=Streamed SOG",),
        why="; name the output lod-meta.json, or add --format streamed-sog",
    ),
    Rule(BUILD, ("environment_beyond",), excludes=("environment",)),
    Rule(
        BUILD, TILES_3D, only_for=("format=3D Tiles",), why="; name the output tileset.json, or add --format 3d-tiles"
    ),
    Rule(BUILD, ("transform",), excludes=("lat", "lon")),
    Rule(BUILD, ("lat",), needs=("lon",), why="and --lon go together; give both"),
    Rule(BUILD, ("lon",), needs=("lat",), why="and --lat go together; give both"),
    Rule(BUILD, ("height", "heading"), needs=("lat",), why="is of a place; give --lat and --lon, too"),
    Rule(CONVERT, ("layout",), only_for=("format=--layout",), why="writes .npz, .bin, .raw, not {suffix}"),
    # Reports
    Rule(INSPECT, ("chunks", "histogram", "style"), excludes=("field",)),
    Rule(INSPECT, ("field", "histogram", "style"), excludes=("as_json",)),
    Rule(
        INSPECT,
        ("stats",),
        needs=("as_json",),
        when=("check", *EXPECTATIONS),
        why="cannot be used with --check or expectations unless --json is given",
    ),
    Rule(INSPECT, ("style", "fail_on"), needs=("check", *EXPECTATIONS), why="needs --check or an expectation"),
    Rule(INSPECT, ("plot_level", "plot_by"), needs=("plot", "html"), why="needs --plot or --html"),
    Rule(TRAVERSE, ("padded",), needs=("indices_out",)),
    Rule(
        TRAVERSE,
        ("form", "per_instance", "no_timing"),
        excludes=("table=none",),
        why="is of the table, and --json and terminals get the summary; redirect it, or add --output",
    ),
    # Pictures
    Rule(RENDER, NOT_COMPARED, excludes=("compare",)),
    Rule(RENDER, ("asserts", "plot", "max_sh"), needs=("compare",)),
    Rule(RENDER, NOT_OF_THUMBNAILS, excludes=("thumbnail",)),
    Rule(RENDER, ("color_by",), excludes=("diff",), why=", which compares the splats' own colours"),
    Rule(RENDER, ("gain",), needs=("diff",)),
    Rule(RENDER, ("no_bar",), needs=("color_by", "diff")),
    Rule(RENDER, ("alpha",), excludes=("background",), why=", which fills what is transparent"),
    Rule(
        RENDER,
        ("backend", "device"),
        needs=("style=splats",),
        why=f"{STYLED}, which every picture gets from one renderer",
    ),
    Rule(RENDER, ("profile",), needs=("style=splats",), why=STYLED),
    Rule(RENDER, ("sort",), needs=("style=splats", "style=sorted-billboards"), why=STYLED),
    Rule(RENDER, ("device",), excludes=("backend=osmesa", "backend=open3d")),
    Rule(RENDER, ("profile", "sort"), excludes=("backend=open3d",)),
    Rule(RENDER, ("sorting", "sort_throttle"), needs=("backend=osmesa",)),
    Rule(RENDER, ("sort", "style", "backend", "device"), excludes=("color_by=overdraw",), why=", which counts splats"),
    Rule(RENDER, ("jpeg_quality",), only_for=("picture=jpg",), why="can only be used with a .jpg"),
    Rule(RENDER, ("no_bar",), excludes=("picture=npy",), why=OF_NUMBERS),
    Rule(
        RENDER,
        ("background", "alpha"),
        excludes=("picture=npy",),
        when=("color_by=overdraw", "color_by=depth"),
        why=OF_NUMBERS,
    ),
    # Cameras
    Rule(CAMERAS, SOURCES, excludes=SOURCES, why="and {other} cannot be used together; give one source of cameras"),
    Rule(CAMERAS, ("camera_format", "camera_axes"), needs=("camera_path",)),
    Rule(
        CAMERAS,
        ("center", "distance", "elevation"),
        excludes=("camera_path", "look_at", "keyframes", "views"),
        why="can only be used with --orbit or --dolly",
    ),
    Rule(
        CAMERAS,
        ("seconds",),
        excludes=("camera_path", "look_at", "views"),
        why="can only be used with --orbit or --dolly or --keyframes",
    ),
    Rule(CAMERAS, ("world_transform",), needs=("camera_path", "look_at", "views", "keyframes")),
    Rule(CAMERAS, ("fps", "every"), excludes=("look_at", "views"), why=STILL),
    Rule(RENDER, ("fps", "every", "seconds"), needs=PATHS, why=STILL),
    Rule(CAMERAS, ("fps",), excludes=("seconds",), when=("orbit",), why=OF_ORBITS),
    Rule(TRAVERSE, ("fps",), needs=PATHS, when=("seconds",), why=OF_ORBITS),
    # Cuts
    Rule(CAMERAS, ("preset",), excludes=("budget",)),
    Rule(CAMERAS, ("lod_render_scale",), excludes=("pixel_scale_limit",)),
    Rule(CAMERAS, CONES, excludes=("outside_foveate",)),
    Rule(RENDER, (*CUTS, *LEVELS), excludes=("full",)),
    Rule(CAMERAS, ("lod_base_distance",), needs=("budget_mode=limit",)),
    Rule(RENDER, ("blend",), needs=("continuous",)),
    Rule(RENDER, ("full", "continuous", "compare"), excludes=("after",)),
    Rule(CAMERAS, ("lod_underfill", "latency", "fetchers", "after"), needs=("bandwidth",)),
    Rule(RENDER, ("bandwidth", "chunk_cache"), needs=("after",)),
    Rule(CAMERAS, (*PIXELS, *NODES, *INDICES, "chunk_cache"), excludes=("scenes=Streamed SOG",), why=OF_TREES),
    Rule(
        CAMERAS,
        ("budget", "preset", "lod_splat_scale", *NODES, *LEVELS, *INDICES, "chunk_cache"),
        excludes=("scenes=3D Tiles",),
        why=NO_BUDGET,
    ),
    Rule(CAMERAS, LEVELS, excludes=("scenes=a Level-of-Detail tree",), why=OF_LEVELS),
    Rule(RENDER, (*CUTS, *LEVELS, *NETWORK), excludes=("scenes=None",), why=PLAIN),
)


def check(ctx: click.Context, **facts: Any) -> None:
    """Raise a `click.UsageError` if options contradict each other, or the facts known so far."""
    values = {**ctx.params, "stdout": "terminal" if is_terminal(sys.stdout) else "file", **facts}
    for rule in RULES:
        if ctx.command.name not in rule.commands or (rule.when and not _holding(ctx, rule.when, values)):
            continue
        if rule.only_for and rule.only_for[0].partition("=")[0] not in facts:
            continue
        for name in _holding(ctx, rule.options, values):
            others = [each for each in _holding(ctx, rule.excludes, values) if each != name]
            required = rule.needs or rule.only_for
            if others or (required and not _holding(ctx, required, values)):
                text = _usual(ctx, rule, others, values) if rule.why[:1] in ("", ",", ";") else " "
                other = flag_of(ctx, others[0]) if others and "=" not in others[0] else ""
                raise click.UsageError(flag_of(ctx, name) + text + rule.why.format(**values | {"other": other}), ctx)


def _usual(ctx: click.Context, rule: Rule, others: list[str], values: Mapping[str, Any]) -> str:
    """Return the usual words after the flag: what it cannot, or can only, be used with, or whose option it is."""
    if rule.only_for:
        fact = rule.only_for[0].partition("=")[0]
        known = " and ".join(each.partition("=")[2] for each in rule.only_for)
        return f" is an option of {known}, not of {values[fact]}"
    named = [
        f"{flag_of(ctx, name)} {value}".rstrip()
        for name, _, value in (each.partition("=") for each in others[:1] or rule.needs)
        if name in ctx.params
    ]
    return f" {'cannot' if others else 'can only'} be used with {' or '.join(named)}"


def _holding(ctx: click.Context, conditions: Iterable[str], values: Mapping[str, Any]) -> list[str]:
    """Return the conditions that hold; an option given as None, such as a transparent background, does not."""
    parts = ((each, *each.partition("=")) for each in conditions)
    return [
        each
        for each, name, equals, value in parts
        if (name in values and str(values[name]) == value if equals else is_set(ctx, name) and values[name] is not None)
    ]


def is_set(ctx: click.Context, name: str) -> bool:
    """Return whether a parameter was given, even with its default value."""
    return ctx.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT)


def flag_of(ctx: click.Context, name: str) -> str:
    """Return the flag of a parameter, such as --lod-splat-scale for lod_splat_scale, or the name of an argument."""
    param = next(param for param in ctx.command.params if param.name == name)
    return max(param.opts, key=len) if isinstance(param, click.Option) else str(param.metavar).strip("[].")
