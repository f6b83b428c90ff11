"""The law of options: what somebody gives is used, or refused by its name, in every mode of `sparklod render`.

Used means that something comes out differently. A new option without a row in `GIVEN` fails.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cli import run
from sparklod_cli.codecs import ply
from sparklod_cli.commands.render import render as command
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.scene import Scene
from sparklod_cli.render import renderer
from sparklod_cli.render.rasterizer import Image, ShadedSplats
from sparklod_cli.render.render_settings import RasterSettings
from tests.conftest import FIXTURES, Capture
from tests.lod.trees import row_of_regions
from tests.part_files import tiled, write_streamed
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

CAMERAS = FIXTURES / "cameras"
AT = ("--look-at", "0.5,-0.2,-2:0,0.1,0")

#: More trees, each a chunk.
MORE = ("second.spz", "third.spz")

#: By option: what it takes to mean anything, and how it is given, so that it makes a difference.
GIVEN: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "files": ((), (str(FIXTURES / "sh1.ply"),)),
    "scene": ((), ("--scene", "scene.json")),
    "precision": (("--budget", "150"), ("--precision", "packed")),
    "camera_path": ((), ("--camera-path", str(CAMERAS / "inria.json"))),
    "camera_format": (("--camera-path", str(CAMERAS / "inria.json")), ("--camera-format", "colmap")),
    "camera_axes": (("--camera-path", str(CAMERAS / "inria.json")), ("--camera-axes", "opengl-c2w")),
    "orbit": ((), ("--orbit", "2")),
    "dolly": ((), ("--dolly", "--every", "20")),
    "look_at": ((), ("--look-at", "1,0,-3:0,0,0")),
    "keyframes": ((), ("--keyframes", "1,0,-3:0,0,0 1,0,3:0,0,0", "--every", "20")),
    "views": ((), ("--view", "1,0,-3:0,0,0")),
    "center": ((), ("--center", "0.5,0,0")),
    "distance": ((), ("--distance", "3")),
    "elevation": ((), ("--elevation", "60")),
    "up": ((), ("--up", "0,0,1")),
    "seconds": ((), ("--seconds", "3")),
    "world_transform": ((), ("--world-transform", "1,0,0,0.3,0,1,0,0,0,0,1,0,0,0,0,1")),
    "size": ((), ("--size", "40x40")),
    "fov": ((), ("--fov", "30")),
    "fps": ((), ("--fps", "7")),
    "every": ((), ("--every", "2")),
    "sheet": ((), ("--sheet", "-o", "other.png")),
    "budget": ((), ("--budget", "50")),
    "preset": ((), ("--preset", "quest", "--lod-splat-scale", "1e-4")),
    "lod_splat_scale": ((), ("--lod-splat-scale", "1e-5")),
    "budget_mode": (("--budget", "1M"), ("--budget-mode", "limit")),
    "lod_base_distance": (("--budget-mode", "limit", "--budget", "1M"), ("--lod-base-distance", "1")),
    "lod_multiplier": ((), ("--lod-multiplier", "1.2")),
    "lod_behind_penalty": ((), ("--lod-behind-penalty", "9")),
    "lod_underfill": (("--after", "9s", "--bandwidth", "100kbit"), ("--lod-underfill", "2")),
    "lod_render_scale": ((), ("--lod-render-scale", "30")),
    "pixel_scale_limit": ((), ("--pixel-scale-limit", "1")),
    "cone_fov0": (("--budget", "90"), ("--cone-fov0", "0")),
    "cone_fov": (("--budget", "90"), ("--cone-fov0", "0", "--cone-fov", "5")),
    "cone_foveate": (("--budget", "90", "--cone-fov0", "0"), ("--cone-foveate", "0.01")),
    "outside_foveate": (("--budget", "90", "--fov", "10"), ("--outside-foveate", "0.01")),
    "behind_foveate": (("--budget", "90"), ("--cone-fov0", "0", "--cone-fov", "5", "--behind-foveate", "0.9")),
    "full": (("--budget", "50"), ("--full",)),
    "after": (("--bandwidth", "1kbit"), ("--after", "1s")),
    "bandwidth": (("--after", "1s"), ("--bandwidth", "1kbit")),
    "latency": (("--after", "1s", "--bandwidth", "1Gbit"), ("--latency", "2s")),
    "fetchers": ((*MORE, "--after", "2s", "--bandwidth", "1Gbit", "--latency", "1.5s"), ("--fetchers", "1")),
    "chunk_cache": ((*MORE, "--after", "1s", "--bandwidth", "1Gbit"), ("--chunk-cache", "1")),
    "background": ((), ("--background", "#123456")),
    "alpha": ((), ("--alpha",)),
    "supersample": ((), ("--supersample", "2")),
    "near": ((), ("--near", "2")),
    "far": ((), ("--far", "2")),
    "continuous": (("--budget", "90"), ("--continuous",)),
    "blend": (("--budget", "90", "--continuous"), ("--blend", "2")),
    "style": ((), ("--style", "points")),
    "color_by": ((), ("--color-by", "size")),
    "no_bar": (("--color-by", "size", "--size", "400x240"), ("--no-bar",)),
    "through": ((), ("--through", "packed")),
    "profile": (("--budget", "20", "--size", "200x150"), ("--profile", "shifted")),
    "sort": (("--fov", "150"), ("--sort", "z")),
    "sorting": (("--backend", "osmesa"), ("--sorting", "counting16")),
    "sort_throttle": (("--backend", "osmesa"), ("--sort-throttle", "2")),
    "backend": ((), ("--backend", "osmesa")),
    "compare": ((), ("--compare", "-o", "other.csv")),
    "asserts": ((), ("--assert", "psnr>1000")),
    "plot": ((), ("--plot", "plot.png")),
    "max_sh": ((), ("--max-sh", "0")),
    "diff": ((), ("--diff", "other.ply")),
    "gain": (("--diff", "other.ply"), ("--gain", "0.5")),
    "output": ((), ("-o", "other.webp")),
    "thumbnail": ((), ("--thumbnail",)),
    "jpeg_quality": (("-o", "other.jpg"), ("--jpeg-quality", "10")),
}

#: Where the tree lies in its own space.
AWAY = 1000.0

#: Options that change how work is done, or what is said, and nothing that comes out.
OF_WORK = {"device", "overwrite", "jobs", "threads", "quiet", "verbose", "as_json"}

MODES: dict[str, tuple[str, ...]] = {
    "a still": (*AT, "-o", "out.png"),
    "a view of the scene": ("-o", "out.png"),
    "a file without a tree": (*AT, "-o", "out.png"),
    "Streamed SOG": ("--look-at", "0,0,7:0,0,20", "--budget", "200", "-o", "out.png"),
    "3D Tiles": ("--look-at", "0,0,-4:0,0,0", "-o", "out.png"),
    "full": (*AT, "--full", "-o", "out.png"),
    "views": ("--view", "1,0,-2:0,0,0", "--view", "0,1,-2:0,0,0", "-o", "out.png"),
    "frames": ("--orbit", "3", "--distance", "2", "-o", "out.%d.png"),
    "an animation": ("--dolly", "--every", "20", "-o", "out.gif"),
    "a sheet": ("--orbit", "3", "--distance", "2", "--sheet", "-o", "out.webp"),
    "a camera path": ("--camera-path", str(CAMERAS / "splat-transform.json"), "-o", "out.%d.webp"),
    "keyframes": ("--keyframes", "1,0,-2:0,0,0 1,0,2:0,0,0", "--every", "15", "-o", "out.%d.png"),
    "floats": (*AT, "-o", "out.npy"),
    "a JPEG": (*AT, "-o", "out.jpg"),
    "points": (*AT, "--style", "points", "-o", "out.png"),
    "billboards": (*AT, "--style", "billboards", "-o", "out.png"),
    "sorted billboards": (*AT, "--style", "sorted-billboards", "-o", "out.png"),
    "levels": (*AT, "--color-by", "level", "-o", "out.png"),
    "depth": (*AT, "--color-by", "depth", "-o", "out.png"),
    "depths": (*AT, "--color-by", "depth", "-o", "out.npy"),
    "overdraw": (*AT, "--color-by", "overdraw", "-o", "out.png"),
    "an encoding": (*AT, "--through", "ext", "-o", "out.png"),
    "a difference": (*AT, "--diff", "plain.ply", "-o", "out.png"),
    "osmesa": ("--orbit", "3", "--distance", "2", "--backend", "osmesa", "-o", "out.%d.png"),
    "open3d": (*AT, "--backend", "open3d", "-o", "out.png"),
    "a comparison": (*AT, "--compare", "-o", "out.csv"),
    "a comparison along a path": (
        "--orbit",
        "3",
        "--distance",
        "2",
        "--compare",
        "--budget",
        "50,20%",
        "-o",
        "out.csv",
    ),
    "a comparison by osmesa": ("--orbit", "3", "--distance", "2", "--compare", "--backend", "osmesa", "-o", "out.csv"),
}

#: Options that ask for what is so already: nothing is outside of a view of all, floats keep alpha, and as many splats
#: cover a pixel in either profile, unless they are more opaque than these.
THE_SAME = {
    "a view of the scene": {"outside_foveate", "cone_foveate"},
    "floats": {"alpha"},
    "overdraw": {"profile"},
    "sorted billboards": {"sort"},
}

Came = tuple[int, dict[str, bytes], Any, str]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of a few hundred splats with SH, and its tree, which lies where half floats are coarse."""
    folder = tmp_path_factory.mktemp("options")
    splats = random_splats(400, sh_degree=3)
    (folder / "plain.ply").write_bytes(b"".join(ply.encode(Scene(splats))))
    (folder / "other.ply").write_bytes(b"".join(ply.encode(Scene(splats.take(np.arange(0, 400, 2))))))
    away = dataclasses.replace(splats, center=splats.center + np.float32([AWAY, 0, 0]))
    (folder / "away.ply").write_bytes(b"".join(ply.encode(Scene(away))))
    assert run(["build-lod", str(folder / "away.ply"), "-o", str(folder / "tree.spz"), "-q"]) == 0
    for tree, file in zip(MORE, ("other.ply", "plain.ply"), strict=True):
        assert run(["build-lod", str(folder / file), "-o", str(folder / tree), "-q"]) == 0
    write_streamed(folder / "web", row_of_regions(8, 4), together=4)
    tiled(splats, folder / "city", TileSettings(tile_splats=100))
    there = {"file": "tree.spz", "translation": [-AWAY, 0, 0]}
    (folder / "back.json").write_text(json.dumps({"instances": [there]}))
    twice = [there, there | {"translation": [1 - AWAY, 0, 0]}]
    (folder / "scene.json").write_text(json.dumps({"instances": twice}))
    return folder


