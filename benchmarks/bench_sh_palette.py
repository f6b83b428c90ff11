"""Palettes of spherical harmonics, beside faiss and brute force: `python benchmarks/bench_sh_palette.py --help`."""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from fidelity_report import head, line
from fidelity_views import Image, cameras_of
from numpy.typing import NDArray
from performance.machine import machine

import sparklod_cli as sparklod
from sparklod_cli.codecs.sh_palette import cluster, visible_weight
from sparklod_cli.system.threads import processors

Rows = NDArray[np.float32]

#: Rows whose distances to all codes are in memory at a time, by brute force.
BLOCK = 2048

#: Cuts that pictures are drawn of, as shares of the leaves.
BUDGETS = (0.05, 0.25, 1.0)


def nearest(rows: Rows, codes: Rows) -> NDArray[np.int64]:
    """The nearest code of each row, by brute force: matrix products."""
    labels = np.empty(len(rows), np.int64)
    half = (codes**2).sum(axis=1) / 2
    for start in range(0, len(rows), BLOCK):
        part = slice(start, start + BLOCK)
        labels[part] = (half - rows[part] @ codes.T).argmin(axis=1)
    return labels


def brute_force(rows: Rows, count: int, rounds: int) -> Rows:
    """Lloyd's algorithm, from codes at equal steps, as Spark's tool starts; returns the code of each row."""
    codes = rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]
    for _ in range(rounds):
        labels = nearest(rows, codes)
        sums = np.stack([np.bincount(labels, column, count) for column in rows.T], axis=1)
        known = np.bincount(labels, minlength=count)
        codes[known > 0] = (sums[known > 0] / known[known > 0, None]).astype(np.float32)
    return codes[nearest(rows, codes)]


def by_faiss(rows: Rows, count: int, rounds: int) -> Rows:
    """Faiss's k-means of all rows; returns the code of each row."""
    import faiss

    faiss.omp_set_num_threads(processors())
    limits = {"max_points_per_centroid": len(rows), "min_points_per_centroid": 1}
    found = faiss.Kmeans(rows.shape[1], count, niter=rounds, seed=1, **limits)
    found.train(rows)
    return found.centroids[found.index.search(rows, 1)[1][:, 0]]


def ours(rows: Rows, count: int) -> Rows:
    """The code of each row in our palette."""
    return cluster(rows.reshape(len(rows), -1, 3), count, threads=None).expand().reshape(rows.shape)


def times(rows: Rows, count: int, arguments: argparse.Namespace) -> Iterator[tuple[str, float, float]]:
    """The name, the seconds, and the mean squared error of a coefficient, of each way."""
    ways: dict[str, Callable[[], Rows]] = {"ours": lambda: ours(rows, count)}
    if arguments.faiss:
        ways[f"faiss, {arguments.faiss} rounds"] = lambda: by_faiss(rows, count, arguments.faiss)
    if arguments.brute:
        ways[f"brute force, {arguments.brute} rounds"] = lambda: brute_force(rows, count, arguments.brute)
    for name, way in ways.items():
        start = time.perf_counter()
        found = way()
        yield name, time.perf_counter() - start, float(((found - rows) ** 2).mean())


def pictures(tree: sparklod.Tree, cameras: list[sparklod.Camera], leaves: int) -> list[list[Image]]:
    """The pictures of all cameras, for each of BUDGETS."""
    settings = sparklod.LodSettings(pixel_scale_limit=0.0)
    return [
        [
            sparklod.render(sparklod.cut(tree, camera, budget=max(1, int(share * leaves)), settings=settings), camera)
            for camera in cameras
        ]
        for share in BUDGETS
    ]


def main() -> None:
    """Prints Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files with spherical harmonics")
    parser.add_argument("--method", default="quality", help="builder of the trees")
    parser.add_argument("--codes", type=int, nargs="+", default=[65536, 16384, 4096], help="most codes of a palette")
    parser.add_argument("--noise", type=float, default=0.0, help="add noise, so that no two splats have the same SH")
    parser.add_argument("--faiss", type=int, default=0, metavar="ROUNDS", help="measure faiss, too (pip: faiss-cpu)")
    parser.add_argument("--brute", type=int, default=0, metavar="ROUNDS", help="measure brute force, too")
    parser.add_argument("--pictures", action="store_true", help="also draw cuts with and without each palette")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}.\n")
    cluster(np.random.default_rng(0).normal(size=(3000, 3, 3)).astype(np.float32), 100)  # compiles
    trees = {}
    head(["scene", "nodes", "SH", "codes", "way", "s", "mean squared error"])
    for path in arguments.scenes:
        scene = sparklod.read(path)
        tree = sparklod.build_lod(scene, method=arguments.method)
        trees[path] = scene, tree
        rows = tree.splats.sh.reshape(len(tree), -1)
        if arguments.noise:
            rows = (rows + np.random.default_rng(0).normal(0, arguments.noise, rows.shape)).astype(np.float32)
        for count in arguments.codes:
            for name, seconds, error in times(rows, count, arguments):
                cells = [path.name, f"{len(tree):,}", str(tree.splats.sh_degree), f"{count:,}", name]
                line([*cells, f"{seconds:.2f}", f"{error:.7f}"])
    if arguments.pictures:
        print("\nPSNR of cuts with a palette against the same cuts without, in dB, means of the cameras:\n")
        head(["scene", "codes", "weights", *(f"{share:.0%}" for share in BUDGETS)])
        for path, (scene, tree) in trees.items():
            cameras = cameras_of("around", scene)[::3]
            full = pictures(tree, cameras, len(scene))
            for count in arguments.codes:
                for name, weight in (("equal", None), ("as seen", visible_weight(tree.splats))):
                    palette = cluster(tree.splats.sh, count, weight=weight, threads=None)
                    other = dataclasses.replace(tree, splats=dataclasses.replace(tree.splats, sh=palette.expand()))
                    drawn = pictures(other, cameras, len(scene))
                    psnr = [statistics.mean(map(sparklod.psnr, *pair)) for pair in zip(drawn, full, strict=True)]
                    line([path.name, f"{count:,}", name, *(f"{mean:.1f}" for mean in psnr)])


if __name__ == "__main__":
    main()
