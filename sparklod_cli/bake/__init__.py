"""Baking: from splat files to a Level-of-Detail file."""

from .baking import Baked, bake
from .resources import Resources
from .settings import BakeSettings
from .sources import Merged, Source

__all__ = ["BakeSettings", "Baked", "Merged", "Resources", "Source", "bake"]
