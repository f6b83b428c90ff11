"""Fitting the merged splats of a tree, from Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.model.splats import same_rows
from tests.api.runs import DEMO, camera, command
from tests.fittings import STEPS, StandIn
from tests.fittings import stand_in as stand_in


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
