"""`World`: Level-of-Detail trees, and where each stands how often."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .cameras.framing import Balls, balls_of, together
from .codecs.gpu import lod_tree
from .codecs.gpu.lod_tree import Nodes
from .io import examine_scene, size_on_disk
from .lod.traversal import CHUNK_NODES, Cones, Forest, Frustum, Instance, Matrix
from .model.gaussian import placed, spark_size
from .model.scene import Scene
from .model.splats import COLUMNS, Splats
from .support.defaults import PRECISIONS
from .support.errors import FormatError, SparklodError, TreeError, memory_told
from .support.progress import Progress, silent

#: What all instances together are called.
TOTAL = "total"

#: What the traversal reads of splats.
TRAVERSED = ("center", "scale", "opacity")


@dataclass(frozen=True)
class Placement:
    """A tree's file and where it stands.

    Attributes:
        file: of the tree.
        name: for people; different from those of others.
        object_to_world: (4, 4) rotation, uniform scale and translation.
        lod_scale: how much its pixel scales count against those of others.
        foveation: None for that of all.
    """

    file: Path
    name: str
    object_to_world: Matrix = field(default_factory=lambda: np.eye(4))
    lod_scale: float = 1.0
    foveation: Cones | Frustum | None = None


@dataclass(frozen=True)
class Tree:
    """A tree's file, read once however often it stands.

    Attributes:
        file: where it is.
        bytes: of the file.
        scene: what was read of it, without the columns that nobody asked for.
        level: (N,) links from the root to each node.
    """

    file: Path
    bytes: int
    scene: Scene
    level: NDArray[np.int32]


@dataclass(frozen=True)
class World:
    """Trees and their instances.

    Attributes:
        trees: each file once.
        forest: the same, as the traversal reads them.
        placements: at least one.
        instances: one for each placement, without its foveation if that is the one of all.
    """

    trees: Sequence[Tree]
    forest: Forest
    placements: Sequence[Placement]
    instances: Sequence[Instance]

    def foveated(self, foveation: Cones | Frustum) -> list[Instance]:
        """The instances, those without a foveation of their own with this one."""
        return [
            Instance(at.tree, at.object_to_world, at.lod_scale, place.foveation or foveation)
            for at, place in zip(self.instances, self.placements, strict=True)
        ]

    def balls(self) -> Balls:
        """What the splats cover in the world: the leaves of every instance."""
        parts = []
        for instance in self.instances:
            scene = self.trees[instance.tree].scene
            assert scene.tree is not None
            parts.append(balls_of(scene.splats, scene.tree.is_leaf, instance.object_to_world))
        return together(parts)

    def splats_of(self, number: int, nodes: NDArray[np.uint32]) -> Splats:
        """Some nodes of an instance, in the world; SH stay in the directions of its own space."""
        instance = self.instances[number]
        return placed(self.trees[instance.tree].scene.splats.take(nodes), instance.object_to_world)

    def chunk_bytes(self) -> list[NDArray[np.int64]]:
        """For each tree the bytes of its chunks, as if its file were cut evenly: SPZ has no chunks of its own."""
        sizes = []
        for tree in self.trees:
            nodes = len(tree.level)
            ends = np.minimum(np.arange(1, -(-nodes // CHUNK_NODES) + 1) * CHUNK_NODES, nodes)
            sizes.append(np.diff(ends * tree.bytes // nodes, prepend=0))
        return sizes


def read_world(
    placements: Sequence[Placement],
    *,
    columns: Collection[str] = TRAVERSED,
    precision: str = PRECISIONS[0],
    threads: int = 1,
    progress: Progress = silent,
) -> World:
    """Reads the trees of a world.

    Args:
        placements: at least one.
        columns: of `Splats`, what is read of each node.
        precision: one of `PRECISIONS`.
        threads: to decode with.
        progress: is told how much is done.

    Raises:
        FormatError: a file cannot be read, or is no tree; names the file.
        TreeError: a tree is broken; names the file.
    """
    scenes = {}
    for file in dict.fromkeys(place.file for place in placements):
        scenes[file] = read_file(file, columns=columns, threads=threads, progress=progress)
        if scenes[file].tree is None:
            raise FormatError(f"{file}: it is not a Level-of-Detail tree; bake it first with sparklod build-lod")
    return world_of(placements, scenes, precision=precision, threads=threads)


def read_file(
    file: Path, *, columns: Collection[str] = COLUMNS, threads: int = 1, progress: Progress = silent
) -> Scene:
    """Reads a file that may be a tree.

    Raises:
        FormatError: it cannot be read; names the file.
        OutOfMemoryError: it does not fit into memory; names the file.
        TreeError: its tree is broken; names the file.
    """
    try:
        with memory_told():
            scene = examine_scene(file, columns=columns, threads=threads, progress=progress)
        if scene.tree is not None:
            scene.tree.validate()
    except TreeError as error:
        raise TreeError(f"{file}: its tree is broken: {error}") from None
    except SparklodError as error:
        raise type(error)(f"{file}: {error}") from None
    return scene


def world_of(
    placements: Sequence[Placement], scenes: Mapping[Path, Scene], *, precision: str = PRECISIONS[0], threads: int = 1
) -> World:
    """The world of trees that `read_file` read, by their files."""
    files = list(dict.fromkeys(place.file for place in placements))
    trees = [_tree(file, scenes[file]) for file in files]
    forest = Forest([_nodes(tree.scene, precision, threads) for tree in trees])
    instances = [Instance(files.index(place.file), place.object_to_world, place.lod_scale) for place in placements]
    return World(trees, forest, placements, instances)


def _tree(file: Path, scene: Scene) -> Tree:
    assert scene.tree is not None
    return Tree(file, size_on_disk(file) or 0, scene, scene.tree.depths())


def _nodes(scene: Scene, precision: str, threads: int) -> Nodes:
    assert scene.tree is not None
    if precision == "float16":
        return lod_tree.unpack(lod_tree.pack(scene.splats, scene.tree, threads=threads))
    return Nodes(scene.splats.center, spark_size(scene.splats), scene.tree)


def names_of(files: Sequence[Path], taken: Collection[str] = ()) -> list[str]:
    """A name for each file, numbered where several have the same; none is `TOTAL`, or taken."""
    seen = {TOTAL, *taken}
    counts: dict[str, int] = {}
    names = []
    for file in files:
        stem = file.name if file.stem == TOTAL else file.stem
        for count in itertools.count(counts.get(stem, 0) + 1):
            name = stem if count == 1 else f"{stem} {count}"
            if name not in seen:
                break
        counts[stem] = count
        seen.add(name)
        names.append(name)
    return names
