"""Baking: from a splat file to a Level-of-Detail file."""

from .baking import Baked, bake
from .resources import Resources
from .settings import BakeSettings

__all__ = ["BakeSettings", "Baked", "Resources", "bake"]
