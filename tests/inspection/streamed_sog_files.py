"""Folders of Streamed SOG written without sparklod whose manifests can be changed, and a table of faulty ones."""

from __future__ import annotations

import copy
import functools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fixtures.by_hand_sog import sog_files
from fixtures.by_hand_streamed_sog import Columns, joined, streamed_sog_files

Node = dict[str, Any]

#: Splats of two regions at three detail levels; as many at level 1 as at level 2 of the second one.
COUNTS = ((200, 12, 6), (24, 6, 6))


@dataclass(frozen=True)
class Folder:
    """A folder: its manifest, and its other files by name."""

    manifest: Node
    files: dict[str, bytes] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Writes the files, and returns the path of the manifest."""
        for name, data in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        path = folder / "lod-meta.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.manifest))
        return path

    def changed(self, change: Callable[[Node], object]) -> Folder:
        """A folder whose manifest is changed in place."""
        manifest = copy.deepcopy(self.manifest)
        change(manifest)
        return replace(self, manifest=manifest)

    def having(self, **top: Any) -> Folder:
        """A folder with other fields at the top of the manifest; those that are None are left out."""
        manifest = copy.deepcopy(self.manifest) | top
        return replace(self, manifest={key: value for key, value in manifest.items() if value is not None})

    def with_files(self, files: dict[str, bytes | None]) -> Folder:
        """A folder with other files; those that are None are left out."""
        return replace(self, files={name: data for name, data in (self.files | files).items() if data is not None})


def regions(manifest: Node) -> list[Node]:
    """The leaves of the tree of a manifest."""

    def below(node: Node) -> Iterator[Node]:
        if "lods" in node:
            yield node
        for child in node.get("children", []):
            yield from below(child)

    return list(below(manifest["tree"]))


def splats(count: int, middle: float, sh_degree: int = 0) -> Columns:
    """Splats on a line along x, which is their order along the Morton curve, too."""
    rng = np.random.default_rng(count)
    center = np.zeros((count, 3))
    center[:, 0] = middle + np.linspace(-1, 1, count)
    quat = rng.normal(size=(count, 4))
    return {
        "center": center,
        "scale": rng.uniform(0.01, 0.1, (count, 3)),
        "quat_wxyz": quat / np.linalg.norm(quat, axis=1, keepdims=True),
        "opacity": rng.uniform(0.1, 0.9, count),
        "rgb": rng.uniform(0.1, 0.9, (count, 3)),
        "sh": rng.normal(size=(count, (sh_degree + 1) ** 2 - 1, 3)) * 0.1,
    }


@functools.cache
def folder(counts: Sequence[Sequence[int]] = COUNTS, *, sh_degree: int = 0, errors: bool = True) -> Folder:
    """A folder without faults, with an environment; regions stand in a row along x."""
    held = [[splats(count, 3.0 * number, sh_degree) for count in row] for number, row in enumerate(counts)]
    measured = [[0.1 * level for level in range(len(row))] for row in counts] if errors else None
    environment = splats(5, 100.0, sh_degree)
    files = streamed_sog_files(held, sog_files, environment=environment, errors=measured)
    return Folder(json.loads(files.pop("lod-meta.json")), files)


# --- Faults -----------------------------------------------------------------------------------------------------------

SOUND = folder()

#: One region, whose chunk files hold nothing else.
ALONE = folder(((40, 6),))


def leaf(number: int, /, **fields: Any) -> Folder:
    """A folder with other fields of one region; those that are None are left out."""

    def change(manifest: Node) -> None:
        node = regions(manifest)[number]
        node.update(fields)
        for name in [name for name, value in fields.items() if value is None]:
            del node[name]

    return SOUND.changed(change)


def run_of(number: int, level: int, /, **fields: Any) -> Folder:
    """A folder with other fields of a run."""
    return SOUND.changed(lambda manifest: regions(manifest)[number]["lods"][str(level)].update(fields))


def tree(change: Callable[[Node], Node]) -> Folder:
    """A folder with another tree."""
    return SOUND.changed(lambda manifest: manifest.update(tree=change(manifest["tree"])))


def root(**fields: Any) -> Folder:
    return tree(lambda node: node | fields)


def swapped(manifest: Node) -> None:
    """Two levels of a region, of as many splats, are in each other's files."""
    lods = regions(manifest)[1]["lods"]
    lods["1"], lods["2"] = lods["2"], lods["1"]


