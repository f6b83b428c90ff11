"""What is read and what of it is drawn: trees and plain files, in full and in cuts, through encodings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.framing import COVERED, covered, fitted
from sparklod_cli.codecs import ply
from sparklod_cli.codecs.gpu import ext_splats, packed_splats
from sparklod_cli.images.metrics import psnr
from sparklod_cli.model.gaussian import moved
from sparklod_cli.model.scene import Scene
from sparklod_cli.render.color_by import values_of
from sparklod_cli.render.renderer import Renderer, RenderSettings
from sparklod_cli.scenery import Scenery, read_scenery
from sparklod_cli.simulation.frames import LodSettings, Simulation
from sparklod_cli.support.errors import FormatError, InvalidSplatsError
from sparklod_cli.world import Placement, read_world
from tests.conftest import FIXTURES
from tests.render.sceneries import camera
from tests.scenes import random_splats

TOWN, TREE = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
PLAIN = FIXTURES / "sh1.ply"


def at(*files: Path) -> list[Placement]:
    return [Placement(file, f"{number}") for number, file in enumerate(files)]


def seen(scenery: Scenery, size: tuple[int, int] = (160, 120)) -> Camera:
    return fitted(camera(*size), covered(scenery.balls()))


def test_a_cut_is_that_of_the_simulation() -> None:
    viewer = LodSettings(3000)
    scenery = read_scenery(at(TOWN, PLAIN, TREE), viewer)
    world = read_world(at(TOWN, TREE))
    view = seen(scenery)
    town, plain, tree = scenery.pieces(view)
    expected = Simulation(world, viewer).cut(view).indices()
    assert np.array_equal(town.index, expected[0])
    assert np.array_equal(tree.index, expected[1])
    assert len(plain.index) == len(scenery.sources[1].splats)
    assert np.array_equal(town.splats.center, scenery.sources[0].splats.center[town.index])
    assert len(town.index) + len(tree.index) <= 3000


@pytest.mark.parametrize("by", ["level", "chunk"])
@pytest.mark.parametrize("budget", [50, 3000, 50_000])
def test_colours_of_whole_numbers_span_what_the_cuts_have(by: str, budget: int) -> None:
    scenery = read_scenery(at(TOWN, TREE), LodSettings(budget))
    views = [camera(160, 120, z) for z in (3.0, 20.0)]
    scale = Renderer(scenery, RenderSettings(color_by=by), views).scale
    assert scale is not None
    pieces = [piece for view in views for piece in scenery.pieces(view)]
    values = np.concatenate([values_of(by, piece) for piece in pieces])
    assert (scale.low, scale.high) == (values.min(), values.max())
    texts = [text for _, text in scale.bar.marks]
    assert (texts[0], texts[-1]) == (f"{scale.low}", f"{scale.high}")
    for view in views:
        told = scenery.drawn(view)
        assert all(
            np.array_equal(index, piece.index) for (_, index), piece in zip(told, scenery.pieces(view), strict=True)
        )


def test_in_full_it_is_the_leaves() -> None:
    scenery = read_scenery(at(TOWN, PLAIN), None)
    town, plain = scenery.pieces(seen(scenery))
    source = scenery.sources[0]
    assert source.level is not None
    assert np.array_equal(town.index, source.leaves)
    assert len(scenery.balls().center) == len(town.index) + len(plain.index)
    assert plain.source.first_chunk == source.chunks


def test_a_file_stands_in_several_places() -> None:
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    matrix[:3, 3] = 7, 0, 0
    places = [Placement(TREE, "here"), Placement(TREE, "there", matrix)]
    scenery = read_scenery(places, None)
    here, there = scenery.pieces(camera())
    assert here.source is there.source
    assert here.splats is there.splats
    centers = scenery.balls().center
    assert np.allclose(centers[len(here.index) :], moved(here.splats.center, matrix), rtol=1e-6)


def test_through_an_encoding_splats_are_rounded_and_the_cut_stays() -> None:
    viewer = LodSettings(2000)
    scenes = {through: read_scenery(at(TOWN), viewer, through=through) for through in (None, "packed", "ext", "spz")}
    view = seen(scenes[None])
    cuts = [scenery.pieces(view)[0].index for scenery in scenes.values()]
    assert all(np.array_equal(cut, cuts[0]) for cut in cuts)
    original = scenes[None].sources[0].splats
    encoding = packed_splats.Encoding(lod_opacity=True)
    expected = packed_splats.unpack(packed_splats.pack(original, encoding), encoding)
    assert np.array_equal(scenes["packed"].sources[0].splats.scale, expected.scale)
    assert expected.opacity.max() > 1
    expected = ext_splats.unpack(ext_splats.pack(original))
    assert np.array_equal(scenes["ext"].sources[0].splats.quat_xyzw, expected.quat_xyzw)
    # The file is an SPZ already, with other fractional bits.
    rounded = scenes["spz"].sources[0].splats
    assert np.allclose(rounded.center, original.center, atol=2**-9)
    assert np.array_equal(rounded.scale, original.scale)
    images = {
        through: Renderer(scenery, RenderSettings(), [view]).draw(view).image for through, scenery in scenes.items()
    }
    qualities = {through: psnr(images[None][..., :3], image[..., :3]) for through, image in images.items()}
    assert qualities[None] > qualities["spz"] > 30
    assert 30 < qualities["packed"] < qualities["ext"]


def test_what_spz_cannot_hold_is_said(tmp_path: Path) -> None:
    splats = random_splats(30)
    splats.center[3] = 1e9
    (tmp_path / "far.ply").write_bytes(b"".join(ply.encode(Scene(splats))))
    with pytest.raises(FormatError, match=r"far.ply: coordinates reach"):
        read_scenery(at(tmp_path / "far.ply"), None, through="spz")


def test_what_cannot_be_drawn_is_left_out() -> None:
    file = FIXTURES / "faults" / "nan.ply"
    scenery = read_scenery(at(file), None)
    assert scenery.sources[0].splats.is_valid().all()
    assert any(note.startswith(f"{file}: left out ") and "not finite" in note for note in scenery.notes)
    with pytest.raises(InvalidSplatsError, match=r"no-splats.ply: it has no splats"):
        read_scenery(at(FIXTURES / "faults" / "no-splats.ply"), None)


@pytest.mark.parametrize("size", [(160, 90), (90, 160)])
@pytest.mark.parametrize("file", [TOWN, PLAIN, FIXTURES / "demo.ply"], ids=lambda path: path.name)
def test_a_fitted_camera_has_the_scene_in_its_picture(file: Path, size: tuple[int, int]) -> None:
    scenery = read_scenery(at(file), None)
    view = fitted(camera(*size), covered(scenery.balls()))
    center = scenery.balls().center
    local = (center - view.position) @ view.camera_to_world[:3, :3]
    places = np.abs(local[:, :2] / -local[:, 2:]) * view.focal / (np.array(size) / 2)
    inside = (places <= 1).all(axis=1) & (local[:, 2] < 0)
    assert inside.mean() >= COVERED
    assert places[inside].max() > 0.7  # and it fills that
