"""Draws full detail beside cuts of one budget, of Spark's trees and of ours, with their figures.

SPARK_DIR=folder-with-node_modules python benchmarks/fidelity_pictures.py fine-structure docs/images/fine-structure.webp
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from bench_fidelity import MADE, scenes_of, size_of, sources
from fidelity_trees import METHODS, build
from fidelity_views import FOV_Y
from PIL import Image

import sparklod_cli as sparklod
from sparklod_cli.api.comparison import PicturePair, measured
from sparklod_cli.images.metrics import edges
from sparklod_cli.images.pixels import eight_bits, over, sheet

#: In front of the made scene, as (eye, target): tree, wires, fence and chart are in the picture.
FRONT = ((1.0, -1.9, -7.0), (0.5, -1.9, 0.0))

#: Of the file, a WebP with loss.
WEBP_QUALITY = 88


def point(text: str) -> tuple[float, ...]:
    """x, y and z between commas."""
    return tuple(map(float, text.split(",")))


def main() -> None:
    """Writes the picture and prints its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help=f"a splat file, or {', '.join(MADE)}, which is made")
    parser.add_argument("output", type=Path, help="the .webp to write")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="what builds trees")
    parser.add_argument("--budget", default="10%", help="share of the leaves, or a count (default 10%%)")
    parser.add_argument("--eye", type=point, default=FRONT[0], help="x,y,z of the camera, y being down")
    parser.add_argument("--target", type=point, default=FRONT[1], help="x,y,z that it looks at")
    parser.add_argument("--size", type=size_of, default=(560, 315), help="of each picture (default 560x315)")
    parser.add_argument("--steps", type=int, help="of refining; by default what suits the tree")
    parser.add_argument("--trees", type=Path, help="folder that keeps our trees, that of bench_fidelity.py --trees")
    parser.set_defaults(growth=1.4, sh=False)
    arguments = parser.parse_args()
    settings = sparklod.LodSettings(foveation=sparklod.Cones(), pixel_scale_limit=0.0)
    camera = sparklod.Camera.look_at(arguments.eye, arguments.target, fov_y=FOV_Y, size=arguments.size)
    with tempfile.TemporaryDirectory() as made:
        (path,) = scenes_of([arguments.scene], Path(made))
        source = next(sources(path, arguments))
        full = sparklod.render(source.drawn, camera)
        images, captions = [full], [f"full detail: {len(source.drawn):,} splats"]
        for method in arguments.methods:
            tree = build(source, method)
            cut = sparklod.cut(tree, camera, budget=arguments.budget, settings=settings, precision="float16")
            images.append(sparklod.render(cut, camera))
            row = measured(PicturePair({}, images[-1], full, edges(full), None))
            figures = f"{row['psnr']:.1f} dB, edges {row['edge_psnr']:.1f} dB, SSIM {row['ssim']:.3f}"
            captions.append(f"{METHODS[method]}, {arguments.budget}: {figures}")
            print(captions[-1], flush=True)
    whole = sheet([eight_bits(over(image, (0.0, 0.0, 0.0))) for image in images], captions)
    Image.fromarray(np.asarray(whole)).save(arguments.output, "WEBP", quality=WEBP_QUALITY, method=6)


if __name__ == "__main__":
    main()
