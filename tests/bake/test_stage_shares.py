"""The progress of a bake names stages that its shares know, in their order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.bake.flow import bake, stage_shares
from sparklod_cli.bake.settings import BakeSettings, Resources
from sparklod_cli.bake.simplifying import SimplifyGoal
from sparklod_cli.codecs.options import RadOptions, SogOptions, WriteOptions
from sparklod_cli.fitting.settings import FitSettings
from sparklod_cli.lod.budget import parse_budget
from sparklod_cli.lod.tree_settings import DetailSettings, TileSettings
from tests.conftest import FIXTURES

CODES = WriteOptions(rad=RadOptions(sh_codes=64), sog=SogOptions(64))
SETTINGS: dict[str, dict[str, Any]] = {
    "a.spz": {},
    "b.rad": {"suffix": ".rad"},
    "c.rad": {"suffix": ".rad", "method": "quality", "options": CODES},
    "d.spz": {"method": "quality", "refine": FitSettings(steps=2)},
    "e.sog": {"suffix": ".sog", "method": "quality", "simplify": SimplifyGoal(parse_budget("50%")), "options": CODES},
    "f/lod-meta.json": {"method": "quality", "detail": DetailSettings()},
    "g/tileset.json": {"method": "quality", "tiles": TileSettings()},
}


@pytest.mark.parametrize("out_of_core", [False, True], ids=["in memory", "out of core"])
@pytest.mark.parametrize("output", SETTINGS)
def test_stages_come_in_the_order_of_their_shares(output: str, out_of_core: bool, tmp_path: Path) -> None:
    settings = BakeSettings(**SETTINGS[output])
    stages: dict[str, None] = {}
    resources = Resources(block_splats=1 << 16 if out_of_core else None)
    bake(
        FIXTURES / "sh1.ply",
        tmp_path / output,
        settings,
        resources=resources,
        progress=lambda stage, done, total, unit: stages.setdefault(stage),
    )
    shares = list(stage_shares(settings))
    assert [stage for stage in shares if stage in stages] == list(stages)
    assert stages
