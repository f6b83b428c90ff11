"""From a Level-of-Detail file back to its splats. What `sparklod build-lod --unlod` calls, and a program can call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .codecs import ply, splat, spz
from .io import Sink, read_scene
from .model.scene import Scene
from .support.defaults import DEFAULT_COMPRESSION, PLAIN_SUFFIXES, SPZ_VERSIONS
from .support.errors import FormatError, memory_told
from .support.progress import Progress, silent


@dataclass(frozen=True)
class Target:
    """How to write.

    Attributes:
        suffix: one of `defaults.PLAIN_SUFFIXES`.
        version, fractional_bits: of SPZ; None takes those of the input, which keeps its values as they are.
        compression_level: of SPZ.
        threads: to work on.
    """

    suffix: str = ".spz"
    version: int | None = None
    fractional_bits: int | None = None
    compression_level: int = DEFAULT_COMPRESSION
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
    if target.suffix not in PLAIN_SUFFIXES:
        raise ValueError(f"{target.suffix} is not one of {PLAIN_SUFFIXES}")
    if target.suffix != ".spz":
        codec = {".ply": ply, ".splat": splat}[target.suffix]
        return codec.encode(scene, threads=target.threads, progress=progress)
    version = target.version or scene.header["version"]
    options = spz.Options(
        version=version if version in SPZ_VERSIONS else max(SPZ_VERSIONS),
        fractional_bits=scene.header["fractional_bits"] if target.fractional_bits is None else target.fractional_bits,
        compression_level=target.compression_level,
        threads=target.threads,
    )
    return spz.encode(scene, options, progress=progress)
