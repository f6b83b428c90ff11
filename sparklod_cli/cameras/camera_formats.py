"""Formats of camera paths: `Axes` of their poses, and their table: adding one is a module and a row.

Imports nothing heavy, for `--help`.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class Axes(Enum):
    """Directions of a camera's own axes, and direction of its matrix.

    In OpenGL's axes, also those of Blender, three.js and nerfstudio, y points up and the camera looks along -z. In
    OpenCV's, also those of COLMAP, y points down and the camera looks along +z. In both x points right. A matrix
    transforms from camera to world (its last column is the position of the camera) or from world to camera.
    """

    OPENGL_C2W = "opengl-c2w"
    OPENCV_C2W = "opencv-c2w"
    OPENGL_W2C = "opengl-w2c"
    OPENCV_W2C = "opencv-w2c"


#: PlayCanvas rotates what it loads by 180 degrees about z, so that y points up.
PLAYCANVAS = (
    "SuperSplat and splat-transform rotate a PLY file by 180 degrees about z when they load it;"
    " --world-transform -1,0,0,0,0,-1,0,0,0,0,1,0,0,0,0,1 rotates the cameras back."
)


class PathFormat(NamedTuple):
    """A format of camera paths.

    Attributes:
        name: value of `--camera-format`.
        module: in this package; has `recognises_NAME(files) -> bool` and `parse_NAME(files, settings) -> Parsed`.
        axes: of its matrices; None if it has eyes and targets instead.
        looking: its cameras may have an eye and a target instead of a matrix, and then need an up axis.
        world: note for a path without `--world-transform`: the world of its cameras may not be that of the splats.
        names: sets of file names that belong together in a folder; empty if its file may have any name.
    """

    name: str
    title: str
    module: str
    axes: Axes | None
    looking: bool = False
    world: str = ""
    names: tuple[tuple[str, ...], ...] = ()


#: The formats, in the order in which they are tried.
FORMATS = (
    PathFormat("sparklod", "sparklod's JSON", "camera_files", Axes.OPENGL_C2W, looking=True),
    PathFormat("csv", "sparklod's CSV", "camera_files", Axes.OPENGL_C2W, looking=True),
    PathFormat(
        "nerfstudio",
        "nerfstudio's camera path",
        "other_programs",
        Axes.OPENGL_C2W,
        world="nerfstudio's viewer works in a world that it centred, turned and scaled, as are the splats that it"
        " exports; splats trained elsewhere need --world-transform.",
    ),
    PathFormat("transforms", "transforms.json", "other_programs", Axes.OPENGL_C2W, names=(("transforms.json",),)),
    PathFormat("inria", "Inria's cameras.json", "other_programs", Axes.OPENCV_C2W, names=(("cameras.json",),)),
    PathFormat("supersplat", "SuperSplat", "other_programs", None, looking=True, world=PLAYCANVAS),
    PathFormat(
        "camera-track", "splat-transform's camera track", "other_programs", None, looking=True, world=PLAYCANVAS
    ),
    PathFormat("open3d", "Open3D's camera trajectory", "other_programs", Axes.OPENCV_W2C),
    PathFormat(
        "colmap",
        "COLMAP",
        "colmap",
        Axes.OPENCV_W2C,
        names=(("images.bin", "cameras.bin"), ("images.txt", "cameras.txt")),
    ),
    PathFormat("tum", "TUM trajectory", "other_programs", Axes.OPENCV_C2W),
)

#: Sets of files that are searched for in a folder, and beside a file of one of them: COLMAP's first.
NAMES = tuple(names for form in reversed(FORMATS) for names in form.names)
