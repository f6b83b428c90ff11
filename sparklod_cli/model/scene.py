"""`Scene`, what a codec reads and writes: splats, and what belongs to the file rather than to a splat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from .lod_tree import LodTree
from .splats import Splats


@dataclass(frozen=True)
class Scene:
    """A decoded file.

    Attributes:
        splats: N splats, in the order and the axes of the file.
        tree: (N,) nodes where the file is a Level-of-Detail tree, else None.
        antialiased: trained with the opacity compensation of Mip-Splatting.
        format: what it was read from, for people ("PLY", "SPZ 4").
        notes: what the reader had to leave out, for people.
        header: numbers of the file's header that the splats do not tell, by name ("version", "fractional_bits").
    """

    splats: Splats
    tree: LodTree | None = None
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
