"""Work of `build-lod` and `simplify`: inputs become files, one after the other or on a cluster."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..bake.flow import bake, stage_shares
from ..bake.settings import LARGE, Baked, BakeSettings, Merged, Resources, Source
from ..system.addresses import Place
from ..system.errors import SparklodError
from ..system.progress import Progress, silent

if TYPE_CHECKING:
    from ..model.instances import Instance

#: Context in which stages of work, by name with their relative times, are shown as one job.
Job = Callable[[Mapping[str, float]], contextlib.AbstractContextManager[None]]

#: An input and its output.
Pair = tuple[Source, Place]

#: Result for an input; None if the output exists already.
Outcome = Baked | SparklodError | None


def merged_source(files: Sequence[Place], instances: Sequence[Instance] = ()) -> Source:
    """Merge the files of instances, each where it stands, or else `files` where their own coordinates put them."""
    placed = tuple((each.file, each.transform) for each in instances if each.file is not None)
    return Merged(placed) if placed else Merged.of(files)


def bake_files(
    pairs: Sequence[Pair],
    settings: BakeSettings,
    *,
    job: Job,
    say: Callable[[str], None],
    progress: Progress = silent,
    threads: int = 1,
    overwrite: bool = False,
    skip: str | None = None,
    memory: int | None = None,
    scratch_dir: Place | None = None,
    resume: bool = False,
    scheduler: str | None = None,
    workers: int | None = None,
    cluster_threads: int | None = None,
) -> Generator[Outcome, None, None]:
    """Bake each input into its output, and yield the results in order.

    An error is the result of its input, so that it does not stop the others.

    Args:
        say: receives one-line messages for the user.
        skip: skip outputs of the same inputs and settings: "date" compares sizes and dates, "verify" contents; None
            bakes all.
        scheduler, workers, cluster_threads: see `cluster.cluster`, which is used if one of the first two is set.

    Raises:
        SparklodError: the cluster cannot be used.
    """
    make: Callable[..., Baked | None] = bake
    if skip is not None:
        from ..bake.skipping import bake_unless_there

        make = functools.partial(bake_unless_there, verify=skip == "verify")
    resources, engine = Resources(memory, scratch_dir, resume), None
    how: dict[str, Any] = {"settings": settings, "overwrite": overwrite, "progress": progress}
    with contextlib.ExitStack() as stack:
        outcomes: Iterator[Any] = itertools.repeat(LARGE)
        if scheduler is not None or workers is not None:
            from ..bake.cluster import bake_side_by_side, cluster

            engine = stack.enter_context(
                cluster(scheduler, workers=workers or 1, threads=cluster_threads, memory=memory, say=say)
            )
            resources = dataclasses.replace(resources, memory=engine.memory)
            if len(pairs) > 1:
                small = bake_side_by_side(pairs, **how, engine=engine, resources=resources, make=make)
                outcomes = stack.enter_context(contextlib.closing(small))
        for pair, outcome in zip(pairs, outcomes, strict=False):
            if outcome is LARGE:
                try:
                    with job(stage_shares(settings)):
                        outcome = make(*pair, **how, resources=resources, engine=engine, threads=threads, say=say)
                except SparklodError as error:
                    outcome = error
            yield outcome
