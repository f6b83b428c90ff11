"""Views of scenes at several detail levels, by the Python API."""

from __future__ import annotations

from pathlib import Path

import pytest

import sparklod_cli as sparklod
from tests.lod.trees import row_of_regions
from tests.part_files import write_streamed

AT = sparklod.Camera.look_at([0, 0, -6], [0, 0, 0], size=(48, 32))
FULL = 6 * 64 + 5


def test_views_take_scenes_in_memory_and_files(tmp_path: Path) -> None:
    scene = row_of_regions(environment=5)
    for viewed in (scene, sparklod.Instance(write_streamed(tmp_path, scene))):
        assert len(sparklod.cut(viewed, AT)) == FULL
        cut = sparklod.cut(viewed, AT, budget=200)
        assert 150 < len(cut) <= 205 and cut.reason == "budget"
        assert sparklod.render(cut, AT).shape == (32, 48, 4)
        (row,) = sparklod.traverse(viewed, [AT], budget=200)
        assert row["selected"] == len(cut) and row["budget"] == 200
        table = sparklod.compare(viewed, None, [AT], budgets=[0.3, 1.0])
        coarse, full = table.column("psnr")
        assert coarse < full == 100


def test_the_rule_is_a_setting(tmp_path: Path) -> None:
    scene = row_of_regions(environment=5)
    rule = sparklod.DetailRule(mode="limit", base_distance=0.1)
    settings = sparklod.LodSettings(detail=rule)
    assert len(sparklod.cut(scene, AT, settings=settings)) == 6 * 16 + 5
    finest = sparklod.LodSettings(detail=sparklod.DetailRule(finest=1))
    assert len(sparklod.cut(scene, AT, settings=finest)) == 6 * 32 + 5


def test_what_has_no_levels_is_refused_by_traverse() -> None:
    with pytest.raises(sparklod.FormatError, match="scene: it is not a Level-of-Detail tree"):
        sparklod.traverse(row_of_regions().scene(), [AT])
