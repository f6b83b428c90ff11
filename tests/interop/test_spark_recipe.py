"""The pages of docs/spark.md show a tree in Spark as `sparklod render` draws it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparklod_cli import read, write
from sparklod_cli.cli import run
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES, ROOT
from tests.interop.conftest import PAGE
from tests.interop.engines import recipes
from tests.interop.engines.browser import Browser
from tests.interop.pictures import psnr
from tests.interop.test_view import packages as packages

pytestmark = pytest.mark.slow

SIZE = 240, 136

#: The camera of the page, in the axes of the file: y and z point the other way.
LOOK = ("--look-at", "0,-3,-9:0,-1,0", "--fov", "60", "--size", "240x136", "--background", "black")

#: Least PSNR in dB: Spark keeps 16 bytes a splat, and rounds to 8 bits after every splat.
LEAST = 32


@pytest.fixture(scope="module")
def browser(packages: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser with Spark."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("Chromium is not installed (Debian's package chromium)")
    browser = Browser(packages, chromium, tmp_path_factory.mktemp("pictures"))
    yield browser
    browser.close()


@pytest.mark.parametrize("streamed", [False, True])
def test_the_page_shows_what_render_draws(streamed: bool, browser: Browser, tmp_path: Path) -> None:
    tree = tmp_path / (recipes.RAD if streamed else recipes.TREE)
    options = ["--format", "rad"] if streamed else []
    write(tmp_path / "scene.ply", Scene(read(FIXTURES / "demo.ply").splats.take(slice(0, None, 4))))
    assert run(["build-lod", str(tmp_path / "scene.ply"), *options, "-o", str(tree), "-q"]) == 0
    assert run(["render", str(tree), "--full", *LOOK, "-o", str(tmp_path / "ours.png"), "-q"]) == 0
    with Image.open(tmp_path / "ours.png") as image:
        ours = np.asarray(image.convert("RGB"), np.float64) / 255
    theirs = browser.still(recipes.spark(streamed=streamed), tmp_path, SIZE)
    assert psnr(theirs - ours) >= LEAST
    assert max(psnr(wrong - ours) for wrong in (theirs[::-1], theirs[:, ::-1], theirs[::-1, ::-1])) < 20


def test_the_document_names_the_versions_that_are_tested() -> None:
    text = (ROOT / "docs" / "spark.md").read_text(encoding="utf-8")
    named = dict(re.findall(r"(\S+)@(\d+\.\d+\.\d+)", text.replace("`", " ")))
    assert named == {name: PAGE[name] for name in ("@sparkjsdev/spark", "three")}
