"""The table of backends that draw splats: adding one is a module and a row. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

from ..system.errors import SparklodError

if TYPE_CHECKING:
    from ..cameras.camera import Camera
    from .rasterizer import Image
    from .settings import RasterSettings
    from .shading import ShadedSplats


class BackendError(SparklodError):
    """A backend cannot draw here; its text says what is missing and which package brings it."""


@dataclass(frozen=True)
class Backend:
    """One way to draw; its module has a function `draw`."""

    name: str
    module: str

    def draw(self, splats: ShadedSplats, camera: Camera, settings: RasterSettings, **options: Any) -> Image:
        """Draw splats; options are those of the module's function.

        Returns:
            (height, width, 4) float32: red, green and blue, multiplied by alpha, and alpha, all 0..1.

        Raises:
            BackendError: it cannot draw here.
        """
        module = import_module(self.module, __package__)
        return cast("Image", module.draw(splats, camera, settings, **options))


#: The backend that draws instead of numba where that is to use an NVIDIA card.
ON_CARD = "cuda"

#: By name; the first is the default.
BACKENDS = {
    backend.name: backend
    for backend in (
        Backend("numba", ".rasterizer"),
        Backend(ON_CARD, ".cuda.rasterizer"),
        Backend("osmesa", ".gl.osmesa"),
        Backend("open3d", ".open3d.backend"),
    )
}
