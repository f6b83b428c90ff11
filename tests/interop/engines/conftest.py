"""The browser with the engines, splat-transform, and the scene that they show; or a skipped test if one is missing."""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import sparklod_cli
from fixtures import demo_scene
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.codecs import streamed_sog as codec
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.io.reading import read_scene
from sparklod_cli.io.writing import parts_output
from sparklod_cli.lod import parts, quality
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.scene import DetailScene
from sparklod_cli.model.splats import Splats
from tests.conftest import FIXTURES
from tests.interop import npm
from tests.interop.engines import PACKAGES, recipes
from tests.interop.engines.browser import Browser
from tests.interop.engines.splat_transform import SplatTransform
from tests.interop.pictures import cameras_around
from tests.outputs import write_files

SIZE = 320, 180


@dataclass(frozen=True)
class Shot:
    """A scene as Streamed SOG and how it is looked at.

    Attributes:
        file: lod-meta.json of three levels in several chunks and regions.
        splats: of level 0 and the environment.
        camera: sees all of them from the side, upright where -y of the file is up.
    """

    file: Path
    splats: Splats
    camera: Camera


def counts_of(file: Path) -> list[int]:
    """The splats of each detail level, as lod-meta.json says."""
    counts: list[int] = json.loads(file.read_text(encoding="utf-8"))["counts"]
    return counts


@pytest.fixture(scope="session")
def engines_dir(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose node_modules has `PACKAGES`: the one that ENGINES_DIR names, or one that is installed here."""
    return npm.folder_with(PACKAGES, variable="ENGINES_DIR", request=request, tmp_path_factory=tmp_path_factory)


@pytest.fixture(scope="module")  # an engine draws its page again and again as long as that is open
def browser(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The browser, started once for the tests of a module."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("Chromium is not installed (Debian's package chromium)")
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    browser = Browser(request.getfixturevalue("engines_dir"), chromium, tmp_path_factory.mktemp("pictures"))
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def splat_transform(engines_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SplatTransform]:
    """splat-transform, started once for all tests."""
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    process = SplatTransform(engines_dir, tmp_path_factory.mktemp("columns"))
    yield process
    process.close()


@pytest.fixture(scope="session")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    """The demo scene, in which up, left and front differ, as Streamed SOG."""
    return written(detailed(), tmp_path_factory.mktemp("web"))


@pytest.fixture(scope="session")
def shot_with_sky(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    """The same scene with an environment, which is in its splats."""
    return written(dataclasses.replace(detailed(), environment=sky()), tmp_path_factory.mktemp("web"))


#: How the demo scene is divided into levels, regions and chunks.
DETAIL = DetailSettings((0.25, 0.05), chunk_splats=8_000, extent=4, min_splats=2_000)


@functools.cache
def detailed() -> DetailScene:
    """Return the demo scene at several detail levels, which notes the axis that points up."""
    scene = parts.make_levels(*quality.build(read_scene(FIXTURES / "demo.ply").splats, 2.0), DETAIL)
    return dataclasses.replace(scene, up="-y")


def sky() -> Splats:
    """Return the far sky of the demo scene."""
    made = demo_scene.sky()
    quat_xyzw = made["quat_wxyz"][:, [1, 2, 3, 0]]
    no_sh = np.empty((len(quat_xyzw), 0, 3))
    columns = made["center"], np.exp(made["log_scale"]), quat_xyzw, made["opacity"], made["rgb"], no_sh
    return Splats(*(np.array(column, np.float32, order="C") for column in columns))


def written(scene: DetailScene, folder: Path, size: tuple[int, int] = SIZE) -> Shot:
    """Write a scene as Streamed SOG, and return it with a camera that sees the demo scene."""
    file = folder / recipes.MANIFEST
    write_files(parts_output(file, overwrite=False), codec.encode_files(scene, WriteOptions(), DETAIL))
    level = slice(0, int(scene.counts[:, 0].sum()))
    return Shot(file, read_scene(file).splats, cameras_around(scene.splats.center[level], *size)[1])


@pytest.fixture(scope="session")
def sog(shot: Shot, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Level 0 as a plain SOG, bundled and unbundled, by the names of the files."""
    folder = tmp_path_factory.mktemp("sog")
    scene = sparklod_cli.read(shot.file)
    files = {name: folder / name for name in (recipes.SOG, "meta.json")}
    for file in files.values():
        sparklod_cli.write(file, scene)
    return files
