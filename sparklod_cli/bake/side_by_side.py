"""Several scenes on a cluster: each that a worker can hold is one task, and larger ones are baked by blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from ..support.addresses import Place
from ..support.errors import SparklodError
from ..support.progress import Progress, silent
from .baking import Baked, bake
from .out_of_core.cluster_engine import ClusterEngine
from .settings import BakeSettings


def bake_side_by_side(
    pairs: Sequence[tuple[Place, Place]],
    settings: BakeSettings,
    engine: ClusterEngine,
    *,
    fits: Callable[[Place], bool],
    bake_large: Callable[[Place, Place], Baked],
    overwrite: bool = False,
    progress: Progress = silent,
) -> Iterator[Baked | SparklodError]:
    """Bakes scenes, and yields what came of each in their order, as soon as it is known.

    Args:
        pairs: inputs and outputs, which all workers see.
        settings: how.
        engine: of the cluster.
        fits: whether a worker can hold an input.
        bake_large: bakes one that none can.
        overwrite: replace files that exist.
        progress: told how many scenes are done.
    """
    small = [fits(source) for source, _ in pairs]
    calls = [(*pair, settings, overwrite) for pair, is_small in zip(pairs, small, strict=True) if is_small]
    with engine.each("baking", _bake_small, calls, progress, "scene") as outcomes:
        for pair, is_small in zip(pairs, small, strict=True):
            yield next(outcomes) if is_small else _outcome(bake_large, pair)


def _bake_small(source: Place, target: Place, settings: BakeSettings, overwrite: bool, *, threads: int) -> Baked:
    """What a worker does."""
    return bake(source, target, settings, overwrite=overwrite, threads=threads)


def _outcome(bake_large: Callable[[Place, Place], Baked], pair: tuple[Place, Place]) -> Any:
    try:
        return bake_large(*pair)
    except SparklodError as error:
        return error
