"""A tree as a stream, for what writes one that is not in memory."""

from __future__ import annotations

from sparklod_cli.model.lod_tree import LodTree, NodeStream
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats


def node_stream(scene: Scene) -> NodeStream:
    """The nodes of a scene with a tree, copied whenever they are asked for."""
    tree = scene.tree
    assert tree is not None

    def read(start: int, stop: int) -> tuple[Splats, LodTree]:
        assert 0 <= start < stop <= len(scene)
        part = slice(start, stop)
        return scene.splats.take(part), LodTree(tree.child_count[part].copy(), tree.child_start[part].copy())

    return NodeStream(len(scene), scene.splats.sh_degree, scene.antialiased, read)
