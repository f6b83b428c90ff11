"""The table of tree builders; a new one needs a module and a row here."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from .stages.records import StagedBuilder


@dataclass(frozen=True)
class Builder:
    """A tree builder.

    Attributes:
        module: module of this package that has `build(splats, SETTING, *, progress) -> (nodes, tree)`.
        stages: module of this package that is a `stages.records.StagedBuilder` of such trees.
        setting: name of its only parameter, a number.
        summary: a phrase for help texts.
        in_bands: its trees are put in the order of `band_order` for files that are read whole. That saves 3 to 4 % of
            a file of quality, and 1 to 2 % of one of quick, which is not worth the time.
    """

    module: str
    stages: str
    setting: str
    summary: str
    in_bands: bool

    def load(self) -> Any:
        """The module, imported when it is needed."""
        return import_module(f".{self.module}", __package__)

    def load_stages(self) -> StagedBuilder:
        """The module that builds in stages, imported when it is needed."""
        found: Any = import_module(f".{self.stages}", __package__)
        return cast("StagedBuilder", found)


#: Builders by the name of the method; the first is the default.
BUILDERS = {
    "quick": Builder("quick", "stages.quick", "base", "pairs in cells of a voxel grid, in seconds", in_bands=False),
    "quality": Builder("quality", "stages.quality", "growth", "the pairs that cost least, in all", in_bands=True),
}
METHODS = tuple(BUILDERS)
