"""How well errors of regions choose their detail levels: measured on pictures, the tree's own, or distance alone.

For each scene, regions and levels are made from its quality tree; a budget of splats is then spent region by region,
and the pictures are compared with those of full detail. Prints the mean PSNR in dB over the views,
and that of each view.

    python benchmarks/bench_region_errors.py scene.ply ... [--regions 64] [--widths 32 64 128 256]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import sparklod_cli
from sparklod_cli.bake import parts_output
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.lod import quality
from sparklod_cli.lod.parts import detail_cuts, make_levels, owners_of
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.gaussian import covariance
from sparklod_cli.model.instances import DetailScene
from sparklod_cli.render import rasterizer
from sparklod_cli.render.rasterizer import shade
from sparklod_cli.render.render_settings import RasterSettings
from sparklod_cli.system.progress import silent

SHARES = (0.5, 0.25, 0.12, 0.06)
BUDGETS = (0.1, 0.2, 0.4)
SIZE = (480, 270)

#: Row and column of the variances of a covariance xx xy xz yy yz zz on the planes xy, xz and yz.
PLANES = ((0, 3, 1, 0, 1), (0, 5, 2, 0, 2), (3, 5, 4, 1, 2))


def products(nodes, first, second):
    """Integrals of products of splats `first` and `second` of a tree, over three planes, of colour and opacity."""
    cov = covariance(nodes.scale, nodes.quat_xyzw)
    height = np.minimum(nodes.opacity.astype(np.float64), 1)
    color = np.concatenate([nodes.rgb.astype(np.float64), np.ones((len(nodes), 1))], 1) * height[:, None]
    total = np.zeros(len(first))
    offset = nodes.center[second].astype(np.float64) - nodes.center[first]
    a, b = cov[first], cov[second]
    for xx, yy, xy, across, along in PLANES:
        sxx, syy, sxy = a[:, xx] + b[:, xx], a[:, yy] + b[:, yy], a[:, xy] + b[:, xy]
        dets = [np.maximum(c[:, xx] * c[:, yy] - c[:, xy] ** 2, 0) for c in (a, b)]
        det = np.maximum(sxx * syy - sxy**2, 1e-300)
        x, y = offset[:, across], offset[:, along]
        power = np.clip((syy * x * x - 2 * sxy * x * y + sxx * y * y) / (2 * det), 0, 60)
        total += 2 * np.pi * np.sqrt(dets[0] * dets[1] / det) * np.exp(-power)
    return total * (color[first] * color[second]).sum(1)


def merging_errors(nodes, tree):
    """(M,) squared difference of each node to its children, in closed form; and (M,) each node's own energy."""
    every = np.arange(len(tree))
    own = products(nodes, every, every)
    inner = np.flatnonzero(tree.child_count)
    counts = tree.child_count[inner].astype(np.int64)
    parent = np.repeat(inner, counts)
    child = np.repeat(tree.child_start[inner].astype(np.int64) - np.cumsum(counts) + counts, counts)
    child += np.arange(len(child))
    error = np.zeros(len(tree))
    error[inner] = own[inner]
    np.add.at(error, parent, own[child] - 2 * products(nodes, parent, child))
    for step in range(1, int(counts.max())):  # pairs of siblings
        left = np.flatnonzero(child + step < np.repeat(tree.child_start[inner].astype(np.int64) + counts, counts))
        np.add.at(error, parent[left], 2 * products(nodes, child[left], child[left] + step))
    return np.maximum(error, 0), own


def tree_errors(nodes, tree, scene: DetailScene):
    """(R, L) the tree's own errors: those of all merges below the nodes of a level, by the energy of the leaves."""
    error, own = merging_errors(nodes, tree)
    below = error.copy()  # children come after their parents
    cuts, parent = detail_cuts(nodes, tree, SHARES)
    for node in range(len(tree) - 1, 0, -1):
        below[parent[node]] += below[node]
    owner = owners_of(parent, cuts[-1])
    # Regions of the nodes of the coarsest level, found by centres in the runs.
    last = scene.levels - 1
    place = {tuple(c): r for r in range(scene.regions) for c in scene.splats.center[scene.run(r, last)].tolist()}
    region = np.array([place[tuple(c)] for c in nodes.center[cuts[-1]].tolist()])
    sums = [np.bincount(region[owner[level]], below[level], scene.regions) for level in cuts]
    energy = np.bincount(region[owner[cuts[0]]], own[cuts[0]], scene.regions)
    return np.maximum.accumulate(np.stack(sums, 1) / energy[:, None], axis=1)


def by_errors(scene: DetailScene, errors, weight, camera: Camera, budget: int):
    """Levels, refined one by one where the error falls most, by splat, for the solid angle of a region and a weight."""
    middle = scene.bounds.mean(axis=1)
    radius = np.linalg.norm(scene.bounds[:, 1] - scene.bounds[:, 0], axis=1) / 2
    angle = (radius / np.maximum(np.linalg.norm(middle - camera.position, axis=1), radius)) ** 2
    every = np.arange(scene.regions)
    level = np.full(scene.regions, scene.levels - 1)
    while True:
        counts = scene.counts[every, level]
        more = scene.counts - counts[:, None]
        gain = (angle * weight)[:, None] * (errors[every, level][:, None] - errors) / np.maximum(more, 1)
        gain[(more <= 0) | (counts.sum() + more > budget)] = 0
        region, finer = np.unravel_index(np.argmax(gain), gain.shape)
        if not gain[region, finer] > 0:
            return level
        level[region] = finer


