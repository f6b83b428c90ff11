"""Options of traverse and render: cameras, files and cuts."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..cameras import DEFAULT_SIZE, ELEVATION, ORBIT
from ..cameras.camera_formats import FORMATS, Axes
from ..codecs.formats import PRECISIONS
from ..lod.budget import LARGEST, Budget, parse_budgets
from ..model.foveation import BEHIND_FOVEATE, CONE_FOV, CONE_FOV0, CONE_FOVEATE, Cones, Foveation, Frustum
from ..system.errors import CameraPathError, TooManyCamerasError
from ..system.setting_fields import Quantity, Range, setting, whole
from ..system.units import check_grouping
from ..system.untrusted import printable
from ..viewers.viewer_settings import BLEND, FACTOR, PLAYCANVAS_BUDGET, PRESETS, LodSettings, Network
from .command import DIRECTION, POINT, SIZE, VIEW, VIEWS, common, flag
from .console import Console
from .option_groups import DEFAULT_UP, UP, General
from .outputs import NamedPath
from .rules import check, is_set

if TYPE_CHECKING:
    from ..cameras.camera import Matrix
    from ..cameras.sources import CameraPath
    from ..model.instances import Instance
    from ..render.render_settings import RenderSettings
    from ..viewers.scenes import Scenes

# Cameras and cuts

#: Sources of cameras with given coordinates, which do not depend on the scene.
FIXED = ("camera_path", "look_at", "views", "keyframes")

#: Characters of a --world-transform given as numbers; any other text names a file.
NUMERIC = set("0123456789+-.,eE ")

#: Help and range of `--orbit`.
AROUND_SCENE = "Place N cameras around the scene.  [default, without any source of cameras: "
CAMERAS = whole(1, 1 << 20)


@dataclass(frozen=True)
class Cameras:
    """Options of cameras; None where not given."""

    HEADING: ClassVar[str] = "Cameras"

    camera_path: Path | None = common("Read the cameras from a file, or from a folder written by COLMAP.", NamedPath())
    orbit: int | None = common(f"{AROUND_SCENE}an orbit of {ORBIT}]", CAMERAS)
    look_at: Any = common("Place one camera at EYE that looks at TARGET, each x,y,z.", VIEW)
    size: tuple[int, int] | None = common(
        "Width and height of the images, in pixels; the vertical field of view is kept."
        f"  [default: the file's, or {DEFAULT_SIZE[0]}x{DEFAULT_SIZE[1]}]",
        SIZE,
    )
    dolly: bool = flag("Move the camera straight towards the scene, from far to near.")
    keyframes: Any = setting(
        "Move the camera smoothly through two or more views, separated by spaces or semicolons.", VIEWS
    )
    camera_format: str | None = setting(
        f"Format of --camera-path: auto, by its content, or {', '.join(form.name for form in FORMATS)}."
        "  [default: auto]",
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
        "Distance from that point, in world units; of --dolly, that of its first camera."
        "  [default: where the scene fits the image; 4 times that with --dolly]",
        Range(above=0, unit="D"),
    )
    elevation: float | None = setting(
        f"Angle of --orbit and --dolly above that point, in degrees.  [default: {ELEVATION:g}]",
        Range(-89, 89, unit="DEGREES"),
    )
    up: tuple[float, float, float] | None = common(
        f"{UP} For cameras of which only eye and target are known.{DEFAULT_UP}; y in SuperSplat's camera files]",
        DIRECTION,
    )
    world_transform: str | None = setting(
        "Transform from the cameras' world to the splats': 16 numbers with commas, row by row, or a file of them.",
        metavar="MATRIX",
    )
    fov: float | None = setting(
        "Vertical field of view, in degrees.  [default: the file's, or 60]", Range(above=0, below=180, unit="DEGREES")
    )
    seconds: float | None = setting(
        "Duration of --orbit, --dolly, or --keyframes from view to view, in seconds.  [default: 2; of --orbit, N"
        " frames at --fps]",
        Range(above=0, most=1e6, unit="S"),
    )
    fps: float | None = setting(
        "Frames per second of the path; times are counted by it.  [default: the file's times, or 30]",
        Range(above=0, most=1e6, unit="N"),
    )
    every: int = setting("Take every K-th camera of the path.", whole(1, unit="K"), 1)
    views: tuple[Any, ...] = ()  # an option of pictures alone

    #: Whether the default is one camera that sees the whole scene, instead of an orbit.
    still: ClassVar[bool] = False

    def path(self, scenes: Callable[[], Scenes]) -> CameraPath:
        """Return the cameras; calls `scenes` only if cameras are placed by the scenes or need their up axis."""
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
    """Return the (4, 4) matrix of --world-transform: numbers, or the name of a file."""
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
    """Options of the splat files, or of the instances file that lists them."""

    HEADING: ClassVar[str] = "Inputs"

    files: tuple[Path, ...] = setting("", NamedPath(), (), argument=True, nargs=-1, metavar="[FILE]...")
    scene: Path | None = setting(
        "Read an instances file: JSON that lists splat files and where they stand (see docs/traverse.md).", NamedPath()
    )

    def instances(self) -> list[Instance]:
        """Return the instances of the instances file, or one of each FILE, untransformed."""
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
    """Options of the cuts of trees, and of the choice of detail levels of Streamed SOG."""

    HEADING: ClassVar[str] = "Cut"

    budget: tuple[Budget, ...] | None = common(
        f"{MOST_DRAWN}.  [default: that of --preset]", Quantity("N|P%", parse_budgets)
    )
    preset: str | None = setting(
        "Budget of a device: Spark 2's, or that of Spark's LoD design with preview-desktop and mobile."
        f"  [default: {DEFAULT_PRESET}; for Streamed SOG PlayCanvas's, {PLAYCANVAS_BUDGET:,} splats]",
        tuple(PRESETS),
    )
    lod_splat_scale: float = setting("Factor by which the budget is multiplied.", Range(above=0), 1.0)
    lod: LodSettings = field(default_factory=LodSettings)
    cone_fov0: float = setting(
        "Full angle of the inner foveation cone, inside which priority is full, in degrees.", DEGREES, CONE_FOV0
    )
    cone_fov: float = setting(
        "Full angle of the outer cone, at which priority is --cone-foveate, in degrees.", DEGREES, CONE_FOV
    )
    cone_foveate: float = setting(f"Priority of nodes at the outer cone, {PRIORITY}.", FACTOR, CONE_FOVEATE)
    outside_foveate: float | None = setting(
        "Priority of nodes outside the frustum, in place of the cones, as in Spark's LoD design.", FACTOR
    )
    behind_foveate: float | None = setting(
        f"Priority of nodes behind the camera.  [default: {BEHIND_FOVEATE:g}; 1 with --outside-foveate]", FACTOR
    )
    precision: str = setting(
        "Precision of centres and sizes of nodes: the file's, half floats, or Spark's, for the same cuts to the last"
        " node: ext with extSplats, else packed, or packed-pages of a RAD file that it streams.",
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
        """Return the settings of cuts, with foveation by cones or by the frustum."""
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
    """Return a function that reads the scenes of instances once, when first called; `how` goes to `read_scenes`."""
    from ..viewers.scenes import read_scenes

    how |= {"precision": cut.precision, "threads": general.threads, "progress": console.progress}
    return functools.cache(functools.partial(read_scenes, instances, **how))


def files_read(cameras: Cameras, instances: list[Instance]) -> dict[str, list[Path]]:
    """Return files that are inputs because another file or option names them, by option, for `keep_apart`."""
    splats = [each.source for each in instances if isinstance(each.source, Path)]
    matrix = Path(cameras.world_transform or "")
    return {"scene": splats, "world_transform": [matrix] if os.path.isfile(matrix) else []}  # noqa: PTH113


def check_view(
    ctx: click.Context,
    console: Console,
    cameras: Cameras,
    path: CameraPath,
    scenes: Scenes,
    network: Network | None = None,
    notes: Iterable[str] = (),
) -> None:
    """Refuse options that do not apply to the kind of the files, and print notes on cameras and scenes."""
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
    """Move the near and far planes so that a view of the whole scene clips nothing.

    Planes stay if they, the distance or the cameras were given.
    """
    fixed = cameras.distance is not None or any(getattr(cameras, name) for name in FIXED)
    if fixed or any(is_set(ctx, name) for name in ("near", "far")):
        return render
    from ..cameras.framing import reach

    near, far = reach(render.raster.near, render.raster.far, path.cameras, scenes().balls())
    return replace(render, raster=replace(render.raster, near=near, far=far))
