"""Options of what a viewer draws: files, budget, cut, detail levels, and how chunks get to the viewer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ...codecs.formats import PRECISIONS
from ...lod.settings import BLEND, FACTOR, PLAYCANVAS_BUDGET, PRESETS, DetailRule, LodSettings
from ...model.foveation import BEHIND_FOVEATE, CONE_FOV, CONE_FOV0, CONE_FOVEATE, Cones, Foveation, Frustum
from ...simulation.streaming_settings import Network, StreamingSettings
from ...system.setting_fields import Quantity, Range, setting
from ...system.units import check_grouping, parse_time
from ...system.untrusted import printable
from ..command import COMMON, flag, parameters_of, refuse
from ..paths import InputPath

if TYPE_CHECKING:
    from ...api.jobs import ViewedFiles
    from ...lod.budget import Budget
    from ...model.instances import Instance
    from ...scenes.loaded import Scenes
    from ..console import Console
    from ..render import RenderOptions
    from ..traverse import TraverseOptions

#: A key of `PRESETS`.
DEFAULT_PRESET = "desktop"

#: Options of the size on the screen, pixels, which 3D Tiles have, too.
OF_PIXELS = ("lod_render_scale", "pixel_scale_limit")

#: Options of the foveation cones, which --outside-foveate replaces, and of nodes, which Streamed SOG does not have.
CONES = ("cone_fov0", "cone_fov", "cone_foveate")
NODES = (
    *(*OF_PIXELS, *CONES, "outside_foveate", "behind_foveate"),
    *("precision", "continuous", "blend"),
)

#: Options of cuts, which have no effect where full detail is drawn.
CUTS = ("budget", "preset", "lod_splat_scale", *NODES)

#: Options for Streamed SOG alone, and options of loading, without which all chunks are resident.
DETAIL = parameters_of(DetailRule)
LOADING = ("after", "bandwidth", "latency", "fetchers", "chunk_cache")

#: Angles of cones, and weights of nodes where 1 is that of nodes in the middle.
DEGREES = Range(0, 180, unit="DEGREES")
PRIORITY = "of 1, which is that of nodes in the middle"


@dataclass(frozen=True)
class Inputs:
    """The splat files, each an instance; or an instances file, which names them."""

    HEADING: ClassVar[str] = "Inputs"

    files: tuple[Path, ...] = setting("", InputPath(), (), argument=True, nargs=-1, metavar="[FILE]...")
    scene: Path | None = setting(
        "Read an instances file: JSON that lists splat files and where they stand (see docs/traverse.md).", InputPath()
    )

    @property
    def first(self) -> Path | None:
        """The file that outputs are named after; None without an input."""
        return self.scene or next(iter(self.files), None)

    def instances(self) -> list[Instance]:
        """Return the instances: each FILE once, untransformed, or those of the instances file.

        Raises:
            InstancesFileError: the instances file cannot be read.
        """
        from ...model.instances import instances_of
        from ...scenes.instances_file import read_instances

        if not self.files and self.scene is None:
            raise click.UsageError("a FILE is missing; name one, or an instances file with --scene")
        if self.files and self.scene is not None:
            raise click.UsageError("FILE cannot be used with --scene, which names the files")
        return instances_of(self.files) if self.scene is None else read_instances(self.scene)


def _parse_budgets(text: str) -> tuple[Budget, ...]:
    from ...lod.budget import parse_budgets

    return parse_budgets(text)


def _budget_option(unit: str, several: str = "") -> Any:
    return setting(
        f"Largest number of splats to draw, such as 500k, or a share of the leaves, such as 5%{several}."
        "  [default: that of --preset]",
        Quantity(unit, _parse_budgets),
        heading=COMMON,
        excludes=("preset",),
    )


@dataclass(frozen=True)
class CutOptions:
    """Options of the cuts of trees, and of how detail levels of Streamed SOG are chosen."""

    HEADING: ClassVar[str] = "Cut"

    budget: tuple[Budget, ...] | None = _budget_option("N|P%")
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
        "Full angle of the outer cone, in degrees, where priority has fallen to --cone-foveate.",
        DEGREES,
        CONE_FOV,
    )
    cone_foveate: float = setting(f"Priority of nodes at the outer cone, {PRIORITY}.", FACTOR, CONE_FOVEATE)
    outside_foveate: float | None = setting(
        "Priority of nodes outside the frustum, in place of the cones, as in Spark's LoD design.",
        FACTOR,
        excludes=CONES,
    )
    behind_foveate: float | None = setting(
        f"Priority of nodes behind the camera.  [default: {BEHIND_FOVEATE:g}; 1 with --outside-foveate]",
        FACTOR,
    )
    precision: str = setting(
        "Precision of the centres and sizes that cuts are found with: the file's, its half floats, or what Spark has of"
        " the file, for the same cuts to the last node: ext with extSplats, else packed, or packed-pages of a RAD file"
        " that it streams.",
        PRECISIONS,
        PRECISIONS[0],
    )

    def one_budget(self) -> Budget:
        """Return the budget, or that of the preset, times --lod-splat-scale."""
        from ...lod.budget import LARGEST, Budget

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
        scaled = budget.scaled(self.lod_splat_scale)
        if scaled.count is not None and not scaled.count * scaled.scale <= LARGEST:
            raise click.UsageError(
                f"the budget must be from 1 to 2^53, not {budget.text} times --lod-splat-scale {scaled.scale:g}"
            )
        return scaled

    def settings(self) -> LodSettings:
        return replace(self.lod, foveation=self._foveation())

    def _foveation(self) -> Foveation:
        behind = self.behind_foveate
        if self.outside_foveate is not None:
            return Frustum(self.outside_foveate, 1.0 if behind is None else behind)
        behind = BEHIND_FOVEATE if behind is None else behind
        return Cones(self.cone_fov0, self.cone_fov, self.cone_foveate, behind)


@dataclass(frozen=True)
class PictureCut(CutOptions):
    """Options of the cuts that pictures show."""

    budget: tuple[Budget, ...] | None = _budget_option("N|P%,...", "; with --compare several, such as 5%,500k")
    full: bool = flag(
        "Draw full detail: all leaves, however many there are.", heading=COMMON, excludes=(*CUTS, *DETAIL)
    )
    continuous: bool = flag(
        "Blend nodes and their children where one replaces the other, so that nothing pops; draws 18 to 40 % more"
        " splats than the budget."
    )
    blend: float | None = setting(
        f"With --continuous: ratio of the pixel scales between which nodes blend.  [default: {BLEND:g}]",
        Range(above=1),
        needs="continuous",
    )

    def settings(self) -> LodSettings:
        width = (self.blend or BLEND) if self.continuous else None
        return replace(super().settings(), continuous=width)


@dataclass(frozen=True)
class PictureStreaming:
    """Options of how chunks get to a viewer whose first pictures are drawn."""

    HEADING: ClassVar[str] = "Streaming"

    after: float | None = setting(
        "Draw what a visitor sees this long after opening a page with the files, such as 500ms, who waits in front of"
        " the camera; with --bandwidth.  [default: what is drawn once every chunk has arrived]",
        Quantity("TIME", parse_time),
        needs="bandwidth",
        excludes=("full", "continuous", "compare"),
    )
    streaming: StreamingSettings = field(default_factory=StreamingSettings)

    def check(self, ctx: click.Context) -> None:
        if self.after is None:
            refuse(ctx, LOADING, "can only be used with --after")

    def loading(self) -> tuple[StreamingSettings, float] | None:
        """Return how chunks are fetched and for how many seconds; None where all are resident."""
        return None if self.after is None else (self.streaming, self.after)


def files_read(options: RenderOptions | TraverseOptions, instances: list[Instance]) -> dict[str, list[Path]]:
    """For `keep_apart`: by the name of an option, the files that it names without being one."""
    splats = [instance.file for instance in instances if instance.file is not None]
    return {"scene": splats, "world_transform": options.cameras.files()}


def viewed_files(options: RenderOptions | TraverseOptions, instances: list[Instance], console: Console) -> ViewedFiles:
    """Return the files and the cameras that look at them."""
    from ...api.jobs import ViewedFiles

    cameras, general = options.cameras, options.general
    source, settings = cameras.camera_source(), cameras.settings()
    return ViewedFiles(instances, source, settings, options.cut.precision, general.threads, console.progress)


def check_scenes(ctx: click.Context, scenes: Scenes) -> None:
    """Raise a `click.UsageError` where an option is for trees or Streamed SOG, and the files are something else."""
    if scenes.details:
        streamed = "is for trees; use --budget, --budget-mode and --lod-multiplier for Streamed SOG"
        refuse(ctx, (*NODES, "chunk_cache", "indices_out", "padded"), streamed)
    elif scenes.tiled:
        tiled = "is not for 3D Tiles, which CesiumJS draws without a budget; --lod-render-scale 2 halves their detail"
        others = (each for each in (*CUTS, *DETAIL, "indices_out", "padded") if each not in OF_PIXELS)
        refuse(ctx, (*others, "chunk_cache"), tiled)
    elif scenes.trees:
        refuse(ctx, DETAIL, "is for Streamed SOG, and no file is; --budget and --preset are for trees, too")
    else:
        plain = (
            "is for Level-of-Detail files, and no file is one, so that all splats are drawn; bake one with build-lod"
        )
        refuse(ctx, (*CUTS, *LOADING, *DETAIL), plain)


def notes_on_loading(scenes: Scenes, network: Network) -> list[str]:
    """Return a note on trees that viewers load whole, if a network is simulated."""
    whole = dict.fromkeys(printable(loaded.name) for loaded in scenes.trees if not loaded.has_chunks)
    if network.instant or not whole:
        return []
    names = ", ".join(whole)
    return [f"{names}: loaded whole by viewers before they draw; the waits are those of a RAD with the same nodes"]
