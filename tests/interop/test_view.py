"""The page of `sparklod view` in a real browser, with the real Spark."""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

from sparklod_cli import read, write
from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.cli import run
from sparklod_cli.lod import quick
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.view.site import CDN, CESIUM, MODULES, PACKAGES, PLAYCANVAS, THREE, VERSIONS
from tests.conftest import FIXTURES
from tests.interop.engines import like_cesium
from tests.interop.node import ENGINES, PAGE, Node, require
from tests.interop.pictures import psnr
from tests.part_files import tiled
from tests.scenes import random_splats
from tests.signals import heed_signals

pytestmark = pytest.mark.slow

SIZE = 240, 136
LOOK = ("--look-at", "0,-3.4,9:0,-1.1,0", "--fov", "40")
#: Software draws a frame of all splats of the demo scene in a second or more; of these, in a tenth of it.
SPLATS = 6_950
BUDGET = 2_000

#: Least PSNR in dB of a picture of the page from one of `sparklod render`: Spark rounds to 8 bits after every splat.
LEAST = 40

#: The same of PlayCanvas, whose blur and falloff are others.
LEAST_OF_PLAYCANVAS = 28

#: How often the page is asked whether something has come about, which takes moments.
PATIENCE = 1_000

#: A camera path that only moves.
PATH = {
    "format": "sparklod-camera-path",
    "fov": 40,
    "frames": [
        {"time": 0, "eye": [0, -3.4, 9], "target": [0, -3.4, 0]},
        {"time": 1000, "eye": [0, -3.4, 5], "target": [0, -3.4, 0]},
    ],
}


