"""Steps of a bake in memory: selected and transformed splats of an input are one block."""

from __future__ import annotations

import dataclasses
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from ..codecs.reader import check_valid, is_valid_and_visible
from ..codecs.statistics import Statistics
from ..io.files import read_rgba
from ..io.reading import Source, read_scene
from ..lod.tree_settings import BUILDERS
from ..model.lod_tree import LodTree
from ..model.scene import Scene, rotated_axis
from ..model.selection import Selection, SelectionTally
from ..model.splats import Splats
from ..system.errors import FormatError, InvalidSplatsError, naming
from ..system.progress import Progress
from ..system.threads import on_threads
from .settings import BakeSettings
from .tree_output import BuiltTree, keep_tree

if TYPE_CHECKING:
    from ..model.transforms import Transform


def build(tree: BuiltTree, source: Source, threads: int, progress: Progress) -> None:
    """Select and transform the splats of an input, and build their tree, or keep the one that it has."""
    settings, baked, scene = tree.settings, tree.baked, tree.nodes
    assert isinstance(scene, Scene)
    tree.nodes = None
    if settings.environment is not None:
        tree.environment = read_environment(settings, threads, progress)
    antialiased, up = scene.antialiased, settings.up or scene.up
    if up is not None and settings.transform is not None:
        up = rotated_axis(up, settings.transform.rotation)
    if scene.tree is not None:
        keep_tree(tree, source, scene)
        check_valid(scene.splats, threads)
        baked.splats = int(np.count_nonzero(scene.tree.is_leaf))
        tree.nodes = Scene(scene.splats, scene.tree, antialiased, up=up)
        tree.end("read")
        return
    splats, tally = select(scene.splats, settings, threads=threads)
    if tally.dropped or not len(splats):
        settings.selection.check(tally)
    if settings.environment_beyond is not None:
        from ..lod.parts import beyond

        if (far := beyond(splats, settings.environment_beyond)).any():
            if tree.environment is None:
                tree.environment = transformed(splats.take(far), settings.transform, threads)
            splats = splats.take(~far)
    if settings.transform is not None:
        splats = transformed(splats, settings.transform, threads)
    tree.end("read")
    if tree.form is not None:
        codec = tree.form.codec()
        tree.statistics = Statistics.of(splats, np.ones(len(splats), np.bool_), codec.needed(tree.options), threads)
        codec.settled(tree.statistics, tree.options)  # reports a tree that the output cannot hold before it is built
    baked.splats, baked.dropped, baked.method = len(splats), tally.dropped, settings.method
    leaves = [splats]
    del scene, splats  # the builder frees its input as it goes, if nobody else holds it: a third of the peak
    with on_threads(threads):
        built = build_tree(leaves, settings, in_chunks=tree.in_chunks, progress=progress)
    tree.nodes = Scene(*built, antialiased, up=up)
    tree.end("build")


def put_in_order(tree: BuiltTree, threads: int, progress: Progress) -> None:
    """Put the nodes of a tree into the order of its output, and count them."""
    scene, baked = tree.nodes, tree.baked
    assert isinstance(scene, Scene) and scene.tree is not None
    baked.nodes, baked.sh_degree = len(scene), scene.splats.sh_degree
    baked.levels = int(scene.tree.depths().max()) + 1
    if tree.in_chunks and not tree.is_ordered:
        with on_threads(threads):
            from ..lod.chunk_order import chunk_order, reordered

            order, child_start = chunk_order(scene.splats, scene.tree, progress=progress)
            built, antialiased, up = [(scene.splats, scene.tree)], scene.antialiased, scene.up
            tree.nodes = None
            del scene  # `reordered` frees the nodes as it goes
            tree.nodes = scene = Scene(*reordered(built, order, child_start), antialiased=antialiased, up=up)
        tree.end("arrange")
    if tree.form is None:
        return
    needed = tree.form.codec().needed(tree.options)
    if tree.statistics is None:
        tree.statistics = Statistics.of_scene(scene, needed, threads=threads)
    else:
        assert scene.tree is not None
        inner = scene.splats.take(~scene.tree.is_leaf)
        merged = Statistics.of(inner, np.zeros(len(inner), np.bool_), needed, threads)
        tree.statistics = Statistics.merged([tree.statistics, merged])


def build_tree(
    leaves: list[Splats], settings: BakeSettings, *, in_chunks: bool, progress: Progress
) -> tuple[Splats, LodTree]:
    """Build the tree of splats, which are taken out of a list so that the builder can free them.

    With `in_chunks`, the nodes are put into the order for streaming later.
    """
    row = BUILDERS[settings.method]
    builder = import_module(f"..lod.{settings.method}", __package__)
    built = [builder.build(leaves.pop(), getattr(settings, row.setting), progress=progress)]
    if row.in_bands and not in_chunks:
        from ..lod.chunk_order import banded

        return banded(built)
    return built.pop()


def select(
    splats: Splats, settings: BakeSettings, *, start: int = 0, total: int | None = None, threads: int = 1
) -> tuple[Splats, SelectionTally]:
    """Recolour splats, limit their SH, and return the selected splats and a tally of the rest.

    Args:
        splats: of an input, all or some.
        start, total: number of the first one, and of all splats of the input; by default these are all.
    """
    if settings.rgba is not None:  # SH stay, as where Spark is given new colours
        values = read_rgba(settings.rgba, len(splats) if total is None else total, slice(start, start + len(splats)))
        splats = dataclasses.replace(splats, rgb=np.ascontiguousarray(values[:, :3]), opacity=values[:, 3].copy())
    if settings.max_sh < splats.sh_degree:
        splats = splats.with_max_sh(settings.max_sh)
    selection = settings.selection
    drops_nothing = len(splats) and dataclasses.replace(selection, drop_invalid=False) == Selection()
    if drops_nothing and all(is_valid_and_visible(splats, threads)):
        return splats, SelectionTally(len(splats))
    keep, tally = selection.examine(splats, threads=threads)
    return (splats if keep.all() else splats.take(keep)), tally


def transform(splats: Splats, settings: Transform | None, threads: int = 1) -> tuple[Splats, int]:
    """Turn, scale and move splats; return them and how many left the range of float32."""
    turned = splats if settings is None else settings.apply(splats)
    if turned is splats or is_valid_and_visible(turned, threads)[0]:
        return turned, 0
    return turned, int(np.count_nonzero(~turned.is_valid()))


def check_transformed(beyond: int) -> None:
    """Raise `InvalidSplatsError` where a transform moved this many splats out of the range of float32."""
    if beyond:
        raise InvalidSplatsError(
            "scaled and moved like this, it leaves the range of float32; give a smaller --scale or --translate"
        )


def transformed(splats: Splats, settings: Transform | None, threads: int = 1) -> Splats:
    """Turn, scale and move splats; fail where one leaves the range of float32."""
    turned, beyond = transform(splats, settings, threads)
    check_transformed(beyond)
    return turned


def read_environment(settings: BakeSettings, threads: int, progress: Progress) -> Splats:
    """Read the file of an environment, turned and moved as the scene; errors name it."""
    path = settings.environment
    assert path is not None
    with naming(f"the environment {path}", (FormatError, InvalidSplatsError)):
        scene = read_scene(path, threads=threads, progress=progress)
        if scene.tree is not None:
            raise FormatError("it is a Level-of-Detail file; give the splats that its tree was built from")
        selection = Selection(drop_invalid=settings.selection.drop_invalid)
        splats, tally = select(scene.splats, dataclasses.replace(settings, rgba=None, selection=selection))
        selection.check(tally)
        return transformed(splats, settings.transform, threads)
