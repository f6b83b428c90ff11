"""What Spark 2.2.0 does not do with RAD; docs/streaming.md says so to those who write pages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fixtures import by_hand_rad
from tests.conftest import FIXTURES
from tests.interop.spark import Spark
from tests.scenes import random_splats

pytestmark = pytest.mark.slow


def test_spark_loads_a_header_of_chunk_files_paged_alone(spark: Spark) -> None:
    with pytest.raises(AssertionError, match="Incomplete RAD chunk"):
        spark.load(FIXTURES / "golden" / "sh3-rad" / "sh3.rad")


def test_spark_ignores_a_palette_if_it_is_asked_for_a_tree(spark: Spark, tmp_path: Path) -> None:
    """Where a page says `lod: true`, Spark decodes with another reader, also if the file has a tree already."""
    splats = random_splats(50, sh_degree=1)
    columns = {name: getattr(splats, name) for name in ("center", "scale", "opacity", "rgb", "sh")}
    columns["quat_wxyz"] = splats.quat_xyzw[:, [3, 0, 1, 2]]
    children = [49, *[0] * 49], [1, *[0] * 49]
    files = by_hand_rad.rad(**columns, tree=children, palette=(splats.sh, np.arange(50)))
    path = tmp_path / "scene.rad"
    path.write_bytes(files["scene.rad"])
    assert np.abs(spark.load(path).sh).max() > 0.2
    assert np.abs(spark.load(path, lod=True).sh).max() < 1e-4
