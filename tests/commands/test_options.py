"""The law of options: a value is used, or refused by the option's name, in every mode of `render` and `traverse`.

Used means that an output differs. A new option without a row fails.
"""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cli import COMMANDS
from sparklod_cli.cli import cli as program
from sparklod_cli.codecs.formats import RadOptions, SogOptions, WriteOptions
from sparklod_cli.commands.command import Option
from sparklod_cli.fitting.fit_settings import FitSettings
from sparklod_cli.images import charts
from sparklod_cli.lod.tree_settings import DetailSettings, TileSettings
from sparklod_cli.render import renderer
from sparklod_cli.render.rasterizer import Image, ShadedSplats
from sparklod_cli.render.render_settings import RasterSettings, RenderSettings
from sparklod_cli.system.setting_fields import CheckedSettings, Range, Setting, setting, settings_in
from sparklod_cli.viewers.viewer_settings import DetailRule, LodSettings, Network, StreamingSettings
from tests.commands.cli import Cli
from tests.lod.trees import row_of_regions
from tests.part_files import tiled, write_streamed
from tests.scenes import random_splats

# --- Values that no option takes --------------------------------------------------------------------------------------

SETTINGS = (
    *(RasterSettings, RenderSettings, LodSettings, DetailRule, DetailSettings, Network, StreamingSettings),
    *(FitSettings, RadOptions, WriteOptions),
)
DECLARED = [
    pytest.param(kind, field.name, declared, id=f"{kind.__name__}.{field.name}")
    for kind in SETTINGS
    for field, declared in settings_in(kind)
    if declared is not None
]


def params(command: str) -> list[click.Parameter]:
    found = program.get_command(click.Context(program), command)
    return [] if found is None else found.params


OPTIONS = [
    pytest.param(name, param, id=f"{name}-{param.name}")
    for name in COMMANDS
    for param in params(name)
    if isinstance(param, Option) and isinstance(param.declared.kind, (Range, tuple))
]


def outside(kind: Any) -> list[Any]:
    """Return values that a range, a quantity or a choice does not allow."""
    if isinstance(kind, tuple):
        return ["none of them"]
    bounds: Range | None = getattr(kind, "range", kind)
    if not isinstance(bounds, Range):
        return []
    ends = [(bounds.least, -1), (bounds.most, 1), (bounds.above, 0), (bounds.below, 0)]
    beyond = [end + (step if abs(end) < 2**53 else step * abs(end)) for end, step in ends if end is not None]
    return [*beyond, 10**400 if bounds.whole else math.nan]


@pytest.mark.parametrize(("command", "option"), OPTIONS)
def test_a_command_refuses_other_values(command: str, option: Option, cli: Cli) -> None:
    for value in (*outside(option.declared.kind), "word"):
        done = cli(command, f"{option.opts[0]}={value}", "a.spz", status=2)
        assert "--" + option.opts[0].lstrip("-") in done.err.splitlines()[-1]


@pytest.mark.parametrize(("kind", "name", "declared"), DECLARED)
def test_the_api_refuses_other_values_and_documents_the_field(kind: type[Any], name: str, declared: Setting) -> None:
    for value in outside(declared.kind):
        with pytest.raises(ValueError, match=r"is|there is no"):
            kind(**{name: value})
    for value in (True, "5") if not isinstance(declared.kind, tuple) else ():
        if getattr(declared.kind, "range", declared.kind) is not None:
            with pytest.raises(TypeError, match=f"^{name} is {value!r}; give a"):
                kind(**{name: value})
    assert kind(**{name: getattr(kind(), name)}) == kind()
    assert f"    {name}: {declared.help}" in (kind.__doc__ or "").splitlines()


@dataclass(frozen=True)
class Example(CheckedSettings):
    """An example.

    Attributes:
        plain: not declared.
    """

    plain: int = 0
    share: float | None = setting("Share of the splats.", Range(above=0, most=1))
    angle: float = setting("Field of view.", Range(above=0, below=180), 60.0)


