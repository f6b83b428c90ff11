"""Public names, for type checkers, and for `__init__.py`, which imports each when it is first used."""

from typing import TYPE_CHECKING

__version__: str

if TYPE_CHECKING:  # mypy then resolves the modules first, which import this one
    from .api.comparison import ComparisonTable as ComparisonTable
    from .api.comparison import compare as compare
    from .api.reports import inspect as inspect
    from .api.splat_files import Tree as Tree
    from .api.splat_files import Written as Written
    from .api.splat_files import pack as pack
    from .api.splat_files import read as read
    from .api.splat_files import read_rad_chunk as read_rad_chunk
    from .api.splat_files import read_rad_header as read_rad_header
    from .api.splat_files import unpack as unpack
    from .api.splat_files import write as write
    from .api.trees import arrange_chunks as arrange_chunks
    from .api.trees import build_lod as build_lod
    from .api.trees import extract_leaves as extract_leaves
    from .api.trees import refine as refine
    from .api.trees import simplify as simplify
    from .api.views import Frames as Frames
    from .api.views import Picture as Picture
    from .api.views import cut as cut
    from .api.views import orbit as orbit
    from .api.views import psnr as psnr
    from .api.views import read_cameras as read_cameras
    from .api.views import render as render
    from .api.views import show as show
    from .api.views import ssim as ssim
    from .api.views import traverse as traverse
    from .cameras.camera import Camera as Camera
    from .cameras.sources import CameraPath as CameraPath
    from .codecs.formats import RadOptions as RadOptions
    from .codecs.formats import SogOptions as SogOptions
    from .codecs.rad.rad_header import RadChunkEntry as RadChunkEntry
    from .codecs.rad.rad_header import RadChunkHeader as RadChunkHeader
    from .codecs.rad.rad_header import RadHeader as RadHeader
    from .codecs.rad.rad_reader import RadChunk as RadChunk
    from .codecs.spark_codings import SplatEncoding as SplatEncoding
    from .fitting.fit_settings import FitSettings as FitSettings
    from .fitting.fit_settings import Refined as Refined
    from .inspection.report import Report as Report
    from .lod.tree_settings import DetailSettings as DetailSettings
    from .model.foveation import Cones as Cones
    from .model.foveation import Frustum as Frustum
    from .model.instances import Instance as Instance
    from .model.lod_tree import LodTree as LodTree
    from .model.scene import Scene as Scene
    from .model.selection import Selection as Selection
    from .model.splats import Splats as Splats
    from .model.transforms import Transform as Transform
    from .render.render_settings import RasterSettings as RasterSettings
    from .render.render_settings import RenderSettings as RenderSettings
    from .system.errors import BackendError as BackendError
    from .system.errors import CameraPathError as CameraPathError
    from .system.errors import FormatError as FormatError
    from .system.errors import InvalidSplatsError as InvalidSplatsError
    from .system.errors import OutOfMemoryError as OutOfMemoryError
    from .system.errors import OutputError as OutputError
    from .system.errors import SparklodError as SparklodError
    from .system.errors import TreeError as TreeError
    from .viewers.instances_file import InstancesFileError as InstancesFileError
    from .viewers.instances_file import read_instances as read_instances
    from .viewers.scenes import Cut as Cut
    from .viewers.viewer_settings import DetailRule as DetailRule
    from .viewers.viewer_settings import LodSettings as LodSettings
    from .viewers.viewer_settings import Network as Network
    from .viewers.viewer_settings import StreamingSettings as StreamingSettings
