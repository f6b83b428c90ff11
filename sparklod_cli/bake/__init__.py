"""Baking: from splat files to a Level-of-Detail file."""

from typing import TYPE_CHECKING

from ..support.lazy import loader_of

if TYPE_CHECKING:
    from .baking import Baked, bake
    from .resources import Resources
    from .settings import BakeSettings
    from .skipping import bake_unless_there
    from .sources import Merged, Source

#: By module, the names that it has, as above.
_NAMES = {
    "bake.baking": ("Baked", "bake"),
    "bake.resources": ("Resources",),
    "bake.settings": ("BakeSettings",),
    "bake.skipping": ("bake_unless_there",),
    "bake.sources": ("Merged", "Source"),
}

__getattr__ = loader_of(__name__, _NAMES)

__all__ = ["BakeSettings", "Baked", "Merged", "Resources", "Source", "bake", "bake_unless_there"]
