"""Options of `sparklod build-lod`, in part shared with `simplify`, and the formats that names of outputs choose."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from ...codecs.formats import MANIFEST, TILESET, WRITABLE, ending_of
from ...codecs.formats import RAD_SUFFIX as RAD
from ...codecs.options import MAX_SH_CODES, SH_CODES, SogOptions, WriteOptions
from ...fitting import FIT_DEVICE_HELP, SEED, SEED_HELP, STEPS
from ...lod.tree_settings import (
    BUILDERS,
    DEFAULT_BASE,
    DEFAULT_GROWTH,
    DETAIL_GROWTH,
    MAX_BASE,
    MAX_GROWTH,
    METHODS,
    MIN_BASE,
    MIN_GROWTH,
    DetailSettings,
    TileSettings,
)
from ...model import MAX_SH_DEGREE, UP_AXES
from ...render import DEVICES
from ...system.addresses import Place
from ...system.setting_fields import Quantity, Range, setting, whole
from ...system.stdio import DASH
from ...system.units import parse_size
from ..command import BALL, COMMON, POINT, OptionalNumber, flag, parameters_of
from ..paths import NamedPath, stem_of
from ..rules import flags_set
from .common import EACH_AS_JSON, JSON, OUTPUT, OVERWRITE, General

if TYPE_CHECKING:
    from ...api.bake_jobs import BakeSettings

#: Headings of `--help`.
TREE, SELECTION, POSITION, FILE_FORMAT = "Tree", "Selection", "Rotation, scale and position", "File format"
DETAIL, TILED, REFINING = DetailSettings.HEADING, TileSettings.HEADING, "Refining"
LARGE, CLUSTER = "Large scenes", "Cluster"

#: Suffixes of the formats in which a tree can be written, and what they are called; the first one is the default.
TREES = {suffix: form.name for suffix, form in WRITABLE.items() if form.trees}
SPZ = next(iter(TREES))

#: The values of --format for regions at several detail levels, and for tiles.
STREAMED_SOG, TILES_3D = "streamed-sog", "3d-tiles"

#: Default builders of trees, and of trees that detail levels or tiles are cut from.
METHOD, METHOD_OF_DETAIL = METHODS[0], "quality"

#: Value of --refine without a number, and an example of a useful number.
BY_SIZE, EXAMPLE_STEPS = "default", 2000

#: Values of --skip-existing: read only files whose size or date changed, or all.
BY_DATE, VERIFY = "date", "verify"


class OutputForm(NamedTuple):
    """Format and files of an output of build-lod.

    Attributes:
        suffix: of the file.
        chunked: each chunk of a RAD gets a file of its own.
        cuts: name of the format, if it has cuts of a tree and not the tree; otherwise empty.
        manifest: name of the file of such a format.
        beside: the files beside the manifest, for display.
    """

    suffix: str
    chunked: bool = False
    cuts: str = ""
    manifest: str = ""
    beside: str = ""


#: Values of --format.
FORMS = {
    "spz": OutputForm(".spz"),
    "rad": OutputForm(".rad"),
    "rad-chunked": OutputForm(".rad", chunked=True),
    STREAMED_SOG: OutputForm(".json", cuts=DETAIL, manifest=MANIFEST, beside="folders"),
    TILES_3D: OutputForm(".json", cuts=TILED, manifest=TILESET, beside="a folder"),
}

#: Values of --format whose manifest has a name of its own, by that name.
MANIFESTS = {form.manifest: name for name, form in FORMS.items() if form.manifest}


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

    def settings(self, ctx: click.Context) -> dict[str, Any]:
        """Return the fields of `BakeSettings` for the scene; loads numpy."""
        from ...model.selection import Selection

        parts: dict[str, Any] = {
            "up": self.up or UP_AXES[0],
            "rotate": self.rotate,
            "scale": self.scale,
            "translate": self.translate,
        }
        transform = None
        if parts != {"up": UP_AXES[0], "rotate": (0, 0, 0), "scale": 1, "translate": (0, 0, 0)}:
            from ...model.transforms import Transform

            try:
                transform = Transform.from_parts(**parts)
            except ValueError as error:
                raise click.UsageError(str(error)) from None
        selection = Selection(
            drop_invalid=self.on_invalid == "drop",
            min_opacity=self.min_opacity,
            min_box=self.min_box,  # type: ignore[arg-type]
            max_box=self.max_box,  # type: ignore[arg-type]
            within=self.within,
        )
        unused = tuple(flags_set(ctx, OF_TREES))
        return {"selection": selection, "transform": transform, "up": self.up, "rgba": self.rgba, "unused": unused}


#: Parameters without an effect on an input that has a tree, of any command.
_BUILT = ("method", "max_sh", *(builder.setting for builder in BUILDERS.values()))
OF_TREES = (*_BUILT, *parameters_of(SceneOptions), "environment_beyond")


def write_options(options: WriteOptions, sh_codes: int | None, *, chunked: bool = False) -> WriteOptions:
    """Return write options with those of the command; defaults are left to the library, which knows the input."""
    rad = dataclasses.replace(options.rad, chunked=chunked, sh_codes=sh_codes)
    return dataclasses.replace(options, rad=rad, sog=SogOptions(sh_codes))


def memory_size(text: str) -> int:
    """Parse an amount of memory such as 4G or "600 MB"; raise `ValueError` for one without a unit."""
    size = parse_size(text)
    if not text.strip()[-1:].isalpha():
        raise ValueError(f"{text!r} has no unit; write {text.strip()}G or {text.strip()}MB")
    if size < 1:
        raise ValueError(f"{text!r} must be positive, such as 4G")
    return size


@dataclass(frozen=True)
class BuildLodOptions:
    """Options of build-lod."""

    inputs: tuple[Place, ...] = setting(
        "", NamedPath(stdin=True, addresses=True), (), argument=True, nargs=-1, metavar="INPUT..."
    )
    merge: bool = flag(
        "Bake all INPUTs as one scene, into the file that --output names: tiles of a city, each where its own"
        " coordinates put it.",
        heading=COMMON,
    )
    scene: Path | None = setting(
        "Merge the files of an instances file, each where it stands there, in place of INPUTs (see docs/build-lod.md).",
        NamedPath(),
        heading=COMMON,
    )
    output: Place | None = setting(
        "Output of a single input, or a folder for all outputs; - is standard output.  [default: NAME-lod.spz beside"
        f" the input; NAME-lod.rad with --format rad, NAME-lod/{MANIFEST} with --format {STREAMED_SOG},"
        f" NAME-lod/{TILESET} with --format {TILES_3D},"
        " NAME-lod-refined.spz of a NAME-lod.spz with --refine]",
        NamedPath(output=True, addresses=True),
        **OUTPUT,
    )
    output_dir: Place | None = setting(
        "Folder for the outputs; created if it does not exist.",
        NamedPath(output=True, folder=True, addresses=True),
        heading=COMMON,
    )
    overwrite: bool = flag(**OVERWRITE)
    skip_existing: str | None = setting(
        "Skip inputs whose output exists already, made from the same inputs and settings, as a small file beside it,"
        " NAME.sparklod.json, records. Files whose size and date are unchanged are not read;"
        " --skip-existing=verify reads all, and so finds damage that left both as they were.",
        (BY_DATE, VERIFY),
        heading=LARGE,
        metavar="[=verify]",
        bare=BY_DATE,
    )
    form: str | None = setting(
        "Format of the output. rad is what Spark streams; rad-chunked writes each chunk to a file of its own,"
        " NAME-lod-0.radc and so on, beside NAME-lod.rad; streamed-sog is what PlayCanvas, SuperSplat and Babylon.js"
        f" stream, {MANIFEST} and folders beside it; 3d-tiles is what CesiumJS streams, {TILESET} and a folder beside"
        " it. A Level-of-Detail file of another format keeps its tree. "
        " [default: by the name of FILE, or spz]",
        tuple(FORMS),
        flags=("--format",),
        heading=COMMON,
    )
    refine: int | None = setting(
        "Fit merged splats to pictures of full detail, in STEPS pictures of cuts: minutes, for cuts that come closer to"
        " it. The leaves stay as they are, and so does the tree of a Level-of-Detail file. Ctrl-C ends it early and"
        " keeps what was gained.  [default, without STEPS: by the size of the tree]",
        OptionalNumber(STEPS, placeholder="STEPS", example=EXAMPLE_STEPS, zero=BY_SIZE),
        is_flag=False,
        flag_value=BY_SIZE,
        heading=REFINING,
    )
    camera_path: Path | None = setting(
        "Cameras that --refine fits for, in the coordinates of the output, in any format that render reads: those of"
        " visitors whose paths are known.  [default: cameras around and inside the scene]",
        NamedPath(),
        heading=REFINING,
    )
    seed: int = setting(SEED_HELP, SEED, 0, heading=REFINING)
    device: str = setting(FIT_DEVICE_HELP, DEVICES, "cpu", heading=REFINING)
    method: str | None = setting(
        "How splats are merged: quick takes seconds; quality takes longer, and its cuts come closer to full detail."
        f"  [default: {METHOD}; {METHOD_OF_DETAIL} with --format {STREAMED_SOG} or {TILES_3D}]",
        METHODS,
        heading=COMMON,
    )
    max_sh: int = setting(
        "Highest degree of spherical harmonics to keep.", whole(0, MAX_SH_DEGREE), MAX_SH_DEGREE, heading=COMMON
    )
    base: float = setting(
        "Growth of the voxel grid from level to level, with --method quick. Smaller values give smoother transitions"
        " and more nodes.",
        Range(MIN_BASE, MAX_BASE, unit="N"),
        DEFAULT_BASE,
        heading=TREE,
    )
    growth: float | None = setting(
        "Largest number of nodes for each leaf, with --method quality."
        f"  [default: {DEFAULT_GROWTH:g}; {DETAIL_GROWTH:g} with --format {STREAMED_SOG} or"
        f" {TILES_3D}]",
        Range(MIN_GROWTH, MAX_GROWTH, unit="N"),
        heading=TREE,
    )
    input_scene: SceneOptions = field(default_factory=SceneOptions)
    written: WriteOptions = field(default_factory=WriteOptions)
    cluster_sh: int | None = setting(
        "Write spherical harmonics to RAD as a palette of at most N entries, 2 to 65,536, and a label for each splat:"
        " the file gets smaller, and reflections less exact. N is 65,536 if it is left out. SOG always has a palette;"
        " this chooses its size, which otherwise suits the number of splats.",
        OptionalNumber(SH_CODES, example=MAX_SH_CODES),
        is_flag=False,
        flag_value=str(MAX_SH_CODES),
        heading=FILE_FORMAT,
    )
    detail: DetailSettings = field(default_factory=DetailSettings)
    environment: Path | None = setting(
        "Splats that are always drawn, such as a sky, from a file of any format without a tree; turned and moved as the"
        " scene.",
        NamedPath(),
        heading=DETAIL,
    )
    environment_beyond: float | None = setting(
        "Make splats whose centre is farther than this from the median of all centres the environment, in the input's"
        " units.",
        Range(above=0, unit="RADIUS"),
        heading=DETAIL,
    )
    tiles: TileSettings = field(default_factory=TileSettings)
    memory: int | None = setting(
        "Memory that a bake may take, such as 4G or '600 MB'. A scene that needs more is baked out of core: block by"
        " block, with a scratch folder.  [default: 75 % of what is available]",
        Quantity("SIZE", memory_size),
        heading=LARGE,
    )
    scratch_dir: Place | None = setting(
        "Where a bake out of core makes its scratch folder, which is removed at the end.  [default: beside the output]",
        NamedPath(output=True, folder=True, addresses=True),
        heading=LARGE,
    )
    resume: bool = flag(
        "Go on with a bake out of core that was interrupted; it must be the same bake. Without one, begin.",
        heading=LARGE,
    )
    workers: int | None = setting(
        "Bake on this many processes of this machine, which share --threads and --memory.",
        whole(1, 256),
        heading=CLUSTER,
    )
    scheduler: str | None = setting(
        "Bake on the Dask cluster whose scheduler has this address, as tcp://host:8786.",
        metavar="ADDRESS",
        heading=CLUSTER,
    )
    as_json: bool = flag(EACH_AS_JSON, **JSON)
    general: General = field(default_factory=General)

    @property
    def name(self) -> str:
        """Name of the output; empty if none is given, and for standard output."""
        return self.output.name if self.output is not None and self.output != DASH else ""

    @property
    def output_form(self) -> OutputForm:
        """Format of the output, by --format, or else by the name of the output."""
        form = self.form
        if form is None:
            form = MANIFESTS.get(self.name)
        if form is not None:
            return FORMS[form]
        refines_rad = self.refine is not None and {each.suffix.lower() for each in self.inputs} == {RAD}
        return OutputForm(ending_of(self.name) or (RAD if refines_rad else SPZ))

    @property
    def builder(self) -> str:
        """Builder of the tree, by --method, or else by the format."""
        return self.method or (METHOD_OF_DETAIL if self.output_form.cuts else METHOD)

    @property
    def format(self) -> str:
        """Name of the format that is written; empty if there is none for the suffix."""
        form = self.output_form
        return form.cuts or (WRITABLE[form.suffix].name if form.suffix in WRITABLE else "")

    def target(self, source: Place) -> Place:
        """Return the output for an input."""
        if self.output is not None:
            return self.output
        form, stem = self.output_form, stem_of(source)
        known = self.form is not None or self.refine is not None
        if form.cuts or (known and source.suffix.lower() in TREES):
            stem = stem.removesuffix("-lod")  # a tree in another format has its name
        name = f"{stem}-lod{form.suffix}"
        if form.cuts:
            name = f"{stem}-lod/{form.manifest}"
        elif self.refine is not None and name == source.name:
            name = f"{stem}-lod-refined{form.suffix}"
        return (self.output_dir or source.parent) / name

    def bake_settings(self, ctx: click.Context) -> BakeSettings:
        """Return the settings of bakes; loads numpy."""
        from ...api.bake_jobs import BakeSettings

        refine = None
        if self.refine is not None:
            from ...fitting.settings import FitSettings

            refine = FitSettings(self.refine or None, self.seed, device=self.device)
        form = self.output_form
        growth = DETAIL_GROWTH if form.cuts else DEFAULT_GROWTH
        return BakeSettings(
            method=self.builder,
            base=self.base,
            growth=growth if self.growth is None else self.growth,
            max_sh=self.max_sh,
            **self.input_scene.settings(ctx),
            suffix=form.suffix,
            options=write_options(self.written, self.cluster_sh, chunked=form.chunked),
            detail=self.detail if form.cuts == DETAIL else None,
            tiles=self.tiles if form.cuts == TILED else None,
            environment=self.environment,
            environment_beyond=self.environment_beyond,
            refine=refine,
            camera_path=self.camera_path,
            converts=self.form is not None or ending_of(self.name) in TREES or bool(form.cuts),
        )
