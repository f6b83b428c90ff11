"""Compares orders of nodes for streaming on the same tree: `python benchmarks/bench_chunk_order.py --help`."""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scenes import load, tiled

import sparklod_cli as sparklod
from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.cameras.framing import framing
from sparklod_cli.codecs.formats import DEFAULTS
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.lod.chunk_order import arrange
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.lod_tree import CHUNK_NODES, LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.threads import processors
from sparklod_cli.viewers.loaded_scene import TreeCut
from sparklod_cli.viewers.loaded_scene import Viewer as PackageViewer
from sparklod_cli.viewers.scenes import Scenes, read_scenes
from sparklod_cli.viewers.streaming import Chunks, ChunkStream
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, pixel_limit

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.references.chunk_orders import reordered, size_order, spark_order

Tree = tuple[Splats, LodTree]

#: The orders by name; each makes the same tree of a tree.
ORDERS: dict[str, Callable[[Splats, LodTree], Tree]] = {
    "ours": arrange,
    "Spark's": lambda splats, tree: reordered(splats, tree, spark_order(splats, tree)),
    "by size": lambda splats, tree: reordered(splats, tree, size_order(splats, tree)),
}

#: 20 Mbit/s, 60 ms, and Spark's three fetchers.
NETWORK = Network(20e6 / 8, 0.06)

#: Budgets, as shares of the leaves; in turn for views, and for paths.
SHARES, SHARE = (0.05, 0.1, 0.2, 0.4, 0.8), 0.4

#: Picture of a camera, pixels; its vertical field of view, degrees; frames a second and frames of a path.
SIZE, FOV, FPS, FRAMES = (1920, 1080), 60.0, 10, 100

#: The share of a cut's nodes at which it counts as resident.
MOST = 0.9


def camera(eye: np.ndarray, target: np.ndarray, at: float = 0.0) -> Camera:
    """A camera with the y axis down, as scenes of 3DGS have it."""
    focal = SIZE[1] / (2 * math.tan(math.radians(FOV) / 2))
    return Camera(look_at(eye, target, (0, -1, 0)), *SIZE, (focal, focal), (SIZE[0] / 2, SIZE[1] / 2), at)


def on_sphere(rng: np.random.Generator, low: float, high: float) -> np.ndarray:
    """A direction at an elevation between bounds, radians."""
    turn, up = rng.uniform(0, 2 * np.pi), rng.uniform(low, high)
    return np.array([np.cos(turn) * np.cos(up), -np.sin(up), np.sin(turn) * np.cos(up)])


def views(centers: np.ndarray, count: int, seed: int) -> list[Camera]:
    """Random views, in turn from outside towards the scene and from inside in any direction."""
    rng = np.random.default_rng(seed)
    middle, radius = framing(centers)
    low, high = np.percentile(centers, [5, 95], axis=0)
    found = []
    for number in range(count):
        if number // len(SHARES) % 2 == 0:
            eye = middle + on_sphere(rng, -0.1, 0.7) * radius * np.exp(rng.uniform(np.log(0.8), np.log(3)))
            found.append(camera(eye, middle + rng.normal(0, radius / 6, 3)))
        else:
            eye = rng.uniform(low, high)
            found.append(camera(eye, eye + on_sphere(rng, -0.4, 0.4)))
    return found


def paths(centers: np.ndarray, seed: int) -> dict[str, list[Camera]]:
    """An orbit, a dolly, a walk through the scene and a random walk, each of 10 seconds."""
    rng = np.random.default_rng(seed)
    middle, radius = framing(centers)
    low, high = np.percentile(centers, [5, 95], axis=0)
    along = np.linspace(0, 1, FRAMES)[:, None]
    turn = 2 * np.pi * along
    orbit = middle + 1.5 * radius * np.hstack([np.sin(turn), 0 * turn - 0.4, np.cos(turn)])
    dolly = middle + np.array([[0, -0.3, -1.0]]) * radius * 4 * 0.05**along
    through = low + (high - low) * np.hstack([along, 0 * along + 0.5, 0.5 + 0.3 * np.sin(turn)])
    steps = np.cumsum(rng.normal(size=(FRAMES, 3)), axis=0) / np.sqrt(FRAMES)
    walk = np.clip(middle + steps * (high - low) / 2, low, high)
    gaze = np.cumsum(rng.normal(0, 0.2, FRAMES))
    ahead = np.stack([np.cos(gaze), 0 * gaze, np.sin(gaze)], axis=1)
    looks = {
        "orbit": (orbit, np.broadcast_to(middle, orbit.shape)),
        "dolly": (dolly, np.broadcast_to(middle, dolly.shape)),
        "walk through": (through, through + np.gradient(through, axis=0)),
        "random walk": (walk, walk + ahead),
    }
    return {
        name: [camera(eye, target, number / FPS) for number, (eye, target) in enumerate(zip(*points, strict=True))]
        for name, points in looks.items()
    }


