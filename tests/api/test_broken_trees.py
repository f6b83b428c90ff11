"""Every public function that takes a scene refuses a broken tree: by one error, in a process that survives."""

from __future__ import annotations

import copy
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
from sparklod_cli.api.files import Tree
from sparklod_cli.codecs.formats import MANIFEST
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from tests.conftest import ROOT
from tests.scenes import random_splats

SECONDS = 120


def links_of(*families: tuple[int, int, int], nodes: int) -> LodTree:
    """Links of nodes, from families: a node, its first child, its number of children."""
    count, start = np.zeros(nodes, np.uint16), np.zeros(nodes, np.uint32)
    for node, first, children in families:
        start[node], count[node] = first, children
    return LodTree(count, start)


#: Kinds of broken links of seven nodes, whose valid ones are (0, 1, 2), (1, 3, 2), (2, 5, 2).
BROKEN: dict[str, Callable[[], LodTree]] = {
    "children out of range": lambda: links_of((0, 4_000_000_000, 2), (1, 3, 2), (2, 5, 2), nodes=7),
    "children that overflow 32 bits": lambda: links_of((0, 2**32 - 1, 2), (1, 3, 2), (2, 5, 2), nodes=7),
    "a child count past the end": lambda: links_of((0, 1, 2), (1, 3, 2), (2, 5, 65_535), nodes=7),
    "a node that is its own child": lambda: links_of((0, 0, 2), (1, 3, 2), (2, 5, 2), nodes=7),
    "a circle": lambda: links_of((0, 1, 2), (1, 3, 2), (3, 1, 2), (2, 5, 2), nodes=7),
    "a node with two parents": lambda: links_of((0, 1, 2), (1, 3, 2), (2, 4, 2), nodes=7),
    "an orphan": lambda: links_of((0, 1, 2), (1, 3, 2), (2, 5, 1), nodes=7),
    "children before their parent": lambda: links_of((0, 3, 2), (3, 1, 2), (4, 5, 2), nodes=7),
    "fewer starts than counts": lambda: LodTree(np.zeros(7, np.uint16), np.zeros(5, np.uint32)),
    "fewer nodes than splats": lambda: links_of((0, 1, 2), (1, 3, 2), nodes=5),
    "more nodes than splats": lambda: links_of((0, 1, 2), (1, 3, 2), (2, 5, 2), (6, 7, 2), nodes=9),
    "no node": lambda: links_of(nodes=0),
}

VALID = ((0, 1, 2), (1, 3, 2), (2, 5, 2))


def functions() -> dict[str, Callable[..., Any]]:
    """The public functions that take a scene or a tree, by the types of their arguments."""
    found = {}
    for name in sparklod.__all__:
        function = getattr(sparklod, name)
        if inspect.isfunction(function) and any(map(takes_scene, typed_arguments(function))):
            found[name] = function
    return found


def typed_arguments(function: Callable[..., Any]) -> list[inspect.Parameter]:
    return list(inspect.signature(function).parameters.values())


def takes_scene(argument: inspect.Parameter) -> bool:
    return any(word in str(argument.annotation).replace("|", " ").split() for word in ("Scene", "Tree", "Viewed"))


#: Values of arguments that functions ask for besides a scene, by name.
NEEDED: dict[str, Callable[[], Any]] = {
    "camera": lambda: sparklod.Camera.look_at((0.5, -1.0, 9.0), (0, 0, 0), size=(32, 24)),
    "cameras": lambda: [sparklod.Camera.look_at((0.5, -1.0, 9.0), (0, 0, 0), size=(32, 24))],
    "budgets": lambda: [3],
    "encoding": lambda: "ext",
    "to": lambda: 3,
    "steps": lambda: 2,
}


def calls(tree: Scene, valid: Scene, folder: Path) -> dict[str, Callable[[], Any]]:
    """Every call of every function that has the tree as one of its scenes, and needs no other one to be broken."""
    found: dict[str, Callable[[], Any]] = {}
    for name, function in functions().items():
        arguments = typed_arguments(function)
        scenes = [each.name for each in arguments if takes_scene(each)]
        path = {"path": folder / MANIFEST, "overwrite": True} if "path" in (each.name for each in arguments) else {}
        needed = {
            each.name: NEEDED[each.name]()
            for each in arguments
            if each.name in NEEDED and (each.default is inspect.Parameter.empty or each.name in ("to", "steps"))
        }
        for one in scenes:
            others = {each: valid for each in scenes if each != one and is_needed(function, each)}
            found[f"{name}({one})"] = lambda f=function, kw={one: tree, **others, **needed, **path}: f(**kw)
        if scenes == ["viewed"] or name == "compare":
            several = {"viewed": [sparklod.Instance(valid), sparklod.Instance(tree)], **needed}
            several |= {"scene": None} if name == "compare" else {}
            found[f"{name}(instances)"] = lambda f=function, kw=several: f(**kw)
    return found


