"""From a Level-of-Detail file back to its splats. What `sparklod build-lod --unlod` calls, and a program can call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .codecs.formats import WRITABLE
from .codecs.options import WriteOptions
from .codecs.spz_options import like
from .io import Sink, read_scene
from .model.scene import Scene
from .support.errors import FormatError, memory_told
from .support.progress import Progress, silent


@dataclass(frozen=True)
class Target:
    """How to write.

    Attributes:
        suffix: one of `formats.WRITABLE`.
        options: of the file; what is None is taken from the input, which keeps its values as they are.
        threads: to work on.
    """

    suffix: str = ".spz"
    options: WriteOptions = field(default_factory=WriteOptions)
    threads: int = 1


@dataclass(frozen=True)
class Unbaked:
    """What came of it.

    Attributes:
        format: of the input, for people.
        nodes, splats: of its tree, and those of them that are leaves, which were written.
        sh_degree: of the splats.
        bytes: of the output.
        seconds: by stage (read, write).
    """

    format: str
    nodes: int
    splats: int
    sh_degree: int
    bytes: int
    seconds: dict[str, float]


def unlod(source: Path, write: Sink, target: Target, *, progress: Progress = silent) -> Unbaked:
    """Reads the tree at `source` and hands its leaves to `write`, in their order, as a file of plain splats.

    Raises:
        FormatError, OutputError: see `io.read_scene` and `write`; the file has no tree.
        OutOfMemoryError: it does not fit into memory.
    """
    with memory_told():
        return _unlod(source, write, target, progress)


def _unlod(source: Path, write: Sink, target: Target, progress: Progress) -> Unbaked:
    start = time.perf_counter()
    scene = read_scene(source, threads=target.threads, progress=progress)
    if scene.tree is None:
        raise FormatError("it has no Level-of-Detail tree that could be undone")
    leaves = scene.splats.take(scene.tree.is_leaf)
    read_done = time.perf_counter()
    # A leaf is an input splat. One that is more than opaque comes from a writer that rounds up.
    leaves = dataclasses.replace(leaves, opacity=np.minimum(leaves.opacity, np.float32(1)))
    plain = Scene(leaves, antialiased=scene.antialiased, header=scene.header)
    size = write(_encode(plain, target, progress))
    seconds = {"read": read_done - start, "write": time.perf_counter() - read_done}
    return Unbaked(
        format=scene.format,
        nodes=len(scene.splats),
        splats=len(leaves),
        sh_degree=leaves.sh_degree,
        bytes=size,
        seconds={stage: round(value, 4) for stage, value in seconds.items()},
    )


def _encode(scene: Scene, target: Target, progress: Progress) -> Iterator[bytes]:
    if target.suffix not in WRITABLE:
        raise ValueError(f"{target.suffix} is not one of {', '.join(WRITABLE)}")
    codec, options = WRITABLE[target.suffix].codec(), like(scene, target.options)
    pieces: Iterator[bytes] = codec.encode(scene, options, threads=target.threads, progress=progress)
    return pieces
