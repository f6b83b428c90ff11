"""Choice of Spark's layouts: one loses strong SH, the other far places and colours beyond 0 to 1."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sparklod_cli.codecs.losses import SAMPLE, LayoutLoss, sample_loss
from sparklod_cli.model.splats import Splats
from tests.scenes import random_splats


def changed(sh_degree: int, *, sh: float = 1, moved: float = 0, rgb: float = 0) -> Splats:
    """Random splats with weaker SH, farther from the origin, brighter."""
    splats = random_splats(500, sh_degree=sh_degree)
    return replace(
        splats,
        sh=splats.sh * np.float32(sh),
        center=splats.center + np.float32(moved),
        rgb=splats.rgb + np.float32(rgb),
    )


@pytest.mark.parametrize("sh_degree", [1, 2, 3])
@pytest.mark.parametrize(
    ("change", "layout"),
    [({}, "packed"), ({"sh": 0.05}, "ext"), ({"sh": 0}, "ext"), ({"moved": 2000}, "ext"), ({"rgb": 0.5}, "ext")],
)
def test_sh_decide_unless_places_or_colours_do(sh_degree: int, change: dict[str, float], layout: str) -> None:
    assert sample_loss(changed(sh_degree, **change)).better == layout


def test_ext_splats_lose_more_of_stronger_sh() -> None:
    """The loss is a share of SH: ten times weaker SH lose 20 dB less."""
    strong, weak = (sample_loss(changed(2, sh=sh)).psnr("ext") for sh in (1, 0.1))
    assert weak == pytest.approx(strong + 20, abs=1)


def test_a_sample_stands_for_all() -> None:
    splats = random_splats(3 * SAMPLE + 1, sh_degree=1)
    parts = [LayoutLoss.of(splats.take(slice(start, start + SAMPLE))) for start in range(0, len(splats), SAMPLE)]
    for layout in ("ext", "packed"):
        assert sample_loss(splats).psnr(layout) == pytest.approx(LayoutLoss.total(parts).psnr(layout), abs=0.2)


def test_invalid_and_invisible_splats_have_no_weight() -> None:
    splats = changed(1)
    splats.center[0], splats.opacity[1], splats.scale[2] = np.nan, 0, 0
    assert np.isfinite(sample_loss(splats).psnr("ext"))
    assert sample_loss(splats.take(slice(0, 1))).better == "ext"
    assert sample_loss(Splats.empty(0, 2)).better == "ext"
