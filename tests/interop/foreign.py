"""Programs that read and write splat files: splat-transform, mkkellogg's viewer, gsplat.js and Adobe's SPZ library."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS, SH_C0
from sparklod_cli.model.splats import Splats
from tests.interop.node import Node


class Foreign:
    """splat-transform 2, mkkellogg's viewer and gsplat.js in one Node process; see `programs/foreign.mjs`."""

    def __init__(self, packages: Path, scratch: Path) -> None:
        self._scratch = scratch
        self._node = Node("foreign.mjs", packages, scratch=scratch)
        self.close = self._node.close

    def write(self, action: str, source: Path, path: Path, **options: Any) -> Path:
        """Have another program write the splats of `source` to `path`, and return `path`."""
        self._node.ask({"do": action, "source": str(source), "path": str(path), **options})
        return path

    def spz_centers(self, path: Path) -> NDArray[np.float64]:
        """Return (N, 3) the centres that mkkellogg's viewer reads of an SPZ, as the file has them."""
        return np.array(self._node.ask({"do": "spz", "path": str(path)})["centers"])

    def read(self, path: Path) -> Splats:
        """Have splat-transform decode a file, and return the splats in the axes of PLY files."""
        return splats_of(self._node.ask({"do": "read", "path": str(path), "out": str(self._scratch / "column")}))


class SplatTransform:
    """splat-transform 3 in a Node process; see `programs/splat_transform.mjs`."""

    def __init__(self, packages: Path, scratch: Path) -> None:
        self._out = scratch / "column"
        self._node = Node("splat_transform.mjs", packages, scratch=scratch)
        self.close = self._node.close

    def levels(self, path: Path) -> list[Splats]:
        """Return the splats of each detail level of a file, the finest first, in the axes of PLY files."""
        return [splats_of(level) for level in self._node.ask({"path": str(path), "out": str(self._out)})["levels"]]


class SpzLibrary:
    """The library of the authors of SPZ in a Node process; see `programs/spz_library.mjs`."""

    def __init__(self, packages: Path, scratch: Path) -> None:
        self._scratch = scratch
        self._node = Node("spz_library.mjs", packages, scratch=scratch)
        self.ask, self.close = self._node.ask, self._node.close

    def read(self, path: Path, to: str = "UNSPECIFIED") -> Scene:
        """Return the splats of a file, turned into a coordinate system; by default they stay as they are."""
        answer = self.ask({"do": "read", "path": str(path), "to": to, "out": str(self._scratch / "column")})
        columns = columns_of(answer)
        with np.errstate(over="ignore"):
            splats = linear_splats(
                center=columns["positions"].reshape(-1, 3),
                log_scale=columns["scales"].reshape(-1, 3),
                quat_xyzw=columns["rotations"].reshape(-1, 4),
                logit=columns["alphas"],
                dc=columns["colors"].reshape(-1, 3),
                sh=columns["sh"].reshape(answer["count"], -1, 3),
            )
        return Scene(splats, antialiased=answer["antialiased"])


def columns_of(answer: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    """Read the files of float32 that an answer names by column."""
    return {name: np.fromfile(file, "<f4").astype(np.float64) for name, file in answer["columns"].items()}


def splats_of(answer: Mapping[str, Any]) -> Splats:
    """Return the splats of an answer with the columns of a PLY file."""
    columns = columns_of(answer)
    assert all(len(column) == answer["count"] for column in columns.values())

    def stack(*names: str) -> NDArray[np.float64]:
        return np.stack([columns[name] for name in names], axis=1)

    rest = sum(name.startswith("f_rest_") for name in columns)
    assert rest // 3 in COEFFICIENTS[:4]
    sh = stack(*(f"f_rest_{i}" for i in range(rest))) if rest else np.zeros((len(columns["x"]), 0))
    return linear_splats(
        center=stack("x", "y", "z"),
        log_scale=stack("scale_0", "scale_1", "scale_2"),
        quat_xyzw=stack("rot_1", "rot_2", "rot_3", "rot_0"),
        logit=columns["opacity"],
        dc=stack("f_dc_0", "f_dc_1", "f_dc_2"),
        sh=sh.reshape(len(sh), 3, rest // 3).transpose(0, 2, 1),  # all coefficients of a channel together
    )


def linear_splats(
    *,
    center: NDArray[np.float64],
    log_scale: NDArray[np.float64],
    quat_xyzw: NDArray[np.float64],
    logit: NDArray[np.float64],
    dc: NDArray[np.float64],
    sh: NDArray[np.float64],
) -> Splats:
    columns = center, np.exp(log_scale), quat_xyzw, 1 / (1 + np.exp(-logit)), SH_C0 * dc + 0.5, sh
    arrays = [np.ascontiguousarray(column, np.float32) for column in columns]
    arrays[2] = np.ascontiguousarray(normalized_quat(arrays[2]), np.float32)
    return Splats(*arrays)
