"""Settings and resources of a bake, and its records: the tree in work and the result."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..codecs.encoder import Clamp
from ..codecs.options import WriteOptions
from ..codecs.reader import Reader
from ..codecs.statistics import Statistics
from ..fitting.settings import FitSettings
from ..io.reading import Merged as Merged
from ..io.reading import Source as Source
from ..lod.budget import Budget
from ..lod.builders import DEFAULT_BASE, DEFAULT_GROWTH, METHODS
from ..lod.part_settings import DetailSettings, TileSettings
from ..model import MAX_SH_DEGREE
from ..model.scene import NodeStream, Scene, rotated_axis, up_notes
from ..model.selection import Selection
from ..model.splats import Splats
from ..model.transforms import Transform
from ..system.addresses import Place

#: Suffix of the format that is written unless another one is chosen.
SPZ = ".spz"


@dataclass(frozen=True)
class SimplifyGoal:
    """Size or fidelity of a simplified scene. One of the three is not None.

    Attributes:
        to: number of splats, or a share of all.
        max_bytes: size of a file that as many splats as possible shall fill.
        psnr: least PSNR against full detail, dB, of as few splats as possible.

    Raises:
        ValueError: not exactly one is given, or it is out of its range.
    """

    to: Budget | None = None
    max_bytes: int | None = None
    psnr: float | None = None

    def __post_init__(self) -> None:
        from ..images.metrics import MOST_PSNR

        if sum(each is not None for each in (self.to, self.max_bytes, self.psnr)) != 1:
            raise ValueError("give one of to, max_bytes and psnr")
        if self.max_bytes is not None and self.max_bytes < 1:
            raise ValueError(f"max_bytes is {self.max_bytes}; give 1 or more")
        if self.psnr is not None and not 0 < self.psnr < MOST_PSNR:
            raise ValueError(f"psnr is {self.psnr}; give more than 0 and less than {MOST_PSNR:g} dB")


@dataclass(frozen=True)
class BakeSettings:
    """Settings of a bake.

    Attributes:
        method: of `lod.builders.BUILDERS`.
        base: of quick, growth of the voxel grid from level to level, 1.1 to 2.0.
        growth: of quality, the largest number of nodes for each leaf, 1.05 to 2.0.
        max_sh: the highest SH degree that is kept.
        selection: which splats are kept; its coordinates are those of the input.
        transform: turns, scales and moves the splats that are kept.
        up: axis of the input that points up, one of `scene.AXES`, which `transform` may have turned to another; None
            for that of the file.
        rgba: a file of colours and opacities that replace the splats' own, see `io.read_rgba`.
        suffix: of the format, one of `WRITABLE` that holds trees.
        options: how to write it.
        encoding: of `codecs.formats.ENCODINGS`, to write arrays in that layout instead.
        raw: write their words alone, rather than as .npz.
        detail: of regions and detail levels, to write a Streamed SOG instead.
        tiles: of tiles and where they stand, to write 3D Tiles instead.
        environment: of a Streamed SOG, a file whose splats are always drawn; turned and moved as the scene.
        environment_beyond: of a Streamed SOG, splats of the input farther out than this become its environment, see
            `lod.detail_levels.beyond`; in the input's units. None for none.
        simplify: how many splats a cut of the tree has, to write that without a tree instead.
        refine: how merged splats are fitted to pictures of full detail, its cameras left out; None for not at all.
        camera_path: a file of training cameras, or of those by which a PSNR is measured, in the coordinates of the
            output; None for cameras that are placed around and inside the scene.
        converts: an input that has a tree keeps it, if its format is another one; otherwise it is refused.
        unused: flags of given options that have no effect on a tree; such an input is refused.
    """

    method: str = METHODS[0]
    base: float = DEFAULT_BASE
    growth: float = DEFAULT_GROWTH
    max_sh: int = MAX_SH_DEGREE
    selection: Selection = field(default_factory=Selection)
    transform: Transform = field(default_factory=Transform)
    up: str | None = None
    rgba: Path | None = None
    suffix: str = SPZ
    options: WriteOptions = field(default_factory=WriteOptions)
    encoding: str | None = None
    raw: bool = False
    detail: DetailSettings | None = None
    tiles: TileSettings | None = None
    environment: Path | None = None
    environment_beyond: float | None = None
    simplify: SimplifyGoal | None = None
    refine: FitSettings | None = None
    camera_path: Path | None = None
    converts: bool = False
    unused: tuple[str, ...] = ()

    @property
    def files(self) -> dict[str, Any]:
        """Files whose contents are inputs of the bake, by the setting that names them."""
        named = {"rgba": self.rgba, "environment": self.environment, "camera_path": self.camera_path}
        return {name: path for name, path in named.items() if path is not None}

    def up_of(self, found: str | None) -> str | None:
        """Return the axis of the output that points up, for that of the input."""
        up = self.up or found
        return rotated_axis(up, self.transform.rotation) if up else None

    def notes_on(self, source: Scene | Reader) -> tuple[str, ...]:
        """Return notes on an input for the user: its own, and on its up axis if a specification names that."""
        return source.notes + (up_notes(source.up, source.up_by) if source.up and self.up is None else ())


@dataclass(frozen=True)
class Resources:
    """Resources that a bake may use.

    Attributes:
        memory: bytes; None for `estimate.MEMORY_SHARE` of what is available.
        scratch_dir: folder for the scratch folder of a bake out of core; None for that of the output.
        resume: continue an interrupted bake with its results there.
        block_splats: splats of a block, out of core; None for as many as the memory allows, at most
            `estimate.MOST_BLOCK_SPLATS`.
    """

    memory: int | None = None
    scratch_dir: Place | None = None
    resume: bool = False
    block_splats: int | None = None


if TYPE_CHECKING:
    from .parts_output import WrittenDetail, WrittenTiles
    from .simplifying import Refined, WrittenSet
    from .tree_output import BakeOutput


class Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    def end(self, stage: str) -> None:
        """End a stage; the next one begins."""
        now = time.perf_counter()
        self.seconds[stage] = round(now - self._start, 4)
        self._start = now


@dataclass(kw_only=True, eq=False)
class BuiltTree:
    """Tree on its way from the splats of an input to a file.

    Attributes:
        nodes: in memory or in a store; None while a step replaces them.
        format, notes: of the input, for display.
        read: number of splats of the input, or of its nodes if it has a tree.
        splats: number of leaves.
        dropped: number of dropped splats by reason (`selection.REASONS`).
        method: builder of the tree; None for the tree of the input.
        environment: splats that are always drawn; None without.
        levels: depth plus 1.
        statistics: those of all nodes that `output.needed` names; None for an output that needs none.
        is_ordered: the nodes have the order of the output.
        blocks: number of blocks, out of core; None in memory.
    """

    nodes: Scene | NodeStream | None
    output: BakeOutput
    format: str = ""
    notes: tuple[str, ...] = ()
    read: int = 0
    splats: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    method: str | None = None
    environment: Splats | None = None
    levels: int = 0
    statistics: Statistics | None = None
    is_ordered: bool = False
    blocks: int | None = None

    @property
    def scene(self) -> Scene:
        """The tree in memory."""
        assert isinstance(self.nodes, Scene)
        return self.nodes

    @property
    def count(self) -> int:
        """Number of nodes."""
        assert self.nodes is not None
        return len(self.nodes) if isinstance(self.nodes, Scene) else self.nodes.count

    @property
    def sh_degree(self) -> int:
        """SH degree of the nodes."""
        assert self.nodes is not None
        return self.nodes.splats.sh_degree if isinstance(self.nodes, Scene) else self.nodes.sh_degree


@dataclass(frozen=True, kw_only=True)
class WrittenTree:
    """Result of writing a tree.

    Attributes:
        output_format: "spz", "rad", "rad-chunked", "streamed-sog", "3d-tiles", the name of the encoding of
            arrays, or the name of the format of a simplified scene.
        bytes: size of all files of the output.
        version, fractional_bits: of an SPZ output, else None.
        chunks: of a RAD output, else None.
        encodings: of a RAD output, by the field of `RadOptions`.
        sh_codes: the most entries of the SH palette of a RAD output; None without one.
        arrays: shapes of the arrays of another output, in its order.
        detail: of a Streamed SOG, else None.
        tiles: of 3D Tiles, else None.
        simplified: of a simplified scene, else None.
        clamped: number of nodes with a value that the output cannot hold, by column of `Splats`.
        clamps: at which ends of the range, and how far beyond.
    """

    output_format: str
    bytes: int
    version: int | None = None
    fractional_bits: int | None = None
    chunks: int | None = None
    encodings: dict[str, str] = field(default_factory=dict)
    sh_codes: int | None = None
    arrays: dict[str, tuple[int, ...]] = field(default_factory=dict)
    detail: WrittenDetail | None = None
    tiles: WrittenTiles | None = None
    simplified: WrittenSet | None = None
    clamped: dict[str, int] = field(default_factory=dict)
    clamps: tuple[Clamp, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Baked(WrittenTree):
    """Result of a bake.

    Attributes:
        format, read, splats, dropped, method, levels, notes, blocks: as in `BuiltTree`.
        sh_degree, nodes: of the tree.
        seconds: by stage (read, build, order, refine, arrange, levels, tiles, errors, simplify, encode, write).
        refine: result of fitting merged splats; None without `--refine`.
        scratch_bytes_written, scratch_bytes_read: in the scratch folder; None in memory.
    """

    format: str
    read: int
    splats: int
    sh_degree: int
    dropped: dict[str, int]
    method: str | None
    nodes: int
    levels: int
    notes: tuple[str, ...]
    seconds: dict[str, float]
    refine: Refined | None = None
    blocks: int | None = None
    scratch_bytes_written: int | None = None
    scratch_bytes_read: int | None = None
