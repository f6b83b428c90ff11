"""Detail levels, and refining, by the API."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.model.splats import same_rows
from tests.api.runs import DEMO, camera, command
from tests.fittings import STEPS, StandIn
from tests.fittings import stand_in as stand_in
from tests.lod.details import row_of_regions
from tests.streamed import write_streamed

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


def test_a_tree_is_fitted_as_by_the_command(file: Path, held: sparklod.Tree, tmp_path: Path, stand_in: StandIn) -> None:
    said: list[str] = []
    fitted, report = sparklod.refine(held, seed=3, say=said.append, threads=2)
    assert isinstance(fitted, sparklod.Tree)
    assert isinstance(report, sparklod.Refined)
    assert (report.steps, report.seed, report.is_complete) == (STEPS, 3, True)
    assert said == ["fit 1 of 1: 2 % 30.0 -> 32.5 dB"]
    command("build-lod", file, "--refine", "--seed", 3, "-o", tmp_path / "theirs.spz", "-q")
    theirs = sparklod.read(tmp_path / "theirs.spz")
    assert theirs.tree is not None
    assert np.array_equal(theirs.tree.child_start, fitted.tree.child_start)
    assert same_rows(theirs.splats, held.splats)[held.tree.is_leaf].all()
    assert same_rows(fitted.splats, held.splats)[held.tree.is_leaf].all()
    np.testing.assert_allclose(theirs.splats.center, fitted.splats.center, atol=2e-3)


def test_a_scene_is_built_and_fitted(scene: sparklod.Scene, tmp_path: Path, stand_in: StandIn) -> None:
    command("build-lod", DEMO, "--refine", 7, "-o", tmp_path / "theirs.spz", "-q")
    for wanted in (7, sparklod.FitSettings(steps=7)):
        ours = sparklod.build_lod(scene, refine=wanted)
        sparklod.write(tmp_path / "ours.spz", ours, overwrite=True)
        assert (tmp_path / "ours.spz").read_bytes() == (tmp_path / "theirs.spz").read_bytes()
    assert [settings.steps for settings, _ in stand_in.calls] == [7, 7, 7]
    sparklod.build_lod(scene, refine=True)
    assert stand_in.calls[-1][0] == sparklod.FitSettings()
    sparklod.build_lod(scene)
    assert len(stand_in.calls) == 4


def test_cameras_are_a_path_or_some(held: sparklod.Tree, stand_in: StandIn) -> None:
    for given in (camera(), [camera()], sparklod.orbit(held, count=1)):
        sparklod.refine(held, cameras=given)
        path = stand_in.calls[-1][0].path
        assert path is not None
        assert len(path) == 1


def test_what_cannot_be_is_an_error(scene: sparklod.Scene, held: sparklod.Tree, stand_in: StandIn) -> None:
    with pytest.raises(sparklod.FormatError, match="no Level-of-Detail tree; build_lod makes one"):
        sparklod.refine(scene)
    for wrong in ({"steps": 0}, {"seed": -1}, {"cameras": []}):
        with pytest.raises(ValueError, match=r"give|there are no cameras"):
            sparklod.refine(held, **wrong)  # type: ignore[arg-type]
    for wrong in ({"steps": 1.5}, {"cameras": "orbit"}):
        with pytest.raises(TypeError):
            sparklod.refine(held, **wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="refine is 0; give 1 to"):
        sparklod.build_lod(scene, refine=0)
    with pytest.raises(TypeError, match="refine is 'yes'"):
        sparklod.build_lod(scene, refine="yes")  # type: ignore[arg-type]
    assert not stand_in.calls
