"""Other people's programs that read and write splat files, in a Node process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.sh import COEFFICIENTS, SH_C0
from sparklod_cli.model.splats import Splats
from tests.interop.node import Node

#: The versions that these tests were written for. splat-transform needs playcanvas, mkkellogg's viewer needs three.js.
PACKAGES = {
    "@playcanvas/splat-transform": "2.7.1",
    "playcanvas": "2.23.3",
    "@mkkellogg/gaussian-splats-3d": "0.4.7",
    "three": "0.160.0",
    "gsplat": "1.2.9",
}


class Foreign:
    """One Node process with the other programs; `foreign.mjs` describes its requests."""

    def __init__(self, packages: Path, scratch: Path) -> None:
        self._scratch = scratch
        self._node = Node([str(Path(__file__).with_name("foreign.mjs")), str(packages)], scratch / "stderr.txt")
        self.close = self._node.close

    def write(self, action: str, source: Path, path: Path, **options: Any) -> Path:
        """Has another program write the splats of `source` to `path`; returns `path`."""
        self._node.ask({"do": action, "source": str(source), "path": str(path), **options})
        return path

    def spz_centers(self, path: Path) -> NDArray[np.float64]:
        """(N, 3) the centres that mkkellogg's viewer reads of an SPZ, as the file has them."""
        return np.array(self._node.ask({"do": "spz", "path": str(path)})["centers"])

    def read(self, path: Path) -> Splats:
        """Has splat-transform decode a file; returns the splats in the axes of PLY files."""
        answer = self._node.ask({"do": "read", "path": str(path), "out": str(self._scratch / "column")})
        columns = {}
        for name, file in answer["columns"].items():
            columns[name] = np.fromfile(file, "<f4")
            Path(file).unlink()
        assert all(len(column) == answer["count"] for column in columns.values())
        return splats_of(columns)


def splats_of(columns: dict[str, NDArray[np.float32]]) -> Splats:
    """Converts the columns of a PLY file to `Splats`."""

    def stack(*names: str) -> NDArray[np.float64]:
        return np.stack([columns[name] for name in names], axis=1).astype(np.float64)

    rest = sum(name.startswith("f_rest_") for name in columns)
    assert rest // 3 in COEFFICIENTS[:4]
    sh = stack(*(f"f_rest_{i}" for i in range(rest))) if rest else np.zeros((len(columns["x"]), 0))
    linear = {
        "center": stack("x", "y", "z"),
        "scale": np.exp(stack("scale_0", "scale_1", "scale_2")),
        "quat_xyzw": stack("rot_1", "rot_2", "rot_3", "rot_0"),
        "opacity": 1 / (1 + np.exp(-columns["opacity"].astype(np.float64))),
        "rgb": SH_C0 * stack("f_dc_0", "f_dc_1", "f_dc_2") + 0.5,
        "sh": sh.reshape(len(sh), 3, rest // 3).transpose(0, 2, 1),  # all coefficients of a channel together
    }
    arrays = {name: np.ascontiguousarray(values, np.float32) for name, values in linear.items()}
    arrays["quat_xyzw"] = np.ascontiguousarray(normalized_quat(arrays["quat_xyzw"]), np.float32)
    return Splats(**arrays)
