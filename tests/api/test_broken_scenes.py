"""Invalid splats and broken trees: every public function refuses them by one error, in a process that survives."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import json
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.api.splat_files import Tree
from sparklod_cli.codecs.formats import ENCODINGS, MANIFEST, WRITABLE, RadOptions, WriteOptions
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import InvalidSplatsError, TreeError
from tests.commands.cli import Cli
from tests.conftest import ROOT
from tests.scenes import random_splats

CAMERA = sparklod.Camera.look_at((0.5, -1.0, 9.0), (0, 0, 0), size=(32, 24))

# --- Broken trees -----------------------------------------------------------------------------------------------------


def links_of(*families: tuple[int, int, int], nodes: int = 7) -> LodTree:
    """Links of nodes, from families: a node, its first child, its number of children."""
    count, start = np.zeros(nodes, np.uint16), np.zeros(nodes, np.uint32)
    for node, first, children in families:
        start[node], count[node] = first, children
    return LodTree(count, start)


VALID = ((0, 1, 2), (1, 3, 2), (2, 5, 2))

#: Kinds of broken links of seven nodes.
BROKEN: dict[str, Callable[[], LodTree]] = {
    "children out of range": lambda: links_of((0, 4_000_000_000, 2), *VALID[1:]),
    "children that overflow 32 bits": lambda: links_of((0, 2**32 - 1, 2), *VALID[1:]),
    "a child count past the end": lambda: links_of(*VALID[:2], (2, 5, 65_535)),
    "a node that is its own child": lambda: links_of((0, 0, 2), *VALID[1:]),
    "a circle": lambda: links_of((0, 1, 2), (1, 3, 2), (3, 1, 2), (2, 5, 2)),
    "a node with two parents": lambda: links_of(*VALID[:2], (2, 4, 2)),
    "an orphan": lambda: links_of(*VALID[:2], (2, 5, 1)),
    "children before their parent": lambda: links_of((0, 3, 2), (3, 1, 2), (4, 5, 2)),
    "fewer starts than counts": lambda: LodTree(np.zeros(7, np.uint16), np.zeros(5, np.uint32)),
    "fewer nodes than splats": lambda: links_of(*VALID[:2], nodes=5),
    "more nodes than splats": lambda: links_of(*VALID, (6, 7, 2), nodes=9),
    "no node": lambda: links_of(nodes=0),
}


def instances(*scenes: Scene) -> list[sparklod.Instance]:
    return [sparklod.Instance(scene) for scene in scenes]


#: Calls of every function with a tree as one of its scenes, a valid one as the others, and a path to write to.
CALLS: dict[str, Callable[[Scene, Scene, Path], Any]] = {
    "arrange_chunks": lambda tree, valid, path: sparklod.arrange_chunks(tree),
    "build_lod": lambda tree, valid, path: sparklod.build_lod(tree),
    "compare": lambda tree, valid, path: sparklod.compare(tree, None, [CAMERA], budgets=[3]),
    "compare scene": lambda tree, valid, path: sparklod.compare(valid, tree, [CAMERA], budgets=[3]),
    "compare both": lambda tree, valid, path: sparklod.compare(instances(valid, tree), None, [CAMERA], budgets=[3]),
    "cut": lambda tree, valid, path: sparklod.cut(tree, CAMERA),
    "cut both": lambda tree, valid, path: sparklod.cut(instances(valid, tree), CAMERA),
    "extract_leaves": lambda tree, valid, path: sparklod.extract_leaves(tree),
    "orbit": lambda tree, valid, path: sparklod.orbit(tree),
    "orbit both": lambda tree, valid, path: sparklod.orbit(instances(valid, tree)),
    "pack": lambda tree, valid, path: sparklod.pack(tree, "ext"),
    "refine": lambda tree, valid, path: sparklod.refine(tree, steps=2),
    "render": lambda tree, valid, path: sparklod.render(tree, CAMERA),
    "render both": lambda tree, valid, path: sparklod.render(instances(valid, tree), CAMERA),
    "simplify": lambda tree, valid, path: sparklod.simplify(tree, to=3),
    "traverse": lambda tree, valid, path: sparklod.traverse(tree, [CAMERA]),
    "traverse both": lambda tree, valid, path: sparklod.traverse(instances(valid, tree), [CAMERA]),
    "write": lambda tree, valid, path: sparklod.write(path, tree, overwrite=True),
    "write environment": lambda tree, valid, path: sparklod.write(path, valid, environment=tree, overwrite=True),
}

#: Calls that take plain scenes alone, and refuse any tree.
OF_PLAIN_SCENES = {"build_lod", "write environment"}


def scene_of(links: LodTree) -> Tree:
    return Tree(random_splats(7), links)


def report(folder: str) -> None:
    """Print the error of each call, a line of JSON each, with valid and with broken trees."""
    valid = scene_of(links_of(*VALID))
    for kind, make in {"valid": lambda: links_of(*VALID), **BROKEN}.items():
        tree = scene_of(make())
        repr(tree)
        for name, call in CALLS.items():
            try:
                call(tree, valid, Path(folder) / MANIFEST)
                end = "no error"
            except Exception as error:
                end = type(error).__name__
            print(json.dumps([kind, name, end]), flush=True)


def test_every_function_that_takes_a_scene_has_a_call() -> None:
    found = set()
    for name in sparklod.__all__:
        if inspect.isfunction(function := getattr(sparklod, name)):
            types = " ".join(str(each.annotation) for each in inspect.signature(function).parameters.values())
            found |= {name} if {"Scene", "Tree", "Viewed"}.intersection(types.replace("|", " ").split()) else set()
    assert found == {name.split()[0] for name in CALLS}


def test_broken_trees_are_refused_by_every_function(tmp_path: Path) -> None:
    code = "import sys; from tests.api.test_broken_scenes import report; report(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, (done.returncode, done.stdout[-300:], done.stderr[-2000:])
    ends = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(ends) == len(CALLS) * (1 + len(BROKEN))
    for kind, name, end in ends:
        of_plain = name in OF_PLAIN_SCENES
        expected = "no error" if kind == "valid" else "TreeError"
        assert end in ("FormatError", "TreeError") if of_plain else end == expected, (kind, name, end)


def test_a_broken_tree_says_so_where_it_is_printed() -> None:
    for make in BROKEN.values():
        assert ", broken: " in repr(scene_of(make()))
        if "fewer nodes" not in repr(scene_of(make())) and len(make()) == 7:
            with pytest.raises(sparklod.TreeError):
                make().depths()


def test_arrays_of_a_caller_do_not_reach_a_tree() -> None:
    """Views, arrays that are read-only for now, and arrays with strides, changed after a call, or before any."""
    valid = links_of(*VALID)
    for how in ("writable", "read-only", "view", "strided"):
        count, start = valid.child_count.copy(), valid.child_start.copy()
        if how == "strided":
            count, start = np.repeat(count, 2)[::2], np.repeat(start, 2)[::2]
        given = (count[:], start[:]) if how == "view" else (count, start)
        for array in given:
            array.flags.writeable = how != "read-only"
        tree = scene_of(LodTree(*given))
        drawn = sparklod.cut(tree, CAMERA, budget=3).nodes[0]
        for array in (count, start):
            array.flags.writeable = True
            array[:] = 9
        assert np.array_equal(tree.tree.child_start, valid.child_start)
        assert np.array_equal(tree.tree.child_count, valid.child_count)
        assert np.array_equal(sparklod.cut(tree, CAMERA, budget=3).nodes[0], drawn)
        assert len(sparklod.arrange_chunks(tree)) == 7
        with pytest.raises(ValueError, match="read-only"):
            tree.tree.child_start[0] = 9
        with pytest.raises(ValueError, match="WRITEABLE"):
            tree.tree.child_start.flags.writeable = True


@pytest.mark.parametrize("copied", [copy.deepcopy, copy.copy, lambda tree: pickle.loads(pickle.dumps(tree))])
def test_copies_of_trees_cannot_change_either(copied: Callable[[Tree], Tree]) -> None:
    tree = scene_of(links_of(*VALID))
    sparklod.cut(tree, CAMERA)
    again = copied(tree)
    for array in (again.tree.child_start, again.tree.child_count, again.splats.center):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 9
    assert np.array_equal(again.tree.child_start, tree.tree.child_start) and again.up == tree.up


def test_links_that_a_caller_keeps_are_validated_each_time() -> None:
    links, frozen = links_of(*VALID), links_of(*VALID).frozen()
    frozen.validate()
    for each in (links, copy.deepcopy(frozen), pickle.loads(pickle.dumps(frozen))):
        each.validate()
        each.child_start[0] = 0
        with pytest.raises(sparklod.TreeError, match="node 0"):
            each.validate()


@pytest.mark.parametrize(
    ("count", "start", "error", "message"),
    [
        (np.zeros(3, np.int64), np.zeros(3, np.uint32), ValueError, "child_count is int64"),
        (np.zeros(3, np.uint16), np.zeros((3, 1), np.uint32), ValueError, r"child_start is uint32\[3, 1\]"),
        (np.zeros(3, ">u2"), np.zeros(3, np.uint32), ValueError, "child_count is >u2"),
        ([0, 0, 0], np.zeros(3, np.uint32), TypeError, "child_count is a list; give an array of uint16"),
        (np.zeros(3, np.uint16), None, TypeError, "child_start is a NoneType"),
    ],
)
def test_links_of_other_types_are_refused(count: Any, start: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        LodTree(count, start)


# --- Invalid splats ---------------------------------------------------------------------------------------------------

#: The column and the value of an invalid splat.
WRONG = {
    "NaN centre": ("center", np.nan),
    "infinite scale": ("scale", np.inf),
    "negative scale": ("scale", -1.0),
    "no rotation": ("quat_xyzw", 0.0),
    "negative opacity": ("opacity", -0.5),
    "NaN colour": ("rgb", np.nan),
    "infinite SH": ("sh", -np.inf),
}

#: Names and options of every way in which the API writes a scene without a tree, and a tree.
PLAIN: dict[str, dict[str, str]] = {f"out{suffix}": {} for suffix in (".ply", ".splat", ".sog", ".glb", ".spz", ".rad")}
TREES: dict[str, dict[str, str]] = {name: {} for name in ("out.spz", "out.rad", MANIFEST)}
TREES |= {f"{encoding}.npz": {"encoding": encoding} for encoding in ENCODINGS}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(random_splats(60, sh_degree=1))


@pytest.fixture(scope="module")
def tree(scene: Scene) -> Tree:
    return sparklod.build_lod(scene)


def spoiled(scene: Scene, wrong: str) -> Scene:
    """Return a scene whose last splat, a leaf of a tree, is invalid."""
    column, value = WRONG[wrong]
    values = getattr(scene.splats, column).copy()
    values[-1] = value
    return dataclasses.replace(scene, splats=dataclasses.replace(scene.splats, **{column: values}))


@pytest.mark.parametrize("wrong", WRONG)
def test_invalid_splats_are_not_written_built_or_fitted(wrong: str, scene: Scene, tree: Tree, tmp_path: Path) -> None:
    plain, nodes = spoiled(scene, wrong), spoiled(tree, wrong)
    for whole, ways in ((plain, PLAIN), (nodes, TREES)):
        for name, options in ways.items():
            count = len(whole)
            with pytest.raises(InvalidSplatsError, match=f"{name}: 1 of {count} splats is .*splat {count - 1}"):
                sparklod.write(tmp_path / name, whole, **options)
    for call in (
        lambda: sparklod.write(tmp_path / MANIFEST, tree, environment=plain),
        lambda: sparklod.build_lod(plain),
        lambda: sparklod.simplify(plain, to=20),
        lambda: sparklod.simplify(nodes, to=20),
        lambda: sparklod.refine(nodes, steps=1),
    ):
        with pytest.raises(InvalidSplatsError, match=r"1 of .* splats is"):
            call()
    assert not list(tmp_path.iterdir())


def test_broken_trees_are_never_written(tree: Tree, tmp_path: Path) -> None:
    count, start = tree.tree.child_count, tree.tree.child_start.copy()
    start[0] = 2**32 - 1
    for links in (LodTree(count, start), LodTree(count[:-1], tree.tree.child_start[:-1])):
        for name, options in TREES.items():
            with pytest.raises(TreeError, match="node"):
                sparklod.write(tmp_path / name, dataclasses.replace(tree, tree=links), **options)
    empty = Scene.from_arrays(*(np.zeros(shape) for shape in ((0, 3), (0, 3), (0, 4), 0, (0, 3))))
    for name in ("out.spz", "out.ply", "out.splat"):
        with pytest.raises(InvalidSplatsError, match="no splats to write"):
            sparklod.write(tmp_path / name, empty)
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("wrong", ["NaN centre", "infinite scale", "negative scale", "infinite SH"])
def test_a_file_is_validated_before_it_is_converted(wrong: str, tree: Tree, cli: Cli) -> None:
    """A tree with all of its floats, as another program may write it."""
    floats = RadOptions("f32", "f32", "f32", "f32", "f32", "f32", ranges=SplatEncoding(lod_opacity=True))
    pieces = WRITABLE[".rad"].codec().encode(spoiled(tree, wrong), WriteOptions(rad=floats))
    cli.put("wrong.rad", b"".join(pieces))
    for line in (
        *("build-lod wrong.rad -o out.spz", "build-lod wrong.rad --format rad-chunked -o out.rad"),
        f"build-lod wrong.rad -o web/{MANIFEST}",
        *(f"convert wrong.rad {f'out{ending}' if ending[0] == '.' else ending} --leaves" for ending in WRITABLE),
    ):
        assert "1 of " in cli(line, status=1).err and cli.made() == []
