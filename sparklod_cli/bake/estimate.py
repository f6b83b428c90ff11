"""Estimates of the memory and disk space of a bake, by measured coefficients as in `lod.tree_settings.SplatBytes`."""

from __future__ import annotations

import functools

from ..lod.tree_settings import BUILDERS, bytes_of
from ..system import machine
from ..system.errors import OutOfMemoryError
from ..system.units import format_size, megabytes
from .settings import BakeSettings

#: Default share of the available memory that a bake may take. Chosen.
MEMORY_SHARE = 0.75

#: Factor of the memory that an error recommends, since `format_size` rounds by up to 5 %.
ENOUGH = 1.05

#: Bytes of a process with numba and all kernels, before it reads inputs.
PROCESS = 200_000_000

#: Bytes per splat of the input while its tree is refined, besides the tree, and bytes of the pictures. Measured with up
#: to 700,000 nodes.
OF_REFINED, PICTURES = (500, 40), 310_000_000

#: Most and least splats of a block. More are no faster, and fewer make its margins too large a part of it.
MOST_BLOCK_SPLATS, LEAST_BLOCK_SPLATS = 1 << 21, 1 << 16

#: Out of core, bytes per node of a window, which is read, gathered or encoded at once; and nodes of a window.
OF_WINDOW, WINDOW = (230, 50), 1 << 19

#: Out of core, bytes per splat of the whole scene while its nodes are ordered, other than for streaming.
OF_ORDER = 20

#: Families per splat of the input, bytes of each while parts of them are ordered for streaming, and further bytes while
#: they are divided into parts. Measured with 40 million.
FAMILIES, OF_FAMILY, OF_DIVIDED = 0.4, 40, 50


def default_memory() -> int | None:
    """Return the default memory of a bake in bytes; None if the system does not report what is available."""
    available = machine.available_memory()
    return None if available is None else int(MEMORY_SHARE * available)


def in_memory_bytes(settings: BakeSettings, splats: int, sh_degree: int) -> int:
    """Return the peak memory of a bake in memory, bytes."""
    refining = 0 if settings.refine is None else PICTURES + bytes_of(OF_REFINED, splats, sh_degree)
    return PROCESS + bytes_of(BUILDERS[settings.method].in_memory, splats, sh_degree) + refining


def most_in_memory(memory: int, settings: BakeSettings, sh_degree: int) -> int:
    """Return the size of the largest scene, splats, that can be baked in this many bytes of memory."""
    fixed, one = (in_memory_bytes(settings, splats, sh_degree) for splats in (0, 1))
    return max(memory - fixed, 0) // (one - fixed)


def out_of_core_bytes(
    method: str, splats: int, sh_degree: int, block_splats: int, *, in_chunks: bool = False, threads: int = 1
) -> int:
    """Return the peak memory of a bake out of core, bytes; `in_chunks` if the output has the order for streaming."""
    from ..lod.chunk_order import MOST_FAMILIES, family_bytes  # loads slowly, and bakes in memory need neither

    window = bytes_of(OF_WINDOW, min(2 * splats, WINDOW), sh_degree)
    block = bytes_of(BUILDERS[method].in_block, min(splats, block_splats), sh_degree)
    families = int(FAMILIES * splats) if in_chunks else 0
    part = family_bytes(threads) * min(families, MOST_FAMILIES)
    arranging = OF_FAMILY * families + max(part, OF_DIVIDED * families if families > MOST_FAMILIES else 0)
    return PROCESS + max(window, block, OF_ORDER * splats, arranging)


def windows_within(memory: int | None, splats: int, sh_degree: int, threads: int) -> int:
    """Return the number of windows of nodes that fit into memory at once, from 1 to `threads`."""
    window = bytes_of(OF_WINDOW, min(2 * splats, WINDOW), sh_degree)
    if memory is None or not window:
        return threads
    return max(1, min(threads, (memory - PROCESS) // window))


def scratch_bytes(method: str, splats: int, sh_degree: int) -> int:
    """Return the peak size of the scratch folder, bytes, without the unpacked input."""
    return bytes_of(BUILDERS[method].in_scratch, splats, sh_degree)


def block_splats_within(
    memory: int | None, method: str, splats: int, sh_degree: int, *, in_chunks: bool = False, threads: int = 1
) -> int:
    """Return the size of blocks, splats: a power of two, so that nearly the same memory gives the same blocks.

    Args:
        memory: bytes that a bake may take; None for any number.

    Raises:
        OutOfMemoryError: the memory is too little for blocks of `LEAST_BLOCK_SPLATS`.
    """
    size = MOST_BLOCK_SPLATS
    needed = functools.partial(out_of_core_bytes, method, splats, sh_degree, in_chunks=in_chunks, threads=threads)
    while memory is not None and needed(size) > memory:
        size //= 2
        if size < LEAST_BLOCK_SPLATS:
            raise OutOfMemoryError(
                f"{format_size(memory)} of memory is too little even out of core; give --memory"
                f" {megabytes(ENOUGH * needed(LEAST_BLOCK_SPLATS))} or more"
            )
    return size
