"""Records that the steps of a bake exchange and report: the built tree, and the result."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..codecs.clamps import Clamp
from ..codecs.losses import Losses
from ..codecs.statistics import Statistics
from ..model.scene import NodeStream, Scene
from ..model.splats import Splats

if TYPE_CHECKING:
    from .output import BakeOutput
    from .refining import Refined


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
    """A tree on its way from the splats of an input to a file.

    Attributes:
        nodes: of the tree, in memory or in a store; None while a step replaces them.
        format, notes: of the input, for display.
        read: number of splats of the input, which are nodes where it has a tree.
        splats: leaves of the tree.
        dropped: number of splats that were left out, by reason (`selection.REASONS`).
        method: that built the tree; None for the tree of the input.
        environment: splats beside the tree that are always drawn; None without.
        levels: depth and 1, so that a tree of one node has one.
        statistics: of all nodes, as far as `output.needed`; None where it is made as a whole.
        is_ordered: the nodes have the order of the output.
        blocks: number of blocks that it was built of, out of core; None in memory.
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


@dataclass(frozen=True)
class WrittenLevel:
    """Detail level of a Streamed SOG.

    Attributes:
        splats: of all regions.
        share: of the splats of level 0.
        worst_error: largest error of a region.
    """

    splats: int
    share: float
    worst_error: float


@dataclass(frozen=True)
class WrittenDetail:
    """Detail levels of a Streamed SOG.

    Attributes:
        levels: full detail first.
        regions, chunks: how many; each chunk is a folder.
        environment: number of splats that are always drawn.
    """

    levels: tuple[WrittenLevel, ...]
    regions: int
    chunks: int
    environment: int


@dataclass(frozen=True)
class WrittenTiles:
    """Tiles of a tileset.

    Attributes:
        tiles, levels: how many.
        splats: of each level's cut, the root's first; the last has full detail.
        error: geometric error of the root.
        georeferenced: the tileset stands on the Earth.
    """

    tiles: int
    levels: int
    splats: tuple[int, ...]
    error: float
    georeferenced: bool


@dataclass(frozen=True)
class WrittenSet(Losses):
    """A simplified scene.

    Attributes:
        splats, share: how many, and their share of full detail.
        faint: number of merged splats whose opacity is too low to be drawn.
        psnr: mean over the cameras and a black and a white background, dB; None where it was not measured.
        refine: result of fitting it; None without `--refine`.
    """

    splats: int
    share: float
    faint: int
    psnr: float | None
    refine: Refined | None


@dataclass(frozen=True, kw_only=True)
class WrittenTree:
    """Result of writing a tree.

    Attributes:
        output_format: "spz", "rad", "rad-chunked", "streamed-sog", "3d-tiles", the name of the encoding of
            arrays, or the name of the format of a simplified scene.
        bytes: of the output, all of its files.
        version, fractional_bits: of an SPZ output, else None.
        chunks: of a RAD output, else None.
        encodings: of a RAD output, by the field of `RadOptions`.
        sh_codes: the most entries of the SH palette of a RAD output; None without one.
        arrays: shapes of the arrays of another output, in its order.
        detail: of a Streamed SOG, else None.
        tiles: of 3D Tiles, else None.
        simplified: of a simplified scene, else None.
        clamped: by the column of `Splats`, the number of nodes with a value that the output cannot hold.
        clamps: at which ends, and how far beyond.
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