def by_distance(scene: DetailScene, camera: Camera, budget: int):
    """Levels of distances that grow threefold from level to level, as near as the budget allows."""
    nearest = np.clip(camera.position, scene.bounds[:, 0], scene.bounds[:, 1])
    distance = np.maximum(np.linalg.norm(nearest - camera.position, axis=1), 1e-6)
    best = np.full(scene.regions, scene.levels - 1)
    for base in np.geomspace(distance.min() / 1000, distance.max() * 2, 400):
        level = np.clip(np.ceil(np.log(distance / base) / np.log(3)), 0, scene.levels - 1).astype(int)
        if scene.counts[np.arange(scene.regions), level].sum() <= budget:
            best = level
    # What is left goes to the nearest regions.
    spent = int(scene.counts[np.arange(scene.regions), best].sum())
    for r in np.argsort(distance):
        while best[r] and spent + scene.counts[r, best[r] - 1] - scene.counts[r, best[r]] <= budget:
            spent += int(scene.counts[r, best[r] - 1] - scene.counts[r, best[r]])
            best[r] -= 1
    return best


def picture(splats, camera):
    """The rasterizer's picture of plain splats."""
    return rasterizer.draw(shade([(splats, np.eye(4))], camera), camera, RasterSettings())


def brightness(scene: DetailScene):
    """(R,) mean square of the pictures of each region at full detail."""
    runs = np.stack([scene.starts, scene.counts], 2)
    widths = parts_output._widths(scene, runs)
    return parts_output._differences(scene, runs, 1, silent)[:, 0] / widths**2


def cameras_of(scene: DetailScene):
    """Three around the scene, and three near to its parts."""
    center = scene.splats.center[scene.level(0)].astype(np.float64)
    low, high = np.quantile(center, [0.02, 0.98], axis=0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    found = []
    for k, (far, up) in enumerate([(1.0, 0.2), (0.8, 0.5), (0.9, 0.1), (0.45, 0.15), (0.4, 0.25), (0.35, 0.05)]):
        angle = 2.4 * k
        eye = middle + size * far * np.array([np.cos(angle), -up, np.sin(angle)])
        found.append(Camera.look_at(eye.tolist(), middle.tolist(), size=SIZE))
    return found


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--regions", type=int, default=64)
    parser.add_argument("--widths", type=int, nargs="*", default=[32, 64, 128, 256])
    options = parser.parse_args()
    for path in options.scenes:
        splats = sparklod_cli.read(path).splats
        count = len(splats)
        nodes, tree = quality.build(splats, 2.0)
        most = max(1, int(count * (1 + sum(SHARES)) / options.regions))
        scene = make_levels(nodes, tree, DetailSettings(levels=SHARES, chunk_splats=most, extent=1e9, min_splats=1))
        ways = {"tree": tree_errors(nodes, tree, scene)}
        for width in options.widths:
            parts_output.LEAST_WIDTH, parts_output.MOST_WIDTH = min(width, 64), width
            began = time.process_time()
            ways[f"pictures-{width}"] = parts_output.measured(scene, threads=1)
            seconds = time.process_time() - began
            print(f"{path.stem}: pictures of {width}, {seconds:.2f} s of a processor for {len(scene.splats):,} splats")
        best = ways[f"pictures-{options.widths[-1]}"]
        for name, errors in ways.items():
            orders = [each[:, 1:].argsort(axis=0).argsort(axis=0) for each in (errors, best)]
            same = [np.corrcoef(a, b)[0, 1] for a, b in zip(orders[0].T, orders[1].T, strict=True)]
            ratio = np.median(errors[:, 1:] / best[:, 1:], axis=0)
            print(f"{path.stem}: {name}, rank correlation {np.round(same, 3)}, ratio {np.round(ratio, 3)}")
        bright = brightness(scene)
        plans = {"distance": None}
        plans |= {name: (errors, np.ones(scene.regions)) for name, errors in ways.items()}
        plans |= {f"{name} by brightness": (errors, bright) for name, errors in ways.items()}
        views = cameras_of(scene)
        full = [picture(scene.splats.take(scene.level(0)), camera) for camera in views]
        for budget in BUDGETS:
            most = int(budget * count)
            for name, plan in plans.items():
                found = []
                for camera, whole in zip(views, full, strict=True):
                    level = by_errors(scene, *plan, camera, most) if plan else by_distance(scene, camera, most)
                    runs = map(scene.run, range(scene.regions), level)
                    seen = picture(
                        scene.splats.take(np.concatenate([np.arange(r.start, r.stop) for r in runs])), camera
                    )
                    found.append(-10 * np.log10(((seen[..., :3].astype(float) - whole[..., :3]) ** 2).mean()))
                each = " ".join(f"{value:.1f}" for value in found)
                print(
                    f"{path.stem}: {scene.regions} regions, {100 * budget:g} %, {name}: {np.mean(found):.2f} ({each})",
                    flush=True,
                )


if __name__ == "__main__":
    main()
