"""sparklod: Level-of-Detail trees for 3D Gaussian splat scenes, from Python.

    import sparklod_cli as sparklod

    tree = sparklod.build_lod(sparklod.read("scene.ply"))
    sparklod.write("scene-lod.spz", tree)

What `__all__` names is the public interface, described in docs/python.md. Nothing else is promised to stay as it is.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .support.lazy import loader_of

if TYPE_CHECKING:
    from .api.cameras import orbit, read_cameras
    from .api.files import build_lod, extract_leaves, inspect, pack, read, unpack
    from .api.rad import arrange_chunks, read_rad_chunk, read_rad_header
    from .api.refining import refine
    from .api.results import ComparisonTable, Frames, Picture, show
    from .api.views import compare, cut, psnr, render, ssim, traverse
    from .api.writing import Written, write
    from .bake.refining import Refined
    from .cameras.camera import Camera
    from .cameras.path import CameraPath
    from .codecs.options import RadOptions, SogOptions
    from .codecs.rad.codec import RadChunk
    from .codecs.rad.records import RadChunkEntry, RadChunkHeader, RadHeader
    from .codecs.splat_encoding import SplatEncoding
    from .fitting.settings import FitSettings
    from .inspection.report import Report
    from .lod.detail_rule import DetailRule
    from .lod.detail_settings import DetailSettings
    from .lod.settings import LodSettings
    from .model.instances import Cones, Frustum, Instance
    from .model.lod_tree import LodTree
    from .model.scene import Scene, Tree
    from .model.selection import Selection
    from .model.splats import Splats
    from .model.transforms import Transform
    from .render.backends import BackendError
    from .render.settings import RasterSettings, RenderSettings
    from .scenes.instances_file import InstancesFileError, read_instances
    from .scenes.loaded import Cut
    from .simulation.streaming import Network, StreamingSettings
    from .support.errors import (
        CameraPathError,
        FormatError,
        InvalidSplatsError,
        OutOfMemoryError,
        OutputError,
        SparklodError,
        TreeError,
    )

__version__ = "0.1.0"

#: Where each public name is. Its module is imported when the name is first used (PEP 562), so that importing the
#: package loads neither numpy nor numba. tests/api/test_package.py holds this and the imports above together.
_MODULES = {
    "api.cameras": ("orbit", "read_cameras"),
    "api.files": ("build_lod", "extract_leaves", "inspect", "pack", "read", "unpack"),
    "api.rad": ("arrange_chunks", "read_rad_chunk", "read_rad_header"),
    "api.refining": ("refine",),
    "api.results": ("ComparisonTable", "Frames", "Picture", "show"),
    "api.views": ("compare", "cut", "psnr", "render", "ssim", "traverse"),
    "api.writing": ("Written", "write"),
    "bake.refining": ("Refined",),
    "cameras.camera": ("Camera",),
    "cameras.path": ("CameraPath",),
    "codecs.options": ("RadOptions", "SogOptions"),
    "codecs.rad.codec": ("RadChunk",),
    "codecs.rad.records": ("RadChunkEntry", "RadChunkHeader", "RadHeader"),
    "codecs.splat_encoding": ("SplatEncoding",),
    "fitting.settings": ("FitSettings",),
    "inspection.report": ("Report",),
    "lod.detail_settings": ("DetailSettings",),
    "lod.detail_rule": ("DetailRule",),
    "lod.settings": ("LodSettings",),
    "model.foveation": ("Cones", "Frustum"),
    "model.instances": ("Instance",),
    "model.lod_tree": ("LodTree",),
    "model.scene": ("Scene", "Tree"),
    "model.selection": ("Selection",),
    "model.splats": ("Splats",),
    "model.transforms": ("Transform",),
    "render.backends": ("BackendError",),
    "render.settings": ("RasterSettings", "RenderSettings"),
    "scenes.instances_file": ("InstancesFileError", "read_instances"),
    "scenes.loaded": ("Cut",),
    "simulation.streaming": ("Network", "StreamingSettings"),
    "support.errors": (
        *("CameraPathError", "FormatError", "InvalidSplatsError", "OutOfMemoryError", "OutputError"),
        *("SparklodError", "TreeError"),
    ),
}

_HOMES = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "BackendError",
    "Camera",
    "CameraPath",
    "CameraPathError",
    "ComparisonTable",
    "Cones",
    "Cut",
    "DetailRule",
    "DetailSettings",
    "FitSettings",
    "FormatError",
    "Frames",
    "Frustum",
    "Instance",
    "InstancesFileError",
    "InvalidSplatsError",
    "LodSettings",
    "LodTree",
    "Network",
    "OutOfMemoryError",
    "OutputError",
    "Picture",
    "RadChunk",
    "RadChunkEntry",
    "RadChunkHeader",
    "RadHeader",
    "RadOptions",
    "RasterSettings",
    "Refined",
    "RenderSettings",
    "Report",
    "Scene",
    "Selection",
    "SogOptions",
    "SparklodError",
    "SplatEncoding",
    "Splats",
    "StreamingSettings",
    "Transform",
    "Tree",
    "TreeError",
    "Written",
    "arrange_chunks",
    "build_lod",
    "compare",
    "cut",
    "extract_leaves",
    "inspect",
    "orbit",
    "pack",
    "psnr",
    "read",
    "read_cameras",
    "read_instances",
    "read_rad_chunk",
    "read_rad_header",
    "refine",
    "render",
    "show",
    "ssim",
    "traverse",
    "unpack",
    "write",
]

__getattr__ = loader_of(__name__, _MODULES)


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


class _Package(ModuleType):
    """Keeps public functions: importing a module of the same name (`render`, `compare`) would put it in their place."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _HOMES or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