@dataclass(frozen=True)
class Tab:
    """The browser's tab."""

    node: Node

    def ask(self, do: str, **request: Any) -> dict[str, Any]:
        """Asks `view_page.mjs` for something."""
        return self.node.ask({"do": do, **request})

    def open(
        self, url: str, *, without: list[str] | None = None, size: tuple[int, int] = SIZE, hold: bool = False
    ) -> None:
        """Opens a page."""
        self.ask("open", url=url, width=size[0], height=size[1], without=without or [], hold=hold)

    def settled(self) -> dict[str, Any]:
        """The state of the page, once its picture is that of its camera."""
        self.ask("settle")
        return self.ask("state")

    def until(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The state of the page, once something holds of it."""
        for _ in range(PATIENCE):
            state = self.ask("state")
            if holds(state):
                return state
            time.sleep(0.05)
        raise AssertionError(f"the page stays as it is: {state}")

    def picture(self, out: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
        """(height, width, 3) what the page shows, 0..1."""
        self.ask("picture", out=str(out))
        return pixels(out)


def pixels(path: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), np.float64) / 255


@pytest.fixture(scope="module")
def tab(page_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    """The tab of a browser."""
    node = Node("view_page.mjs", page_dir, require("chromium"), scratch=tmp_path_factory.mktemp("view"))
    yield Tab(node)
    node.close()


@pytest.fixture(scope="module")
def trees(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a fourth of the demo scene, demo.ply, and its tree as demo.spz and demo.rad."""
    folder = tmp_path_factory.mktemp("trees")
    scene = read(FIXTURES / "demo.ply")
    write(folder / "demo.ply", replace(scene, splats=scene.splats.take(slice(0, None, 4))))
    for name in ("demo.spz", "demo.rad"):
        assert run(["build-lod", str(folder / "demo.ply"), "-o", str(folder / name), "-q"]) == 0
    return folder


class Served:
    """`sparklod view` as a process."""

    def __init__(self, page_dir: Path, *arguments: object) -> None:
        more = ["--spark-dir", page_dir, "--no-open", "-q", *arguments]
        command = [sys.executable, "-m", "sparklod_cli", "view", *map(str, more)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heed_signals)

    def __enter__(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        assert self.process.wait(20) == 0
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture(scope="module")
def shown(tab: Tab, page_dir: Path, trees: Path) -> Iterator[Tab]:
    """The browser with the tree as SPZ."""
    with Served(page_dir, trees / "demo.spz", *LOOK, "--budget", BUDGET) as url:
        tab.open(url)
        yield tab


def check_picture(
    tab: Tab, state: dict[str, Any], file: Path, folder: Path, budget: int | None = BUDGET, least: float = LEAST
) -> None:
    """Assert that the page shows the picture of `sparklod render` from the camera that it copies out."""
    out, theirs = folder / "r.png", tab.picture(folder / "page.png")
    limit = [] if budget is None else ["--budget", str(budget)]
    more = ["--size", f"{SIZE[0]}x{SIZE[1]}", "--background", "black", "-q", "-o", str(out), "--overwrite"]
    assert run(["render", str(file), *state["camera"].split(), *limit, *more]) == 0
    assert theirs.max(axis=2).mean() > 0.05, "the picture is empty"
    assert psnr(theirs - pixels(out)) >= least


def test_on_a_phone_the_panel_leaves_the_middle_of_the_scene_free(tab: Tab, page_dir: Path, trees: Path) -> None:
    width, height = 390, 844
    with Served(page_dir, trees / "demo.spz", "--budget", 1_000) as url:
        open_slowly(tab, url, trees / "demo.spz", (width, height))
        targets = tab.ask("targets")["targets"]
        assert {"panel-hide", "help-open", "budget", "levels", "orbit", "copy"} <= targets.keys()
        assert {name: sides for name, sides in targets.items() if min(sides) < 44} == {}
        x, y = tab.ask("middle")["middle"]
        assert x == pytest.approx(width / 2, abs=1)
        assert 0.2 * height < y < 0.3 * height
        tab.ask("click", id="panel-hide")
        tab.settled()
        assert tab.ask("middle")["middle"] == pytest.approx([width / 2, height / 2], abs=1)
        assert tab.ask("targets")["targets"].keys() == {"panel-show"}
        tab.ask("click", id="panel-show")
        tab.settled()
        assert tab.ask("middle")["middle"] == pytest.approx([x, y], abs=1)


def open_slowly(tab: Tab, url: str, file: Path, size: tuple[int, int] = SIZE) -> dict[str, Any]:
    """Opens a page, asserts that it says what it loads, with bytes, and returns its state once all is there."""
    tab.open(url, size=size, hold=True)
    loading = tab.until(lambda state: state["loading"] is not None)["loading"]
    assert loading.startswith(f"{file.name}: loading")
    assert loading.endswith(f" of {file.stat().st_size / 1e6:.1f} MB")
    tab.ask("release")
    state = tab.settled()
    assert state["loading"] is None
    return state


@pytest.fixture(scope="module")
def others(page_dir: Path, engines_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose node_modules has PlayCanvas, CesiumJS and three.js."""
    folder = tmp_path_factory.mktemp("others")
    (folder / "node_modules").mkdir()
    for package, source in ((PLAYCANVAS, engines_dir), (CESIUM, engines_dir), (THREE, page_dir)):
        (folder / "node_modules" / package).symlink_to(source / "node_modules" / package)
    return folder


def test_streamed_sog_is_shown_in_playcanvas(tab: Tab, others: Path, trees: Path, tmp_path: Path) -> None:
    """From the camera of the page, which it copies out; its modules have the digests that the page asks a CDN for."""
    check_digests(others, (PLAYCANVAS, THREE))
    assert ENGINES[PLAYCANVAS] == VERSIONS[PLAYCANVAS]
    manifest = trees / "web" / "lod-meta.json"
    assert run(["build-lod", str(trees / "demo.ply"), "-o", str(manifest), "-q"]) == 0
    with Served(others, manifest, *LOOK) as url:
        tab.open(url)
        state = tab.settled()
        assert state["faults"] == []
        assert state["camera"] == "--look-at=0,-3.4,9:0,-1.1,0 --fov=40"
        assert (state["drawn"], state["budget"]) == (SPLATS, f"{SPLATS:,} (all)")
        check_picture(tab, state, manifest, tmp_path, SPLATS, LEAST_OF_PLAYCANVAS)
        tab.ask("press", key="l")
        assert tab.until(lambda state: state["legend"] is not None)["legend"] == "01"
        tab.ask("fill", id="budget", value="0")
        tab.until(lambda state: 0 < state["drawn"] < SPLATS)


@pytest.mark.parametrize("up", [None, "-y"])
def test_a_glb_is_shown_in_playcanvas(up: str | None, tab: Tab, others: Path, trees: Path, tmp_path: Path) -> None:
    """Upright whether its node turns it or not."""
    file = tmp_path / "demo.glb"
    write(file, replace(read(trees / "demo.ply"), up=up))
    with Served(others, file, *LOOK) as url:
        tab.open(url)
        state = tab.settled()
        assert (state["faults"], state["message"], state["drawn"]) == ([], None, SPLATS)
        check_picture(tab, state, file, tmp_path, None, LEAST_OF_PLAYCANVAS)


def test_3d_tiles_are_shown_in_cesium(tab: Tab, others: Path, trees: Path, tmp_path: Path) -> None:
    """Where their own axes put them, not where they are on the Earth; without any other host."""
    assert ENGINES[CESIUM] == VERSIONS[CESIUM]
    place = TileSettings(tile_splats=2_000, lat=47.37, lon=8.54)
    tileset = tiled(read(trees / "demo.ply").splats, tmp_path, place)
    with Served(others, tileset, *LOOK) as url:
        tab.open(url)
        state = tab.settled()
        assert (state["faults"], state["message"], state["drawn"]) == ([], None, SPLATS)
        assert state["camera"] == "--look-at=0,-3.4,9:0,-1.1,0 --fov=40"
        focal = SIZE[1] / 2 / math.tan(math.radians(40) / 2)
        pose = look_at(np.array([0, -3.4, 9]), np.array([0, -1.1, 0]), (0, -1, 0))
        camera = Camera(pose, *SIZE, (focal, focal), (SIZE[0] / 2, SIZE[1] / 2))
        theirs = tab.picture(tmp_path / "page.png")
        assert psnr(theirs - like_cesium(read(tileset).splats, camera)[..., :3]) >= LEAST


def eye_of(camera: str) -> list[float]:
    return [float(value) for value in camera.partition("=")[2].partition(":")[0].split(",")]


def test_the_digests_are_those_of_the_packages(page_dir: Path) -> None:
    assert {name: PAGE[name] for name in PACKAGES["spark"]}.items() <= VERSIONS.items()
    check_digests(page_dir, PACKAGES["spark"])


def check_digests(page_dir: Path, names: Collection[str]) -> None:
    """Assert that modules of packages have the digests by which the page asks a CDN for them."""
    for (package, path), digest in MODULES.items():
        if package in names:
            data = (page_dir / "node_modules" / package / path).read_bytes()
            assert base64.b64encode(hashlib.sha384(data).digest()).decode() == digest, path


def test_the_page_shows_what_render_draws(shown: Tab, trees: Path, tmp_path: Path) -> None:
    """From the camera that the page copies out."""
    state = shown.settled()
    assert state["faults"] == []
    assert state["camera"] == "--look-at=0,-3.4,9:0,-1.1,0 --fov=40"
    assert 0.9 * BUDGET < state["drawn"] <= BUDGET
    assert state["said"] == f"{state['drawn']:,}"
    assert state["budget"] == f"{BUDGET:,}"
    check_picture(shown, state, trees / "demo.spz", tmp_path)


def test_the_slider_changes_the_budget(shown: Tab) -> None:
    shown.ask("fill", id="budget", value="0")
    few = shown.settled()
    assert few["budget"] == "1,000" and 0 < few["drawn"] <= 1_000
    shown.ask("fill", id="budget", value="500")
    assert shown.settled()["drawn"] > 2 * few["drawn"]


def test_colours_by_level_are_those_of_the_legend(shown: Tab, tmp_path: Path) -> None:
    shown.settled()
    plain = shown.picture(tmp_path / "plain.png")
    shown.ask("press", key="l")
    state = shown.settled()
    colored = shown.picture(tmp_path / "colored.png")
    shown.ask("press", key="l")
    assert state["legend"]
    assert psnr(plain - colored) < 20
    # Viridis has no reds: of what is bright, green is the strongest.
    bright = colored[colored.max(axis=2) > 0.5]
    assert (bright.argmax(axis=1) == 1).mean() > 0.9
    shown.settled()
    assert psnr(plain - shown.picture(tmp_path / "again.png")) >= LEAST


def test_dragging_turns_around_the_target(shown: Tab) -> None:
    before = shown.ask("state")["camera"]
    shown.ask("drag", dx=60, dy=10)
    after = shown.settled()["camera"]
    target = np.array([0, -1.1, 0])
    assert before != after
    assert after.partition(":")[2].startswith("0,-1.1,0 ")
    distances = [np.linalg.norm(np.subtract(eye_of(camera), target)) for camera in (before, after)]
    assert distances[0] == pytest.approx(distances[1], rel=1e-3)
    shown.ask("press", key="0")
    assert shown.settled()["camera"] == "--look-at=0,-3.4,9:0,-1.1,0 --fov=40"


def test_a_dropped_path_plays(shown: Tab) -> None:
    shown.ask(
        "drop", name="path.csv", text="x,y,z,target_x,target_y,target_z,time\n0,-3.4,9,0,0,0,0\n0,-3.4,5,0,0,0,1000\n"
    )
    state = shown.until(lambda state: state["path"] is not None)
    assert state["path"] == "path.csv: sparklod's CSV, 2 cameras, 1000.0 s"
    shown.until(lambda later: later["time"] > state["time"])
    shown.ask("fill", id="scrub", value="500")
    middle = shown.settled()
    assert not middle["playing"]
    assert eye_of(middle["camera"]) == pytest.approx([0, -3.4, 7], abs=1e-3)
    shown.ask("drag", dx=5, dy=0)  # who takes the camera leaves the path
    assert shown.ask("state")["path"] is None
    shown.ask("drop", name="scene.ply", text="ply\n")
    assert shown.ask("message")["text"].startswith("scene.ply cannot be played: scene.ply: its content is of no known")


def test_a_rad_tree_is_paged(tab: Tab, page_dir: Path, trees: Path, tmp_path: Path) -> None:
    with Served(page_dir, trees / "demo.rad", trees / "demo.spz", *LOOK, "--budget", BUDGET) as url:
        state = open_slowly(tab, url, trees / "demo.rad")
        assert (state["paged"], state["chunks"], state["meshes"], state["faults"]) == ([True, False], "1 of 1", 2, [])
        tab.ask("fill", id="budget", value="0")  # of both together
        assert 0 < tab.settled()["drawn"] <= 1_000


def test_a_rad_tree_with_sh_of_degree_3_is_paged_whole(tab: Tab, page_dir: Path, tmp_path: Path) -> None:
    """Spark 2.2.0 has no texture for the second array of degree 3 of paged ExtSplats, and stops at the first chunk."""
    near, far = random_splats(3_000, sh_degree=3, extent=0.02), random_splats(56_000, sh_degree=3, seed=1)
    splats = Splats.concat([near, replace(far, center=far.center + np.float32([0, 0, -20]))])
    splats = replace(splats, sh=splats.sh * np.float32(0.3))  # weak ones lose less as ExtSplats, if these can be had
    write(tmp_path / "sh3.rad", Scene(*quick.build(splats)))
    with Served(page_dir, tmp_path / "sh3.rad", "--look-at", "0,0,0.06:0,0,0", "--budget", 4_000) as url:
        tab.open(url)
        tab.until(lambda state: state["chunks"] == "2 of 2")
        state = tab.settled()
        assert (state["faults"], state["errors"], state["message"]) == ([], [], None)
        check_picture(tab, state, tmp_path / "sh3.rad", tmp_path, 4_000)


@pytest.mark.parametrize("how", ["rejection", "console", "event"])
def test_errors_of_the_engine_are_listed_in_the_panel(how: str, shown: Tab) -> None:
    shown.ask("fail", how=how, text=f"offset is out of bounds by {how}")
    found = f"RangeError: offset is out of bounds by {how}"
    shown.until(lambda state: found in state["errors"])
    shown.ask("fail", how=how, text=f"offset is out of bounds by {how}")
    shown.until(lambda state: f"{found} (2 times)" in state["errors"])


def test_an_exported_site_works_without_sparklod_and_without_ranges(
    tab: Tab, page_dir: Path, trees: Path, tmp_path: Path
) -> None:
    command = ["view", str(trees / "demo.rad"), *LOOK, "--budget", str(BUDGET), "--spark-dir", str(page_dir), "-q"]
    assert run([*command, "--export", str(tmp_path / "public" / "site")]) == 0

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    handler = functools.partial(Quiet, directory=str(tmp_path / "public"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        tab.open(f"http://127.0.0.1:{server.server_port}/site/")
        state = tab.settled()
        assert state["faults"] == []
        assert state["files"][0].endswith("loaded whole: this host sends no ranges")
        check_picture(tab, state, trees / "demo.rad", tmp_path)
        tab.ask("drop", name="path.json", text=json.dumps(PATH))
        tab.until(lambda state: state["path"] is not None)
        tab.ask("fill", id="scrub", value="500")
        assert eye_of(tab.settled()["camera"]) == pytest.approx([0, -3.4, 7], abs=1e-3)
        server.shutdown()


def test_a_page_without_its_libraries_says_what_to_do(tab: Tab, trees: Path) -> None:
    command = [sys.executable, "-m", "sparklod_cli", "view", str(trees / "demo.spz"), "--no-open", "-q"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heed_signals) as process:
        assert process.stdout is not None
        tab.open(process.stdout.readline().strip(), without=[urlsplit(CDN).netloc])
        text = tab.ask("message")["text"]
        process.terminate()
    assert f"cannot be loaded from {CDN}" in text
    assert text.endswith("Without a network, start sparklod view with --spark-dir.")
