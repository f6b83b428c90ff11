"""Selection and transforms: which splats of an input become leaves, and where; in memory and block by block alike."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..codecs.validation import is_valid_and_visible
from ..io import read_rgba, read_scene
from ..model.selection import Selection, SelectionTally
from ..model.splats import Splats
from ..model.transforms import Transform
from ..system.errors import FormatError, InvalidSplatsError, naming
from ..system.progress import Progress
from .settings import BakeSettings


def select(
    splats: Splats, settings: BakeSettings, *, start: int = 0, total: int | None = None, threads: int = 1
) -> tuple[Splats, SelectionTally]:
    """Recolour splats, limit their SH, and return those that are kept, with a tally of the others.

    Args:
        splats: of an input, all or some.
        start, total: number of the first one, and of all splats of the input; by default these are all.
    """
    if settings.rgba is not None:  # SH stay, as where Spark is given new colours
        values = read_rgba(settings.rgba, len(splats) if total is None else total, slice(start, start + len(splats)))
        splats = dataclasses.replace(splats, rgb=np.ascontiguousarray(values[:, :3]), opacity=values[:, 3].copy())
    splats, selection = splats.with_max_sh(settings.max_sh), settings.selection
    drops_nothing = len(splats) and dataclasses.replace(selection, drop_invalid=False) == Selection()
    if drops_nothing and all(is_valid_and_visible(splats, threads)):
        return splats, SelectionTally(len(splats))
    keep, tally = selection.examine(splats, threads=threads)
    return (splats if keep.all() else splats.take(keep)), tally


def transform(splats: Splats, settings: Transform, threads: int = 1) -> tuple[Splats, int]:
    """Turn, scale and move splats; return them and how many left the range of float32."""
    turned = settings.apply(splats)
    if turned is splats or is_valid_and_visible(turned, threads)[0]:
        return turned, 0
    return turned, int(np.count_nonzero(~turned.is_valid()))


def check_transformed(beyond: int) -> None:
    """Raise `InvalidSplatsError` where a transform moved this many splats out of the range of float32."""
    if beyond:
        raise InvalidSplatsError(
            "scaled and moved like this, it leaves the range of float32; give a smaller --scale or --translate"
        )


def transformed(splats: Splats, settings: Transform, threads: int = 1) -> Splats:
    """Turn, scale and move splats; fail where one leaves the range of float32."""
    if settings.is_identity:
        return splats
    turned, beyond = transform(splats, settings, threads)
    check_transformed(beyond)
    return turned


def split_environment(splats: Splats, distance: float) -> tuple[Splats, Splats | None]:
    """Separate splats far outside of a scene, which become its environment; None without any.

    Args:
        distance: see `lod.regions.beyond`.

    Raises:
        InvalidSplatsError: all splats are far outside.
    """
    from ..lod.regions import beyond

    far = beyond(splats, distance)
    return (splats.take(~far), splats.take(far)) if far.any() else (splats, None)


def read_environment(settings: BakeSettings, threads: int, progress: Progress) -> Splats:
    """Read the file of an environment, turned and moved as the scene.

    Raises:
        FormatError, InvalidSplatsError: it cannot be read, is a tree, or has invalid splats; names it.
    """
    path = settings.environment
    assert path is not None
    with naming(f"the environment {path}", (FormatError, InvalidSplatsError)):
        scene = read_scene(path, threads=threads, progress=progress)
        if scene.tree is not None:
            raise FormatError("it is a Level-of-Detail file; give the splats that its tree was built from")
        selection = Selection(drop_invalid=settings.selection.drop_invalid)
        splats, tally = select(scene.splats, dataclasses.replace(settings, rgba=None, selection=selection))
        selection.check(tally)
        return transformed(splats, settings.transform, threads)
