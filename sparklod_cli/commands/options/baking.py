"""Options of `sparklod build-lod`: which splats, how they are merged, where they stand, and what a bake may use."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ...codecs.options import MAX_SH_CODES, SH_CODES
from ...fitting.settings import STEPS, FitSettings
from ...lod.builders import (
    BUILDERS,
    DEFAULT_BASE,
    DEFAULT_GROWTH,
    DETAIL_GROWTH,
    MAX_BASE,
    MAX_GROWTH,
    METHODS,
    MIN_BASE,
    MIN_GROWTH,
)
from ...lod.detail_rule import DetailSettings
from ...model import MAX_SH_DEGREE, UP_AXES
from ...system.addresses import Place
from ...system.setting_fields import Quantity, Range, setting_of, whole
from ...system.units import parse_size
from ..command import BALL, COMMON, POINT, OptionalNumber, flag, is_set, option, parameters_of, refuse
from ..paths import InputPath, OutputPath
from .common import General

if TYPE_CHECKING:
    from ...bake.out_of_core.cluster import ClusterEngine
    from ...model.selection import Selection
    from ...model.transforms import Transform
    from ..console import Console

#: The values of --format for regions at several detail levels, and for tiles.
STREAMED_SOG, TILES_3D = "streamed-sog", "3d-tiles"

#: Default builders of trees, and of trees that detail levels or tiles are cut from.
METHOD, METHOD_OF_DETAIL = METHODS[0], "quality"


@dataclass(frozen=True)
class TreeOptions:
    """Options of the tree."""

    HEADING: ClassVar[str] = "Tree"

    method: str | None = option(
        "How splats are merged: quick takes seconds; quality takes longer, and its cuts come closer to full detail."
        f"  [default: {METHOD}; {METHOD_OF_DETAIL} with --format {STREAMED_SOG} or {TILES_3D}]",
        METHODS,
        heading=COMMON,
    )
    max_sh: int = option(
        "Highest degree of spherical harmonics to keep.",
        whole(0, MAX_SH_DEGREE),
        MAX_SH_DEGREE,
        heading=COMMON,
    )
    base: float = option(
        "Growth of the voxel grid from level to level, with --method quick. Smaller values give smoother transitions"
        " and more nodes.",
        Range(MIN_BASE, MAX_BASE, unit="N"),
        DEFAULT_BASE,
    )
    growth: float | None = option(
        "Largest number of nodes for each leaf, with --method quality."
        f"  [default: {DEFAULT_GROWTH:g}; {DETAIL_GROWTH:g} with --format {STREAMED_SOG} or"
        f" {TILES_3D}]",
        Range(MIN_GROWTH, MAX_GROWTH, unit="N"),
    )

    def settings(self, *, only_cuts: bool) -> dict[str, Any]:
        """Return the fields of `BakeSettings` for the tree; the defaults suit the output.

        Args:
            only_cuts: the output has cuts of the tree, and not the tree.
        """
        growth = DETAIL_GROWTH if only_cuts else DEFAULT_GROWTH
        return {
            "method": self.method or (METHOD_OF_DETAIL if only_cuts else METHOD),
            "base": self.base,
            "growth": growth if self.growth is None else self.growth,
            "max_sh": self.max_sh,
        }

    def check(self, ctx: click.Context, *, only_cuts: bool) -> None:
        """Raise a `click.UsageError` where the number of one method is given with another."""
        chosen = self.settings(only_cuts=only_cuts)["method"]
        for method, row in BUILDERS.items():
            if method != chosen:
                refuse(ctx, [row.setting], f"is an option of --method {method}, not of {chosen}")


@dataclass(frozen=True)
class SelectionOptions:
    """Options of which splats of the input are kept."""

    HEADING: ClassVar[str] = "Selection"

    min_opacity: float = option(
        "Leave out splats whose opacity is lower than this.", Range(0, 1, unit="N"), 0.0, heading=COMMON
    )
    within: Any = option(
        "Leave out splats whose centre is outside this ball, in the input's coordinates.", BALL, heading=COMMON
    )
    min_box: tuple[float, ...] | None = option(
        "Leave out splats whose centre is below this on any axis, in the input's coordinates.", POINT
    )
    max_box: tuple[float, ...] | None = option(
        "Leave out splats whose centre is above this on any axis, in the input's coordinates.", POINT
    )
    on_invalid: str = option(
        "Whether to fail on invalid splats or leave them out: numbers that are not finite, negative scales.",
        ("error", "drop"),
        "error",
    )
    rgba: Path | None = option(
        "Replace colours and opacities by those of a .npy or raw file of (N, 4) bytes or floats 0..1; splats of alpha 0"
        " are left out.",
        InputPath(),
    )

    def selection(self) -> Selection:
        """Return the selection, but for `rgba`."""
        from ...model.selection import Selection

        return Selection(
            drop_invalid=self.on_invalid == "drop",
            min_opacity=self.min_opacity,
            min_box=self.min_box,  # type: ignore[arg-type]
            max_box=self.max_box,  # type: ignore[arg-type]
            within=self.within,
        )


@dataclass(frozen=True)
class TransformOptions:
    """Options of how the scene is turned, scaled and moved."""

    HEADING: ClassVar[str] = "Rotation, scale and position"

    up: str | None = option(
        "Axis that is up in the input: turn it to +y, and note that in the output for render, traverse and view."
        " y turns nothing; scenes as trained are mostly -y.  [default: note what the file says, and turn nothing]",
        UP_AXES,
        heading=COMMON,
    )
    rotate: tuple[float, ...] = option(
        "Turn the scene by these angles in degrees, about x, then y, then z, after --up.", POINT, "0,0,0"
    )
    scale: float = option(
        "Multiply the size of the scene by this, about its origin, after --rotate.", Range(above=0), 1.0
    )
    translate: tuple[float, ...] = option("Move the scene by this, in world units, after --scale.", POINT, "0,0,0")

    def transform(self) -> Transform:
        from ...model.transforms import Transform

        try:
            up = self.up or UP_AXES[0]
            return Transform.from_parts(up=up, rotate=self.rotate, scale=self.scale, translate=self.translate)
        except ValueError as error:
            raise click.UsageError(str(error)) from None


@dataclass(frozen=True)
class PaletteOptions:
    """Option of palettes of spherical harmonics, which RAD and SOG have."""

    HEADING: ClassVar[str] = "File format"

    cluster_sh: int | None = option(
        "Write spherical harmonics to RAD as a palette of at most N entries, 2 to 65,536, and a label for each splat:"
        " the file gets smaller, and reflections less exact. N is 65,536 if it is left out. SOG always has a palette;"
        " this chooses its size, which otherwise suits the number of splats.",
        OptionalNumber(SH_CODES, example=MAX_SH_CODES),
        is_flag=False,
        flag_value=str(MAX_SH_CODES),
    )


@dataclass(frozen=True)
class DetailOptions:
    """Options of Streamed SOG."""

    HEADING: ClassVar[str] = "Streamed SOG"

    settings: DetailSettings = field(default_factory=DetailSettings)
    environment: Path | None = option(
        "Splats that are always drawn, such as a sky, from a file of any format without a tree; turned and moved as the"
        " scene.",
        InputPath(),
    )
    environment_beyond: float | None = option(
        "Make splats whose centre is farther than this from the median of all centres the environment, in the input's"
        " units.",
        Range(above=0, unit="RADIUS"),
    )


#: Value of --refine without a number, and an example of a useful number.
BY_SIZE, EXAMPLE_STEPS = "default", 2000


class Steps(OptionalNumber):
    """A number of steps, or `BY_SIZE`, which becomes 0."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        return 0 if value == BY_SIZE else super().convert(value, param, ctx)


