"""Several scenes on a cluster: each that a worker can hold is one task, and larger ones are baked by blocks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..io.reading import Source, absolute_source, places_of
from ..system.addresses import Place, absolute
from ..system.errors import SparklodError
from ..system.progress import Progress, silent
from .flow import bake, fits_in_memory
from .out_of_core.cluster_engine import ClusterEngine
from .records import Baked
from .settings import BakeSettings, Resources


def bake_side_by_side(
    pairs: Sequence[tuple[Source, Place]],
    *,
    settings: BakeSettings,
    engine: ClusterEngine,
    resources: Resources,
    bake_large: Callable[[Source, Place], Any],
    make: Callable[..., Baked | None] = bake,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Iterator[Any]:
    """Bake scenes; yields what came of each, a `Baked` or a `SparklodError`, in their order as soon as it is known.

    Args:
        pairs: inputs and outputs, which all workers see.
        resources: of a worker; a scene that its memory holds is one task.
        bake_large: bakes one that none can, and returns what came of it.
        make: bakes one; a function of a module.
    """
    small = [fits_in_memory(source, settings, resources.memory) for source, _ in pairs]
    settings = dataclasses.replace(settings, **{name: path.absolute() for name, path in settings.files.items()})
    whole = [
        (absolute_source(source), absolute(target)) for source, target in pairs
    ]  # workers have folders of their own
    calls = [
        (make, *pair, settings, overwrite, resources) for pair, is_small in zip(whole, small, strict=True) if is_small
    ]
    engine.check(None, [place for source, _ in whole for place in places_of(source)])
    with engine.map_calls("baking", _bake_small, calls, progress, "scene") as outcomes:
        for pair, is_small in zip(pairs, small, strict=True):
            yield _checked_outcome(next(outcomes), pair[1]) if is_small else bake_large(*pair)


def _checked_outcome(outcome: Any, target: Place) -> Any:
    """Return the outcome of a bake, or a `SparklodError` if this machine does not see the output."""
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
    """Return what a worker does."""
    return make(source, target, settings, overwrite=overwrite, threads=threads, resources=resources)
