"""splat-transform 3, which reads SOG and Streamed SOG."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sparklod_cli.model.splats import Splats
from tests.interop.foreign import splats_of
from tests.interop.node import Node


class SplatTransform:
    """One Node process with splat-transform."""

    def __init__(self, packages: Path, scratch: Path) -> None:
        self._out = scratch / "column"
        program = Path(__file__).with_name("splat_transform.mjs")
        self._node = Node([str(program), str(packages)], scratch / "stderr.txt")
        self.close = self._node.close

    def levels(self, path: Path) -> list[Splats]:
        """The splats of each detail level of a file, the finest first, in the axes of PLY files."""
        found = []
        for level in self._node.ask({"path": str(path), "out": str(self._out)})["levels"]:
            columns = {name: np.fromfile(file, "<f4") for name, file in level["columns"].items()}
            assert all(len(column) == level["count"] for column in columns.values())
            found.append(splats_of(columns))
        return found
