"""Renders the frames of a camera path, compares and encodes them, and writes them to files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cameras.camera import DEFAULT_FPS
from ..render.render_settings import OF_PIXELS
from ..render.renderer import DrawnPicture, Renderer
from ..system.output import write_file
from ..system.progress import Progress, silent
from ..system.stdio import DASH
from ..system.threads import on_threads, ordered_map
from . import metrics
from . import pixels as codes
from .picture_files import JPEG_QUALITY, PictureOutput
from .pixels import Color, Pixels, animate

if TYPE_CHECKING:
    from ..cameras.sources import CameraPath
    from ..render.render_settings import RenderSettings
    from ..viewers.scenes import CutFinder

#: Maximum total number of pixels of the pictures that are cached after finding a gain until their frames are written:
#: 2 GB of floats.
CACHED_PIXELS = 1 << 26

#: Pictures that were drawn to find the gain, each with its reference, by camera index.
Cached = dict[int, tuple[DrawnPicture, DrawnPicture]]


@dataclass(frozen=True)
class PictureSettings:
    """Settings for writing pictures to files.

    Attributes:
        background: red, green and blue, 0..1, behind the splats; None keeps alpha.
        bar: draw a colour scale beside pictures that have one.
        gain: factor for differences; None chooses one from the pictures.
        jobs: number of pictures drawn at the same time, with `threads` each.
    """

    background: Color | None = None
    bar: bool = True
    gain: float | None = None
    jpeg_quality: int = JPEG_QUALITY
    jobs: int = 2
    threads: int = 1


@dataclass(frozen=True)
class WrittenPictures:
    """Report on pictures written to files.

    Attributes:
        frames: for each camera its number, time, name, splats drawn, width and height of the picture, its file if each
            frame has one, and with a reference the PSNR in dB.
        bytes: total size of the files.
        gain: factor for differences; None without a reference.
        empty: no camera sees a splat.
    """

    frames: list[dict[str, Any]]
    bytes: int
    gain: float | None
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

    Cameras of an animation or a contact sheet have one size. With a `reference`, pictures are differences from it.

    Raises:
        SparklodError: the reference covers no pixel of a frame; errors of `Renderer` and `animate`.
    """
    facts: list[dict[str, Any]] = []
    count, size, empty = len(path.cameras), 0, True
    alone = output.kind in ("picture", "frames")

    def finish(at: int) -> tuple[dict[str, Any], bool, Pixels | bytes]:
        """Draw a picture; return its facts, whether it is empty, and its file or, where files hold several, pixels."""
        camera, number = path.cameras[at], path.numbers[at]
        with on_threads(settings.threads):  # the setting is per Python thread
            drawn, expected = cached.pop(at, (None, None))
            drawn = drawn or renderer.draw(camera)
            expected = expected or (None if other is None else other.draw(camera))
        fact = {"frame": number, "time_s": camera.time, "name": camera.name, "splats": drawn.splats}
        fact |= {"width": camera.width, "height": camera.height}
        if output.kind == "frames":
            fact["file"] = str(*output.paths([number]))
        image = codes.over(drawn.image, settings.background)
        if expected is not None:
            metrics.check_covered(expected.image, f"what --diff names, in frame {number},")
            right = codes.over(expected.image, settings.background)
            fact["psnr_db"] = round(metrics.psnr(*(np.clip(each[..., :3], 0, 1) for each in (image, right))), 3)
            image = codes.difference(image, right, gain)
        empty = not drawn.image[..., 3].any()
        if output.form == "npy":  # the values behind the colours if they are per pixel, else the colours
            values = drawn.values if render.color_by in OF_PIXELS and drawn.values is not None else image
            return fact, empty, codes.encode_floats(values)
        pixels = codes.eight_bits(image)
        bar = renderer.scale if other is None else codes.difference_bar(gain)
        if settings.bar and bar is not None:
            pixels = codes.with_scale(pixels, bar)
            fact["width"] = pixels.shape[1]
        return fact, empty, codes.encode(pixels, output.form, settings.jpeg_quality) if alone else pixels

    def drawn() -> Iterator[Any]:
        nonlocal empty
        finished = ordered_map(finish, range(count), min(settings.jobs, count))
        for done, (fact, is_empty, result) in enumerate(finished, 1):
            progress("drawing", done, count, "frame")
            facts.append(fact)
            empty &= is_empty
            yield result

    with on_threads(settings.threads):
        renderer = Renderer(source, render, path.cameras, progress=progress)
        other = None if reference is None else Renderer(reference, render, path.cameras, progress=progress)
        gain, cached = settings.gain or 1.0, Cached()
        if other is not None and not settings.gain:
            gain, cached = _fitting_gain(renderer, other, path, settings, progress)
        if output.kind == "frames":
            for target, data in zip(output.paths(path.numbers), drawn(), strict=True):
                size += write_file(target, [data], overwrite=overwrite)
        else:
            if output.kind == "picture":
                (data,) = drawn()
            elif output.kind == "animation":
                data = animate(drawn(), count, output.form, frame_rate(path))
            else:
                cameras = zip(path.numbers, path.cameras, strict=True)
                captions = [camera.name or f"frame {number}" for number, camera in cameras]
                data = codes.encode(codes.sheet(list(drawn()), captions), output.form, settings.jpeg_quality)
            size = write_file(output.name or DASH, [data], overwrite=overwrite)
    return WrittenPictures(facts, size, gain if other is not None else None, empty)


def frame_rate(path: CameraPath) -> float:
    """Return the mean number of frames per second."""
    span = path.cameras[-1].time - path.cameras[0].time
    return (len(path.cameras) - 1) / span if span > 0 else DEFAULT_FPS


def _fitting_gain(
    renderer: Renderer, reference: Renderer, path: CameraPath, settings: PictureSettings, progress: Progress
) -> tuple[float, Cached]:
    """Choose the gain for all pictures from the first, the middle and the last one; also return these, if small."""
    cameras, background, cached = path.cameras, settings.background, Cached()
    some = sorted({0, len(cameras) // 2, len(cameras) - 1}, reverse=True)
    keep = 2 * sum(cameras[at].width * cameras[at].height for at in some) <= CACHED_PIXELS
    differences = []
    for done, at in enumerate(some, 1):
        both = renderer.draw(cameras[at]), reference.draw(cameras[at])
        differences.append(codes.apart(*(codes.over(drawn.image, background) for drawn in both)))
        if keep:
            cached[at] = both
        progress("comparing", done, len(some), "frame")
    return codes.gain_for(differences), cached
