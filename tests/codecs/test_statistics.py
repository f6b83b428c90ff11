"""Statistics of pieces, merged, are those of the whole: a file that comes in pieces is settled as one in memory."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import numpy as np
import pytest

from sparklod_cli.codecs import spz, statistics
from sparklod_cli.codecs.options import DEFAULTS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import codec as rad
from sparklod_cli.codecs.statistics import ALL, Statistics
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.support.errors import FormatError
from tests.scenes import random_splats


def tree_of(count: int, sh_degree: int) -> Scene:
    """A root over many leaves, with values in which clamping and rounding are not simple."""
    rng = np.random.default_rng(count + sh_degree)
    splats = random_splats(count, sh_degree=sh_degree, seed=count)
    splats.scale[:] *= np.exp(rng.normal(0, 2, size=(count, 1)))
    splats.rgb[rng.random(count) < 0.01] *= -3
    splats.sh[rng.random(count) < 0.02] *= 9
    children, start = np.zeros(count, np.uint16), np.zeros(count, np.uint32)
    children[0], start[0] = count - 1, 1
    return Scene(splats, LodTree(children, start))


def pieces_of(scene: Scene, cuts: list[int], needed: frozenset[str] = ALL) -> list[Statistics]:
    """Statistics of the pieces between these places."""
    leaf = None if scene.tree is None else scene.tree.is_leaf
    found = []
    for start, stop in zip([0, *cuts], [*cuts, len(scene)], strict=True):
        part = scene.splats.take(slice(start, stop))
        found.append(Statistics.of(part, None if leaf is None else leaf[start:stop], needed))
    return found


@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("codec", [spz, rad])
def test_pieces_in_any_order_settle_as_the_whole(codec, sh_degree: int) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(sh_degree)
    for scene in (tree_of(2_000, sh_degree), Scene(random_splats(700, sh_degree=sh_degree))):
        cuts = sorted(rng.integers(0, len(scene), size=5).tolist())
        parts = pieces_of(scene, [0, *cuts], codec.needed(DEFAULTS))
        rng.shuffle(parts)  # type: ignore[arg-type]
        found = Statistics.merged([Statistics.merged(parts[:3]), *parts[3:]])
        assert codec.settled(found, DEFAULTS) == codec.settled(scene, DEFAULTS)


@pytest.mark.parametrize("codec", [spz, rad])
def test_a_tree_whose_leaves_were_counted_settles_as_the_whole(
    codec: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(statistics, "_BLOCK", 64)
    scene, needed = tree_of(2_000, 3), codec.needed(DEFAULTS)
    splats = scene.splats
    center, scale = splats.center.copy(), splats.scale.copy()
    center[0], scale[0] = 3_000, 80  # the root
    scene = dataclasses.replace(scene, splats=dataclasses.replace(splats, center=center, scale=scale))
    assert scene.tree is not None
    leaves = Statistics.of_leaves(scene.splats.take(scene.tree.is_leaf), needed, threads=2)
    found = Statistics.of_tree(scene, leaves, needed, threads=2)
    assert (found.count, found.tree) == (len(scene), True)
    settled = codec.settled(found, DEFAULTS)
    assert settled == codec.settled(Statistics.of(scene.splats, scene.tree.is_leaf, needed), DEFAULTS)
    assert settled != codec.settled(leaves, DEFAULTS)


def test_an_array_holds_all_of_them() -> None:
    scene = tree_of(900, 2)
    found = Statistics.of_scene(scene)
    assert set(found.magnitudes) == {"rgb", "scale", "sh1", "sh2"}
    array = found.array()
    assert array.dtype == np.uint8 and array.ndim == 1 and len(array) < 20_000
    back = Statistics.from_array(array)
    for name, value in vars(found).items():
        if name not in ("leaf_scale", "leaf_length", "leaf_sh", "magnitudes"):
            assert getattr(back, name) == value
    for one, other in [
        (found.leaf_scale, back.leaf_scale),
        (found.leaf_sh, back.leaf_sh),
        (found.leaf_length, back.leaf_length),
        *((found.magnitudes[name], back.magnitudes[name]) for name in found.magnitudes),
    ]:
        for key, value in vars(one).items():
            np.testing.assert_array_equal(getattr(other, key), value)
    few = Statistics.from_array(Statistics.of_scene(scene, {"reach"}).array())
    assert few.leaf_scale is None and few.leaf_sh is None
    assert few.reach == float(np.abs(scene.splats.center).max()) and not few.magnitudes


def test_only_what_is_needed_is_counted() -> None:
    settled = WriteOptions(fractional_bits=3, sh_bits=5)
    assert spz.needed(DEFAULTS) == {"reach", "leaf_scale", "leaf_sh"} and spz.needed(settled) == {"reach"}
    assert rad.needed(DEFAULTS) == {"rgb", "scale", "sh", "leaf_scale", "leaf_length"}
    assert rad.needed(WriteOptions(rad=RadOptions(center="f32"))) == {"rgb", "scale", "sh", "leaf_length"}
    scene = Scene(random_splats(50, sh_degree=1))
    assert rad.needed(rad.settled(scene, DEFAULTS)) == frozenset()


def test_statistics_refuse_what_the_scene_refuses() -> None:
    far = random_splats(5)
    far.center[2, 1] = -1e7
    with pytest.raises(FormatError, match=r"coordinates reach 1e\+07"):
        spz.settled(Statistics.merged(pieces_of(Scene(far), [2, 4], spz.needed(DEFAULTS))), DEFAULTS)
    many = Statistics(1 << 32, 0, True)
    options = rad.settled(Scene(random_splats(1)), DEFAULTS)
    with pytest.raises(FormatError, match="4,294,967,296 splats; RAD numbers at most 4,294,967,295"):
        rad.settled(many, options)


def test_pieces_of_different_scenes_are_refused() -> None:
    parts = [Statistics.of(random_splats(3, sh_degree=degree)) for degree in (0, 1)]
    with pytest.raises(ValueError, match="cannot be merged"):
        Statistics.merged(parts)
