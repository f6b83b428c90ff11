"""The palette of spherical harmonics of a file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.nodes import CHUNK_NODES
from ...model.scene import Scene
from ...model.splats import FloatArray, Splats
from ...model.streams import NodeStream
from ...support.progress import Progress
from .. import sh_labels, sh_palette

#: Nodes that the palette of a tree is made of which is not in memory, evenly spread; a tree of fewer gives all. Of 16
#: times as many as codes. Chosen.
SAMPLE = 1 << 20

#: Consecutive nodes of a sample, so that reading it takes few reads. Chosen.
RUN = 1 << 8


@dataclass(frozen=True, eq=False)
class Palette:
    """Spherical harmonics that splats share.

    Attributes:
        codes: (codes, K, 3) coefficients, as many codes as the first chunk has splats: Spark reads no other number.
        used: how many of them are codes; the others, behind them, are 0.
        labels: (N,) the code of each splat; None where it is searched for in each chunk.
    """

    codes: FloatArray
    used: int
    labels: NDArray[np.uint32] | None

    @classmethod
    def of(cls, scene: Scene | NodeStream, most: int, threads: int, progress: Progress) -> Palette:
        """A palette of at most so many codes, with zeros behind them up to as many as Spark reads."""
        if isinstance(scene, NodeStream):
            splats, count = _sample(scene), scene.count
        else:
            splats, count = scene.splats, len(scene)
        room = min(count, CHUNK_NODES)
        weight = sh_palette.visible_weight(splats)
        found = sh_palette.cluster(splats.sh, min(most, room), weight=weight, threads=threads, progress=progress)
        padded = np.zeros((room, *found.codes.shape[1:]), np.float32)
        padded[: len(found.codes)] = found.codes
        return cls(padded, len(found.codes), found.labels if len(splats) == count else None)

    def labels_of(self, splats: Splats, start: int) -> NDArray[np.uint32]:
        """(n,) the codes of the splats of the file from number `start` on."""
        if self.labels is not None:
            return self.labels[start : start + len(splats)]
        return sh_labels.labels_of(splats.sh, self.codes[: self.used])


def _sample(nodes: NodeStream) -> Splats:
    """Runs of nodes, evenly spread over all."""
    if nodes.count <= SAMPLE:
        return nodes.read(0, nodes.count)[0]
    starts = np.linspace(0, nodes.count - RUN, SAMPLE // RUN).astype(np.int64)
    return Splats.concat([nodes.read(start, start + RUN)[0] for start in starts.tolist()])
