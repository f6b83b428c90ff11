"""splat-transform 3 reads the splats of our SOG and Streamed SOG as we do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.model.splats import Splats
from tests.conftest import FIXTURES
from tests.interop.engines.conftest import Shot, counts_of
from tests.interop.engines.splat_transform import SplatTransform
from tests.interop.laws import within

pytestmark = pytest.mark.slow


def check_same(ours: Splats, theirs: Splats) -> None:
    """Asserts that both have the same splats in any order, up to the rounding of float32."""
    ours, theirs = in_order(ours), in_order(theirs)
    assert len(ours) == len(theirs)
    within(ours.center, theirs.center, 2e-6 * float(np.abs(theirs.center).max()))
    within(np.log(ours.scale), np.log(theirs.scale), 2e-6)
    within(ours.opacity, theirs.opacity, 2e-6)  # it keeps opacities off 1, whose logit is infinite
    within(ours.rgb, theirs.rgb, 2e-6)
    assert np.abs((ours.quat_xyzw * theirs.quat_xyzw).sum(axis=1)).min() > 1 - 1e-6
    assert ours.sh.shape == theirs.sh.shape
    within(ours.sh, theirs.sh, 1e-6)


def in_order(splats: Splats) -> Splats:
    def steps(values: NDArray[np.float32]) -> NDArray[np.float64]:
        return np.round(values.astype(np.float64), 4)

    x, y, z = steps(splats.center).T
    return splats.take(np.lexsort((*steps(splats.rgb).T, *steps(splats.scale).T, x, y, z)))


def test_it_reads_every_level(splat_transform: SplatTransform, shot: Shot) -> None:
    theirs, scene = splat_transform.levels(shot.file), read_parts(shot.file)
    assert [len(level) for level in theirs] == counts_of(shot.file)
    for level, splats in enumerate(theirs):
        check_same(scene.splats.take(scene.level(level)), splats)


def test_it_reads_the_levels_of_the_file_written_by_hand(splat_transform: SplatTransform) -> None:
    """Which has spherical harmonics."""
    file = FIXTURES / "golden" / "sh1-streamed-sog" / "lod-meta.json"
    scene = read_parts(file)
    for level, splats in enumerate(splat_transform.levels(file)):
        check_same(scene.splats.take(scene.level(level)), splats)


@pytest.mark.parametrize("name", ["scene.sog", "meta.json"])
def test_it_reads_sog(splat_transform: SplatTransform, sog: dict[str, Path], name: str) -> None:
    (theirs,) = splat_transform.levels(sog[name])
    check_same(read_scene(sog[name]).splats, theirs)
