"""Whole-file jobs of `build-lod`, as the library has them; apart from those of `inspect`, which load more."""

from ..bake.flow import bake as bake
from ..bake.out_of_core.cluster import ClusterSettings as ClusterSettings
from ..bake.out_of_core.cluster import cluster as cluster
from ..bake.out_of_core.cluster_engine import ClusterEngine as ClusterEngine
from ..bake.records import Baked as Baked
from ..bake.records import WrittenDetail as WrittenDetail
from ..bake.refining import Refined as Refined
from ..bake.settings import BakeSettings as BakeSettings
from ..bake.settings import Resources as Resources
from ..bake.side_by_side import bake_side_by_side as bake_side_by_side
from ..bake.skipping import bake_unless_there as bake_unless_there
from ..bake.sources import Merged as Merged
from ..bake.sources import Source as Source
from ..extract_leaves import Extracted as Extracted
from ..extract_leaves import extract_leaves as extract_leaves
