"""The whole-file jobs of `build-lod`, as the library has them; apart from those of `inspect`, which load more."""

from ..bake import Baked as Baked
from ..bake import BakeSettings as BakeSettings
from ..bake import Merged as Merged
from ..bake import Resources as Resources
from ..bake import Source as Source
from ..bake import bake as bake
from ..bake import bake_unless_there as bake_unless_there
from ..bake.out_of_core.cluster import ClusterSettings as ClusterSettings
from ..bake.out_of_core.cluster import cluster as cluster
from ..bake.out_of_core.cluster_engine import ClusterEngine as ClusterEngine
from ..bake.refining import Refined as Refined
from ..bake.side_by_side import bake_side_by_side as bake_side_by_side
from ..bake.written import WrittenDetail as WrittenDetail
from ..extract_leaves import Extracted as Extracted
from ..extract_leaves import extract_leaves as extract_leaves
