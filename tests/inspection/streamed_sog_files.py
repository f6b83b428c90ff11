"""Folders of Streamed SOG whose manifests tests change; nothing of sparklod writes them."""

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
from fixtures.by_hand_streamed_sog import Columns, streamed_sog_files

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
