"""One law for every format, scene and SH degree: what is written comes back, off by no more than the codings state."""

from __future__ import annotations

import dataclasses
import functools
import io
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sparklod_cli.codecs import quantize, spz
from sparklod_cli.codecs.formats import FORMATS
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.rad import codec as rad
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import Precision, put
from tests.codecs.test_quantize import rotation_degrees
from tests.codecs.writers import WRITERS
from tests.conftest import FIXTURES
from tests.scenes import random_splats

SCENES = ("sh0", "sh1", "sh2", "sh3", "flat", "needle", "coincident", "huge", "one")


def star(count: int) -> LodTree:
    """The first node as the parent of all others."""
    child_count, child_start = np.zeros(count, np.uint16), np.zeros(count, np.uint32)
    if count > 1:
        child_count[0], child_start[0] = count - 1, 1
    return LodTree(child_count, child_start)


@functools.cache
def scene(name: str, *, lod: bool = False) -> Scene:
    """A fixture; as a tree it has splats of every opacity up to 1000, which is where the encoder stops."""
    splats = read_scene(FIXTURES / f"{name}.ply").splats
    if not lod:
        return Scene(splats)
    opacity = linear_opacity(np.linspace(4.4, 0.01, len(splats), dtype=np.float32))
    return Scene(dataclasses.replace(splats, opacity=opacity), star(len(splats)))


CASES = [pytest.param(form, way, id=f"{form}-{way}") for form, ways in WRITERS.items() for way in ways]


def test_every_format_has_a_writer() -> None:
    assert {form.name for form in FORMATS} == WRITERS.keys()


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(("form", "way"), CASES)
def test_a_scene_comes_back_within_the_precision_of_its_format(form: str, way: str, name: str, tmp_path: Path) -> None:
    case = WRITERS[form][way]
    source = scene(name, lod=case.lod)
    if np.abs(source.splats.center).max() > case.reach:
        with pytest.raises(FormatError, match="coordinates reach"):
            case.write(source)
        return
    back = read_scene(put(case.write(source), tmp_path, form))
    assert (back.format, back.antialiased, back.notes) == (case.format, False, ())
    held = case.held(source.splats)
    assert_close(back.splats, held, case.precision(Scene(held, source.tree)))
    assert (back.tree is None) == (source.tree is None)
    if back.tree and source.tree:
        np.testing.assert_array_equal(back.tree.child_count, source.tree.child_count)
        np.testing.assert_array_equal(back.tree.child_start, source.tree.child_start)


def assert_close(back: Splats, source: Splats, allowed: Precision) -> None:
    assert back.sh.shape == source.sh.shape
    slack = 1e-6  # float32
    assert (np.abs(back.center.astype(np.float64) - source.center) <= allowed.center).all()
    expected = np.clip(source.scale, *allowed.scale_range)
    assert (np.abs(np.log(back.scale / expected)) <= allowed.log_scale).all()
    assert rotation_degrees(back.quat_xyzw, source.quat_xyzw).max() <= allowed.degrees
    opacity = source.opacity
    if allowed.blur is not None:
        opacity = quantize.compensated(opacity, source.scale, back.scale, allowed.blur)
    off = np.abs(lod_opacity(back.opacity) - lod_opacity(opacity))
    assert (off <= np.where(opacity > 1, allowed.merged, allowed.opacity)).all()
    assert (np.abs(back.rgb - np.clip(source.rgb, *allowed.rgb_range)) <= allowed.rgb).all()
    sh = np.abs(back.sh - np.clip(source.sh, *allowed.sh_range))
    assert sh[:, :3].max(initial=0) <= allowed.sh[0] * (1 + slack)
    assert sh[:, 3:].max(initial=0) <= allowed.sh[1] * (1 + slack)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("lod", [False, True])
def test_writing_a_decoded_scene_again_changes_nothing(name: str, version: int, lod: bool) -> None:
    """SPZ of SPZ: whatever was rounded once stays where it is (rotations beyond half a turn excepted)."""
    options = spz.settled(scene(name), WriteOptions(spz_version=version))
    once = decode_file(spz, io.BytesIO(b"".join(spz.encode(scene(name, lod=lod), options))))
    twice = decode_file(spz, io.BytesIO(b"".join(spz.encode(once, options))))
    for column in COLUMNS:
        if column != "quat_xyzw":
            np.testing.assert_array_equal(getattr(twice.splats, column), getattr(once.splats, column), column)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("codec", [spz, rad])
def test_whether_a_scene_is_antialiased_is_kept(codec: ModuleType, antialiased: bool) -> None:
    data = b"".join(codec.encode(Scene(scene("sh0").splats, antialiased=antialiased)))
    assert decode_file(codec, io.BytesIO(data)).antialiased is antialiased


@pytest.mark.parametrize(("form", "way"), CASES)
@pytest.mark.slow
def test_threads_do_not_change_what_is_read(form: str, way: str, tmp_path: Path) -> None:
    case = WRITERS[form][way]
    splats = random_splats(17_000, sh_degree=1)  # more than one chunk of rows
    source = Scene(splats, star(len(splats)) if case.lod else None)
    path = put(case.write(source), tmp_path, form)
    expected = read_scene(path).splats
    assert_close(expected, case.held(splats), case.precision(Scene(case.held(splats), source.tree)))
    actual = read_scene(path, threads=5).splats
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(actual, column), getattr(expected, column), column)
