"""Baking: from splat files to a Level-of-Detail file."""

from .baking import Baked, bake
from .resources import Resources
from .settings import BakeSettings
from .skipping import bake_unless_there
from .sources import Merged, Source

__all__ = ["BakeSettings", "Baked", "Merged", "Resources", "Source", "bake", "bake_unless_there"]
