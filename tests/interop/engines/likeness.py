"""How like our own picture what an engine shows is."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.gaussian import rotation_matrices
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import ShadedSplats, draw, shade, world_to_camera
from sparklod_cli.render.render_settings import RasterSettings
from tests.interop.engines.browser import FAR, NEAR
from tests.interop.pictures import psnr

#: The blur of PlayCanvas's engine and of Babylon.js, pixels squared: they add 0.3 to the covariance in half pixels.
BLUR = 0.3 / 4

#: That of CesiumJS: it adds 0.3 to four times the covariance in half pixels.
CESIUM_BLUR = 0.3 / 16

#: CesiumJS leaves out splats whose larger variance on the screen, after the blur, is below this, pixels squared.
CESIUM_LEAST = 2 / 16

#: ... and those whose centre is beyond this multiple of the picture's half width and height.
CESIUM_CLIP = 1.2


@contextmanager
def their_blur(**settings: float) -> Iterator[None]:
    """Has our renderer draw with the engines' blur, or other values of what is no setting of it."""
    with mock.patch.multiple(importlib.import_module(draw.__module__), **({"BLUR": BLUR} | settings)):
        yield


def our_picture(splats: Splats, camera: Camera) -> NDArray[np.float32]:
    """Our picture of splats, with the engines' blur: (height, width, 4), 0..1."""
    with their_blur():
        shaded = shade([(splats, np.eye(4))], camera)
        return np.clip(draw(shaded, camera, RasterSettings(near=NEAR, far=FAR)), 0, 1)


def like_cesium(splats: Splats, camera: Camera) -> NDArray[np.float32]:
    """Our picture of splats, drawn as CesiumJS's shaders do: (height, width, 4), 0..1.

    Splats are sorted by depth, opacity does not make up for the blur, small splats are left out, and colours are
    clamped before reflections are added to them.
    """
    shaded = shade([(dataclasses.replace(splats, rgb=np.clip(splats.rgb, 0, 1)), np.eye(4))], camera)
    on_screen = _variances(shaded, camera)
    blurred = on_screen + CESIUM_BLUR * np.eye(2)
    # What the renderer divides opacity by.
    opacity = shaded.lod_opacity * np.sqrt(np.linalg.det(blurred) / np.maximum(np.linalg.det(on_screen), 1e-12))
    seen = np.linalg.eigvalsh(blurred)[:, 1] >= CESIUM_LEAST
    columns = {each.name: getattr(shaded, each.name)[seen] for each in dataclasses.fields(shaded)}
    columns["lod_opacity"] = opacity[seen].astype(np.float32)
    with their_blur(BLUR=CESIUM_BLUR, CLIP=CESIUM_CLIP):
        settings = RasterSettings(near=NEAR, far=FAR, sort="z")
        return np.clip(draw(ShadedSplats(**columns), camera, settings), 0, 1)


def _variances(shaded: ShadedSplats, camera: Camera) -> NDArray[np.float64]:
    """Covariances of splats on the screen before the blur, (N, 2, 2), pixels squared."""
    matrix = world_to_camera(camera).astype(np.float64)
    x, y, z = (shaded.center @ matrix[:, :3].T + matrix[:, 3]).T
    zero = np.zeros_like(z)
    across = np.stack([1 / z, zero, -x / z**2], axis=-1) * camera.focal[0]
    down = np.stack([zero, 1 / z, -y / z**2], axis=-1) * camera.focal[1]
    axes = np.moveaxis(rotation_matrices(shaded.quat_xyzw.astype(np.float64)), -1, 0) * shaded.scale[:, None]
    drawn: NDArray[np.float64] = np.stack([across, down], axis=1) @ matrix[:, :3] @ axes
    return drawn @ drawn.transpose(0, 2, 1)


def likeness(theirs: NDArray[np.float64], ours: NDArray[np.float32]) -> float:
    """PSNR in dB of red, green and blue of all pixels."""
    return psnr((theirs - ours)[..., :3])
