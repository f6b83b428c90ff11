"""Folders of 3D Tiles written without sparklod whose tilesets can be changed, and a table of faulty ones."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fixtures import by_hand_glb, by_hand_tiles
from sparklod_cli.codecs.gltf_container import TURNS
from sparklod_cli.model.scene import Scene
from tests.codecs.cases import linear
from tests.scenes import random_splats

Node = dict[str, Any]
Files = dict[str, bytes]


def columns(count: int, sh_degree: int = 0) -> dict[str, Any]:
    return linear(Scene(random_splats(count, sh_degree=sh_degree)))


def folder(*counts: int) -> Files:
    """A root tile of some splats, and a tile below it for each further number; the last one has one of its own."""
    root, *others = counts
    below = [by_hand_tiles.Tile(columns(count)) for count in others]
    below[-1] = by_hand_tiles.Tile(below[-1].splats, [below[-1]], nested=True)
    return by_hand_tiles.tileset_files(by_hand_tiles.Tile(columns(root), below), by_hand_glb.glb)


SOUND = folder(30, 20, 25)


def changed(change: Callable[[Node], object], files: Files = SOUND, name: str = "tileset.json") -> Files:
    value = copy.deepcopy(json.loads(files[name]))
    change(value)
    return files | {name: json.dumps(value).encode()}


def root(**fields: Any) -> Files:
    return changed(lambda tileset: tileset["root"].update(fields))


def leaf(**fields: Any) -> Files:
    """A folder with other fields of the first child of the root, which is a leaf; those that are None are left out."""

    def change(tileset: Node) -> None:
        node = tileset["root"]["children"][0]
        node.update(fields)
        for name in [name for name, value in fields.items() if value is None]:
            del node[name]

    return changed(change)


def top(**fields: Any) -> Files:
    return changed(lambda tileset: tileset.update(fields))


def squeezed(tileset: Node) -> None:
    box = tileset["root"]["children"][0]["boundingVolume"]["box"]
    box[3] = 0.1


def up(axis: str) -> bytes:
    asset = {"version": "2.0", "generator": "sparklod 0", "extras": {"up": axis}}
    return by_hand_glb.glb(**columns(20), asset=asset, nodes=[{"mesh": 0, "rotation": TURNS[axis]}])


def write(files: Files, path: Path) -> Path:
    for name, data in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(data)
    return path / "tileset.json"


# --- Faults -----------------------------------------------------------------------------------------------------------

NAMES = {"extensionsUsed": ["KHR_gaussian_splatting"]}
LEAF = "tiles/1-1.glb"

#: Folders with faults, and the codes of their findings; those without a dot begin with "tiles.".
FAULTS: dict[str, tuple[Files, set[str]]] = {
    "another version": (top(asset={"version": "2"}), {"container.version"}),
    "no asset": (top(asset=None), {"container.corrupt"}),
    "a root that is a list": (top(root=[]), {"container.corrupt"}),
    "implicit tiling": (leaf(implicitTiling={}), {"unread"}),
    "several contents": (leaf(contents=[]), {"unread"}),
    "another kind of content": (leaf(content={"uri": "a.b3dm"}), {"unread"}),
    "children beside a nested tileset": (
        changed(lambda tileset: tileset["root"]["children"][1].update(children=tileset["root"]["children"][:1])),
        {"unread"},
    ),
    "an extension that is required": (top(extensionsRequired=["X_y"]), {"unread"}),
    "tiles that add": (root(refine="ADD"), {"refine"}),
    "no refine": (changed(lambda tileset: tileset["root"].pop("refine")), {"required"}),
    "no error of the tileset": (top(geometricError=None), {"required"}),
    "an error of the tileset below 0": (top(geometricError=-1), {"required"}),
    "no refine of a nested tileset": (
        changed(lambda tileset: tileset["root"].pop("refine"), name="tiles/1-2.json"),
        {"required"},
    ),
    "a transform of few numbers": (leaf(transform=[1, 2]), {"transform"}),
    "a transform that is endless": (leaf(transform=[1e999] * 16), {"transform"}),
    "no volume": (leaf(boundingVolume=None), {"volumes"}),
    "a volume of words": (leaf(boundingVolume={"box": ["a"] * 12}), {"volumes"}),
    "a volume outside of that of the tile above": (
        leaf(boundingVolume={"box": [0, 0, 0, 99, 0, 0, 0, 99, 0, 0, 0, 99]}),
        {"inside"},
    ),
    "a sphere outside": (leaf(boundingVolume={"sphere": [0, 0, 0, 99]}), {"inside"}),
    "a volume that is too small": (changed(squeezed), {"extents"}),
    "a sphere that is too small": (leaf(boundingVolume={"sphere": [0, 0, 0, 0.1]}), {"extents"}),
    "no error": (leaf(geometricError=None), {"errors"}),
    "an error below 0": (leaf(geometricError=-1), {"errors"}),
    "an endless error": (root(geometricError=1e999), {"errors"}),
    "an error larger than that of the tile above": (leaf(geometricError=9), {"errors", "leaf-error"}),
    "an error larger than that of the tileset": (top(geometricError=0.5), {"errors"}),
    "an error of a leaf": (leaf(geometricError=0.5), {"leaf-error"}),
    "a tile that is never refined": (
        changed(lambda tileset: tileset["root"].update(geometricError=0), name="tiles/1-2.json"),
        {"unrefined"},
    ),
    "no file": ({name: data for name, data in SOUND.items() if name != LEAF}, {"files"}),
    "a file that is no GLB": (SOUND | {LEAF: b"glTF"}, {"files"}),
    "a file that is cut short": (SOUND | {LEAF: SOUND[LEAF][:-400]}, {"files"}),
    "a nested tileset that is missing": (
        {name: data for name, data in SOUND.items() if name != "tiles/1-2.json"},
        {"files"},
    ),
    "a file elsewhere": (leaf(content={"uri": "../1-1.glb"}), {"files"}),
    "a file on a server": (leaf(content={"uri": "https://a.example/1-1.glb"}), {"files"}),
    "a file twice": (leaf(content={"uri": "tiles/0-0.glb"}), {"shared"}),
    "another degree": (SOUND | {LEAF: by_hand_glb.glb(**columns(20, sh_degree=1))}, {"sh"}),
    "another axis up": (SOUND | {LEAF: up("z")}, {"kind"}),
    "no extensions": (top(extensionsUsed=[]), {"extensions"}),
    "extensions that are not required": (top(extensions={"3DTILES_content_gltf": NAMES}), {"extensions"}),
    "no extensions of a nested tileset": (
        changed(lambda tileset: tileset.pop("extensions"), name="tiles/1-2.json"),
        {"extensions"},
    ),
    "a transform far away": (root(transform=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1e300, 0, 0, 1]), {"transform"}),
    "a tile that requires an extension": (
        SOUND | {LEAF: by_hand_glb.glb(**columns(20), extensionsRequired=["EXT_meshopt_compression"])},
        {"container.unsupported"},
    ),
    "version 1.0": (top(asset={"version": "1.0"}), {"old"}),
    "a tile of nothing": (leaf(content=None), {"empty"}),
    "children that are fewer": (folder(60, 20, 25), {"decreasing"}),
}
