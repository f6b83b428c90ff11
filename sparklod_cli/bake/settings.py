"""Settings, resources and result of a bake."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..codecs.formats import WriteOptions
from ..io.reading import Merged as Merged
from ..io.reading import Source as Source
from ..lod.tree_settings import DEFAULT_BASE, DEFAULT_GROWTH, METHODS
from ..model import MAX_SH_DEGREE
from ..model.selection import Selection

if TYPE_CHECKING:
    from ..codecs.losses import Clamp
    from ..fitting.fit_settings import FitSettings, Refined
    from ..lod.tree_settings import DetailSettings, TileSettings
    from ..model.transforms import Transform
    from ..system.addresses import Place
    from .parts_output import WrittenDetail, WrittenTiles
    from .simplifying import SimplifyGoal, WrittenSet

#: Result for a scene that exceeds the memory of a worker of a cluster.
LARGE: Any = object()


@dataclass(frozen=True)
class BakeSettings:
    """Settings of a bake.

    Attributes:
        base: with quick, growth of the voxel grid from level to level, 1.1 to 2.0.
        growth: with quality, largest number of nodes for each leaf, 1.05 to 2.0.
        max_sh: highest SH degree to keep.
        selection: in the coordinates of the input.
        transform: of the selected splats; None for the identity.
        up: axis of the input that points up, one of `scene.AXES`; None for that of the file.
        rgba: file of colours and opacities that replace those of the splats, see `files.read_rgba`.
        suffix: of the format, one of `WRITABLE`.
        detail, tiles: write a Streamed SOG, or 3D Tiles, instead.
        environment: of a Streamed SOG, file of splats that are always drawn; transformed as the scene.
        environment_beyond: of a Streamed SOG, distance beyond which splats become its environment, in the input's
            units, see `lod.parts.beyond`.
        simplify: write the splats of a cut, without a tree, instead.
        refine: fitting of merged splats to pictures of full detail, without its cameras.
        camera_path: file of the cameras for fitting, or for measuring a PSNR, in the coordinates of the output; None
            for cameras around and inside the scene.
        converts: keep the tree of an input for another format or container, rather than refuse it.
        recodes: keep the tree of an input also for the same format, with other options.
        unused: flags of options that have no effect on a tree; an input with a tree is refused if there are any.
    """

    method: str = METHODS[0]
    base: float = DEFAULT_BASE
    growth: float = DEFAULT_GROWTH
    max_sh: int = MAX_SH_DEGREE
    selection: Selection = field(default_factory=Selection)
    transform: Transform | None = None
    up: str | None = None
    rgba: Path | None = None
    suffix: str = ".spz"
    options: WriteOptions = field(default_factory=WriteOptions)
    detail: DetailSettings | None = None
    tiles: TileSettings | None = None
    environment: Path | None = None
    environment_beyond: float | None = None
    simplify: SimplifyGoal | None = None
    refine: FitSettings | None = None
    camera_path: Path | None = None
    converts: bool = False
    recodes: bool = False
    unused: tuple[str, ...] = ()

    @property
    def files(self) -> dict[str, Any]:
        """Files that are inputs of the bake, by the settings that name them."""
        named = {"rgba": self.rgba, "environment": self.environment, "camera_path": self.camera_path}
        return {name: path for name, path in named.items() if path is not None}


@dataclass(frozen=True)
class Resources:
    """Resources that a bake may use.

    Attributes:
        memory: bytes; None for `estimate.MEMORY_SHARE` of the available memory.
        scratch_dir: folder for the scratch folder of a bake out of core; None for the folder of the output.
        resume: continue an interrupted bake from its scratch folder.
        block_splats: size of a block, out of core; None for as many splats as the memory allows, at most
            `estimate.MOST_BLOCK_SPLATS`.
    """

    memory: int | None = None
    scratch_dir: Place | None = None
    resume: bool = False
    block_splats: int | None = None


@dataclass(kw_only=True)
class Baked:
    """Result of a bake, which its steps fill in; fields that do not apply are None or empty.

    Attributes:
        output_format: "spz", "rad", "rad-chunked", "streamed-sog", "3d-tiles", or the name of the format
            of a simplified scene.
        bytes: size of all files of the output.
        version, fractional_bits: of SPZ.
        chunks, encodings, sh_codes: of RAD: encodings by field of `RadOptions`, and largest size of the SH palette.
        clamped: number of nodes with a value that the output cannot hold, by column of `Splats`.
        clamps: the ends of the ranges that were exceeded, and how far.
        format, notes: of the input, for display.
        read: number of splats, or of nodes, of the input.
        splats: number of leaves.
        levels: depth of the tree plus 1.
        dropped: number of dropped splats by reason (`selection.REASONS`).
        method: builder of the tree; None for the tree of the input.
        seconds: by stage (read, build, order, refine, arrange, levels, tiles, errors, simplify, encode, write).
        blocks, scratch_bytes_written, scratch_bytes_read: of a bake out of core.
    """

    output_format: str = ""
    bytes: int = 0
    version: int | None = None
    fractional_bits: int | None = None
    chunks: int | None = None
    encodings: dict[str, str] = field(default_factory=dict)
    sh_codes: int | None = None
    detail: WrittenDetail | None = None
    tiles: WrittenTiles | None = None
    simplified: WrittenSet | None = None
    clamped: dict[str, int] = field(default_factory=dict)
    clamps: tuple[Clamp, ...] = ()
    format: str = ""
    read: int = 0
    splats: int = 0
    sh_degree: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    method: str | None = None
    nodes: int = 0
    levels: int = 0
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    refine: Refined | None = None
    blocks: int | None = None
    scratch_bytes_written: int | None = None
    scratch_bytes_read: int | None = None