def squeezed(manifest: Node) -> None:
    """The bound of the last region, and so that of all, ends where its splats begin."""
    node = regions(manifest)[-1]
    node["bound"]["max"][0] = node["bound"]["min"][0]
    manifest["tree"]["bound"]["max"][0] = max(each["bound"]["max"][0] for each in regions(manifest))


def shuffled() -> dict[str, bytes | None]:
    """The chunk file of level 0, in which the splats of the first region are in no order."""
    columns = joined([splats(row[0], 3.0 * number) for number, row in enumerate(COUNTS)])
    count = COUNTS[0][0]
    columns["center"][:count] = columns["center"][77 * np.arange(count) % count]
    return {f"0_0/{name}": data for name, data in sog_files(**columns).items()}


def of_degree_1() -> dict[str, bytes | None]:
    """The chunk file of level 1, with spherical harmonics."""
    return {name: data for name, data in folder(sh_degree=1).files.items() if name.startswith("1_0/")}


def deep(depth: int) -> Node:
    """A tree of so many nodes on one way."""
    node: Node = {"bound": SOUND.manifest["tree"]["bound"], "lods": {}}
    for _ in range(depth):
        node = {"bound": node["bound"], "children": [node]}
    return node


#: Folders with faults, and the codes of their findings; those without a dot begin with "streamed-sog.".
FAULTS: dict[str, tuple[Folder, set[str]]] = {
    "another version": (SOUND.having(version=2), {"container.version"}),
    "a version that is a text": (SOUND.having(version="1"), {"container.version"}),
    "no levels": (SOUND.having(lodLevels=0), {"container.corrupt"}),
    "very many levels": (SOUND.having(lodLevels=10**18), {"container.corrupt"}),
    "levels in words": (SOUND.having(lodLevels="three"), {"container.corrupt"}),
    "filenames that are numbers": (SOUND.having(filenames=[1, 2, 3]), {"container.corrupt"}),
    "no tree": (SOUND.having(tree=None), {"container.corrupt"}),
    "a tree that is a list": (SOUND.having(tree=[]), {"container.corrupt"}),
    "a run at a level beyond": (leaf(0, lods={"3": {"file": 0, "offset": 0, "count": 1}}), {"container.corrupt"}),
    "a run at level 01": (leaf(0, lods={"01": {"file": 0, "offset": 0, "count": 1}}), {"container.corrupt"}),
    "a run in no file": (run_of(0, 0, file=99), {"container.corrupt"}),
    "a run before its file": (run_of(0, 0, offset=-1), {"container.corrupt"}),
    "a run of half a splat": (run_of(0, 0, count=1.5), {"container.corrupt"}),
    "a run of very many splats": (run_of(0, 0, count=2**63), {"container.corrupt"}),
    "an environment that is a number": (SOUND.having(environment=1), {"container.corrupt"}),
    "a tree that is too deep": (SOUND.having(tree=deep(300)), {"container.corrupt"}),
    "no version": (SOUND.having(version=None, count=None, counts=None), {"old"}),
    "one child": (tree(lambda node: {"bound": node["bound"], "children": [node]}), {"nodes"}),
    "a long way of single children": (
        SOUND.having(tree=deep(100)),
        {"nodes", "unused", "counts", "full-detail", "coarsest", "lod-errors", "decreasing"},
    ),
    "three children": (
        tree(lambda node: node | {"children": [*node["children"], node["children"][0] | {"lods": {}}]}),
        {"nodes", "full-detail", "coarsest"},
    ),
    "children and runs": (root(lods={}), {"nodes"}),
    "neither children nor runs": (
        tree(lambda node: {"bound": node["bound"], "children": [node, {"bound": node["bound"]}]}),
        {"nodes"},
    ),
    "no bound": (leaf(0, bound=None), {"bounds"}),
    "a bound with null": (leaf(0, bound={"min": [0, 0, None], "max": [1, 1, 1]}), {"bounds"}),
    "an endless bound": (leaf(0, bound={"min": [0, 0, -1e999], "max": [1, 1, 1]}), {"bounds"}),
    "a bound without a number": (leaf(0, bound={"min": [0, 0, float("nan")], "max": [1, 1, 1]}), {"bounds"}),
    "a bound the wrong way round": (leaf(0, bound={"min": [9, 9, 9], "max": [1, 1, 1]}), {"bounds"}),
    "a bound of all that is too large": (root(bound={"min": [-99, -99, -99], "max": [99, 99, 99]}), {"union"}),
    "a bound that is too small": (SOUND.changed(squeezed), {"extents"}),
    "too few errors": (leaf(0, errors=[0, 0.1]), {"errors"}),
    "an error below 0": (leaf(0, errors=[0, -0.1, 0.1]), {"errors"}),
    "an error that is null": (leaf(0, errors=[0, None, 0.1]), {"errors"}),
    "an endless error": (leaf(0, errors=[0, 0.1, 1e999]), {"errors"}),
    "errors in words": (leaf(0, errors="none"), {"errors"}),
    "an error at level 0": (leaf(0, errors=[0.1, 0.1, 0.1]), {"errors"}),
    "errors that decrease": (leaf(0, errors=[0, 0.2, 0.1]), {"errors"}),
    "errors of one region only": (leaf(0, errors=None), {"lod-errors"}),
    "errors that the head denies": (SOUND.having(lodErrors=False), {"lod-errors"}),
    "errors that are not there": (folder(errors=False).having(lodErrors=True), {"lod-errors"}),
    "another sum": (SOUND.having(count=1), {"counts"}),
    "another sum of a level": (SOUND.having(counts=[224, 18, 13]), {"counts"}),
    "sums of fewer levels": (SOUND.having(counts=[224, 18]), {"counts"}),
    "a sum in words": (SOUND.having(count="many"), {"counts"}),
    "a file elsewhere": (SOUND.having(filenames=["../0_0/meta.json", "1_0/meta.json", "2_0/meta.json"]), {"filenames"}),
    "a file at the root": (SOUND.having(filenames=["/0_0/meta.json", "1_0/meta.json", "2_0/meta.json"]), {"filenames"}),
    "a file on a server": (
        SOUND.having(filenames=["https://a.example/0_0", "1_0/meta.json", "2_0/meta.json"]),
        {"filenames"},
    ),
    "a file twice": (SOUND.having(filenames=[*SOUND.manifest["filenames"], "0_0/meta.json"]), {"filenames", "unused"}),
    "no file": (SOUND.with_files({"1_0/meta.json": None}), {"chunk-files"}),
    "a file that is no SOG": (SOUND.with_files({"1_0/meta.json": b"[]"}), {"chunk-files"}),
    "a file without an image": (SOUND.with_files({"1_0/quats.webp": None}), {"chunk-files"}),
    "an image that is cut short": (
        SOUND.with_files({"0_0/quats.webp": SOUND.files["0_0/quats.webp"][:-40]}),
        {"chunk-files"},
    ),
    "an image of a coarse level that is cut short": (
        SOUND.with_files({"2_0/quats.webp": SOUND.files["2_0/quats.webp"][:-40]}),
        {"chunk-files"},
    ),
    "a file of two levels": (SOUND.changed(swapped), {"mixed"}),
    "runs that overlap": (run_of(1, 0, offset=199), {"runs"}),
    "a gap between runs": (run_of(1, 0, offset=201), {"runs"}),
    "a run that is too short": (run_of(1, 0, count=23), {"runs", "counts"}),
    "a run that is too long": (run_of(1, 0, count=25), {"runs", "counts"}),
    "a file that no region has": (SOUND.having(filenames=[*SOUND.manifest["filenames"], "env/meta.json"]), {"unused"}),
    "no environment": (SOUND.with_files({"env/meta.json": None}), {"environment"}),
    "an environment elsewhere": (SOUND.having(environment="../env/meta.json"), {"environment"}),
    "a region without full detail": (folder(((40, 12, 6), (0, 6, 6))), {"full-detail"}),
    "a region that disappears": (folder(((40, 12, 6), (24, 6, 0))), {"coarsest"}),
    "a level that is as large": (folder(((40, 12, 12), (24, 6, 6))), {"decreasing"}),
    "another degree": (SOUND.with_files(of_degree_1()), {"kind"}),
    "no order": (SOUND.with_files(shuffled()), {"order"}),
    "rotations of a coarse level that are none": (
        ALONE.with_files({"1_0/quats.webp": ALONE.files["1_0/sh0.webp"]}),
        {"values.non-finite"},
    ),
}
