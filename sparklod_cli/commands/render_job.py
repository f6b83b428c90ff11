"""What `sparklod render` does with its cameras."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from ..images import pixels as codes
from ..images.metrics import check_covered, psnr
from ..io import write_stdout, write_whole
from ..support import jit
from ..support.defaults import OF_PIXELS
from ..support.parallel import ordered_map
from .console import Console, count_of, size_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..cameras.camera import Camera
    from ..cameras.path import CameraPath
    from ..images.pixels import Color, Pixels
    from ..render.color_scales import Coloring
    from ..render.renderer import Drawn, Renderer
    from .render_output import Output


@dataclass(frozen=True)
class Wanted:
    """What is to be made of what is drawn.

    Attributes:
        output: where it goes.
        overwrite: replace files that exist.
        background: behind the splats; None keeps alpha.
        bar: say beside the picture what its colours mean.
        gain: how many times as strong differences are; None for what suits them.
        jobs: pictures at a time.
        threads: of kernels.
    """

    output: Output
    overwrite: bool
    background: Color | None
    bar: bool
    gain: float | None
    jobs: int
    threads: int


@dataclass(frozen=True)
class Frame:
    """A picture that is done.

    Attributes:
        number: of its camera.
        facts: what the report says of it.
        pixels: None where they are in `data`, as they are written.
        data: bytes of a file.
        empty: nothing is in view.
    """

    number: int
    facts: dict[str, Any]
    pixels: Pixels | None
    data: bytes
    empty: bool


@dataclass
class Job:
    """Pictures on their way into files.

    Attributes:
        painter: draws them.
        other: draws what they are compared with; None for nothing.
        path: the cameras.
        captions: of each, for a contact sheet.
        start: when the work began, by `time.perf_counter`.
    """

    console: Console
    wanted: Wanted
    painter: Renderer
    other: Renderer | None
    path: CameraPath
    captions: list[str]
    start: float
    frames: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    written: int = 0
    _empty: bool = True
    _gain: float = 1.0

    def run(self) -> None:
        """Draws and writes all of them."""
        from ..images.animation import animate
        from ..images.contact_sheet import sheet

        output = self.wanted.output
        if self.other is not None:
            self._gain = self.wanted.gain or self._fitting_gain(self.other)
        drawn = self._drawn()
        if output.kind == "frames":
            for frame in drawn:
                self._write(output.path(frame.number), frame.data)
        elif output.kind == "picture":
            (frame,) = drawn
            self._write(output.name, frame.data)
        elif output.kind == "animation":
            pictures = (_pixels(frame) for frame in drawn)
            data = animate(pictures, output.form, frame_rate(self.path), self.console.progress)
            self._write(output.name, data)
        else:
            whole = sheet([_pixels(frame) for frame in drawn], self.captions)
            self._write(output.name, codes.encode(whole, output.form))
        self.seconds = time.perf_counter() - self.start
        self.console.clear()
        if self._empty:
            self.console.say(
                "warning: nothing is in view; cameras and scene may not share their axes (--camera-axes,"
                " --world-transform, --up), or --near and --far leave nothing"
            )

    def _drawn(self) -> Iterator[Frame]:
        """The pictures, in order."""
        count = len(self.path.cameras)
        for done, frame in enumerate(ordered_map(self._frame, range(count), min(self.wanted.jobs, count)), 1):
            self.frames.append(frame.facts)
            self._empty &= frame.empty
            self.console.progress("drawing", done, count, "frame")
            yield frame

    def _frame(self, at: int) -> Frame:
        jit.use_threads(self.wanted.threads)  # that is said of each thread by itself
        camera, number = self.path.cameras[at], self.path.numbers[at]
        drawn = self.painter.draw(camera)
        facts = self._facts(number, camera, drawn)
        image = codes.over(drawn.image, self.wanted.background)
        if self.other is not None:
            other = self.other.draw(camera).image
            check_covered(other, f"what --diff names, in frame {number},")
            reference = codes.over(other, self.wanted.background)
            clipped = [np.clip(each[..., :3], 0, 1) for each in (image, reference)]
            facts["psnr_db"] = round(psnr(*clipped), 3)
            image = codes.difference(image, reference, self._gain)
        empty = not drawn.image[..., 3].any()
        if self.wanted.output.form == "npy":
            return Frame(number, facts, None, codes.encode_floats(self._floats(drawn, image)), empty)
        pixels = codes.eight_bits(image)
        bar = self._bar()
        if bar is not None:
            pixels = codes.with_scale(pixels, bar)
            facts["width"] = pixels.shape[1]
        if self.wanted.output.kind in ("picture", "frames"):
            return Frame(number, facts, None, codes.encode(pixels, self.wanted.output.form), empty)
        return Frame(number, facts, pixels, b"", empty)

    def _bar(self) -> Coloring | None:
        """What colours mean; None where that is not said."""
        if not self.wanted.bar:
            return None
        if self.other is not None:
            return codes.difference_bar(self._gain)
        return self.painter.scale.bar if self.painter.scale is not None else None

    def _fitting_gain(self, other: Renderer) -> float:
        """What suits the first picture, the last and the one in the middle; the same for all."""
        cameras, background = self.path.cameras, self.wanted.background
        some = sorted({0, len(cameras) // 2, len(cameras) - 1}, reverse=True)
        differences = []
        for done, at in enumerate(some, 1):
            images = [codes.over(each.draw(cameras[at]).image, background) for each in (self.painter, other)]
            differences.append(codes.apart(*images))
            self.console.progress("comparing", done, len(some), "frame")
        return codes.gain_for(differences)

    def _facts(self, number: int, camera: Camera, drawn: Drawn) -> dict[str, Any]:
        facts = {"frame": number, "time_s": camera.time, "name": camera.name, "splats": drawn.splats}
        facts |= {"width": camera.width, "height": camera.height}
        if self.wanted.output.kind == "frames":
            facts["file"] = str(self.wanted.output.path(number))
        return facts

    def _floats(self, drawn: Drawn, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """What a .npy holds: the numbers behind the colours where those are of pixels, else the colours."""
        by = self.painter.settings.color_by
        return drawn.values if by in OF_PIXELS and drawn.values is not None else image

    def _write(self, target: Path | None, data: bytes) -> None:
        self.written += len(data)
        if target is None:
            write_stdout([data])
        else:
            write_whole(target, [data], overwrite=self.wanted.overwrite)

    def report(self, *, as_json: bool) -> None:
        """Says what was drawn."""
        output, frames = self.wanted.output, self.frames
        if as_json:
            report = {
                "output": str(output.name),
                "format": output.form,
                "kind": output.kind,
                "bytes": self.written,
                "frames": frames,
                "seconds": round(self.seconds, 3),
            }
            if self.other is not None:
                report["gain"] = self._gain
            click.echo(json.dumps(report, allow_nan=False))
        name = "standard output" if output.name is None else output.name
        sizes = dict.fromkeys(f"{frame['width']} x {frame['height']}" for frame in frames)
        splats = sorted({frame["splats"] for frame in frames})
        said = [count_of(len(frames), "frame")] if len(frames) > 1 else []
        said.append(next(iter(sizes)) + (" and others" if len(sizes) > 1 else ""))
        least = "" if splats[0] == splats[-1] else f"{splats[0]:,} to "
        said.append(least + count_of(splats[-1], "splat"))
        if self.other is not None:
            worst = min(frame["psnr_db"] for frame in frames)
            said.append(f"PSNR {worst:.2f} dB" + (" or more" if len(frames) > 1 else ""))
            said.append(f"differences {self._gain:g} times as strong" if self._gain != 1 else "differences as they are")
        self.console.say(f"{name}  {', '.join(said)}, {self.seconds:.2f} s")
        manner = self.painter.settings
        self.console.detail(
            f"  {self.path.format}, {size_of(self.written)} of {output.form}; {manner.style} by {manner.backend},"
            f" from {manner.raster.near:g} to {manner.raster.far:g} units away"
        )


def frame_rate(path: CameraPath) -> float:
    """Frames a second, on average."""
    from ..cameras.frame import DEFAULT_FPS

    span = path.cameras[-1].time - path.cameras[0].time
    return (len(path.cameras) - 1) / span if span > 0 else DEFAULT_FPS


def _pixels(frame: Frame) -> Pixels:
    assert frame.pixels is not None
    return frame.pixels
