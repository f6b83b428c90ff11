"""Random and hand-made splats to test with, trees as streams, and the files of outputs."""

from __future__ import annotations

import numpy as np

from fixtures import by_hand
from sparklod_cli.codecs.reader import Reader, RowBuffer
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS, SH_C0
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.output import Files, Output
from sparklod_cli.system.progress import Progress


def random_splats(count: int, *, sh_degree: int = 0, seed: int = 0, extent: float = 1.0) -> Splats:
    """Plausible splats: scales over two decades, clustered centres, mostly opaque."""
    rng = np.random.default_rng(seed)
    f32 = np.float32
    clusters = rng.normal(size=(8, 3)) * extent
    return Splats(
        center=(clusters[rng.integers(8, size=count)] + rng.normal(size=(count, 3)) * 0.2 * extent).astype(f32),
        scale=np.exp(rng.normal(-4, 0.8, size=(count, 3)) + np.log(extent)).astype(f32),
        quat_xyzw=np.ascontiguousarray(normalized_quat(rng.normal(size=(count, 4)).astype(f32))),
        opacity=rng.uniform(0.05, 1, size=count).astype(f32),
        rgb=rng.uniform(0, 1, size=(count, 3)).astype(f32),
        sh=np.clip(rng.normal(0, 0.15, size=(count, COEFFICIENTS[sh_degree], 3)), -0.9, 0.9).astype(f32),
    )


def single_layer(side: int, *, seed: int = 0) -> Splats:
    """Return side * side flat, nearly opaque splats that just overlap, in the plane y = 0 from -1 to 1."""
    rng, count, step = np.random.default_rng(seed), side * side, 2 / (side - 1)
    x, z = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1, 1, side)] * 2))
    center = np.stack([x, 0 * x, z], axis=1) + step * rng.normal(0, 0.1, (count, 3)) * [1, 0.3, 1]
    scale = step * np.insert(rng.uniform(0.55, 0.75, (count, 2)), 1, 0.1, axis=1)
    columns = center, scale, np.tile([0, 0, 0, 1], (count, 1)), rng.uniform(0.9, 0.99, count)
    gray = np.full((count, 3), 0.5), np.zeros((count, 0, 3))
    return Splats(*(np.ascontiguousarray(column, np.float32) for column in (*columns, *gray)))


def splat_columns(count: int, *, sh_degree: int = 0, seed: int = 0) -> dict[str, np.ndarray]:
    """The vertex properties of plausible splats as a 3DGS PLY stores them, for `fixtures.by_hand.ply`; float32."""
    splats = random_splats(count, sh_degree=sh_degree, seed=seed)
    columns = by_hand.ply_columns(
        center=splats.center,
        log_scale=np.log(splats.scale),
        quat_wxyz=splats.quat_xyzw[:, [3, 0, 1, 2]],
        logit=np.log(splats.opacity / (1.001 - splats.opacity)),
        dc=(splats.rgb - 0.5) / SH_C0,
        sh=splats.sh,
    )
    return {name: np.array(column, np.float32) for name, column in columns.items()}


def node_stream(scene: Scene) -> Reader:
    """The nodes of a scene with a tree, copied whenever they are read."""
    tree = scene.tree
    assert tree is not None

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        part = slice(target.start, target.stop)
        assert 0 <= target.start < target.stop <= len(scene) and target.tree is not None
        for name in COLUMNS:
            getattr(target.splats, name)[:] = getattr(scene.splats, name)[part]
        target.tree.child_count[:], target.tree.child_start[:] = tree.child_count[part], tree.child_start[part]

    return Reader(len(scene), scene.splats.sh_degree, "", fill, scene.antialiased, has_tree=True)


def write_files(out: Output, files: Files) -> int:
    """Write the files of an output; return their bytes."""
    with out:
        return sum(out.write(*file) for file in files)
