"""Options that several commands have: general ones, tables, scenes and how they are written."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..codecs.options import SogOptions, WriteOptions
from ..lod.tree_settings import BUILDERS
from ..model import UP_AXES
from ..system.errors import CHECK_FAILED
from ..system.setting_fields import Range, setting, whole
from ..system.stdio import DASH
from ..system.units import parse_size
from .command import BALL, COMMON, GENERAL, POINT, flag, parameters_of
from .console import Console, is_terminal
from .outputs import Form, NamedPath, require_suffix
from .rules import flags_set

if TYPE_CHECKING:
    from ..bake.settings import BakeSettings
    from ..model.transforms import Transform
    from ..tables.assertions import Assertion, Outcome
    from ..tables.columns import Column, TableOutput

#: Headings of `--help` of options of scenes.
SELECTION, POSITION, FILE_FORMAT = "Selection", "Rotation, scale and position", "File format"
SCENE_HEADINGS = (COMMON, SELECTION, POSITION, FILE_FORMAT, "RAD")

#: Largest accepted number of threads.
MAX_THREADS = 256


def processors_to_use() -> int:
    """Return the default of --threads."""
    from ..system.threads import processors

    return min(processors(), MAX_THREADS)


#: Attributes of options that several commands have, see `setting`.
JSON: dict[str, Any] = {"flags": ("--json",), "heading": GENERAL}
QUIET: dict[str, Any] = {"flags": ("-q", "--quiet")}
VERBOSE: dict[str, Any] = {"flags": ("-v", "--verbose")}
OUTPUT: dict[str, Any] = {"flags": ("-o", "--output"), "heading": COMMON}
OVERWRITE: dict[str, Any] = {"help": "Replace outputs that exist.", "flags": ("-f", "--overwrite"), "heading": COMMON}
ASSERT: dict[str, Any] = {"flags": ("--assert",), "metavar": "TEXT", "multiple": True}

#: Type of a picture of a table or of a file.
PNG = NamedPath(output=True, suffixes=[".png"])

#: Help of `--up` of cameras, and its default.
UP = "Axis that is up, such as -y, or a direction x,y,z."
DEFAULT_UP = "  [default: what the files or their formats say, or -y, as training leaves scenes"

#: Help of `--json` of commands that print an object for each file.
EACH_AS_JSON = "Print one JSON object for each file on standard output."


@dataclass(frozen=True)
class General:
    """General options of the commands that read splat files."""

    HEADING: ClassVar[str] = GENERAL

    quiet: bool = flag("Print nothing but errors.", **QUIET)
    verbose: bool = flag("Print how long each stage took, and which settings were chosen.", **VERBOSE)
    threads: int = setting(
        "Number of threads to work on.", whole(1, MAX_THREADS), processors_to_use, show_default="all processors"
    )


def table_output(
    output: Path | None,
    columns: Sequence[Column],
    *,
    overwrite: bool,
    as_json: bool = False,
    flag: str = "--output",
    form: str | None = None,
) -> TableOutput:
    """Return the destination of a table, with its format by --format, or else by the name of the output.

    Without an output, the table is CSV on standard output. It is not written (form None) where an object goes there
    with --json, and on a terminal, where it would scroll by and the summary is printed instead.
    """
    from ..tables.columns import FORMS, TableOutput

    if output is None and (as_json or is_terminal(sys.stdout)):
        return TableOutput(None, None, columns, overwrite=overwrite)
    if output is not None and form is None:
        require_suffix(flag, output, (f".{each}" for each in FORMS))
    suffix = output.suffix.lower()[1:] if output is not None else ""
    if suffix and form is None and suffix not in FORMS:
        raise click.UsageError(f"{flag} {output}: tables are written as {', '.join(f'.{form}' for form in FORMS)}")
    if suffix and form is not None:
        from ..codecs.formats import FORMATS
        from ..images.picture_files import MOVING, STILL, SUFFIXES

        of_splats = (suffix for each in FORMATS for suffix in each.suffixes)
        others = {*FORMS, *STILL, *MOVING, *SUFFIXES, "html", "npz"}
        if suffix != form and (suffix in others or f".{suffix}" in of_splats):
            raise click.UsageError(f"{flag} {output} does not end in .{form}, which --format asks for")
    form = form or suffix or next(iter(FORMS))
    return TableOutput(None if output == DASH else output, form, columns, overwrite=overwrite)


def report_outcomes(console: Console, outcomes: Sequence[Outcome], places: Iterable[str] = itertools.repeat("")) -> int:
    """Print the outcomes of assertions, each with where it is; return the exit status."""
    for outcome, place in zip(outcomes, places):  # noqa: B905  # places may be endless
        if outcome.held:
            console.detail(f"  holds: {outcome.message()}{place}")
        else:
            console.error(f"{outcome.message()}{place}")
    return 0 if all(outcome.held for outcome in outcomes) else CHECK_FAILED


def parse_asserts(texts: Sequence[str], columns: Sequence[Column]) -> list[Assertion]:
    """Parse the values of --assert; raise a `click.UsageError` for one that cannot be understood."""
    if not texts:
        return []
    from ..tables.assertions import BadAssertionError, parse

    try:
        return [parse(text, columns) for text in texts]
    except BadAssertionError as error:
        raise click.UsageError(f"--assert {error}") from None


# Scenes


@dataclass(frozen=True)
class SceneOptions:
    """Options of which splats of the input are kept, and how the scene is turned, scaled and moved."""

    min_opacity: float = setting(
        "Leave out splats whose opacity is lower than this.", Range(0, 1, unit="N"), 0.0, heading=COMMON
    )
    within: Any = setting(
        "Leave out splats whose centre is outside this ball, in the input's coordinates.", BALL, heading=COMMON
    )
    min_box: tuple[float, ...] | None = setting(
        "Leave out splats whose centre is below this on any axis, in the input's coordinates.", POINT, heading=SELECTION
    )
    max_box: tuple[float, ...] | None = setting(
        "Leave out splats whose centre is above this on any axis, in the input's coordinates.", POINT, heading=SELECTION
    )
    on_invalid: str = setting(
        "Whether to fail on invalid splats or leave them out: numbers that are not finite, negative scales.",
        ("error", "drop"),
        "error",
        heading=SELECTION,
    )
    rgba: Path | None = setting(
        "Replace colours and opacities by those of a .npy or raw file of (N, 4) bytes or floats 0..1; splats of alpha 0"
        " are left out.",
        NamedPath(),
        heading=SELECTION,
    )
    up: str | None = setting(
        "Axis that is up in the input: turn it to +y, and note that in the output for render, traverse and view."
        " y turns nothing; scenes as trained are mostly -y.  [default: note what the file says, and turn nothing]",
        UP_AXES,
        heading=COMMON,
    )
    rotate: tuple[float, ...] = setting(
        "Turn the scene by these angles in degrees, about x, then y, then z, after --up.  [default: 0,0,0]",
        POINT,
        (0.0, 0.0, 0.0),
        heading=POSITION,
    )
    scale: float = setting(
        "Multiply the size of the scene by this, about its origin, after --rotate.",
        Range(above=0),
        1.0,
        heading=POSITION,
    )
    translate: tuple[float, ...] = setting(
        "Move the scene by this, in world units, after --scale.  [default: 0,0,0]",
        POINT,
        (0.0, 0.0, 0.0),
        heading=POSITION,
    )

    @property
    def transform(self) -> Transform | None:
        """Transform of the splats; None for the identity."""
        parts = {"up": self.up or UP_AXES[0], "rotate": self.rotate, "scale": self.scale, "translate": self.translate}
        if parts == {"up": UP_AXES[0], "rotate": (0, 0, 0), "scale": 1, "translate": (0, 0, 0)}:
            return None
        from ..model.transforms import Transform

        try:
            return Transform.from_parts(**parts)  # type: ignore[arg-type]
        except ValueError as error:
            raise click.UsageError(str(error)) from None


#: Parameters without an effect on an input that has a tree, of any command.
_BUILT = ("method", "max_sh", *(builder.setting for builder in BUILDERS.values()))
OF_TREES = (*_BUILT, *parameters_of(SceneOptions), "environment_beyond")


def bake_settings(
    ctx: click.Context, form: Form, scene: SceneOptions, written: WriteOptions, sh_codes: int | None, **more: Any
) -> BakeSettings:
    """Return the settings of a bake or conversion, `more` among them; loads numpy."""
    from ..bake.settings import BakeSettings
    from ..model.selection import Selection

    rad = dataclasses.replace(written.rad, chunked=form.chunked, sh_codes=sh_codes)
    return BakeSettings(
        suffix=form.suffix,
        options=dataclasses.replace(written, rad=rad, sog=SogOptions(sh_codes)),
        selection=Selection(
            drop_invalid=scene.on_invalid == "drop",
            min_opacity=scene.min_opacity,
            min_box=scene.min_box,  # type: ignore[arg-type]
            max_box=scene.max_box,  # type: ignore[arg-type]
            within=scene.within,
        ),
        transform=scene.transform,
        up=scene.up,
        rgba=scene.rgba,
        unused=tuple(flags_set(ctx, OF_TREES)),
        **more,
    )


def memory_size(text: str) -> int:
    """Parse an amount of memory such as 4G or "600 MB"; raise `ValueError` for one without a unit."""
    size = parse_size(text)
    if not text.strip()[-1:].isalpha():
        raise ValueError(f"{text!r} has no unit; write {text.strip()}G or {text.strip()}MB")
    if size < 1:
        raise ValueError(f"{text!r} must be positive, such as 4G")
    return size
