"""Work of `convert`: a file in another format, which keeps its tree, holds its leaves or its splats, or arrays."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass

from ..bake.built_tree import select, transformed
from ..bake.flow import bake
from ..bake.settings import Baked, BakeSettings
from ..bake.simplifying import leaves_of
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


@dataclass(frozen=True, kw_only=True)
class Converted(Losses):
    """Result of writing splats without a tree, or arrays.

    Attributes:
        format: of the input, for display.
        nodes: number of nodes of the input's tree; None without one.
        splats: number of written splats.
        dropped: number of splats left out, by reason.
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


def convert_file(
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

    A tree is kept if the format holds trees; otherwise its leaves are written.

    Args:
        settings: of format, selection and position; others have no effect.
        layout: one of `formats.ENCODINGS`, to write arrays; None for splats.
        leaves: write the leaves of the tree even if the format holds trees.
        say: receives one-line messages for the user.

    Raises:
        FormatError, InvalidSplatsError, OutputError: see `io.open_reader`, `Selection.check` and
            `system.output.Output`; or the settings have no effect on a tree, or need one.
        OutOfMemoryError: the scene does not fit into memory.
    """
    with memory_errors_translated():
        form = WRITABLE[settings.suffix] if layout is None else None
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
        if form is not None:
            # Opacities of leaves already compensate for the rounding of their scales.
            options = dataclasses.replace(like(scene.header, settings.options), covering=nodes is None)
            options, losses = settled_with_losses(scene, form, options, threads)
            size = write_scene(out, form, scene, options, threads=threads, progress=progress)
        else:
            assert layout is not None
            from ..codecs import layouts

            try:
                arrays = layouts.pack_layout(scene, layout, threads)
            except ValueError:
                raise FormatError(
                    f"it has no tree, which the layout {layout} consists of; build-lod makes one"
                ) from None
            with out:
                size = out.write(out.target.name, layouts.encode_arrays(arrays, raw=settings.suffix != NPZ))
            shapes = {name: words.shape for name, words in arrays.items()}
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
    """Select and transform the splats of a scene, but no tree; also return the number of dropped splats, by reason."""
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
