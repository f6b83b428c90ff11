"""Outputs of `sparklod render`: files of pictures, and their formats."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ...images.defaults import JPEG_QUALITY, MOVING, STILL, THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from ..command import COMMON, option, with_options
from ..paths import Folder, require_suffix, stem_of
from ..usage import exclude, require
from .common import Command, output_option, overwrite_option

if TYPE_CHECKING:
    from ...cameras.camera import Camera
    from ...images.output import Output

HEADING = "Output"

#: Pixels that are drawn for a picture: the floats of more do not fit into the memory of most machines.
MOST_PIXELS = 1 << 27

#: Pixels along a side of a file, by its form.
MOST_SIDE = {"webp": 16_383, "jpg": 65_500}

#: Options that --thumbnail decides, and cameras that do not see the whole scene.
NO_THUMBNAIL = (
    *("size", "supersample", "camera_path", "orbit", "dolly", "look_at", "views", "keyframes", "center", "distance"),
    *("sheet", "fps", "every"),
)


@dataclass(frozen=True)
class Pictures:
    """The values of the options of `picture_options`; None for those not given.

    Attributes:
        output: a file, a name with a place for a number, a folder for files named after the input, or -.
        overwrite: replace files that exist.
        thumbnail: a small picture of the whole scene.
        sheet: put all pictures on a contact sheet.
        jobs: pictures to work on at a time.
        jpeg_quality: of .jpg, 1 to 100.
    """

    output: Path | Folder | None
    overwrite: bool
    thumbnail: bool
    sheet: bool
    jobs: int
    jpeg_quality: int

    def check(self, ctx: click.Context) -> None:
        """Raises a `click.UsageError` where options contradict each other."""
        if self.thumbnail:
            exclude(ctx, NO_THUMBNAIL, "--thumbnail")

    def place(self, ctx: click.Context, scene: Path, cameras: int, *, sheet: bool) -> Output:
        """Where the pictures of some cameras go.

        Args:
            ctx: of the command.
            scene: the file beside which an output goes that has no name, and whose name it has.
            cameras: how many there are.
            sheet: they are put on a contact sheet.

        Raises:
            click.UsageError: the cameras do not fit into the output.
        """
        from ...images.output import output_for

        named, folder = (None, self.output.path) if isinstance(self.output, Folder) else (self.output, scene.parent)
        assert isinstance(folder, Path)  # pictures go to no addresses
        if named is not None:
            require_suffix("--output", named, (f".{form}" for form in dict.fromkeys((*STILL, *MOVING))))
        name = folder / (stem_of(scene) + ("-thumbnail" if self.thumbnail else ""))
        try:
            output = output_for(named, name, cameras, sheet=sheet)
        except ValueError as error:
            raise click.UsageError(str(error)) from None
        if output.form != "jpg":
            require(ctx, ["jpeg_quality"], "a .jpg")
        return output


def check_sizes(output: Output, cameras: Sequence[Camera], supersample: int, *, bar: bool) -> None:
    """Raises a `click.UsageError` where a picture is larger than can be drawn, or than its file can be.

    Args:
        output: where the pictures go.
        cameras: that they are of.
        supersample: samples along each side of a pixel.
        bar: a colour bar stands beside each.
    """
    from ...images.pixels import scale_width

    for camera in cameras:
        width = camera.width + (scale_width(camera.width, camera.height) if bar else 0)
        height, most = camera.height, MOST_SIDE.get(output.form)
        if width * height * supersample**2 > MOST_PIXELS:
            times = f" x {supersample**2} (--supersample {supersample})" if supersample > 1 else ""
            raise click.UsageError(
                f"{width:,} x {height:,} pixels{times} are more than {MOST_PIXELS:,}; give a smaller --size"
            )
        if most is not None and max(width, height) > most:
            raise click.UsageError(
                f"{width:,} x {height:,} pixels are more than {most:,} a side, the most of .{output.form}; write .png"
            )
    if output.kind in ("animation", "sheet") and len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise click.UsageError(
            f"the cameras have pictures of several sizes, and those of one {output.kind} must be alike; give a --size"
        )


def picture_options(command: Command) -> Command:
    """The options of `Pictures`."""
    add = functools.partial(option, heading=HEADING)
    width, height = THUMBNAIL_SIZE
    return with_options(
        command,
        output_option(
            "Write a .png, .jpg, .webp or .npy (floats), or with out.%04d.png one for each camera; a .mp4,"
            " .webm, .gif or .webp for an animation; with --compare a .csv, .json or .parquet; or into the folder FILE"
            " as NAME.png; - is standard output.  [default: NAME.png beside the first FILE; with --compare standard"
            " output]"
        ),
        overwrite_option,
        option(
            "--thumbnail",
            heading=COMMON,
            is_flag=True,
            help=f"Draw a small picture of the whole scene: {width}x{height} pixels, each the mean of"
            f" {THUMBNAIL_SUPERSAMPLE} x {THUMBNAIL_SUPERSAMPLE} samples, to NAME-thumbnail.png.",
        ),
        add("--sheet", is_flag=True, help="Put the pictures of all cameras on one contact sheet."),
        add(
            "--jobs",
            metavar="N",
            type=click.IntRange(1, 256),
            default=2,
            help="Number of pictures to work on at a time: while one is drawn, others are sorted and written.",
        ),
        add(
            "--jpeg-quality",
            metavar="N",
            type=click.IntRange(1, 100),
            default=JPEG_QUALITY,
            help="Quality of a .jpg, from 1 to 100.",
        ),
    )
