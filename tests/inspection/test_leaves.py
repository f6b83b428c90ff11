"""`inspect --leaves-of`: the leaves of every baked tree are the splats of its scene, and no longer after any change."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.cli import run
from sparklod_cli.codecs import ply, spz
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.inspection import leaves
from sparklod_cli.inspection.findings import Finding
from sparklod_cli.inspection.leaves import check
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from tests.conftest import FIXTURES, Capture, real_scene
from tests.scenes import random_splats


def bake(source: Path, folder: Path, *options: object) -> Path:
    output = folder / "out.spz"
    assert run(["build-lod", str(source), "-o", str(output), "-q", "--overwrite", *map(str, options)]) == 0
    return output


def baked(source: Path, folder: Path, *options: object) -> Scene:
    return read_scene(bake(source, folder, *options), validate=False)


def findings_of_tree(path: Path, original: Scene) -> list[str]:
    """Codes of the findings of `inspect --check --leaves-of`."""
    report, scene = inspect(path, ReportSettings(check=True, at_once=True))
    assert scene is not None
    return [finding.code for finding in [*(report.findings or []), *check(scene, original)]]


SOURCES = [f"sh{degree}.ply" for degree in range(4)]

SOURCES += ["flat.ply", "needle.ply", "coincident.ply", "huge.ply", "one.ply", "demo.ply"]

SOURCES += ["golden/sh3-v2.spz", "golden/sh3-v3.spz", "golden/hand-v1.spz", "golden/hand-v2.spz", "golden/hand-v4.spz"]

SOURCES += ["golden/sh1-sog", "golden/sh3-v2.sog", "golden/sh2-v1.sog", "golden/sh3-compressed.ply"]

SOURCES += ["golden/sh2-level0.ksplat", "golden/sh2-level2.ksplat", "golden/sh0.splat"]


#: Findings about trees of scenes that SPZ hardly holds.
ODD = {"huge.ply": ["values.scale-clamped", "values.center-far"]}


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("source", SOURCES)
def test_a_baked_tree_has_the_splats_as_its_leaves_and_no_findings(source: str, version: int, tmp_path: Path) -> None:
    original = read_scene(FIXTURES / source)
    for base in (1.1, 1.5, 2.0):
        path = bake(FIXTURES / source, tmp_path, "--base", base, "--spz-version", version)
        assert findings_of_tree(path, original) == ODD.get(source, [])


@pytest.mark.parametrize("source", ["biker.ply", "biker.spz", "playbot-125k.ply", "meadow.sog"])
@pytest.mark.slow
def test_trees_of_real_scenes_have_the_splats_as_their_leaves_and_no_findings(source: str, tmp_path: Path) -> None:
    path = real_scene(source)
    for base in (1.1, 2.0):
        assert findings_of_tree(bake(path, tmp_path, "--base", base), read_scene(path)) == []


@pytest.mark.slow
def test_leaves_of_a_file_that_spark_wrote_are_the_splats_of_its_scene(capsys: Capture) -> None:
    tree, original = real_scene("rad/playbot-125k-spark/p-lod.rad"), real_scene("playbot-125k.ply")
    assert run(["inspect", str(tree), "--leaves-of", str(original)]) == 0
    capsys.readouterr()


RAD_OPTIONS = [
    "",
    "--rad-center f16 --rad-alpha f16 --rad-rgb f16 --rad-scales ln_f16 --rad-orientation f16 --rad-sh f16",
    "--rad-center f32 --rad-alpha f32 --rad-rgb f32 --rad-scales f32 --rad-orientation f32 --rad-sh f32",
    "--rad-center f16_lebytes --rad-alpha r8 --rad-rgb r8_delta --rad-sh s8_delta",
    "--cluster-sh 8",
    "--format rad-chunked",
]


@pytest.mark.parametrize("options", RAD_OPTIONS)
@pytest.mark.parametrize("name", ["sh3.ply", "needle.ply"])
def test_rad_files_that_we_write_have_no_findings_and_the_leaves_of_their_scenes(
    name: str, options: str, tmp_path: Path, capsys: Capture
) -> None:
    source, path = str(FIXTURES / name), str(tmp_path / "a.rad")
    assert run(["build-lod", source, "-o", path, "-q", *options.split()]) == 0
    assert run(["inspect", path, "--check", "--leaves-of", source, "--fail-on", "warning"]) == 0
    assert run(["inspect", path, "--leaves-of", str(FIXTURES / "sh2.ply")]) == 3
    assert capsys.readouterr().out.count("expect.leaves") == 1


def one_place() -> Splats:
    splats = random_splats(300, sh_degree=2)
    splats.center[:] = [3, 2, 1]
    return splats


def tiny() -> Splats:
    splats = random_splats(300, extent=3e-7)
    splats.scale[:] = 1.5e-8
    return splats


def two_sizes() -> Splats:
    splats = random_splats(600, extent=5e5)
    splats.scale[:300], splats.scale[300:] = 8e-7, 8e3
    splats.center[:100] *= 1e-9
    return splats


@pytest.mark.parametrize("scene", [one_place, tiny, two_sizes])
@pytest.mark.parametrize("options", [[], ["--rad-center", "f32"]])
def test_leaves_of_rad_are_the_splats_however_centres_were_rounded(
    scene: Callable[[], Splats], options: list[str], tmp_path: Path
) -> None:
    source, tree = tmp_path / "scene.ply", tmp_path / "tree.rad"
    source.write_bytes(b"".join(ply.encode(Scene(scene()))))
    assert run(["build-lod", str(source), "-o", str(tree), "-q", *options]) == 0
    assert run(["inspect", str(tree), "--leaves-of", str(source)]) == 0
    changed = scene()
    changed.center[7] += 30 * changed.scale[7].max()
    source.write_bytes(b"".join(ply.encode(Scene(changed))))
    assert run(["inspect", str(tree), "--leaves-of", str(source)]) == 3


@pytest.mark.parametrize("bits", [0, 4, 9])
def test_splats_that_coarse_positions_merge_are_no_finding(bits: int, tmp_path: Path) -> None:
    path = real_scene("biker.ply")
    assert check(baked(path, tmp_path, "--fractional-bits", bits), read_scene(path)) == []


def test_splats_that_cannot_be_drawn_are_not_expected() -> None:
    splats = random_splats(50, sh_degree=1)
    splats.opacity[3] = 0
    splats.scale[8] = 0
    splats.center[20, 1] = np.nan
    good = np.setdiff1d(np.arange(50), [3, 8, 20])
    assert check(tree_of(splats.take(good)), Scene(splats)) == []


def test_a_lower_sh_degree_is_no_finding(tmp_path: Path) -> None:
    original = read_scene(FIXTURES / "sh3.ply")
    for degree in (0, 1, 2):
        assert check(baked(FIXTURES / "sh3.ply", tmp_path, "--max-sh", degree), original) == []


def tree_of(splats: Splats, **options: int) -> Scene:
    """The tree of splats as it is read back."""
    nodes, tree = quick.build(splats)
    return coded(Scene(nodes, tree), **options)


def coded(scene: Scene, **options: int) -> Scene:
    return decode_file(spz, BytesIO(b"".join(spz.encode(scene, WriteOptions(**options)))))


@given(st.integers(1, 60), st.integers(0, 24), st.integers(0, 3), st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_any_coding_has_the_same_leaves(count: int, bits: int, degree: int, seed: int) -> None:
    splats = random_splats(count, sh_degree=degree, seed=seed, extent=0.02)
    bits = min(bits, spz.largest_fractional_bits(float(np.abs(splats.center).max())))
    for version in (2, 3):
        assert check(tree_of(splats, spz_version=version, fractional_bits=bits), Scene(splats)) == []


@pytest.mark.parametrize("column", ["quat_xyzw", "sh", "rgb", "scale", "opacity"])
def test_the_order_of_splats_that_differ_in_one_column_does_not_matter(column: str) -> None:
    splats = random_splats(12, sh_degree=2, seed=4)
    same = splats.take(np.zeros(12, np.int64))
    splats = dataclasses.replace(same, **{column: getattr(splats, column)})
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(12)
        root = LodTree(np.array([12] + [0] * 12, np.uint16), np.array([1] + [0] * 12, np.uint32))
        scene = coded(Scene(splats.take(np.concatenate([[0], order])), root))
        assert check(scene, Scene(splats)) == []


def changed_leaf(change: Callable[[Splats, int, Scene], None], degree: int = 1) -> tuple[int, list[Finding]]:
    """Change a leaf of a baked tree; return its node and the findings."""
    splats = random_splats(300, sh_degree=degree, seed=9)
    scene = tree_of(splats)
    assert scene.tree is not None
    node = int(np.flatnonzero(scene.tree.is_leaf)[123])
    changed = Splats(**{name: column.copy() for name, column in vars(scene.splats).items()})
    change(changed, node, scene)
    return node, check(dataclasses.replace(scene, splats=changed), Scene(splats))


def moved(steps: int) -> Callable[[Splats, int, Scene], None]:
    def change(splats: Splats, node: int, scene: Scene) -> None:
        splats.center[node, 1] += steps * 2.0 ** -scene.header["fractional_bits"]

    return change


def set_to(column: str, change: Callable[[np.ndarray], object]) -> Callable[[Splats, int, Scene], None]:
    def apply(splats: Splats, node: int, scene: Scene) -> None:
        values = getattr(splats, column)
        values[node] = change(values[node])

    return apply


CHANGES = {
    "moved": moved(3),
    "moved the other way": moved(-3),
    "recoloured": set_to("rgb", lambda rgb: rgb + np.float32([0.05, 0, 0])),
    "larger": set_to("scale", lambda scale: scale * np.float32(1.2)),
    "fainter": set_to("opacity", lambda opacity: opacity - 0.03),
    "turned": set_to("quat_xyzw", lambda quat: np.roll(quat, 1)),
    "shining": set_to("sh", lambda sh: -sh[::-1]),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_leaf_that_is_changed_is_found(name: str) -> None:
    node, findings = changed_leaf(CHANGES[name])
    assert [(found.code, found.index, found.count) for found in findings] == [("expect.leaves", node, 1)]
    assert f"{node:,}" in findings[0].message


def rad_with_one_leaf_changed(column: str, change: Callable[[np.ndarray], np.ndarray]) -> list[str]:
    """Messages on the golden RAD file, compared with its own scene after a change to its last leaf."""
    path = FIXTURES / "golden" / "sh1-tree.rad"
    original = read_scene(path)
    assert original.tree is not None
    values = getattr(original.splats, column).copy()
    leaf = np.flatnonzero(original.tree.is_leaf)[-1]
    values[leaf] = change(values[leaf])
    original = dataclasses.replace(original, splats=dataclasses.replace(original.splats, **{column: values}))
    facts = inspect(path, ReportSettings(headers_only=True))[0].rad
    return [finding.message for finding in check(read_scene(path, validate=False), original, facts)]


@pytest.mark.parametrize(
    ("column", "change"),
    [
        ("quat_xyzw", lambda quat: np.float32([0.6, 0, 0, 0.8])),
        ("opacity", lambda opacity: 0.5 * opacity + 0.3),
        *((name, lambda values: values[..., ::-1].copy() * 0.5) for name in ("center", "scale", "rgb", "sh")),
    ],
)
def test_a_leaf_of_rad_that_is_changed_is_found(column: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    (message,) = rad_with_one_leaf_changed(column, change)
    assert "1 leaves are not splats of the original" in message
    assert rad_with_one_leaf_changed(column, lambda values: values) == []


def test_leaves_in_several_encodings_cannot_be_compared() -> None:
    path = FIXTURES / "golden" / "sh1-tree.rad"
    facts = inspect(path, ReportSettings(headers_only=True))[0].rad
    assert facts is not None
    mixed = dataclasses.replace(facts.properties["center"], encoding="f16, f32")
    facts = dataclasses.replace(facts, properties=facts.properties | {"center": mixed})
    (finding,) = check(read_scene(path, validate=False), read_scene(path), facts)
    assert "center in several encodings" in finding.message


def test_a_difference_of_one_step_is_no_finding() -> None:
    assert changed_leaf(moved(1))[1] == []
    assert changed_leaf(set_to("rgb", lambda rgb: rgb + np.float32(0.007)))[1] == []


def test_a_difference_of_one_step_in_many_leaves_is_no_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another writer may round all colours down."""
    monkeypatch.setattr(leaves, "MAX_SEARCHED", 50, raising=False)
    splats = random_splats(300, sh_degree=1)
    scene = tree_of(splats)
    brighter = dataclasses.replace(scene.splats, rgb=scene.splats.rgb + np.float32(0.007))
    assert check(dataclasses.replace(scene, splats=brighter), Scene(splats)) == []


