"""How much of a picture RAD's rounding loses, beside Spark's encodings and LoD SPZ: `bench_rad_rounding.py --help`.

All files have the same tree, and all pictures the same nodes: those of the cut that the tree has before it is rounded.
"""

from __future__ import annotations

import argparse
import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from fidelity_report import add_docs, columns, markdown, put_into
from fidelity_views import cameras_of, count_of, difference
from scenes import load

import sparklod_cli as sparklod
from sparklod_cli import Splats
from sparklod_cli.codecs import layouts, spz
from sparklod_cli.codecs.formats import DEFAULTS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.model.sh import COEFFICIENTS

#: The encodings that Spark's program chooses for a tree, and the ranges that it widens if many values are outside.
SPARK = RadOptions("f32_lebytes", "f16", "r8_delta", "ln_0r8", "oct88r8", "s8")
SPARK_RANGES = SplatEncoding(lod_opacity=True)

#: Most nodes of the first cut are merged; the second is full detail.
BUDGETS = ("25%", "100%")


@dataclass(frozen=True)
class Way:
    """A file that a tree is written to and read from.

    Attributes:
        name: in tables.
        read: the splats of the tree in the file, and its size in bytes.
    """

    name: str
    read: Callable[[sparklod.Tree], tuple[Splats, int]]


def through_spz(tree: sparklod.Tree) -> tuple[Splats, int]:
    """Through our LoD SPZ."""
    data = b"".join(spz.encode(tree, threads=2))
    return decode_file(spz, io.BytesIO(data), threads=2).splats, len(data)


def through_rad(tree: sparklod.Tree, options: WriteOptions = DEFAULTS) -> tuple[Splats, int]:
    """Through RAD."""
    data = b"".join(rad.encode(tree, options, threads=2))
    return decode_file(rad, io.BytesIO(data), threads=2).splats, len(data)


def through_sparks_encodings(tree: sparklod.Tree) -> tuple[Splats, int]:
    """Through RAD as Spark's program writes it, which goes by quantiles: of scales by those of the larger two."""
    low, high = np.quantile(tree.splats.rgb, [0.01, 0.99])
    logs = np.log(np.sort(tree.splats.scale, axis=1)[:, 1:].clip(1e-30))
    least, most = np.quantile(logs, [0.01, 0.99])
    tops = {}
    for degree in range(1, tree.splats.sh_degree + 1):
        ends = np.quantile(tree.splats.sh[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]], [0.05, 0.95])
        tops[f"sh{degree}_max"] = max(1.0, *np.abs(ends).tolist())
    ranges = replace(
        SPARK_RANGES,
        rgb_min=min(float(low), SPARK_RANGES.rgb_min),
        rgb_max=max(float(high), SPARK_RANGES.rgb_max),
        ln_scale_min=min(float(least), SPARK_RANGES.ln_scale_min),
        ln_scale_max=max(float(most), SPARK_RANGES.ln_scale_max),
        **tops,
    )
    return through_rad(tree, WriteOptions(rad=replace(SPARK, ranges=ranges)))


def paged(way: Way) -> Way:
    """The same file in Spark's pages of PackedSplats, which always have Spark's own ranges."""

    def read(tree: sparklod.Tree) -> tuple[Splats, int]:
        splats, size = way.read(tree)
        return layouts.unpack_packed(layouts.pack_packed(splats, SPARK_RANGES), SPARK_RANGES), size

    return Way(f"{way.name}, in PackedSplats pages", read)


FILES = (
    Way("LoD SPZ", through_spz),
    Way("RAD, Spark's encodings", through_sparks_encodings),
    Way("RAD, ours", through_rad),
)


def measure(path: Path, method: str, size: tuple[int, int], views: int) -> Iterator[list[str]]:
    """Yield a row for each way."""
    tree = sparklod.build_lod(sparklod.Scene(load(path)), method=method)
    every = cameras_of("around", tree)
    cameras = [resized(camera, size) for camera in every[:: max(1, len(every) // views)]][:views]
    leaves = int(np.count_nonzero(tree.tree.is_leaf))
    settings = sparklod.LodSettings(foveation=sparklod.Cones(), pixel_scale_limit=0.0)
    cuts = {
        budget: [sparklod.cut(tree, camera, budget=count_of(budget, leaves), settings=settings) for camera in cameras]
        for budget in BUDGETS
    }
    exact = {
        budget: [sparklod.render(*each) for each in zip(found, cameras, strict=True)] for budget, found in cuts.items()
    }
    for way in (*FILES, *(paged(way) for way in FILES[1:])):
        splats, written = way.read(tree)
        cells = []
        for budget, found in cuts.items():
            decibels = []
            for one, camera, full in zip(found, cameras, exact[budget], strict=True):
                held = sparklod.Scene(splats.take(one.nodes[0]))
                decibels.append(difference(sparklod.render(held, camera), full))
            cells.append(f"{np.mean(decibels):.1f} ({min(decibels):.1f})")
        yield [path.name, way.name, f"{written / 1e6:.2f}", *cells]


def resized(camera: sparklod.Camera, size: tuple[int, int]) -> sparklod.Camera:
    """The same view in another size."""
    width, height = size
    focal = height / 2 / math.tan(camera.fov_y / 2)
    return replace(camera, width=width, height=height, focal=(focal, focal), principal=(width / 2, height / 2))


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="splat files")
    parser.add_argument("--method", choices=("quick", "quality"), default="quick", help="our builder")
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--views", type=int, default=4, help="of those that bench_fidelity.py looks from")
    add_docs(parser)
    arguments = parser.parse_args()
    rows = [
        row
        for scene in arguments.scenes
        for row in measure(scene, arguments.method, tuple(arguments.size), arguments.views)
    ]
    budgets = (f"{budget} of the leaves" for budget in columns(BUDGETS))
    table = markdown(["scene", "file", "MB", *budgets], rows)
    print(table)
    if arguments.docs:
        put_into(arguments.docs, {"rounding": table})


if __name__ == "__main__":
    main()
