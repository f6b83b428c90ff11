"""The table of methods that build trees: adding one is a module and a row here."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Builder:
    """A method.

    Attributes:
        module: in this package; has `build(splats, SETTING, *, progress) -> (nodes, tree)`.
        setting: the one number that it takes, by its name.
        summary: for people, a phrase.
    """

    module: str
    setting: str
    summary: str

    def load(self) -> Any:
        """The module, imported when it is needed."""
        return import_module(f".{self.module}", __package__)


#: By the name of the method; the first one is the default.
BUILDERS = {
    "quick": Builder("quick", "base", "a voxel grid a level, in seconds"),
    "quality": Builder("quality", "growth", "merges the pairs that cost least, for closer cuts"),
}
METHODS = tuple(BUILDERS)