def test_a_leaf_that_takes_the_place_of_another_is_found() -> None:
    copied = []

    def change(splats: Splats, node: int, scene: Scene) -> None:
        assert scene.tree is not None
        other = int(np.flatnonzero(scene.tree.is_leaf)[200])
        copied.append(other)
        for column in vars(splats).values():
            column[node] = column[other]

    node, (found,) = changed_leaf(change)
    assert found.count == 1
    assert found.index in (node, *copied)


def test_a_leaf_too_few_or_too_many_is_found() -> None:
    splats = random_splats(100, seed=2)
    for kept, original in ((99, 100), (100, 99)):
        (found,) = check(tree_of(splats.take(slice(kept))), Scene(splats.take(slice(original))))
        assert found.code == "expect.leaves"
        assert f"{kept} leaves" in found.message
        assert f"{original} splats" in found.message


def test_other_findings_about_leaves() -> None:
    detailed, invisible = random_splats(100, sh_degree=2), random_splats(3)
    invisible.opacity[:] = 0
    for scene, original, message in (
        (tree_of(detailed), Scene(detailed.with_max_sh(1)), "SH degree 2, but the original has 1"),
        (Scene(detailed, format="PLY"), Scene(detailed), "the file has no tree whose leaves could be compared"),
        (tree_of(random_splats(5)), Scene(invisible), "the original: no splat is left of 3 (3 zero opacity)"),
    ):
        (finding,) = check(scene, original)
        assert (finding.code, finding.message) == ("expect.leaves", message)


def test_an_original_that_is_a_tree_has_leaves_of_its_own() -> None:
    splats = random_splats(100)
    scene = tree_of(splats)
    assert check(scene, scene) == []
    assert check(scene, tree_of(splats, spz_version=3, fractional_bits=20)) == []
    assert check(tree_of(splats.take(slice(99))), scene) != []
