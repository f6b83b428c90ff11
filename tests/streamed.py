"""Streamed SOG of made-up scenes at several detail levels, written without sparklod's code."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fixtures import by_hand_sog, by_hand_streamed_sog
from sparklod_cli.model.scene import DetailScene
from sparklod_cli.model.splats import Splats


def columns_of(splats: Splats) -> dict[str, np.ndarray]:
    """Arguments of `by_hand_sog.sog_files`."""
    return {
        "center": splats.center,
        "scale": splats.scale,
        "quat_wxyz": splats.quat_xyzw[:, [3, 0, 1, 2]],
        "opacity": splats.opacity,
        "rgb": splats.rgb,
        "sh": splats.sh,
    }


def write_streamed(folder: Path, scene: DetailScene, *, together: int = 2) -> Path:
    """Writes a scene into a folder, with the runs of some regions `together` in a chunk file; returns its manifest."""
    regions = [
        [columns_of(scene.splats.take(scene.run(region, level))) for level in range(scene.levels)]
        for region in range(scene.regions)
    ]
    around = None if scene.environment is None else columns_of(scene.environment)
    files = by_hand_streamed_sog.streamed_sog_files(
        regions, by_hand_sog.sog_files, environment=around, together=together
    )
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder / "lod-meta.json"
