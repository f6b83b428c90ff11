"""The table of tree builders; a new one needs a module and a row here."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Builder:
    """A tree builder.

    Attributes:
        module: module of this package that has `build(splats, SETTING, *, progress) -> (nodes, tree)`, and is a
            `stage_records.StagedBuilder` of such trees.
        setting: name of its only parameter, a number.
        summary: a phrase for help texts.
        in_bands: its trees are put in the order of `band_order` for files that are read whole. That saves 3 to 4 % of
            a file of quality, and 1 to 2 % of one of quick, which is not worth the time.
    """

    module: str
    setting: str
    summary: str
    in_bands: bool

    def load(self) -> Any:
        """Import and return the module."""
        return import_module(f".{self.module}", __package__)


#: Builders by the name of the method; the first is the default.
BUILDERS = {
    "quick": Builder("quick", "base", "pairs in cells of a voxel grid, in seconds", in_bands=False),
    "quality": Builder("quality", "growth", "the pairs that cost least, in all", in_bands=True),
}
METHODS = tuple(BUILDERS)