@dataclass(frozen=True)
class RefineOptions:
    """Options of merged splats that are fitted to pictures of full detail."""

    HEADING: ClassVar[str] = "Refining"

    refine: int | None = option(
        "Fit merged splats to pictures of full detail, in STEPS pictures of cuts: minutes, for cuts that come closer to"
        " it. The leaves stay as they are, and so does the tree of a Level-of-Detail file. Ctrl-C ends it early and"
        " keeps what was gained.  [default, without STEPS: by the size of the tree]",
        Steps(STEPS, placeholder="STEPS", example=EXAMPLE_STEPS),
        is_flag=False,
        flag_value=BY_SIZE,
    )
    camera_path: Path | None = option(
        "Cameras that --refine fits for, in the coordinates of the output, in any format that render reads: those of"
        " visitors whose paths are known.  [default: cameras around and inside the scene]",
        InputPath(),
        needs="refine",
    )
    seed: int = setting_of(FitSettings, "seed")
    device: str = setting_of(FitSettings, "device")


def memory_size(text: str) -> int:
    """Parse an amount of memory such as 4G or "600 MB"; raise `ValueError` for one without a unit."""
    size = parse_size(text)
    if not text.strip()[-1:].isalpha():
        raise ValueError(f"{text!r} has no unit; write {text.strip()}G or {text.strip()}MB")
    if size < 1:
        raise ValueError(f"{text!r} must be positive, such as 4G")
    return size


@dataclass(frozen=True)
class ResourceOptions:
    """Options of scenes that do not fit into memory, and of interrupted bakes."""

    HEADING: ClassVar[str] = "Large scenes"

    memory: int | None = option(
        "Memory that a bake may take, such as 4G or '600 MB'. A scene that needs more is baked out of core: block by"
        " block, with a scratch folder.  [default: 75 % of what is available]",
        Quantity("SIZE", memory_size),
    )
    scratch_dir: Place | None = option(
        "Where a bake out of core makes its scratch folder, which is removed at the end.  [default: beside the output]",
        OutputPath(folder=True, addresses=True),
    )
    resume: bool = flag(
        "Go on with a bake out of core that was interrupted; it must be the same bake. Without one, begin."
    )


@dataclass(frozen=True)
class ClusterOptions:
    """Options of bakes on several processes or machines."""

    HEADING: ClassVar[str] = "Cluster"

    workers: int | None = option(
        "Bake on this many processes of this machine, which share --threads and --memory.", whole(1, 256)
    )
    scheduler: str | None = option(
        "Bake on the Dask cluster whose scheduler has this address, as tcp://host:8786.", metavar="ADDRESS"
    )

    @contextlib.contextmanager
    def engine(
        self, ctx: click.Context, general: General, memory: int | None, console: Console
    ) -> Iterator[ClusterEngine]:
        """Yield the cluster for the duration of the context."""
        from ...bake.out_of_core.cluster import ClusterSettings, cluster

        threads = general.threads if self.scheduler is None or is_set(ctx, "threads") else None
        with cluster(
            ClusterSettings(self.scheduler, self.workers or 1, threads), memory=memory, say=console.say
        ) as engine:
            yield engine


#: Parameters of trees, without an effect where leaves are extracted.
OF_TREES = parameters_of(TreeOptions, SelectionOptions, TransformOptions)
