"""The table of camera path formats: adding one is a module and a row here. Imports nothing heavy, for `--help`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from ..axes import Axes

#: PlayCanvas turns what it loads by 180 degrees about z, so that y is up.
PLAYCANVAS = (
    "SuperSplat and splat-transform turn a PLY file by 180 degrees about z when they load it;"
    " --world-transform -1,0,0,0,0,-1,0,0,0,0,1,0,0,0,0,1 turns the cameras back."
)


@dataclass(frozen=True)
class PathFormat:
    """A format of camera paths.

    Attributes:
        name: what `--camera-format` calls it.
        title: for people.
        module: in this package; has `recognises(files) -> bool` and `parse(files, settings) -> Parsed`.
        axes: of its matrices; None where it has eyes and targets, about which there is nothing to know.
        looking: its cameras look from an eye to a target, or may, so that it matters which way is up.
        world: said where `--world-transform` is not given: the world of the cameras may not be that of the splats.
        names: sets of files that belong together, as they are named in a folder of it; empty where any name will do.
    """

    name: str
    title: str
    module: str
    axes: Axes | None
    looking: bool = False
    world: str = ""
    names: tuple[tuple[str, ...], ...] = ()

    def parser(self) -> Any:
        """The module, imported when it is needed."""
        return import_module(f".{self.module}", __package__)


#: In the order in which they are tried.
FORMATS = (
    PathFormat("sparklod", "sparklod's JSON", "own_json", Axes.OPENGL_C2W, looking=True),
    PathFormat("csv", "sparklod's CSV", "own_csv", Axes.OPENGL_C2W, looking=True),
    PathFormat(
        "nerfstudio",
        "nerfstudio's camera path",
        "nerfstudio",
        Axes.OPENGL_C2W,
        world="nerfstudio's viewer works in a world that it centred, turned and scaled, as are the splats that it"
        " exports; splats trained elsewhere need --world-transform.",
    ),
    PathFormat("transforms", "transforms.json", "transforms", Axes.OPENGL_C2W, names=(("transforms.json",),)),
    PathFormat("inria", "Inria's cameras.json", "inria", Axes.OPENCV_C2W, names=(("cameras.json",),)),
    PathFormat("supersplat", "SuperSplat", "supersplat", None, looking=True, world=PLAYCANVAS),
    PathFormat("camera-track", "splat-transform's camera track", "camera_track", None, looking=True, world=PLAYCANVAS),
    PathFormat("open3d", "Open3D's camera trajectory", "open3d_trajectory", Axes.OPENCV_W2C),
    PathFormat(
        "colmap",
        "COLMAP",
        "colmap",
        Axes.OPENCV_W2C,
        names=(("images.bin", "cameras.bin"), ("images.txt", "cameras.txt")),
    ),
    PathFormat("tum", "TUM trajectory", "tum", Axes.OPENCV_C2W),
)

#: Sets of files to look for in a folder, and beside a file that is one of them: COLMAP's first, as COLMAP does.
NAMES = tuple(names for form in reversed(FORMATS) for names in form.names)
