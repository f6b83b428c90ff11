"""The table of tree builders; a new one needs a module and a row here."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Builder:
    """A tree builder.

    Attributes:
        module: module of this package that has `build(splats, SETTING, *, progress) -> (nodes, tree)`.
        setting: name of its only parameter, a number.
        summary: a phrase for help texts.
    """

    module: str
    setting: str
    summary: str

    def load(self) -> Any:
        """The module, imported when it is needed."""
        return import_module(f".{self.module}", __package__)


#: Builders by the name of the method; the first is the default.
BUILDERS = {
    "quick": Builder("quick", "base", "a voxel grid a level, in seconds"),
    "quality": Builder("quality", "growth", "merges the pairs that cost least, for closer cuts"),
}
METHODS = tuple(BUILDERS)
