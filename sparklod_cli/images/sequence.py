"""Renders the frames of a camera path, compares and encodes them, and writes them to files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cameras.frame import DEFAULT_FPS
from ..render.renderer import Renderer
from ..render.settings import OF_PIXELS
from ..system.output import write_file
from ..system.progress import Progress, silent
from ..system.stdio import DASH
from ..system.threads import on_threads, ordered_map
from . import pixels as codes
from .metrics import check_covered, psnr
from .output import JPEG_QUALITY
from .pixels import animate, sheet

if TYPE_CHECKING:
    from ..cameras.camera import Camera
    from ..cameras.sources import CameraPath
    from ..render.renderer import DrawnPicture
    from ..render.settings import RenderSettings
    from ..viewers.scenes import CutFinder
    from .output import PictureOutput
    from .pixels import Color, Pixels

#: Maximum total number of pixels of the pictures that are cached after finding a gain until their frames are written:
#: 2 GB of floats.
CACHED_PIXELS = 1 << 26


@dataclass(frozen=True)
class PictureSettings:
    """Settings for writing pictures to files.

    Attributes:
        background: red, green and blue, 0..1, behind the splats; None keeps alpha.
        bar: add a colour bar to a picture whose colours encode a quantity.
        gain: factor by which differences are multiplied; None chooses one from the pictures.
        jobs: number of pictures to process concurrently.
        threads: number of threads of the kernels.
    """

    background: Color | None = None
    bar: bool = True
    gain: float | None = None
    jpeg_quality: int = JPEG_QUALITY
    jobs: int = 2
    threads: int = 1


@dataclass(frozen=True)
class WrittenPictures:
    """The pictures that were written.

    Attributes:
        frames: for each camera its number, time, name, splats drawn, width and height of the picture, its file if each
            frame has one, and with a reference the PSNR in dB.
        bytes: size of all files together.
        gain: factor by which differences were multiplied; None without a reference.
        empty: no splat is in view of any camera.
    """

    frames: list[dict[str, Any]]
    bytes: int
    gain: float | None
    empty: bool


@dataclass(frozen=True)
class _Frame:
    """A finished picture: its pixels, or the bytes of its file if each frame has one."""

    facts: dict[str, Any]
    pixels: Pixels | None
    data: bytes
    empty: bool


def write_pictures(
    source: CutFinder,
    path: CameraPath,
    output: PictureOutput,
    render: RenderSettings,
    settings: PictureSettings,
    *,
    reference: CutFinder | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> WrittenPictures:
    """Render and write the pictures of a camera path.

    Args:
        path: the cameras; all of one size for an animation or a contact sheet.
        reference: cuts to compare with; the pictures are then differences from it.

    Raises:
        BackendError: the backend cannot draw here.
        OutputError: a file cannot be written.
        SparklodError: the quantity to colour by is missing, the reference covers no pixel of a frame, or an animation
            cannot be encoded here.
    """
    with on_threads(settings.threads):
        renderer = Renderer(source, render, path.cameras, progress=progress)
        other = None if reference is None else Renderer(reference, render, path.cameras, progress=progress)
        return _Writer(renderer, path, output, settings, other, overwrite, progress).run()


def frame_rate(path: CameraPath) -> float:
    """Mean number of frames per second."""
    span = path.cameras[-1].time - path.cameras[0].time
    return (len(path.cameras) - 1) / span if span > 0 else DEFAULT_FPS


class _Writer:
    """One run of `write_pictures`; see there for the arguments."""

    def __init__(
        self,
        renderer: Renderer,
        path: CameraPath,
        output: PictureOutput,
        settings: PictureSettings,
        reference: Renderer | None,
        overwrite: bool,
        progress: Progress,
    ) -> None:
        self._renderer, self._path, self._output, self._settings = renderer, path, output, settings
        self._reference, self._overwrite, self._progress = reference, overwrite, progress
        # By camera index, pictures that were drawn to find the gain.
        self._drawn: dict[int, tuple[DrawnPicture, DrawnPicture]] = {}
        self._gain = 1.0 if reference is None else settings.gain or self._fitting_gain(reference)
        self._bytes = 0

    def run(self) -> WrittenPictures:
        output, facts, empty = self._output, [], True

        def drawn() -> Iterator[_Frame]:
            nonlocal empty
            count = len(self._path.cameras)
            frames = ordered_map(self._frame, range(count), min(self._settings.jobs, count))
            for done, frame in enumerate(frames, 1):
                self._progress("drawing", done, count, "frame")
                facts.append(frame.facts)
                empty &= frame.empty
                yield frame

        if output.kind == "frames":
            for number, frame in zip(self._path.numbers, drawn(), strict=True):
                self._write(output.path(number), [frame.data])
        elif output.kind == "picture":
            (frame,) = drawn()
            self._write(output.name, [frame.data])
        elif output.kind == "animation":
            pictures = (_pixels(frame) for frame in drawn())
            count = len(self._path.cameras)
            self._write(output.name, [animate(pictures, count, output.form, frame_rate(self._path))])
        else:
            cameras = zip(self._path.numbers, self._path.cameras, strict=True)
            captions = [camera.name or f"frame {number}" for number, camera in cameras]
            self._write(output.name, [self._encode(sheet([_pixels(frame) for frame in drawn()], captions))])
        return WrittenPictures(facts, self._bytes, self._gain if self._reference is not None else None, empty)

    def _frame(self, at: int) -> _Frame:
        camera, number = self._path.cameras[at], self._path.numbers[at]
        with on_threads(self._settings.threads):  # the setting is per Python thread
            both = self._drawn.pop(at, None)
            drawn, other = both or self._both(camera)
        facts = {"frame": number, "time_s": camera.time, "name": camera.name, "splats": drawn.splats}
        facts |= {"width": camera.width, "height": camera.height}
        if self._output.kind == "frames":
            facts["file"] = str(self._output.path(number))
        image = codes.over(drawn.image, self._settings.background)
        if other is not None:
            check_covered(other.image, f"what --diff names, in frame {number},")
            reference = codes.over(other.image, self._settings.background)
            facts["psnr_db"] = round(psnr(*(np.clip(each[..., :3], 0, 1) for each in (image, reference))), 3)
            image = codes.difference(image, reference, self._gain)
        empty = not drawn.image[..., 3].any()
        if self._output.form == "npy":
            # The values behind the colours if they are per pixel, else the colours.
            by = self._renderer.settings.color_by
            values = drawn.values if by in OF_PIXELS and drawn.values is not None else image
            return _Frame(facts, None, codes.encode_floats(values), empty)
        pixels = codes.eight_bits(image)
        bar = self._renderer.scale.bar if self._renderer.scale is not None else None
        if self._reference is not None:
            bar = codes.difference_bar(self._gain)
        if self._settings.bar and bar is not None:
            pixels = codes.with_scale(pixels, bar)
            facts["width"] = pixels.shape[1]
        if self._output.kind in ("picture", "frames"):
            return _Frame(facts, None, self._encode(pixels), empty)
        return _Frame(facts, pixels, b"", empty)

    def _both(self, camera: Camera) -> tuple[DrawnPicture, DrawnPicture | None]:
        return self._renderer.draw(camera), None if self._reference is None else self._reference.draw(camera)

    def _fitting_gain(self, reference: Renderer) -> float:
        """Return the gain for all pictures, chosen from the first, the middle and the last one."""
        cameras, background = self._path.cameras, self._settings.background
        some = sorted({0, len(cameras) // 2, len(cameras) - 1}, reverse=True)
        keep = 2 * sum(cameras[at].width * cameras[at].height for at in some) <= CACHED_PIXELS
        differences = []
        for done, at in enumerate(some, 1):
            both = self._renderer.draw(cameras[at]), reference.draw(cameras[at])
            differences.append(codes.apart(*(codes.over(drawn.image, background) for drawn in both)))
            if keep:
                self._drawn[at] = both
            self._progress("comparing", done, len(some), "frame")
        return codes.gain_for(differences)

    def _encode(self, pixels: Pixels) -> bytes:
        return codes.encode(pixels, self._output.form, self._settings.jpeg_quality)

    def _write(self, target: Path | None, pieces: Iterable[bytes]) -> None:
        self._bytes += write_file(target or DASH, pieces, overwrite=self._overwrite)


def _pixels(frame: _Frame) -> Pixels:
    assert frame.pixels is not None
    return frame.pixels
