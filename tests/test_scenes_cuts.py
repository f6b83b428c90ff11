"""What is read and what of it is drawn: trees and plain files, in full and in cuts, through encodings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.framing import COVERED, covered, fitted
from sparklod_cli.codecs import ext_splats, packed_splats, ply
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.images.metrics import psnr
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.gaussian import moved
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.scene import Scene
from sparklod_cli.render.color_scales import values_of
from sparklod_cli.render.render_settings import RenderSettings
from sparklod_cli.render.renderer import Renderer
from sparklod_cli.system.errors import FormatError, InvalidSplatsError
from sparklod_cli.viewers.scenes import CutFinder, Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings
from tests.conftest import FIXTURES
from tests.render.drawables import camera
from tests.scenes import random_splats

TOWN, TREE = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
PLAIN = FIXTURES / "sh1.ply"


def at(*files: Path) -> list[Instance]:
    return [Instance(file, f"{number}") for number, file in enumerate(files)]


def seen(scenes: Scenes, size: tuple[int, int] = (160, 120)) -> Camera:
    return fitted(camera(*size), covered(scenes.balls()))


def test_a_cut_is_that_of_the_traversal() -> None:
    settings = LodSettings(3000)
    scenes = read_scenes(at(TOWN, PLAIN, TREE))
    view = seen(scenes)
    cut = CutFinder(scenes, settings).cut(view)
    town, plain, tree = cut.parts
    traversal = read_scenes(at(TOWN, TREE), trees_only=True).viewer(settings)
    limit = settings.limit(view.fov_y, view.height)
    found = traversal.cut(view, budget=3000, smallest=limit)
    expected = found.indices()
    assert (cut.reason, cut.pixel_scale) == (found.reason, found.least)
    assert len(cut) == len(found) + len(plain.index) == len(cut.splats)
    assert np.array_equal(town.index, expected[0])
    assert np.array_equal(tree.index, expected[1])
    assert len(plain.index) == len(scenes.loaded[1].splats)
    assert np.array_equal(town.splats.center, scenes.loaded[0].splats.center[town.index])
    assert len(town.index) + len(tree.index) <= 3000


@pytest.mark.parametrize("by", ["level", "chunk"])
@pytest.mark.parametrize("budget", [50, 3000, 50_000])
def test_colours_of_whole_numbers_span_what_the_cuts_have(by: str, budget: int) -> None:
    finder = CutFinder(read_scenes(at(TOWN, TREE)), LodSettings(budget))
    views = [camera(160, 120, z) for z in (3.0, 20.0)]
    scale = Renderer(finder, RenderSettings(color_by=by), views).scale
    assert scale is not None
    parts = [part for view in views for part in finder.cut(view).parts]
    values = np.concatenate([values_of(by, part) for part in parts])
    assert (scale.low, scale.high) == (values.min(), values.max())
    texts = [text for _, text in scale.marks]
    assert (texts[0], texts[-1]) == (f"{scale.low}", f"{scale.high}")


def test_full_detail_is_the_leaves() -> None:
    scenes = read_scenes(at(TOWN, PLAIN))
    town, plain = CutFinder(scenes, None).cut(seen(scenes)).parts
    loaded = scenes.loaded[0]
    assert loaded.depth is not None
    assert np.array_equal(town.index, loaded.leaves)
    assert len(scenes.balls().center) == len(town.index) + len(plain.index)
    assert plain.scene.first_chunk == loaded.chunks


def test_a_file_stands_in_several_places() -> None:
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    matrix[:3, 3] = 7, 0, 0
    scenes = read_scenes([Instance(TREE, "here"), Instance(TREE, "there", matrix)])
    here, there = scenes.full().parts
    assert here.scene is there.scene
    assert here.splats is there.splats
    centers = scenes.balls().center
    assert np.allclose(centers[len(here.index) :], moved(here.splats.center, matrix), rtol=1e-6)
    assert np.allclose(scenes.full().splats.center, centers, rtol=1e-6)


def test_a_scene_in_memory_is_that_of_its_file() -> None:
    scene = read_scene(TREE)
    held, read = (read_scenes([Instance(source, "tree")]) for source in (scene, TREE))
    view = seen(read)
    cuts = [CutFinder(scenes, LodSettings(20)).cut(view) for scenes in (held, read)]
    assert np.array_equal(cuts[0].nodes[0], cuts[1].nodes[0])
    assert np.array_equal(cuts[0].splats.center, cuts[1].splats.center)
    assert len(read_scenes([Instance(scene, "a"), Instance(scene, "b")]).loaded) == 1


def test_continuous_cuts_fade_what_the_weights_say() -> None:
    scenes = read_scenes(at(TOWN))
    view = seen(scenes)
    cut = CutFinder(scenes, LodSettings(3000, continuous=1.25)).cut(view)
    (part,) = cut.parts
    assert part.weight is not None
    whole = part.weight == 1
    assert 0 < whole.sum() < len(whole)
    opacity = scenes.loaded[0].splats.opacity[part.index]
    assert np.array_equal(part.splats.opacity[whole], opacity[whole])
    assert (part.splats.opacity[~whole] < opacity[~whole]).all()
    assert part.weight.sum() == pytest.approx(3000, rel=1e-3)


def test_a_twin_with_another_budget_leaves_the_first_alone() -> None:
    scenes = read_scenes(at(TOWN))
    view, finder = seen(scenes), CutFinder(scenes, LodSettings(2000))
    assert len(finder.with_budget(500).cut(view)) <= 500 < len(finder.cut(view)) <= 2000


def test_through_an_encoding_splats_are_rounded_and_the_cut_stays() -> None:
    scenes = {through: read_scenes(at(TOWN), through=through) for through in (None, "packed", "ext", "spz")}
    finders = {through: CutFinder(each, LodSettings(2000)) for through, each in scenes.items()}
    view = seen(scenes[None])
    cuts = [finder.cut(view).nodes[0] for finder in finders.values()]
    assert all(np.array_equal(cut, cuts[0]) for cut in cuts)
    original = scenes[None].loaded[0].splats
    encoding = SplatEncoding(lod_opacity=True)
    expected = packed_splats.unpack(packed_splats.pack(original, encoding), encoding)
    assert np.array_equal(scenes["packed"].loaded[0].splats.scale, expected.scale)
    assert expected.opacity.max() > 1
    expected = ext_splats.unpack(ext_splats.pack(original))
    assert np.array_equal(scenes["ext"].loaded[0].splats.quat_xyzw, expected.quat_xyzw)
    # The file is an SPZ already, with other fractional bits.
    rounded = scenes["spz"].loaded[0].splats
    assert np.allclose(rounded.center, original.center, atol=2**-9)
    assert np.array_equal(rounded.scale, original.scale)
    images = {
        through: Renderer(finder, RenderSettings(), [view]).draw(view).image for through, finder in finders.items()
    }
    qualities = {through: psnr(images[None][..., :3], image[..., :3]) for through, image in images.items()}
    assert qualities[None] > qualities["spz"] > 30
    assert 30 < qualities["packed"] < qualities["ext"]


def test_an_encoding_says_what_spz_cannot_hold(tmp_path: Path) -> None:
    splats = random_splats(30)
    splats.center[3] = 1e9
    (tmp_path / "far.ply").write_bytes(b"".join(ply.encode(Scene(splats))))
    with pytest.raises(FormatError, match=r"far.ply: coordinates reach"):
        read_scenes(at(tmp_path / "far.ply"), through="spz")


def test_splats_that_cannot_be_drawn_are_left_out() -> None:
    file = FIXTURES / "faults" / "nan.ply"
    scenes = read_scenes(at(file))
    assert scenes.loaded[0].splats.is_valid().all()
    assert any(note.startswith(f"{file}: left out ") and "not finite" in note for note in scenes.notes)
    with pytest.raises(InvalidSplatsError, match=r"no-splats.ply: it has no splats"):
        read_scenes(at(FIXTURES / "faults" / "no-splats.ply"))


@pytest.mark.parametrize("size", [(160, 90), (90, 160)])
@pytest.mark.parametrize("file", [TOWN, PLAIN, FIXTURES / "demo.ply"], ids=lambda path: path.name)
def test_a_fitted_camera_sees_the_scene(file: Path, size: tuple[int, int]) -> None:
    """All of it that is dense, and nearly all that there is: of the demo all but its stars."""
    scenes = read_scenes(at(file))
    view = fitted(camera(*size), covered(scenes.balls()))
    center = covered(scenes.balls()).center
    local = (center - view.position) @ view.camera_to_world[:3, :3]
    places = np.abs(local[:, :2] / -local[:, 2:]) * view.focal / (np.array(size) / 2)
    inside = (places <= 1).all(axis=1) & (local[:, 2] < 0)
    assert inside.all()
    assert places[inside].max() > 0.7  # and it fills that
    assert len(center) >= 0.9 * COVERED * len(scenes.balls().center)