@pytest.mark.parametrize("mode", MODES)
def test_every_option_of_render_is_used_or_refused(
    mode: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(folder)
    inputs = set(folder.iterdir())
    known: dict[tuple[str, ...], Came] = {}
    asked: list[Any] = []
    draw = renderer.draw_styled

    def recorded(
        style: str, backend: str, shown: ShadedSplats, camera: Camera, look: RasterSettings, options: Any = None
    ) -> Image:
        if style == "splats":
            asked.append((backend, look, options))  # pictures of 8 bits do not show it all
        return draw(style, backend, shown, camera, look, options)

    monkeypatch.setattr(renderer, "draw_styled", recorded)

    def came(*arguments: str) -> Came:
        if arguments not in known:
            others = {"a file without a tree": ("plain.ply",), "Streamed SOG": ("web",), "3D Tiles": ("city",)}
            scene = others.get(mode, ("--scene", "back.json"))
            size = () if "--size" in arguments else ("--size", "48x32")
            asked.clear()
            code = run(["render", *scene, *MODES[mode], *size, "--json", *arguments])
            out, err = capsys.readouterr()
            written = {path.name: path.read_bytes() for path in folder.iterdir() if path not in inputs}
            for name in written:
                (folder / name).unlink()
            said = json.loads(out) if code == 0 else {}
            said.pop("seconds", None)
            known[arguments] = code, written, (said, list(asked)), err
        return known[arguments]

    code, written, _, err = came()
    if code == 1 and mode in ("osmesa", "open3d", "a comparison by osmesa"):
        pytest.skip(err)
    assert (code, bool(written)) == (0, True), err
    ignored = []
    for name, (needs, given) in GIVEN.items():
        if name in THE_SAME.get(mode, ()) or all(part in MODES[mode] for part in given):
            continue
        before, after = came(*needs), came(*needs, *given)
        if after[0] in (1, 2):
            assert "error: " in after[3].lower() and not after[1], (name, after[3])
        elif after[:3] == before[:3]:
            ignored.append(name)
    assert " ".join(ignored) == ""


def test_every_option_of_render_has_a_row() -> None:
    assert {param.name for param in command.params} == set(GIVEN) | OF_WORK | {"version", "help_all"}
