"""The whole-file jobs of `build-lod`, as the library has them; apart from those of `inspect`, which load more."""

from typing import TYPE_CHECKING

from ..support.lazy import loader_of

if TYPE_CHECKING:
    from ..bake.baking import Baked as Baked
    from ..bake.baking import bake as bake
    from ..bake.out_of_core.cluster import ClusterSettings as ClusterSettings
    from ..bake.out_of_core.cluster import cluster as cluster
    from ..bake.out_of_core.cluster_engine import ClusterEngine as ClusterEngine
    from ..bake.refining import Refined as Refined
    from ..bake.resources import Resources as Resources
    from ..bake.settings import BakeSettings as BakeSettings
    from ..bake.side_by_side import bake_side_by_side as bake_side_by_side
    from ..bake.skipping import bake_unless_there as bake_unless_there
    from ..bake.sources import Merged as Merged
    from ..bake.sources import Source as Source
    from ..bake.written import WrittenDetail as WrittenDetail
    from ..extract_leaves import Extracted as Extracted
    from ..extract_leaves import extract_leaves as extract_leaves

#: By module, the names that it has, as above.
_NAMES = {
    "bake.baking": ("Baked", "bake"),
    "bake.out_of_core.cluster": ("ClusterSettings", "cluster"),
    "bake.out_of_core.cluster_engine": ("ClusterEngine",),
    "bake.refining": ("Refined",),
    "bake.resources": ("Resources",),
    "bake.settings": ("BakeSettings",),
    "bake.side_by_side": ("bake_side_by_side",),
    "bake.skipping": ("bake_unless_there",),
    "bake.sources": ("Merged", "Source"),
    "bake.written": ("WrittenDetail",),
    "extract_leaves": ("Extracted", "extract_leaves"),
}

__getattr__ = loader_of(__name__, _NAMES)
