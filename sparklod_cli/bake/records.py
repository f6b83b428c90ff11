"""Records that the steps of a bake exchange and report: the built tree and the result."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..codecs.clamps import Clamp
from ..codecs.statistics import Statistics
from ..model.scene import NodeStream, Scene
from ..model.splats import Splats

if TYPE_CHECKING:
    from .parts_output import WrittenDetail, WrittenTiles
    from .refining import Refined
    from .simplifying import WrittenSet
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
