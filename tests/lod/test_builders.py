"""Laws that the trees of every builder keep, in memory and in stages."""

from __future__ import annotations

import math
from importlib import import_module

import pytest

from sparklod_cli.lod.stages import check as check_input
from sparklod_cli.lod.tree_settings import BUILDERS, METHODS
from sparklod_cli.system.errors import InvalidSplatsError
from tests.lod.assembled import run_stages
from tests.lod.trees import check_colours, check_threads, check_tree, hard_cases
from tests.scenes import random_splats

CASES = [("quick", 1.1), ("quick", 1.5), ("quick", 2.0), ("quality", 1.05), ("quality", 1.4), ("quality", 2.0)]

#: Splats of which several threads make a tree.
MANY = {"quick": 60_000, "quality": 20_000}


@pytest.mark.parametrize("name", hard_cases())
@pytest.mark.parametrize(("method", "setting"), CASES)
def test_hard_scenes_make_valid_trees(name: str, method: str, setting: float) -> None:
    splats = hard_cases()[name]
    nodes, tree = import_module(f"sparklod_cli.lod.{method}").build(splats, setting)
    check_tree(splats, nodes, tree)
    if method == "quality":
        assert len(nodes) <= max(setting * len(splats), len(splats) + 1)
    else:
        low, high = splats.center.min(axis=0), splats.center.max(axis=0)
        assert ((nodes.center >= low) & (nodes.center <= high)).all()


@pytest.mark.parametrize(("method", "setting"), CASES)
def test_one_splat_is_a_tree_of_one_node(method: str, setting: float) -> None:
    splats = random_splats(1, sh_degree=2)
    nodes, tree = import_module(f"sparklod_cli.lod.{method}").build(splats, setting)
    assert len(tree) == 1
    check_tree(splats, nodes, tree)


@pytest.mark.parametrize(("method", "setting"), CASES)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_colours_are_means_of_the_leaves_by_what_they_cover(method: str, setting: float, sh_degree: int) -> None:
    splats = random_splats(800, sh_degree=sh_degree, seed=sh_degree)
    nodes, tree = import_module(f"sparklod_cli.lod.{method}").build(splats, setting)
    check_tree(splats, nodes, tree)
    check_colours(nodes, tree)


@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_change_a_bit(method: str) -> None:
    builder, splats = import_module(f"sparklod_cli.lod.{method}"), random_splats(MANY[method], sh_degree=1, seed=3)
    check_threads(lambda: builder.build(splats))
    check_threads(lambda: run_stages(builder, splats, 1.4, [(2, 1, 1)])[:2])


@pytest.mark.parametrize("method", METHODS)
def test_what_cannot_be_drawn_is_an_error(method: str) -> None:
    build = import_module(f"sparklod_cli.lod.{method}").build
    with pytest.raises(InvalidSplatsError, match="no splat"):
        build(random_splats(0))
    for name in ("opacity", "scale"):
        splats = random_splats(10)
        getattr(splats, name)[3] = 0
        with pytest.raises(InvalidSplatsError, match="without opacity or scale"):
            build(splats)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [1.0, 2.01, math.nan])
def test_a_setting_out_of_range_is_an_error(method: str, value: float) -> None:
    builder, splats = import_module(f"sparklod_cli.lod.{method}"), random_splats(2)
    with pytest.raises(ValueError, match=BUILDERS[method].setting):
        builder.build(splats, value)
    with pytest.raises(ValueError, match=BUILDERS[method].setting):
        builder.plan(check_input(splats), splats, value)
