"""Conversion of a file: its tree into another container, its splats or leaves into a plain format, or arrays."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..codecs.formats import NPZ, WRITABLE
from ..codecs.losses import Losses, settled_with_losses
from ..codecs.reader import check_valid
from ..codecs.spz import like
from ..io.reading import open_reader
from ..io.writing import scene_output, write_scene
from ..model.scene import Scene, rotated_axis
from ..system.addresses import Place
from ..system.errors import FormatError, memory_errors_translated
from ..system.output import Output
from ..system.progress import Progress, silent
from .flow import bake
from .in_memory import select, transformed
from .settings import Baked, BakeSettings
from .simplifying import leaves_of

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True, kw_only=True)
class Converted(Losses):
    """Result of writing splats without a tree, or arrays.

    Attributes:
        format: of the input, for display.
        nodes: of the input's tree; None without one.
        splats: written.
        dropped: splats left out, by reason.
        seconds: by stage (read, write).
        output_format: for display, or the name of a layout.
        arrays: shape of each array, by name; empty for other outputs.
    """

    format: str
    nodes: int | None
    splats: int
    sh_degree: int
    dropped: dict[str, int]
    bytes: int
    seconds: dict[str, float]
    output_format: str
    arrays: dict[str, tuple[int, ...]]


def convert(
    source: Place,
    target: Place,
    settings: BakeSettings,
    *,
    layout: str | None = None,
    leaves: bool = False,
    overwrite: bool = False,
    threads: int = 1,
    progress: Progress = silent,
    say: Callable[[str], None] = lambda text: None,
) -> Baked | Converted:
    """Write a splat file in another format.

    A tree stays as it is where the format holds trees; otherwise its leaves are written.

    Args:
        settings: format, selection and position; the rest applies to no conversion.
        layout: one of `formats.ENCODINGS`, to write arrays; None for splats.
        leaves: write the leaves of the tree, even where the format holds trees.
        say: receives one-line messages for the user.

    Raises:
        FormatError, InvalidSplatsError, OutputError: see `io.open_reader`, `Selection.check` and
            `system.output.Output`; or the settings do not apply to a tree, or need one.
        OutOfMemoryError: the scene does not fit into memory.
    """
    with memory_errors_translated():
        form = None if layout is not None else WRITABLE[settings.suffix]
        if form is None:
            out = Output(target, overwrite=overwrite)
        else:
            out = scene_output(target, form, chunked=settings.options.rad.chunked, overwrite=overwrite)
        start = time.perf_counter()
        with open_reader(source, threads=threads) as reader:
            keeps_tree = reader.has_tree and not leaves and form is not None and form.trees
            scene = None if keeps_tree else reader.scene(progress=progress)
        if scene is None:
            return bake(source, target, settings, overwrite=overwrite, threads=threads, progress=progress, say=say)
        nodes = None if scene.tree is None else len(scene)
        if leaves or (nodes is not None and form is not None):
            scene = leaves_of(scene)
        scene, dropped = _placed(scene, settings, threads)
        begun, losses = time.perf_counter(), Losses({}, drops_sh=False, up_lost=None)
        shapes: dict[str, tuple[int, ...]] = {}
        if layout is not None:
            size, shapes = _write_arrays(scene, layout, out, raw=settings.suffix != NPZ, threads=threads)
        elif form is not None:
            # Opacities of leaves make up for the rounding of their scales already.
            options = dataclasses.replace(like(scene.header, settings.options), covering=nodes is None)
            options, losses = settled_with_losses(scene, form, options, threads)
            size = write_scene(out, form, scene, options, threads=threads, progress=progress)
        ended = time.perf_counter()
    return Converted(
        format=scene.format,
        nodes=nodes,
        splats=len(scene),
        sh_degree=scene.splats.sh_degree,
        dropped=dropped,
        bytes=size,
        seconds={"read": round(begun - start, 4), "write": round(ended - begun, 4)},
        output_format=layout or WRITABLE[settings.suffix].name,
        arrays=shapes,
        **vars(losses),
    )


def _placed(scene: Scene, settings: BakeSettings, threads: int) -> tuple[Scene, dict[str, int]]:
    """Return a scene with its selected splats, turned and moved, and the number of those left out, by reason."""
    if scene.tree is not None:
        if settings.unused:
            raise FormatError(
                f"it has a tree, which is written as it is; leave out {', '.join(settings.unused)}, or add --leaves"
            )
        check_valid(scene.splats, threads)
        return scene, {}
    selection = dataclasses.replace(settings.selection, drop_invisible=False)
    splats, tally = select(scene.splats, dataclasses.replace(settings, selection=selection), threads=threads)
    selection.check(tally)
    up = settings.up or scene.up
    if settings.transform is not None:
        splats = transformed(splats, settings.transform, threads)
        up = up and rotated_axis(up, settings.transform.rotation)
    return dataclasses.replace(scene, splats=splats, up=up), dict(tally.dropped)


def _write_arrays(
    scene: Scene, layout: str, out: Output, *, raw: bool, threads: int
) -> tuple[int, dict[str, tuple[int, ...]]]:
    from ..codecs import array_files

    try:
        arrays = array_files.pack_layout(scene, layout, threads)
    except ValueError:
        raise FormatError(f"it has no tree, which the layout {layout} consists of; build-lod makes one") from None
    with out:
        size = out.write(out.target.name, array_files.encode_arrays(arrays, raw=raw))
    return size, {name: words.shape for name, words in arrays.items()}
