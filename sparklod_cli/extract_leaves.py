"""From a Level-of-Detail file back to its splats, which are the leaves of its tree."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import numpy as np

from .codecs.clamps import Losses, settled_with_losses
from .codecs.formats import WRITABLE
from .codecs.options import WriteOptions
from .codecs.spz import like
from .codecs.validation import check_valid
from .io import read_scene, scene_output, write_scene
from .model.scene import Scene
from .system.addresses import Place
from .system.errors import FormatError, memory_errors_translated
from .system.progress import Progress, silent


@dataclass(frozen=True, kw_only=True)
class Extracted(Losses):
    """Result of extracting the leaves of a tree.

    Attributes:
        format: of the input, for display.
        nodes, splats: of its tree, and those of them that are leaves, which were written.
        seconds: by stage (read, write).
    """

    format: str
    nodes: int
    splats: int
    sh_degree: int
    bytes: int
    seconds: dict[str, float]
    output_format: str


def leaves_of(scene: Scene) -> Scene:
    """Return the splats that the tree of a scene was built of, as a scene without a tree.

    Raises:
        FormatError: it has no tree.
    """
    if scene.tree is None:
        raise FormatError("it has no Level-of-Detail tree whose leaves could be written")
    leaves = scene.splats.take(scene.tree.is_leaf)
    # A leaf is an input splat. One whose opacity is above 1 comes from a writer that rounds up.
    leaves = dataclasses.replace(leaves, opacity=np.minimum(leaves.opacity, np.float32(1)))
    return Scene(leaves, antialiased=scene.antialiased, format=scene.format, header=scene.header, up=scene.up)


def extract_leaves(
    source: Place,
    target: Place,
    options: WriteOptions,
    *,
    suffix: str,
    overwrite: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> Extracted:
    """Read the tree of a Level-of-Detail file and writes its leaves, in their order, as a file of plain splats.

    Args:
        source: a Level-of-Detail file; - is standard input.
        options: how to write; what is None is taken from the input, which keeps its values as they are.
        suffix: of the format, one of `WRITABLE`.

    Raises:
        FormatError, OutputError: see `io.read_scene` and `io.scene_output`; the file has no tree.
        InvalidSplatsError: a leaf is invalid.
        OutOfMemoryError: it does not fit into memory.
    """
    with memory_errors_translated():
        form = WRITABLE[suffix]
        out = scene_output(target, form, chunked=options.rad.chunked, overwrite=overwrite)
        start = time.perf_counter()
        scene = read_scene(source, threads=threads, progress=progress)
        leaves = leaves_of(scene)
        check_valid(leaves.splats, threads)
        read_done = time.perf_counter()
        # As they are: their opacities make up for nothing.
        chosen = dataclasses.replace(like(scene.header, options), covering=False)
        chosen, losses = settled_with_losses(leaves, form, chosen, threads)
        size = write_scene(out, form, leaves, chosen, threads=threads, progress=progress)
        seconds = {"read": read_done - start, "write": time.perf_counter() - read_done}
    return Extracted(
        format=scene.format,
        nodes=len(scene.splats),
        splats=len(leaves.splats),
        sh_degree=leaves.splats.sh_degree,
        bytes=size,
        seconds={stage: round(value, 4) for stage, value in seconds.items()},
        output_format=form.name,
        **vars(losses),
    )
