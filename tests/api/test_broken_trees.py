"""No public function follows the links of a broken tree, or of one that was changed after a first call."""

from __future__ import annotations

import copy
import inspect
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from tests.scenes import random_splats

CAMERA = sparklod.Camera.look_at((0, -1, 14), (0, 0, 0), size=(16, 12))

#: Arguments of public functions, by the name of the parameter: those that they require, and few steps.
ARGUMENTS: dict[str, Any] = {
    "path": Path("never.spz"),
    "scene": sparklod.Scene(random_splats(300, sh_degree=0)),
    "camera": CAMERA,
    "cameras": [CAMERA],
    "budgets": [20],
    "encoding": "lodtree",
    "to": 0.3,
    "steps": 2,
    "count": 2,
    "threads": 1,
}

#: Types, as annotations name them, of parameters that a tree can be.
TREES = {"Scene", "Tree", "Viewed"}


def public_functions() -> dict[str, tuple[Callable[..., Any], str]]:
    """Public functions that take a tree, and the parameter that takes it."""
    found = {}
    for name in sparklod.__all__:
        function = getattr(sparklod, name)
        if inspect.isfunction(function):
            for parameter in inspect.signature(function).parameters.values():
                if TREES & set(str(parameter.annotation).replace("|", " ").split()):
                    found[name] = function, parameter.name
                    break
    return found


def call(name: str, tree: sparklod.Scene) -> Any:
    function, parameter = public_functions()[name]
    parameters = inspect.signature(function).parameters.values()
    required = [each.name for each in parameters if each.default is each.empty and each.kind is not each.VAR_KEYWORD]
    optional = {"to", "steps", "threads", "cameras"} & {each.name for each in parameters}
    arguments = {key: ARGUMENTS[key] for key in {*required, *optional} - {parameter}}
    return function(**arguments, **{parameter: tree})


@pytest.fixture(scope="module")
def tree() -> sparklod.Tree:
    return sparklod.build_lod(sparklod.Scene(random_splats(300, sh_degree=0)))


def beyond(start: np.ndarray) -> np.ndarray:
    start[0] = 4_000_000_000
    return start


def circle(start: np.ndarray) -> np.ndarray:
    start[0] = 0
    return start


def short(start: np.ndarray) -> np.ndarray:
    return start[:-5]


def test_functions_that_take_a_tree_are_found() -> None:
    assert {"arrange_chunks", "compare", "cut", "extract_leaves", "orbit", "pack", "refine", "render", "simplify"} | {
        "build_lod",
        "traverse",
        "write",
    } <= set(public_functions())


@pytest.mark.parametrize("wrong", [beyond, circle, short], ids=lambda each: each.__name__)
@pytest.mark.parametrize("name", public_functions())
def test_a_broken_tree_is_refused(
    name: str, wrong: Callable[..., Any], tree: sparklod.Tree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    broken = sparklod.Tree(
        tree.splats, sparklod.LodTree(tree.tree.child_count.copy(), wrong(tree.tree.child_start.copy()))
    )
    with pytest.raises(sparklod.TreeError):
        call(name, broken)


@pytest.mark.parametrize("name", public_functions())
def test_a_tree_with_other_splats_is_refused(
    name: str, tree: sparklod.Tree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(sparklod.TreeError, match="nodes, but there are"):
        call(name, sparklod.Tree(tree.splats.take(slice(0, 200)), tree.tree))


@pytest.mark.parametrize("through", ["array", "view"])
def test_a_tree_cannot_be_changed_after_it_was_made(tree: sparklod.Tree, through: str) -> None:
    start = tree.tree.child_start.copy()
    given = start if through == "array" else start[:]
    if through == "view":
        given.flags.writeable = False
    own = sparklod.Tree(tree.splats, sparklod.LodTree(tree.tree.child_count, given))
    before = sparklod.refine(own, steps=1, threads=1)[0]
    beyond(start)
    own.tree.validate()
    after = sparklod.refine(own, steps=1, threads=1)[0]
    assert (after.splats.rgb == before.splats.rgb).all()
    with pytest.raises(ValueError, match="read-only"):
        own.tree.child_start[0] = 5


def test_copies_of_a_tree_are_validated_again(tree: sparklod.Tree) -> None:
    tree.tree.validate()
    for links in (copy.deepcopy(tree.tree), pickle.loads(pickle.dumps(tree.tree))):
        beyond(links.child_start)
        with pytest.raises(sparklod.TreeError):
            links.validate()


def test_a_broken_tree_can_be_displayed(tree: sparklod.Tree) -> None:
    start = circle(tree.tree.child_start.copy())
    assert "broken: " in repr(sparklod.Tree(tree.splats, sparklod.LodTree(tree.tree.child_count, start)))
