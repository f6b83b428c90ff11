"""PlayCanvas's engine, SuperSplat's viewer and Babylon.js show SOG and Streamed SOG as we do, the right way up."""

from __future__ import annotations

import dataclasses
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import sparklod_cli
from sparklod_cli.io.reading import read_parts
from sparklod_cli.model.scene import Scene
from tests.conftest import ROOT
from tests.interop import engines
from tests.interop.engines import Browser, Request, Shot, Shown, counts_of, likeness, our_picture
from tests.interop.node import ENGINES

pytestmark = pytest.mark.slow

#: Least PSNR in dB, of red, green and blue of all pixels. PlayCanvas is set to draw as we do, but for its falloff and a
#: sort of few bits; SuperSplat's viewer and Babylon.js are as their pages set them.
PLAYCANVAS, OTHERS = 38, 33

#: Most PSNR in dB of pictures that are turned or mirrored.
WRONG = 20


@pytest.fixture(scope="module")
def ours(shot: Shot) -> NDArray[np.float32]:
    """Our picture of level 0, with the engines' blur."""
    return our_picture(shot.splats, shot.camera)


def check(shown: Shown, ours: NDArray[np.float32], least: float) -> None:
    """Assert that a picture is ours, and that the test would notice if it were turned by half a turn or mirrored."""
    rgba = shown.rgba
    assert likeness(rgba, ours) >= least, f"{likeness(rgba, ours):.2f} dB"
    assert max(likeness(wrong, ours) for wrong in (rgba[::-1], rgba[:, ::-1], rgba[::-1, ::-1])) < WRONG


def levels_of(requests: list[Request]) -> list[int]:
    """Return the levels of the chunks requested after the manifest; assert that coarse ones come first."""
    assert requests[0].name == engines.MANIFEST
    levels = [int(each.name.split("_")[0]) for each in requests[1:] if each.name.endswith("/meta.json")]
    assert levels == sorted(levels, reverse=True), levels
    return levels


def test_playcanvas_shows_a_coarse_level_first_and_then_all(
    browser: Browser, shot: Shot, ours: NDArray[np.float32]
) -> None:
    shown = browser.playcanvas(shot.file, shot.camera)
    check(shown, ours, PLAYCANVAS)
    counts = counts_of(shot.file)
    assert set(levels_of(shown.requests)) == {0, 1, 2}
    assert shown.frames[0] <= counts[1], "the first frame shows a part of level 0"
    assert shown.frames[-1] == counts[0]


@pytest.mark.parametrize("name", ["scene.sog", "meta.json"])
def test_playcanvas_and_babylon_show_sog_upright(
    browser: Browser, shot: Shot, sog: dict[str, Path], ours: NDArray[np.float32], name: str
) -> None:
    shown = browser.playcanvas(sog[name], shot.camera)
    check(shown, ours, PLAYCANVAS)
    assert shown.frames == [len(shot.splats)]
    if name == "scene.sog":
        check(browser.babylon(sog[name], shot.camera), ours, OTHERS)


def test_playcanvas_shows_glb_upright(browser: Browser, shot: Shot, ours: NDArray[np.float32], tmp_path: Path) -> None:
    file = tmp_path / engines.GLB
    sparklod_cli.write(file, Scene(shot.splats, up="-y"))
    shown = browser.playcanvas_glb(file, shot.camera)
    check(shown, ours, PLAYCANVAS)
    assert shown.frames == [len(shot.splats)]


def test_supersplat_shows_it_upright(browser: Browser, shot: Shot, ours: NDArray[np.float32]) -> None:
    shown = browser.supersplat(shot.file, shot.camera)
    check(shown, ours, OTHERS)
    assert shown.frames[-1] == counts_of(shot.file)[0]
    assert set(levels_of(shown.requests)) == {0, 2}  # it goes straight from the coarsest level to what it wants


def test_babylon_streams_sog(browser: Browser, shot: Shot, ours: NDArray[np.float32]) -> None:
    shown = browser.babylon(shot.file, shot.camera)
    check(shown, ours, OTHERS)
    assert shown.frames[0] < shown.frames[-1]
    assert 0 <= shown.frames[-1] - counts_of(shot.file)[0] < 16  # rounded up
    # Why its page has a line about the rotation: once this fails, Babylon.js has changed.
    shown = browser.babylon(shot.file, shot.camera, {"stream.rotation.x = 0;": ""})
    assert likeness(shown.rgba, ours) < WRONG


@pytest.mark.parametrize("engine", ["playcanvas", "supersplat", "babylon"])
def test_an_environment_is_drawn(
    engine: str, browser: Browser, shot: Shot, shot_with_sky: Shot, ours: NDArray[np.float32]
) -> None:
    shown = getattr(browser, engine)(shot_with_sky.file, shot_with_sky.camera)
    with_sky = our_picture(shot_with_sky.splats, shot_with_sky.camera)
    check(shown, with_sky, OTHERS)
    assert likeness(shown.rgba, ours) < WRONG
    assert "env/env.sog" in [each.name for each in shown.requests]


def test_the_page_of_playcanvas_draws_far_levels_brighter_than_the_engine_by_itself(
    browser: Browser, shot: Shot, tmp_path: Path
) -> None:
    """Beside full detail, from three times as far: the page has a line about `antiAlias`."""
    levels = read_parts(shot.file)
    pose = shot.camera.camera_to_world.copy()
    middle = np.median(shot.splats.center, axis=0)
    pose[:3, 3] = middle + 3 * (pose[:3, 3] - middle)
    camera = dataclasses.replace(shot.camera, camera_to_world=pose)

    def brightness(level: int, settings: dict[str, bool]) -> float:
        path = tmp_path / f"{level}.sog"
        sparklod_cli.write(path, Scene(levels.splats.take(levels.level(level))), overwrite=True)
        return float(browser.playcanvas(path, camera, {"minPixelSize": 0} | settings).rgba[..., :3].mean())

    page, without = (brightness(2, settings) / brightness(0, settings) for settings in ({}, {"antiAlias": False}))
    assert page > 0.8 and without < page - 0.1, (page, without)


def test_the_documentation_has_the_five_lines_of_the_page_and_the_tested_versions() -> None:
    (lines,) = engines.blocks(engines.PLAYCANVAS, "js")
    assert len(lines.splitlines()) == 5
    assert textwrap.indent(lines, "  ") in engines.page(engines.PLAYCANVAS)
    text = (ROOT / "docs" / "playcanvas.md").read_text(encoding="utf-8")
    named = dict(re.findall(r"(\S+)@(\d+\.\d+\.\d+)", text.replace("`", " ")))
    assert named.items() <= ENGINES.items()
    assert {"playcanvas", "@playcanvas/supersplat-viewer", "@babylonjs/core", "@babylonjs/loaders"} <= named.keys()
