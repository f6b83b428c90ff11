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
    """

    module: str
    stages: str
    setting: str
    summary: str

    def load(self) -> Any:
        """The module, imported when it is needed."""
        return import_module(f".{self.module}", __package__)

    def load_stages(self) -> StagedBuilder:
        """The module that builds in stages, imported when it is needed."""
        found: Any = import_module(f".{self.stages}", __package__)
        return cast("StagedBuilder", found)


#: Builders by the name of the method; the first is the default.
BUILDERS = {
    "quick": Builder("quick", "stages.quick", "base", "a voxel grid a level, in seconds"),
    "quality": Builder("quality", "stages.quality", "growth", "merges the pairs that cost least, for closer cuts"),
}
METHODS = tuple(BUILDERS)
