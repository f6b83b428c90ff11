"""Several scenes on a cluster: a scene that fits into a worker is one task, a larger one is baked by blocks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

from ..io.reading import Source, absolute_source, open_reader, places_of
from ..system.addresses import Place, absolute
from ..system.errors import FormatError, SparklodError
from ..system.progress import Progress, silent
from .estimate import in_memory_bytes
from .flow import bake
from .out_of_core.cluster import ClusterEngine
from .settings import LARGE, Baked, BakeSettings, Resources


def bake_side_by_side(
    pairs: Sequence[tuple[Source, Place]],
    *,
    settings: BakeSettings,
    engine: ClusterEngine,
    resources: Resources,
    make: Callable[..., Baked | None] = bake,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Generator[Any, None, None]:
    """Bake scenes; yield the result of each, a `Baked` or a `SparklodError`, in their order, or `LARGE` unbaked.

    Args:
        pairs: inputs and outputs, which all workers see.
        resources: of a worker; a scene that fits into its memory is one task.
        make: function of a module that bakes a scene.
    """
    small = [_fits_in_memory(source, settings, resources.memory) for source, _ in pairs]
    settings = dataclasses.replace(settings, **{name: path.absolute() for name, path in settings.files.items()})
    sources = [absolute_source(source) for source, _ in pairs]  # workers have folders of their own
    calls = [
        (make, source, absolute(target), settings, overwrite, resources)
        for source, (_, target), is_small in zip(sources, pairs, small, strict=True)
        if is_small
    ]
    engine.check(None, [place for source in sources for place in places_of(source)])
    with engine.map_calls("baking", _bake_small, calls, progress, "scene") as outcomes:
        for pair, is_small in zip(pairs, small, strict=True):
            yield _checked_outcome(next(outcomes), pair[1]) if is_small else LARGE


def _fits_in_memory(source: Source, settings: BakeSettings, memory: int | None) -> bool:
    """Return whether an input can be baked in this much memory; trees and unreadable inputs can.

    Args:
        memory: bytes; None for any number.
    """
    try:
        with open_reader(source) as header:
            needed = in_memory_bytes(settings, header.count, header.sh_degree)
            return header.has_tree or memory is None or needed <= memory
    except FormatError:  # reported when it is baked
        return True


def _checked_outcome(outcome: Any, target: Place) -> Any:
    """Return the result of a bake, or a `SparklodError` if this machine does not see the output."""
    if isinstance(outcome, Baked) and isinstance(target, Path) and not target.exists():
        return SparklodError(
            f"a worker wrote {target} into a folder that is not seen here: give --output-dir a folder that all machines"
            " share, or a URL"
        )
    return outcome


def _bake_small(
    make: Callable[..., Baked | None],
    source: Source,
    target: Place,
    settings: BakeSettings,
    overwrite: bool,
    resources: Resources,
    *,
    threads: int,
) -> Baked | None:
    """Bake a scene on a worker."""
    return make(source, target, settings, overwrite=overwrite, threads=threads, resources=resources)