def is_needed(function: Callable[..., Any], name: str) -> bool:
    return inspect.signature(function).parameters[name].default is inspect.Parameter.empty


def outcome(call: Callable[[], Any]) -> str:
    try:
        call()
    except Exception as error:
        return type(error).__name__
    return "no error"


def scene_of(links: LodTree) -> Tree:
    return Tree(random_splats(7), links)


def report(folder: str) -> None:
    """Print what became of each call, a line of JSON each: of valid trees, of broken ones, and of changed ones."""
    valid = scene_of(links_of(*VALID, nodes=7))
    for name, call in calls(valid, valid, Path(folder)).items():
        print(json.dumps(["valid", name, outcome(call)]), flush=True)
    for kind, make in BROKEN.items():
        broken = scene_of(make())
        repr(broken)
        for name, call in calls(broken, valid, Path(folder)).items():
            print(json.dumps([kind, name, outcome(call)]), flush=True)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str, str]]:
    """What became of each call, in a process that must survive all of them."""
    code = "import sys; from tests.api.test_broken_trees import report; report(sys.argv[1])"
    command = [sys.executable, "-c", code, str(tmp_path_factory.mktemp("written"))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 0, (done.returncode, done.stdout[-300:], done.stderr[-2000:])
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


def test_functions_that_take_a_scene_are_found() -> None:
    known = {"build_lod", "simplify", "refine", "arrange_chunks", "extract_leaves", "pack", "write", "orbit", "compare"}
    assert known | {"cut", "render", "traverse"} <= set(functions())
    for name, function in functions().items():
        for each in typed_arguments(function):
            assert each.default is not inspect.Parameter.empty or takes_scene(each) or each.name in {*NEEDED, "path"}, (
                f"{name} needs {each.name}: give NEEDED a value for it"
            )


def test_broken_trees_are_refused_by_every_function(outcomes: list[tuple[str, str, str]]) -> None:
    assert {kind for kind, _, _ in outcomes} == {"valid", *BROKEN}
    # Functions that take plain scenes alone refuse any tree.
    plain = {name for kind, name, end in outcomes if kind == "valid" and end == "FormatError"}
    assert plain <= {"build_lod(scene)", "write(environment)"}
    assert {end for kind, name, end in outcomes if kind == "valid" and name not in plain} == {"no error"}
    wrong = [(kind, name, end) for kind, name, end in outcomes if kind != "valid" and end != "TreeError"]
    assert [each for each in wrong if each[1] not in plain or each[2] != "FormatError"] == []


def test_a_broken_tree_says_so_where_it_is_printed() -> None:
    for make in BROKEN.values():
        assert ", broken: " in repr(scene_of(make()))
        if "fewer nodes" not in repr(scene_of(make())) and len(make()) == 7:
            with pytest.raises(sparklod.TreeError):
                make().depths()


def test_arrays_of_a_caller_do_not_reach_a_tree() -> None:
    """Views, arrays that are read-only for now, and arrays with strides, changed after a call, or before any."""
    valid = links_of(*VALID, nodes=7)
    for how in ("writable", "read-only", "view", "strided"):
        count, start = valid.child_count.copy(), valid.child_start.copy()
        if how == "strided":
            count, start = np.repeat(count, 2)[::2], np.repeat(start, 2)[::2]
        given = (count[:], start[:]) if how == "view" else (count, start)
        for array in given:
            array.flags.writeable = how != "read-only"
        tree = scene_of(LodTree(*given))
        camera = NEEDED["camera"]()
        drawn = sparklod.cut(tree, camera, budget=3).nodes[0]
        for array in (count, start):
            array.flags.writeable = True
            array[:] = 9
        assert np.array_equal(tree.tree.child_start, valid.child_start)
        assert np.array_equal(tree.tree.child_count, valid.child_count)
        assert np.array_equal(sparklod.cut(tree, camera, budget=3).nodes[0], drawn)
        assert len(sparklod.arrange_chunks(tree)) == 7
        with pytest.raises(ValueError, match="read-only"):
            tree.tree.child_start[0] = 9
        with pytest.raises(ValueError, match="WRITEABLE"):
            tree.tree.child_start.flags.writeable = True


@pytest.mark.parametrize("copied", [copy.deepcopy, copy.copy, lambda tree: pickle.loads(pickle.dumps(tree))])
def test_copies_of_trees_cannot_change_either(copied: Callable[[Tree], Tree]) -> None:
    tree = scene_of(links_of(*VALID, nodes=7))
    sparklod.cut(tree, NEEDED["camera"]())
    again = copied(tree)
    for array in (again.tree.child_start, again.tree.child_count, again.splats.center):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 9
    assert np.array_equal(again.tree.child_start, tree.tree.child_start) and again.up == tree.up


def test_links_that_a_caller_keeps_are_validated_each_time() -> None:
    links, frozen = links_of(*VALID, nodes=7), links_of(*VALID, nodes=7).frozen()
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
