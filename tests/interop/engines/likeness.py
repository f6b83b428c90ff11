"""How like our own picture what an engine shows is."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import draw
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.render.shading import shade
from tests.interop.engines.browser import FAR, NEAR
from tests.interop.pictures import psnr

#: The blur of PlayCanvas's engine and of Babylon.js, pixels squared: they add 0.3 to the covariance in half pixels.
BLUR = 0.3 / 4


@contextmanager
def their_blur() -> Iterator[None]:
    """Has our renderer draw with the engines' blur, which is no setting of it."""
    with mock.patch.object(importlib.import_module(draw.__module__), "BLUR", BLUR):
        yield


def our_picture(splats: Splats, camera: Camera) -> NDArray[np.float32]:
    """Our picture of splats, with the engines' blur: (height, width, 4), 0..1."""
    with their_blur():
        shaded = shade([(splats, np.eye(4))], camera)
        return np.clip(draw(shaded, camera, RasterSettings(near=NEAR, far=FAR)), 0, 1)


def likeness(theirs: NDArray[np.float64], ours: NDArray[np.float32]) -> float:
    """PSNR in dB of red, green and blue of all pixels."""
    return psnr((theirs - ours)[..., :3])
