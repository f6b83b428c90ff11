"""sparklod's rasterizer draws the pictures of Spark in a browser: splats, cuts, refined and paged trees, and pages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from sparklod_cli import read, write
from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.cli import run
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.formats import RadOptions, WriteOptions
from sparklod_cli.codecs.losses import after
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.rad_header import RadHeader, read_header
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import draw, shade
from sparklod_cli.render.render_settings import SORTS, RasterSettings
from tests.codecs.cases import encode
from tests.conftest import FIXTURES, ROOT
from tests.fittings import StandIn
from tests.fittings import stand_in as stand_in
from tests.interop import engines
from tests.interop.engines import Browser
from tests.interop.node import PAGE, require
from tests.interop.pictures import Difference, Page, Picture, Request, cameras_around, compare, psnr
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

SIZE = 240, 136

#: Least PSNR in dB: of all pixels and of covered ones in 8 bits, to which Spark rounds after every splat; and of
#: pictures from Spark's coding of the splats without that rounding, which differ by float32 and float16 alone.
LEAST, LEAST_COVERED, LEAST_HELD = 45, 40, 58

#: The first two where splats have SH, of which ExtSplats lose up to half of a coefficient, and files no longer do.
LEAST_SH = {"least": 42, "covered": 35}


def check(differences: Iterable[Difference], *, least: float = LEAST, covered: float = LEAST_COVERED) -> None:
    for view, difference in enumerate(differences):
        assert difference.share > 0.05, f"view {view} is nearly empty"
        assert difference.same_cut is not False, f"view {view} has another cut"
        assert difference.psnr >= least and difference.covered >= covered, f"view {view}: {difference}"
        assert difference.held >= LEAST_HELD, f"view {view}: {difference}"


@cache
def demo() -> Splats:
    return read_scene(FIXTURES / "demo.ply").splats.take(slice(0, None, 4))


def written(folder: Path, scene: Scene) -> Path:
    path = folder / "scene.spz"
    path.write_bytes(encode(spz, scene))
    return path


def cameras_of(splats: Splats) -> list[Camera]:
    return cameras_around(splats.center, *SIZE)


# --- Splats and cuts --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sort", SORTS)
def test_plain_splats_are_drawn_alike(page: Page, tmp_path: Path, sort: str) -> None:
    """Of coincident splats, in the same order."""
    settings = RasterSettings(sort=sort)
    check(compare(page, written(tmp_path, Scene(demo())), cameras_of(demo())[::2], settings))
    splats = random_splats(300).take(np.repeat(np.arange(300), 3))
    splats.rgb[:] = np.random.default_rng(1).uniform(0, 1, splats.rgb.shape)
    check(compare(page, written(tmp_path, Scene(splats)), cameras_of(splats)[1:2], settings))


@pytest.mark.parametrize("budget", [300, 2_000])
def test_cuts_of_a_tree_are_drawn_alike(page: Page, tmp_path: Path, budget: int) -> None:
    """Of a cut of 300 nodes most are merged splats, many of them with a D above 1."""
    file = written(tmp_path, Scene(*quick.build(demo())))
    check(compare(page, file, cameras_of(demo())[1::2], RasterSettings(), budget))


@pytest.mark.parametrize("sh_degree", range(1, 4))
def test_spherical_harmonics_are_drawn_alike(page: Page, tmp_path: Path, sh_degree: int) -> None:
    splats = random_splats(3_000, sh_degree=sh_degree)
    file = written(tmp_path, Scene(splats))
    check(compare(page, file, cameras_of(splats)[:2], RasterSettings()), **LEAST_SH)


def test_splats_outside_the_clip_planes_are_dropped_alike(page: Page, tmp_path: Path) -> None:
    """Spark drops a whole splat if its centre is nearer, farther or too far out."""
    splats = random_splats(3_000)
    cameras = cameras_of(splats)
    distance = float(np.linalg.norm(cameras[0].position))
    settings = RasterSettings(near=0.8 * distance, far=1.1 * distance)
    check(compare(page, written(tmp_path, Scene(splats)), cameras[:1], settings))


@pytest.mark.parametrize("layout", ["Packed", "Ext"])
def test_packed_splats_clamp_bright_colors_before_sh_are_added(page: Page, tmp_path: Path, layout: str) -> None:
    """So outdoor scenes are darker than in our pictures, which `--through packed` shows; ExtSplats are not."""
    splats = random_splats(3_000, sh_degree=1)
    splats = replace(splats, rgb=splats.rgb + np.float32(0.7), sh=np.full_like(splats.sh, 0.02))
    splats.sh[:, 1] = -0.5  # of z: darker from where the camera is; a power of two, of which ExtSplats cut off nothing
    camera = cameras_of(splats)[0]
    file, settings = written(tmp_path, Scene(splats)), RasterSettings()
    page.open(file, camera, settings, layout=layout)
    theirs = np.clip(page.draw(camera, settings).exact[..., :3], 0, 1)
    scene = read_scene(file)
    ours, through = (
        np.clip(draw(shade([(each, np.eye(4))], camera), camera, settings)[..., :3], 0, 1)
        for each in (scene.splats, after(layout.lower(), file, scene))
    )
    assert psnr(theirs - through) >= LEAST_HELD
    if layout == "Packed":
        assert theirs.mean() < 0.96 * ours.mean()
    else:
        assert theirs.mean() == pytest.approx(ours.mean(), rel=0.02)


def test_cuts_of_refined_trees_are_drawn_alike(page: Page, tmp_path: Path, stand_in: StandIn) -> None:
    """As `--refine` writes them: refined while they are built, and a tree of SH degree 3 as read from its file."""

    def built(name: str, source: Path, *options: str) -> Path:
        assert run(["build-lod", str(source), "--quiet", "-o", str(tmp_path / name), "--refine", *options]) == 0
        return tmp_path / name

    refined = built("refined.rad", written(tmp_path, Scene(demo())), "--method", "quality")
    cameras = cameras_of(read_scene(refined).splats)
    check(compare(page, refined, cameras[1:2], RasterSettings(), 300))
    check(compare(page, refined, cameras[3:4], RasterSettings(), 2_000))
    refined = built("refined.spz", written(tmp_path, Scene(*quick.build(random_splats(2_000, sh_degree=3)))))
    splats = read_scene(refined).splats
    assert len(stand_in.calls) == 2 and splats.sh_degree == 3
    check(compare(page, refined, cameras_of(splats)[1:2], RasterSettings(), 1_000), **LEAST_SH)


# --- Paged RAD --------------------------------------------------------------------------------------------------------

#: Least PSNR in dB from the picture of the LoD SPZ. Both files round splats, and SPZ rounds SH to 4 or 5 bits.
LEAST_PAGED = 40

#: Bytes of Spark's first request, for the header.
HEAD_BYTES = 65_536


@dataclass(frozen=True)
class Files:
    """A tree in three files, and the header of the second."""

    spz: Path
    whole: Path
    chunked: Path
    header: RadHeader

    @classmethod
    def of(cls, scene: Scene, folder: Path, ranges: SplatEncoding | None = None) -> Files:
        options = WriteOptions(rad=RadOptions(ranges=ranges))
        whole, chunked = folder / "tree.rad", folder / "parts-lod.rad"
        whole.write_bytes(encode(rad, scene, options, threads=2))
        for name, pieces in rad.encode_chunked(scene, options, "parts-lod", threads=2):
            (folder / name).write_bytes(b"".join(pieces))
        with whole.open("rb") as file:
            return cls(written(folder, scene), whole, chunked, read_header(file))

    def check_ranges(self, requests: Sequence[Request]) -> set[int]:
        """Assert that Spark requested the beginning and whole chunks, each once, and return the chunks."""
        first, *rest = requests
        assert first == Request("tree.rad", min(HEAD_BYTES, self.whole.stat().st_size), 0)
        starts = {self.header.bytes + entry.offset: number for number, entry in enumerate(self.header.chunks)}
        numbers = [starts[request.start] for request in rest if request.start is not None]
        assert len(numbers) == len(rest) == len(set(numbers))
        sizes = [self.header.chunks[number].bytes for number in numbers]
        assert [(request.name, request.bytes) for request in rest] == [("tree.rad", size) for size in sizes]
        return set(numbers)

    def check_chunk_files(self, requests: Sequence[Request]) -> set[int]:
        """Assert that Spark requested the header and chunk files, each once, and return the chunks."""
        first, *rest = requests
        assert first == Request("parts-lod.rad", self.chunked.stat().st_size, 0)
        numbers = [int(request.name.removeprefix("parts-lod-").removesuffix(".radc")) for request in rest]
        assert len(set(numbers)) == len(numbers)
        sizes = [self.header.chunks[number].bytes for number in numbers]
        assert rest == [Request(f"parts-lod-{n}.radc", size, None) for n, size in zip(numbers, sizes, strict=True)]
        return set(numbers)


def drawn(page: Page, file: Path, camera: Camera, budget: int, layout: str, pages: int = 0) -> Picture:
    page.open(file, camera, RasterSettings(), layout=layout, pages=pages)
    return page.draw(camera, RasterSettings(), budget=budget)


def check_paged(page: Page, files: Files, expected: Picture, camera: Camera, budget: int, layout: str) -> None:
    """Assert that both RAD files give a picture when they are paged, of their first two chunks."""
    assert (expected.rounded[..., 3] > 0.1).mean() > 0.05, "the view is nearly empty"
    pages = len(files.header.chunks)
    whole = drawn(page, files.whole, camera, budget, layout, pages)
    assert files.check_ranges(page.requests()) == {0, 1}
    assert psnr((whole.rounded - expected.rounded)[..., :3]) >= LEAST_PAGED
    assert whole.nodes is not None and whole.nodes.max() < 2 * CHUNK_NODES
    chunked = drawn(page, files.chunked, camera, budget, layout, pages)
    np.testing.assert_array_equal(chunked.rounded, whole.rounded)
    assert files.check_chunk_files(page.requests()) == {0, 1}


def test_a_view_of_a_part_fetches_some_chunks_and_shows_the_picture_of_the_spz(page: Page, tmp_path: Path) -> None:
    files = Files.of(read_scene(FIXTURES / "traverse/town.spz"), tmp_path)
    near = look_at((-4.8, -0.5, 0.3), (-3.8, 0, 0.5), (0, -1, 0))  # at the border of two chunks
    camera = Camera(near, *SIZE, (400, 400), (SIZE[0] / 2, SIZE[1] / 2))
    assert len(files.header.chunks) == 3
    check_paged(page, files, drawn(page, files.spz, camera, 2_000, "Ext"), camera, 2_000, "Ext")


def test_spherical_harmonics_of_degree_3_are_paged_as_packed_splats(page: Page, tmp_path: Path) -> None:
    """As ExtSplats Spark 2.2.0 cannot: its pager has no texture for the second array of degree 3.

    The picture is that of the same file loaded whole, as SPZ rounds SH too coarsely for this comparison. The file has
    the ranges of codes that pages always have in Spark, so that these do not round once more.
    """
    large, small = random_splats(56_000, sh_degree=3), random_splats(3_000, sh_degree=3, seed=1, extent=0.02)
    small = replace(small, center=small.center + np.float32([5, 0, 0]))  # in the second chunk
    scene, camera = Scene(*quick.build(Splats.concat([large, small]))), cameras_of(small)[2]
    files = Files.of(scene, tmp_path, SplatEncoding(lod_opacity=True))
    expected = drawn(page, files.whole, camera, 4_000, "Packed")
    check_paged(page, files, expected, camera, 4_000, "Packed")


# --- The pages of docs/spark.md ---------------------------------------------------------------------------------------

#: The camera of the page, in the axes of the file: y and z point the other way.
LOOK = ("--look-at", "0,-3,-9:0,-1,0", "--fov", "60", "--size", "240x136", "--background", "black")


@pytest.fixture(scope="module")
def spark_browser(page_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(page_dir, require("chromium"), tmp_path_factory.mktemp("pictures"))
    yield browser
    browser.close()


@pytest.mark.parametrize("streamed", [False, True])
def test_the_page_of_the_documentation_shows_the_picture_of_render(
    streamed: bool, spark_browser: Browser, tmp_path: Path
) -> None:
    """Spark keeps 16 bytes a splat, and rounds to 8 bits after every splat."""
    tree = tmp_path / (engines.RAD if streamed else engines.TREE)
    options = ["--format", "rad"] if streamed else []
    write(tmp_path / "scene.ply", Scene(read(FIXTURES / "demo.ply").splats.take(slice(0, None, 4))))
    assert run(["build-lod", str(tmp_path / "scene.ply"), *options, "-o", str(tree), "-q"]) == 0
    assert run(["render", str(tree), "--full", *LOOK, "-o", str(tmp_path / "ours.png"), "-q"]) == 0
    with Image.open(tmp_path / "ours.png") as image:
        ours: NDArray[np.float64] = np.asarray(image.convert("RGB"), np.float64) / 255
    theirs = spark_browser.still(engines.spark(streamed=streamed), tmp_path, SIZE)
    assert psnr(theirs - ours) >= 32
    assert max(psnr(wrong - ours) for wrong in (theirs[::-1], theirs[:, ::-1], theirs[::-1, ::-1])) < 20


def test_the_documentation_names_the_tested_versions() -> None:
    text = (ROOT / "docs" / "spark.md").read_text(encoding="utf-8")
    named = dict(re.findall(r"(\S+)@(\d+\.\d+\.\d+)", text.replace("`", " ")))
    assert named == {name: PAGE[name] for name in ("@sparkjsdev/spark", "three")}