@dataclass
class Viewer:
    """A viewer of a file: Spark's cuts, and a stream of its chunks."""

    scenes: Scenes
    traversal: PackageViewer

    @classmethod
    def of(cls, path: Path) -> Viewer:
        """A viewer with Spark's foveation."""
        scenes = read_scenes([Instance(path, "scene")], threads=processors())
        return cls(scenes, scenes.viewer(LodSettings()))

    def cut(self, at: Camera, share: float, resident: np.ndarray | None = None) -> TreeCut:
        """The cut with a budget of a share of the leaves."""
        smallest = pixel_limit(at.fov_y, at.height)
        budget = max(1, round(share * self.scenes.leaves))
        return self.traversal.cut(at, budget=budget, smallest=smallest, resident=resident)

    def per_chunk(self, at: Camera, share: float) -> np.ndarray:
        """The share of the whole cut's nodes that each chunk has."""
        nodes = self.cut(at, share).indices()[0]
        return np.bincount(nodes // CHUNK_NODES, minlength=self.scenes.forest.chunks) / len(nodes)

    def stream(self) -> ChunkStream:
        """A cold start."""
        held = self.scenes.with_cuts
        stream = ChunkStream(Chunks([each.requests for each in held], [each.headers for each in held]), NETWORK)
        stream.want([])
        return stream

    def cold(self, at: Camera, share: float) -> tuple[int, float]:
        """Bytes and seconds until `MOST` of the cut is resident, from a cold start."""
        stream, per_chunk = self.stream(), self.per_chunk(at, share)
        while per_chunk[stream.cache.resident()].sum() < MOST:
            stream.want(self.cut(at, share, stream.cache.resident()).wanted())
            while not stream.take_arrivals() and stream.step():
                pass
        return stream.received, stream.now

    def along(self, path: list[Camera], share: float) -> tuple[int, float, float]:
        """Bytes of the path, the mean share of its cuts that is resident, and that of frames with `MOST` of it."""
        stream, shares = self.stream(), []
        for at in path:
            stream.advance(at.time)
            resident = stream.cache.resident()
            stream.want(self.cut(at, share, resident).wanted())
            shares.append(float(self.per_chunk(at, share)[resident].sum()))
        return stream.received, float(np.mean(shares)), float(np.mean(np.array(shares) >= MOST))


def trees(arguments: argparse.Namespace) -> Iterator[tuple[str, Tree]]:
    """The trees to measure, by name."""
    for path in arguments.scenes:
        splats = load(path)
        if arguments.tiles:
            splats = tiled(splats.with_max_sh(0), arguments.tiles)
        for method in arguments.methods:
            tree = sparklod.build_lod(Scene(splats), method=method)
            assert tree.tree is not None
            yield f"{path.stem}{' tiled' if arguments.tiles else ''}, {method}", (tree.splats, tree.tree)


def row(*cells: object) -> None:
    """Prints a row of a Markdown table."""
    print(
        "| " + " | ".join(f"{cell:,.2f}" if isinstance(cell, float) else str(cell) for cell in cells) + " |", flush=True
    )


def main() -> None:
    """Prints two Markdown tables for each tree: views, and paths."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+", help="splat files")
    parser.add_argument("--methods", nargs="*", default=["quick", "quality"], help="builders")
    parser.add_argument("--tiles", type=int, default=0, help="tile each scene to this many splats")
    parser.add_argument("--views", type=int, default=50, help="number of views")
    parser.add_argument("--seed", type=int, default=0, help="of views and paths")
    arguments = parser.parse_args()
    for name, tree in trees(arguments):
        chunks = -(-len(tree[1]) // CHUNK_NODES)
        print(f"\n## {name}: {len(tree[1]):,} nodes, {chunks} chunks\n")
        made = []
        options = rad.settled(Scene(*tree), DEFAULTS)  # the same for all orders
        with tempfile.TemporaryDirectory() as folder:
            for order, make in ORDERS.items():
                start = time.perf_counter()
                scene = Scene(*make(*tree))
                seconds = time.perf_counter() - start
                path = Path(folder) / f"{len(made)}.rad"
                path.write_bytes(b"".join(rad.encode(scene, options, threads=processors())))
                made.append((order, seconds, path.stat().st_size, Viewer.of(path)))
        centers = tree[0].center[tree[1].is_leaf]
        around = views(centers, arguments.views, arguments.seed)
        row("order", "file, MB", "s", "chunks touched", "95 %", "MB to 90 %", "95 %", "s to 90 %")
        row(*["---"] * 8)
        for order, seconds, size, viewer in made:
            budgets = [SHARES[number % len(SHARES)] for number in range(len(around))]
            touched = [len(viewer.cut(at, share).wanted()) for at, share in zip(around, budgets, strict=True)]
            cold = np.array([viewer.cold(at, share) for at, share in zip(around, budgets, strict=True)])
            megabytes = cold[:, 0] / 1e6
            row(
                *(order, size / 1e6, seconds, float(np.mean(touched)), float(np.percentile(touched, 95))),
                *(float(megabytes.mean()), float(np.percentile(megabytes, 95)), float(cold[:, 1].mean())),
            )
        print()
        row("path", "order", "MB to 90 % of the first cut", "MB on the path", "resident", "frames with 90 %")
        row(*["---"] * 6)
        for kind, path_ in paths(centers, arguments.seed).items():
            for order, _, _, viewer in made:
                first, (received, mean, frames) = viewer.cold(path_[0], SHARE), viewer.along(path_, SHARE)
                row(kind, order, first[0] / 1e6, received / 1e6, mean, frames)


if __name__ == "__main__":
    main()