@pytest.mark.parametrize(
    ("kind", "name", "value", "error", "message"),
    [
        (Example, "share", 0, ValueError, "share is 0; give more than 0 and at most 1"),
        (Example, "angle", 180, ValueError, "angle is 180; give more than 0 and less than 180"),
        (RadOptions, "sh_codes", 1, ValueError, "sh_codes is 1; give 2 to 65536"),
        (SogOptions, "sh_codes", 1, ValueError, "sh_codes is 1; give 2 to 65536"),
        (TileSettings, "lat", 47, ValueError, "lat and lon go together; give both"),
        (TileSettings, "heading", 47, ValueError, "height and heading are of a place; give lat and lon, too"),
        (RadOptions, "center_bits", 150, ValueError, "center_bits is 150; give -149 to 149"),
        (RadOptions, "center_bits", 1.5, TypeError, r"center_bits is 1\.5; give a whole number"),
    ],
)
def test_messages_say_what_a_setting_allows(
    kind: type[Any], name: str, value: float, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        kind(**{name: value})
    about = "Attributes:", "    plain: not declared.", "    share: Share of the splats.", "    angle: Field of view."
    assert Example.__doc__ == "\n".join(("An example.", "", *about))
    assert str(Range(2)) == "2 or more"


# --- Values that are used ---------------------------------------------------------------------------------------------

#: More trees, each a chunk.
MORE = "second.spz third.spz"
WORLD = "1,0,0,0.3,0,1,0,0,0,0,1,0,0,0,0,1"

#: Options of `render`: the options that it needs, and its own words with a value that makes a difference.
RENDER = {
    "files": ("", "sh1.ply"),
    "scene": ("", "--scene twice.json"),
    "precision": ("--budget 150", "--precision packed"),
    "camera_path": ("", "--camera-path inria.json"),
    "camera_format": ("--camera-path inria.json", "--camera-format colmap"),
    "camera_axes": ("--camera-path inria.json", "--camera-axes opengl-c2w"),
    "orbit": ("", "--orbit 2"),
    "dolly": ("", "--dolly --every 20"),
    "look_at": ("", "--look-at 1,0,-3:0,0,0"),
    "keyframes": ("", "--keyframes 1,0,-3:0,0,0;1,0,3:0,0,0 --every 20"),
    "views": ("", "--view 1,0,-3:0,0,0"),
    "center": ("", "--center 0.5,0,0"),
    "distance": ("", "--distance 3"),
    "elevation": ("", "--elevation 60"),
    "up": ("", "--up 0,0,1"),
    "seconds": ("", "--seconds 3"),
    "world_transform": ("", f"--world-transform {WORLD}"),
    "size": ("", "--size 40x40"),
    "fov": ("", "--fov 30"),
    "fps": ("", "--fps 7"),
    "every": ("", "--every 2"),
    "sheet": ("", "--sheet -o other.png"),
    "budget": ("", "--budget 50"),
    "preset": ("", "--preset quest --lod-splat-scale 1e-4"),
    "lod_splat_scale": ("", "--lod-splat-scale 1e-5"),
    "budget_mode": ("--budget 1M", "--budget-mode limit"),
    "lod_base_distance": ("--budget-mode limit --budget 1M", "--lod-base-distance 1"),
    "lod_multiplier": ("", "--lod-multiplier 1.2"),
    "lod_behind_penalty": ("", "--lod-behind-penalty 9"),
    "lod_underfill": ("--after 9s --bandwidth 100kbit", "--lod-underfill 2"),
    "lod_render_scale": ("", "--lod-render-scale 30"),
    "pixel_scale_limit": ("", "--pixel-scale-limit 1"),
    "cone_fov0": ("--budget 90", "--cone-fov0 0"),
    "cone_fov": ("--budget 90", "--cone-fov0 0 --cone-fov 5"),
    "cone_foveate": ("--budget 90 --cone-fov0 0", "--cone-foveate 0.01"),
    "outside_foveate": ("--budget 90 --fov 10", "--outside-foveate 0.01"),
    "behind_foveate": ("--budget 90", "--cone-fov0 0 --cone-fov 5 --behind-foveate 0.9"),
    "full": ("--budget 50", "--full"),
    "after": ("--bandwidth 1kbit", "--after 1s"),
    "bandwidth": ("--after 1s", "--bandwidth 1kbit"),
    "latency": ("--after 1s --bandwidth 1Gbit", "--latency 2s"),
    "fetchers": (f"{MORE} --after 2s --bandwidth 1Gbit --latency 1.5s", "--fetchers 1"),
    "chunk_cache": (f"{MORE} --after 1s --bandwidth 1Gbit", "--chunk-cache 1"),
    "background": ("", "--background #123456"),
    "alpha": ("", "--alpha"),
    "supersample": ("", "--supersample 2"),
    "near": ("", "--near 2"),
    "far": ("", "--far 2"),
    "continuous": ("--budget 90", "--continuous"),
    "blend": ("--budget 90 --continuous", "--blend 2"),
    "style": ("", "--style points"),
    "color_by": ("", "--color-by size"),
    "no_bar": ("--color-by size --size 400x240", "--no-bar"),
    "through": ("", "--through packed"),
    "profile": ("--budget 20 --size 200x150", "--profile shifted"),
    "sort": ("--fov 150", "--sort z"),
    "sorting": ("--backend osmesa", "--sorting counting16"),
    "sort_throttle": ("--backend osmesa", "--sort-throttle 2"),
    "backend": ("", "--backend osmesa"),
    "compare": ("", "--compare -o other.csv"),
    "asserts": ("", "--assert psnr>1000"),
    "plot": ("", "--plot plot.png"),
    "max_sh": ("", "--max-sh 0"),
    "diff": ("", "--diff other.ply"),
    "gain": ("--diff other.ply", "--gain 0.5"),
    "output": ("", "-o other.webp"),
    "thumbnail": ("", "--thumbnail"),
    "jpeg_quality": ("-o other.jpg", "--jpeg-quality 10"),
}

#: Options that only `traverse` has, or that take other values here.
TRAVERSE = {
    "files": ("", "hand-tree-v3.spz"),
    "scene": ("", "--scene large.json"),
    "precision": ("--budget 5k", "--precision ext"),
    "preset": ("", "--preset quest"),
    "lod_splat_scale": ("", "--lod-splat-scale 1e-4"),
    "cone_fov0": ("--budget 5k", "--cone-fov0 0"),
    "cone_fov": ("--budget 5k", "--cone-fov0 0 --cone-fov 5"),
    "cone_foveate": ("--budget 5k --cone-fov0 0", "--cone-foveate 0.01"),
    "outside_foveate": ("--budget 5k", "--outside-foveate 0.01"),
    "behind_foveate": ("--budget 5k", "--behind-foveate 0.001"),
    "lod_underfill": ("--bandwidth 100kbit", "--lod-underfill 2"),
    "distance": ("", "--distance 2"),
    "chunk_cache": ("", "--chunk-cache 2"),
    "bandwidth": ("", "--bandwidth 1Mbit"),
    "latency": ("--bandwidth 1Mbit", "--latency 90ms"),
    "fetchers": ("--bandwidth 1Mbit --latency 90ms", "--fetchers 1"),
    "output": ("", "-o table.csv"),
    "form": ("-o table", "--format json"),
    "per_instance": ("", "--per-instance"),
    "no_timing": ("", "--no-timing"),
    "asserts": ("", "--assert churn>1000"),
    "plot": ("", "--plot plot.png"),
    "indices_out": ("", "--indices-out cuts"),
    "padded": ("--indices-out cuts", "--padded"),
    "as_json": ("", "--json"),
}
GIVEN = {
    "render": RENDER,
    "traverse": {p.name: (RENDER | TRAVERSE)[p.name] for p in params("traverse") if p.name in RENDER | TRAVERSE},
}

#: Options that change how work is done, or what is printed, and no output.
OF_WORK = {
    "render": {"device", "overwrite", "jobs", "threads", "quiet", "verbose", "as_json"},
    "traverse": {"overwrite", "threads", "quiet", "verbose", "summary"},
}

AT = "--look-at 0.5,-0.2,-2:0,0.1,0"
AROUND = "--orbit 3 --distance 2"
MODES = {
    "render": {
        "a still": f"{AT} -o out.png",
        "a view of the scene": "-o out.png",
        "a file without a tree": f"{AT} -o out.png",
        "Streamed SOG": "--look-at 0,0,7:0,0,20 --budget 200 -o out.png",
        "3D Tiles": "--look-at 0,0,-4:0,0,0 -o out.png",
        "full": f"{AT} --full -o out.png",
        "views": "--view 1,0,-2:0,0,0 --view 0,1,-2:0,0,0 -o out.png",
        "frames": f"{AROUND} -o out.%d.png",
        "an animation": "--dolly --every 20 -o out.gif",
        "a sheet": f"{AROUND} --sheet -o out.webp",
        "a camera path": "--camera-path splat-transform.json -o out.%d.webp",
        "keyframes": "--keyframes 1,0,-2:0,0,0;1,0,2:0,0,0 --every 15 -o out.%d.png",
        "floats": f"{AT} -o out.npy",
        "a JPEG": f"{AT} -o out.jpg",
        "points": f"{AT} --style points -o out.png",
        "billboards": f"{AT} --style billboards -o out.png",
        "sorted billboards": f"{AT} --style sorted-billboards -o out.png",
        "levels": f"{AT} --color-by level -o out.png",
        "depth": f"{AT} --color-by depth -o out.png",
        "depths": f"{AT} --color-by depth -o out.npy",
        "overdraw": f"{AT} --color-by overdraw -o out.png",
        "an encoding": f"{AT} --through ext -o out.png",
        "a difference": f"{AT} --diff plain.ply -o out.png",
        "osmesa": f"{AROUND} --backend osmesa -o out.%d.png",
        "open3d": f"{AT} --backend open3d -o out.png",
        "a comparison": f"{AT} --compare -o out.csv",
        "a comparison along a path": f"{AROUND} --compare --budget 50,20% -o out.csv",
        "a comparison by osmesa": f"{AROUND} --compare --backend osmesa -o out.csv",
    },
    "traverse": {
        "an orbit": "--orbit 3 --distance 1",
        "a view": "--look-at 0.5,-0.5,0.5:3,0,3",
        "a dolly over a network": "--dolly --every 20 --bandwidth 2Mbit --latency 20ms",
        "a camera path": "--camera-path inria.json",
        "keyframes": "--keyframes 0.5,-0.5,0.5:3,0,3;-0.5,-0.5,0.5:3,0,-3 --every 20",
        "Streamed SOG": "--keyframes 0,0,7:0,0,20;0,0,1:0,0,20 --every 10 --budget 200",
        "3D Tiles": "--orbit 3 --distance 9",
        "a summary": "--orbit 3 --distance 2 --json",
    },
}

#: Options that ask for what is so already: nothing is outside of a view of all, floats keep alpha, and as many splats
#: cover a pixel in either profile, unless they are more opaque than these.
THE_SAME = {
    "a view of the scene": {"outside_foveate", "cone_foveate"},
    "floats": {"alpha"},
    "overdraw": {"profile"},
    "sorted billboards": {"sort"},
    "a dolly over a network": {"behind_foveate"},
}

#: Inputs other than trees.
SCENES = {"a file without a tree": "plain.ply", "Streamed SOG": "web", "3D Tiles": "city"}


def without_times(name: str, data: bytes) -> Any:
    """Return an output without the times that it took."""
    if data.startswith(b"{"):
        whole = json.loads(data)
        whole.pop("seconds", None)
        whole.get("quantities", {}).pop("traverse_ms", None)
        return whole
    if not name.endswith((".csv", "table", "standard output")):
        return data
    lines = [line.split(",") for line in data.decode().splitlines()]
    timed = bool(lines) and lines[0][-1] == "traverse_ms"
    return [line[:-1] if timed and number else line for number, line in enumerate(lines)]


class Runs:
    """Runs command lines once each, and removes what they wrote."""

    def __init__(self, cli: Cli, command: str, mode: str) -> None:
        self.cli, self.command, self.mode = cli, command, mode
        self.drawn: list[Any] = []
        self._known: dict[str, tuple[int, dict[str, Any], str]] = {}

    def __call__(self, options: str) -> tuple[int, dict[str, Any], str]:
        """Return the exit status, the outputs by name, and standard error."""
        if options not in self._known:
            fixed = MODES[self.command][self.mode]
            if self.command == "render":
                files = SCENES.get(self.mode, "--scene back.json")
                fixed += " --json" + (" --size 48x32" if "--size" not in options else "")
            else:
                files = "" if "--scene" in options else SCENES.get(self.mode, f"tree.spz {MORE}")
            self.drawn.clear()
            done = self.cli(self.command, *files.split(), *fixed.split(), *options.split(), status=None)
            out = {name: without_times(name, Path(name).read_bytes()) for name in self.cli.made()}
            for name in out:
                Path(name).unlink()
            out |= {"standard output": without_times("standard output", done.out.encode()), "drawn": [*self.drawn]}
            self._known[options] = done.status, out, done.err
        return self._known[options]


def check_all_options(runs: Runs) -> None:
    status, _, err = runs("")
    if status == 1 and ("osmesa" in runs.mode or "open3d" in runs.mode):
        pytest.skip(err)
    assert status == 0, err
    ignored = []
    for name, (needs, given) in GIVEN[runs.command].items():
        if name in THE_SAME.get(runs.mode, ()) or {*given.split()} <= {*MODES[runs.command][runs.mode].split()}:
            continue
        before, after = runs(needs), runs(f"{needs} {given}")
        if after[0] in (1, 2):
            assert "error: " in after[2].lower(), (name, after[2])
            assert runs.command == "traverse" or len(after[1]) == 2, (
                name
            )  # a table may be there when an assertion fails
        elif after[:2] == before[:2]:
            ignored.append(name)
    assert ignored == []


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES["render"])
def test_every_option_of_render_is_used_or_refused(mode: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    # The tree lies where half floats are coarse, and an instances file moves it back.
    splats, away = random_splats(400, sh_degree=3), np.float32([1000, 0, 0])
    cli.put("plain.ply", splats)
    cli.put("other.ply", splats.take(np.arange(0, 400, 2)))
    cli.put("away.ply", dataclasses.replace(splats, center=splats.center + away))
    for tree, file in (("tree", "away"), ("second", "other"), ("third", "plain")):
        cli(f"build-lod {file}.ply -o {tree}.spz -q")
    write_streamed(cli.folder / "web", row_of_regions(8, 4), together=4)
    tiled(splats, cli.folder / "city", TileSettings(tile_splats=100))
    there = {"file": "tree.spz", "translation": [-1000, 0, 0]}
    cli.put("back.json", json.dumps({"instances": [there]}))
    cli.put("twice.json", json.dumps({"instances": [there, there | {"translation": [-999, 0, 0]}]}))
    cli.inputs |= {"tree.spz", *MORE.split(), "web", "city"}
    runs, draw = Runs(cli, "render", mode), renderer.draw_styled

    def recorded(
        style: str, backend: str, shown: ShadedSplats, camera: Camera, look: RasterSettings, options: Any = None
    ) -> Image:
        if style == "splats":
            runs.drawn.append((backend, look, options))  # pictures of 8 bits do not show it all
        return draw(style, backend, shown, camera, look, options)

    monkeypatch.setattr(renderer, "draw_styled", recorded)
    check_all_options(runs)


@pytest.mark.parametrize("mode", MODES["traverse"])
def test_every_option_of_traverse_is_used_or_refused(mode: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(charts, "plot", lambda *arguments: (b"a plot", None))  # takes seconds, and has its tests
    for seed, tree in enumerate(("tree.spz", *MORE.split())):
        cli.put("scene.ply", random_splats(4000, seed=seed, extent=1.5))
        cli(f"build-lod scene.ply -o {tree} -q")
    write_streamed(cli.folder / "web", row_of_regions(8, 4), together=8)
    tiled(random_splats(900), cli.folder / "city", TileSettings(tile_splats=200))
    cli.put("large.json", json.dumps({"instances": [{"file": "tree.spz", "scale": 3}]}))
    cli.inputs |= {"tree.spz", *MORE.split(), "web", "city"}
    check_all_options(Runs(cli, "traverse", mode))


@pytest.mark.parametrize("command", GIVEN)
def test_every_option_has_a_row(command: str) -> None:
    assert {param.name for param in params(command)} == {*GIVEN[command]} | OF_WORK[command] | {"version", "help_all"}
