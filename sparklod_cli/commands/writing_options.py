"""Options of the commands that write scenes, and the format and files of their outputs."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from ..codecs.formats import (
    MANIFEST,
    MAX_SH_CODES,
    META,
    NPZ,
    RAW_SUFFIXES,
    SH_CODES,
    TILESET,
    WRITABLE,
    SogOptions,
    WriteOptions,
    ending_of,
)
from ..lod.tree_settings import BUILDERS
from ..model import MAX_SH_DEGREE, UP_AXES
from ..system.addresses import Place
from ..system.setting_fields import Quantity, Range, setting, whole
from ..system.stdio import DASH
from ..system.units import parse_size
from .command import BALL, COMMON, POINT, common, flag
from .option_groups import JSON, General
from .outputs import Folder, NamedPath, keep_apart, require_suffix
from .rules import check, flag_of, is_set

if TYPE_CHECKING:
    from ..bake.settings import BakeSettings
    from ..model.instances import Instance

#: Headings of `--help` of options of scenes.
SELECTION, POSITION, FILE_FORMAT = "Selection", "Rotation, scale and position", "File format"
SCENE_HEADINGS = (COMMON, SELECTION, POSITION, FILE_FORMAT, "RAD")


class Form(NamedTuple):
    """Format and files of an output of scenes.

    Attributes:
        name: of the format; "--layout" for arrays, and empty for an ending that no format has.
        suffix: ending of the name, as `WRITABLE` knows it, or that of arrays.
        chunked: each chunk of a RAD gets a file of its own.
        manifest: name of the first file of a format that has cuts of a tree and not the tree; otherwise empty.
        beside: the files beside the manifest, for display.
    """

    name: str
    suffix: str
    chunked: bool = False
    manifest: str = ""
    beside: str = ""


#: Values of --format: those of trees and their cuts, and those of plain splats and arrays.
TREE_FORMS = {
    "spz": Form("SPZ", ".spz"),
    "rad": Form("RAD", ".rad"),
    "rad-chunked": Form("RAD", ".rad", chunked=True),
    "streamed-sog": Form("Streamed SOG", ".json", manifest=MANIFEST, beside="folders"),
    "3d-tiles": Form("3D Tiles", ".json", manifest=TILESET, beside="a folder"),
}
ARRAYS = (NPZ, *RAW_SUFFIXES)
PLAIN_FORMS = {
    **{end[1:]: Form(form.name, end) for end, form in WRITABLE.items() if not form.trees and end.startswith(".")},
    **{suffix[1:]: Form("--layout", suffix) for suffix in ARRAYS},
}
FORMS = TREE_FORMS | PLAIN_FORMS


def form_of(output: Place | Folder | None, choice: str | None = None) -> Form:
    """Return the format that --format chooses, or else the name of an output; SPZ without either."""
    if choice is not None:
        return FORMS[choice]
    name = "" if output in (None, DASH) or isinstance(output, Folder) else output.name
    ending = ending_of(name) or ".spz"
    known = (form for form in FORMS.values() if form.manifest == name or (form.suffix == ending and not form.manifest))
    return next(known, Form(WRITABLE[ending].name if ending in WRITABLE else "", ending))


def check_outputs(
    ctx: click.Context,
    form: Form,
    outputs: Sequence[Place],
    endings: Iterable[str],
    instances: Iterable[Instance] = (),
    **facts: Any,
) -> None:
    """Raise a `click.UsageError` where the name of --output contradicts its format, or an output is an input.

    Args:
        outputs: those of all inputs, without the files beside them that are replaced or removed with them.
        endings: possible endings of the name.
        instances: of --scene, whose files are inputs.
        facts: further facts of the rules.
    """
    files = list(outputs)
    if form.chunked or form.manifest or form.suffix == META:
        from ..io.writing import siblings_of

        for header in outputs:
            if isinstance(header, Path):
                target = Path(os.path.realpath(header))
                files += [target.parent / name for name in siblings_of(header).existing(target)]
    keep_apart(ctx, {"output": files, "scene": [each.file for each in instances if each.file is not None]})
    file, choice, flag = ctx.params["output"], ctx.params.get("form"), flag_of(ctx, "output")
    if file is None or isinstance(file, Folder):
        pass
    elif choice is None:
        require_suffix(flag, file, endings)
    elif (form.manifest or form.chunked) and file == DASH:
        example = form.manifest or f"scene{form.suffix}"
        raise click.UsageError(f"--format {choice} writes several files; name the output, such as web/{example}")
    elif form.manifest and file.name != form.manifest:
        raise click.UsageError(
            f"--format {choice} writes {form.manifest} and {form.beside} beside it, not {file.name}; name the"
            f" output {file.parent / file.stem / form.manifest}"
        )
    elif not form.manifest and ending_of(file.name) not in ("", form.suffix):
        raise click.UsageError(f"--format {choice} writes {form.suffix}, not {ending_of(file.name)}")
    check(ctx, format=form.name, **facts)


@dataclass(frozen=True)
class SceneOptions:
    """Options that select splats of the input, and rotate, scale and move the scene."""

    min_opacity: float = common("Leave out splats whose opacity is lower than this.", Range(0, 1, unit="N"), 0.0)
    within: Any = common("Leave out splats whose centre is outside this ball, in the input's coordinates.", BALL)
    min_box: tuple[float, ...] | None = setting(
        "Leave out splats whose centre is below this on any axis, in the input's coordinates.", POINT, heading=SELECTION
    )
    max_box: tuple[float, ...] | None = setting(
        "Leave out splats whose centre is above this on any axis, in the input's coordinates.", POINT, heading=SELECTION
    )
    on_invalid: str = setting(
        "Fail on invalid splats (numbers that are not finite, negative scales), or leave them out.",
        ("error", "drop"),
        "error",
        heading=SELECTION,
    )
    rgba: Path | None = setting(
        "Replace colours and opacities by a .npy or raw file of (N, 4) bytes or floats 0..1; alpha 0 drops a splat.",
        NamedPath(),
        heading=SELECTION,
    )
    up: str | None = common(
        "Axis that is up in the input, mostly -y as trained: turn it to +y, and note that in the output."
        "  [default: note what the file says, and turn nothing]",
        UP_AXES,
    )
    rotate: tuple[float, ...] = setting(
        "Turn the scene by these angles about x, then y, then z, in degrees, after --up.  [default: 0,0,0]",
        POINT,
        (0.0, 0.0, 0.0),
        heading=POSITION,
    )
    scale: float = setting(
        "Factor by which the scene is scaled about its origin, after --rotate.", Range(above=0), 1.0, heading=POSITION
    )
    translate: tuple[float, ...] = setting(
        "Move the scene by this, in world units, after --scale.  [default: 0,0,0]",
        POINT,
        (0.0, 0.0, 0.0),
        heading=POSITION,
    )


#: Parameters of all commands that have no effect on an input with a tree.
_BUILT = ("method", "max_sh", *(builder.setting for builder in BUILDERS.values()))
OF_TREES = (*_BUILT, *(each.name for each in dataclasses.fields(SceneOptions)), "environment_beyond")


class OptionalNumber(click.IntRange):
    """Number that may be left out; the text `zero` means 0, even outside the range."""

    def __init__(self, range: Range, *, placeholder: str = "N", example: int, zero: str = "") -> None:
        super().__init__(range.least, range.most)  # type: ignore[arg-type]  # whole numbers
        self.placeholder, self.example, self.zero = placeholder, example, zero

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if self.zero and value == self.zero:
            return 0
        if isinstance(value, str) and not value.lstrip("-").isdigit() and param is not None:
            flag, example = param.opts[0], f"{param.opts[0]}={self.example}"
            self.fail(f"{value!r} is no number; put {flag} after the inputs, or write {example}", param, ctx)
        number: int = super().convert(value, param, ctx)
        return number

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"[{self.placeholder}]"


@dataclass(frozen=True)
class Writing:
    """Options of all commands that write scenes: selection, position, file format, and messages."""

    max_sh: int = common("Highest degree of spherical harmonics to keep.", whole(0, MAX_SH_DEGREE), MAX_SH_DEGREE)
    scene: SceneOptions = field(default_factory=SceneOptions)
    written: WriteOptions = field(default_factory=WriteOptions)
    cluster_sh: int | None = setting(
        "Write spherical harmonics to RAD as a palette of at most N entries, 2 to 65,536 (the default), which makes"
        " files smaller and reflections less exact. SOG always has a palette, which otherwise suits the number of"
        " splats.",
        OptionalNumber(SH_CODES, example=MAX_SH_CODES),
        is_flag=False,
        flag_value=str(MAX_SH_CODES),
        heading=FILE_FORMAT,
    )
    as_json: bool = flag("Print one JSON object for each file on standard output.", **JSON)
    general: General = field(default_factory=General)

    def settings(self, ctx: click.Context, form: Form, **more: Any) -> BakeSettings:
        """Return the settings of a bake or conversion, with further ones in `more`; loads numpy."""
        from ..bake.settings import BakeSettings
        from ..model.selection import Selection

        scene, transform = self.scene, None
        position = (scene.up or UP_AXES[0], scene.rotate, scene.scale, scene.translate)
        if position != (UP_AXES[0], (0, 0, 0), 1, (0, 0, 0)):
            from ..model.transforms import Transform

            up, rotate, scale, translate = position
            try:
                transform = Transform.from_parts(up=up, rotate=rotate, scale=scale, translate=translate)
            except ValueError as error:
                raise click.UsageError(str(error)) from None
        rad = dataclasses.replace(self.written.rad, chunked=form.chunked, sh_codes=self.cluster_sh)
        return BakeSettings(
            max_sh=self.max_sh,
            suffix=form.suffix,
            options=dataclasses.replace(self.written, rad=rad, sog=SogOptions(self.cluster_sh)),
            selection=Selection(
                drop_invalid=scene.on_invalid == "drop",
                min_opacity=scene.min_opacity,
                min_box=scene.min_box,  # type: ignore[arg-type]
                max_box=scene.max_box,  # type: ignore[arg-type]
                within=scene.within,
            ),
            transform=transform,
            up=scene.up,
            rgba=scene.rgba,
            unused=tuple(flag_of(ctx, name) for name in OF_TREES if is_set(ctx, name)),
            **more,
        )


def _memory(text: str) -> int:
    """Parse an amount of memory such as 4G or "600 MB"; raise `ValueError` for one without a unit."""
    size = parse_size(text)
    if not text.strip()[-1:].isalpha():
        raise ValueError(f"{text!r} has no unit; write {text.strip()}G or {text.strip()}MB")
    if size < 1:
        raise ValueError(f"{text!r} must be positive, such as 4G")
    return size


MEMORY = Quantity("SIZE", _memory)
