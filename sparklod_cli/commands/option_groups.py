"""Options that several commands have: general ones, scenes and how they are written, cameras, cuts and inputs."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..cameras import DEFAULT_SIZE, ELEVATION, ORBIT
from ..cameras.camera_formats import FORMATS, Axes
from ..codecs.formats import PRECISIONS
from ..codecs.options import SogOptions, WriteOptions
from ..lod.budget import LARGEST, Budget, parse_budgets
from ..lod.tree_settings import BUILDERS
from ..model import UP_AXES
from ..model.foveation import BEHIND_FOVEATE, CONE_FOV, CONE_FOV0, CONE_FOVEATE, Cones, Foveation, Frustum
from ..system.errors import CHECK_FAILED, CameraPathError, TooManyCamerasError
from ..system.setting_fields import Quantity, Range, setting, whole
from ..system.stdio import DASH
from ..system.units import check_grouping, parse_size
from ..system.untrusted import printable
from ..viewers.viewer_settings import BLEND, FACTOR, PLAYCANVAS_BUDGET, PRESETS, LodSettings, Network
from .command import BALL, COMMON, DIRECTION, GENERAL, POINT, SIZE, VIEW, VIEWS, flag, parameters_of
from .console import Console, is_terminal
from .outputs import Form, NamedPath, file_of, require_suffix
from .rules import check, flags_set, is_set

if TYPE_CHECKING:
    from ..bake.settings import BakeSettings
    from ..cameras.camera import Matrix
    from ..cameras.sources import CameraPath
    from ..model.instances import Instance
    from ..model.transforms import Transform
    from ..render.render_settings import RenderSettings
    from ..tables.assertions import Outcome
    from ..tables.columns import Column, TableOutput
    from ..viewers.scenes import Scenes

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


@contextlib.contextmanager
def assert_errors() -> Iterator[None]:
    """Turn the error that an assertion cannot be understood into a usage error that names the option."""
    from ..tables.assertions import BadAssertionError

    try:
        yield
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


# Cameras and cuts

#: Sources of cameras whose coordinates are given, so that nothing about them is chosen for the scene.
FIXED = ("camera_path", "look_at", "views", "keyframes")

#: Characters of a --world-transform given as numbers; any other text names a file.
NUMERIC = set("0123456789+-.,eE ")

#: Help and range of `--orbit`.
AROUND_SCENE = "Place N cameras around the scene.  [default, without any source of cameras: "
CAMERAS = whole(1, 1 << 20)


@dataclass(frozen=True)
class Cameras:
    """Values of the options of cameras; None for those not given."""

    HEADING: ClassVar[str] = "Cameras"

    camera_path: Path | None = setting(
        "Read the cameras from a file, or from a folder written by COLMAP.", NamedPath(), heading=COMMON
    )
    orbit: int | None = setting(f"{AROUND_SCENE}an orbit of {ORBIT}]", CAMERAS, heading=COMMON)
    look_at: Any = setting("Place one camera at EYE that looks at TARGET, each x,y,z.", VIEW, heading=COMMON)
    size: tuple[int, int] | None = setting(
        "Width and height of the images, in pixels; the vertical field of view is kept."
        f"  [default: the file's, or {DEFAULT_SIZE[0]}x{DEFAULT_SIZE[1]}]",
        SIZE,
        heading=COMMON,
    )
    dolly: bool = flag("Move the camera straight towards the scene, from far to near.")
    keyframes: Any = setting(
        "Move the camera smoothly through two or more views, separated by spaces or semicolons.", VIEWS
    )
    camera_format: str | None = setting(
        f"Format of --camera-path: {', '.join(form.name for form in FORMATS)}, or auto, which recognises it by its"
        " content.  [default: auto]",
        ("auto", *(form.name for form in FORMATS)),
        metavar="FORMAT",
    )
    camera_axes: str | None = setting(
        "Axes of the matrices of --camera-path: y up (opengl) or down (opencv), camera to world (c2w) or world to"
        " camera (w2c).  [default: those of its format]",
        tuple(axes.value for axes in Axes),
    )
    center: tuple[float, ...] | None = setting(
        "Point that --orbit and --dolly look at.  [default: the middle of the scene]", POINT
    )
    distance: float | None = setting(
        "Distance from that point, in world units: of --orbit, and of the first camera of --dolly."
        "  [default: where the scene fits the image; 4 times that with --dolly]",
        Range(above=0, unit="D"),
    )
    elevation: float | None = setting(
        f"Angle of --orbit and --dolly above that point, in degrees.  [default: {ELEVATION:g}]",
        Range(-89, 89, unit="DEGREES"),
    )
    up: tuple[float, float, float] | None = setting(
        f"{UP} For cameras of which only eye and target are known.{DEFAULT_UP}; y in SuperSplat's camera files]",
        DIRECTION,
        heading=COMMON,
    )
    world_transform: str | None = setting(
        "Transform from the world of the cameras to that of the splats: 16 numbers with commas between, row by row, or"
        " a file of them.",
        metavar="MATRIX",
    )
    fov: float | None = setting(
        "Vertical field of view, in degrees.  [default: the file's, or 60]", Range(above=0, below=180, unit="DEGREES")
    )
    seconds: float | None = setting(
        "Duration of --orbit, of --dolly, and of --keyframes from one view to the next, in seconds.  [default: 2; of"
        " --orbit, N frames at --fps]",
        Range(above=0, most=1e6, unit="S"),
    )
    fps: float | None = setting(
        "Frames per second of the path; times are counted by it.  [default: the file's times, or 30]",
        Range(above=0, most=1e6, unit="N"),
    )
    every: int = setting("Take every K-th camera of the path.", whole(1, unit="K"), 1)
    views: tuple[Any, ...] = ()  # an option of pictures alone

    #: Without a source there is one camera that sees the whole scene, in place of an orbit.
    still: ClassVar[bool] = False

    def path(self, scenes: Callable[[], Scenes]) -> CameraPath:
        """Return the cameras; scenes are read only where cameras are chosen for them, or need their up axis."""
        from ..cameras import sources
        from ..cameras.camera import DEFAULT_SECONDS, Settings

        settings = Settings(
            axes=Axes(self.camera_axes) if self.camera_axes else None,
            world=None if self.world_transform is None else _world(self.world_transform),
            size=self.size,
            fov_y=None if self.fov is None else math.radians(self.fov),
            fps=self.fps,
            every=self.every,
            up=self.up,
            up_of_scene=lambda: scenes().up,
        )
        if self.camera_path is not None:
            from ..cameras.camera_files import read_path

            return read_path(self.camera_path, None if self.camera_format == "auto" else self.camera_format, settings)
        elevation = ELEVATION if self.elevation is None else self.elevation
        seconds = self.seconds or DEFAULT_SECONDS
        try:
            if self.views or self.look_at:
                return sources.single_views(self.views or (self.look_at,), settings, named=bool(self.views))
            if self.keyframes:
                return sources.keyframes(self.keyframes, seconds, settings)
            if self.dolly:
                return sources.dolly(seconds, self.center, self.distance, elevation, settings, lambda: scenes().balls())
            if self.orbit is None and self.still and self.center is None and self.distance is None:
                return sources.whole_scene(elevation, settings, lambda: scenes().balls())
            count = self.orbit or (1 if self.still else ORBIT)
            if self.seconds is not None:
                settings = replace(settings, fps=count / self.seconds)
            return sources.orbit(count, self.center, self.distance, elevation, settings, lambda: scenes().balls())
        except TooManyCamerasError as error:
            source = next((name for name in ("dolly", "keyframes") if getattr(self, name)), "orbit")
            raise click.UsageError(f"--{source}: {error}") from None


def _world(value: str) -> Matrix:
    """Return the (4, 4) matrix of --world-transform, which is a text of numbers or names a file."""
    from ..cameras.camera_files import read_world_transform, similarity

    if "," in value and not set(value) - NUMERIC:
        try:
            return similarity(value)
        except CameraPathError as error:
            raise click.UsageError(f"--world-transform {error}") from None
    return read_world_transform(Path(value))


#: A key of `PRESETS`.
DEFAULT_PRESET = "desktop"

#: Angles of cones, and weights of nodes where 1 is that of nodes in the middle.
DEGREES = Range(0, 180, unit="DEGREES")
PRIORITY = "of 1, which is that of nodes in the middle"


@dataclass(frozen=True)
class Inputs:
    """The splat files, each an instance; or an instances file, which names them."""

    HEADING: ClassVar[str] = "Inputs"

    files: tuple[Path, ...] = setting("", NamedPath(), (), argument=True, nargs=-1, metavar="[FILE]...")
    scene: Path | None = setting(
        "Read an instances file: JSON that lists splat files and where they stand (see docs/traverse.md).", NamedPath()
    )

    def instances(self) -> list[Instance]:
        """Return the instances: each FILE once, untransformed, or those of the instances file."""
        from ..model.instances import instances_of

        if not self.files and self.scene is None:
            raise click.UsageError("a FILE is missing; name one, or an instances file with --scene")
        if self.scene is None:
            return instances_of(self.files)
        from ..viewers.instances_file import read_instances

        return read_instances(self.scene)


#: Help of `--budget`.
MOST_DRAWN = "Largest number of splats to draw, such as 500k, or a share of the leaves, such as 5%"


@dataclass(frozen=True)
class CutOptions:
    """Options of the cuts of trees, and of how detail levels of Streamed SOG are chosen."""

    HEADING: ClassVar[str] = "Cut"

    budget: tuple[Budget, ...] | None = setting(
        f"{MOST_DRAWN}.  [default: that of --preset]", Quantity("N|P%", parse_budgets), heading=COMMON
    )
    preset: str | None = setting(
        "Budget of a device: Spark 2's, or that of Spark's LoD design with preview-desktop and mobile."
        f"  [default: {DEFAULT_PRESET}; for Streamed SOG PlayCanvas's, {PLAYCANVAS_BUDGET:,} splats]",
        tuple(PRESETS),
    )
    lod_splat_scale: float = setting("Factor by which the budget is multiplied.", Range(above=0), 1.0)
    lod: LodSettings = field(default_factory=LodSettings)
    cone_fov0: float = setting(
        "Full angle of the inner foveation cone, in degrees: full priority inside it.", DEGREES, CONE_FOV0
    )
    cone_fov: float = setting(
        "Full angle of the outer cone, in degrees, where priority has fallen to --cone-foveate.", DEGREES, CONE_FOV
    )
    cone_foveate: float = setting(f"Priority of nodes at the outer cone, {PRIORITY}.", FACTOR, CONE_FOVEATE)
    outside_foveate: float | None = setting(
        "Priority of nodes outside the frustum, in place of the cones, as in Spark's LoD design.", FACTOR
    )
    behind_foveate: float | None = setting(
        f"Priority of nodes behind the camera.  [default: {BEHIND_FOVEATE:g}; 1 with --outside-foveate]", FACTOR
    )
    precision: str = setting(
        "Precision of the centres and sizes that cuts are found with: the file's, its half floats, or what Spark has of"
        " the file, for the same cuts to the last node: ext with extSplats, else packed, or packed-pages of a RAD file"
        " that it streams.",
        PRECISIONS,
        PRECISIONS[0],
    )

    #: Options of pictures alone.
    full: bool = False
    continuous: bool = False
    blend: float | None = None

    def one_budget(self) -> Budget:
        """Return the budget, or that of the preset, times --lod-splat-scale."""
        if self.budget is not None and len(self.budget) > 1:
            texts = ",".join(budget.text for budget in self.budget)
            try:
                check_grouping(texts)
            except ValueError as error:
                raise click.UsageError(f"--budget {error}") from None
            raise click.UsageError(f"--budget {texts} names several, which only render --compare takes; give one")
        if self.budget:
            budget = self.budget[0]
        else:
            count = PRESETS[self.preset or DEFAULT_PRESET]
            budget = replace(Budget.of_count(count), by_default=self.preset is None)
        scaled = replace(budget, scale=self.lod_splat_scale)
        if scaled.count is not None and not scaled.count * scaled.scale <= LARGEST:
            raise click.UsageError(
                f"the budget must be from 1 to 2^53, not {budget.text} times --lod-splat-scale {scaled.scale:g}"
            )
        return scaled

    def settings(self) -> LodSettings:
        behind = self.behind_foveate
        if self.outside_foveate is not None:
            foveation: Foveation = Frustum(self.outside_foveate, 1.0 if behind is None else behind)
        else:
            behind = BEHIND_FOVEATE if behind is None else behind
            foveation = Cones(self.cone_fov0, self.cone_fov, self.cone_foveate, behind)
        width = (self.blend or BLEND) if self.continuous else None
        return replace(self.lod, foveation=foveation, continuous=width)


def scenes_of(
    cut: CutOptions, general: General, instances: Sequence[Instance], console: Console, **how: Any
) -> Callable[[], Scenes]:
    """Return a function that reads the scenes of instances when it is first called; `how` are further arguments."""
    from ..viewers.scenes import read_scenes

    how |= {"precision": cut.precision, "threads": general.threads, "progress": console.progress}
    return functools.cache(functools.partial(read_scenes, instances, **how))


def files_read(cameras: Cameras, instances: list[Instance]) -> dict[str, list[Path]]:
    """For `keep_apart`: by the name of an option, the files that it names without being one."""
    splats = [each.source for each in instances if isinstance(each.source, Path)]
    matrix = cameras.world_transform and file_of(cameras.world_transform)
    return {"scene": splats, "world_transform": [matrix] if matrix else []}


def check_view(
    ctx: click.Context,
    console: Console,
    cameras: Cameras,
    path: CameraPath,
    scenes: Scenes,
    network: Network | None = None,
    notes: Iterable[str] = (),
) -> None:
    """Print notes on the cameras, further ones, and those on scenes; refuse options for other kinds of files."""
    from ..model.scene import up_notes_of
    from ..viewers.loaded_scene import TREE

    check(ctx, scenes=scenes.kind)
    upright = cameras.up is None and cameras.camera_path is None  # by the axes of the files
    for note in (*path.notes, *notes, *(up_notes_of(scenes.axes) if upright else ())):
        console.say(note)
    if network is None or network.instant:
        return
    trees = [loaded for loaded in scenes.loaded if loaded.kind == TREE]
    if whole := dict.fromkeys(printable(loaded.name) for loaded in trees if not loaded.has_chunks):
        names = ", ".join(whole)
        console.say(
            f"{names}: loaded whole by viewers before they draw; the waits are those of a RAD with the same nodes"
        )


def with_planes(
    ctx: click.Context, cameras: Cameras, render: RenderSettings, path: CameraPath, scenes: Callable[[], Scenes]
) -> RenderSettings:
    """Return settings whose near and far planes enclose the scenes, where the distance is chosen for them, too.

    So a view of the whole scene clips nothing. Planes that were given stay.
    """
    fixed = cameras.distance is not None or any(getattr(cameras, name) for name in FIXED)
    if fixed or any(is_set(ctx, name) for name in ("near", "far")):
        return render
    from ..cameras.framing import reach

    near, far = reach(render.raster.near, render.raster.far, path.cameras, scenes().balls())
    return replace(render, raster=replace(render.raster, near=near, far=far))
