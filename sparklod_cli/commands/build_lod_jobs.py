"""What `sparklod build-lod` does with its inputs: bakes or converts them, one after the other or side by side."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import click

from ..support.addresses import Place
from ..support.errors import SparklodError
from .build_lod_outputs import VERIFY, Outputs
from .options.baking import bake_settings, write_options
from .options.common import General
from .options.resources import resources_of
from .reports import report_baked, report_extracted

if TYPE_CHECKING:
    from ..bake.out_of_core.cluster_engine import ClusterEngine
    from ..bake.records import Baked
    from ..bake.sources import Source
    from ..extract_leaves import Extracted
    from .console import Console

    #: What is known of an output; None where it was there already.
    Made = Baked | Extracted | None

    #: Makes the outputs of inputs, and yields what came of each, in order.
    Make = Callable[[Sequence[tuple[Source, Place]]], Iterator[Made | SparklodError]]


def job_of(
    ctx: click.Context, outputs: Outputs, general: General, console: Console, engine: ClusterEngine | None
) -> tuple[Make, Callable[..., None]]:
    """What makes outputs of inputs, and what reports one; the point where numpy is loaded."""
    console.announce_compiling()
    shared: dict[str, Any] = {"overwrite": outputs.overwrite, "progress": console.progress}
    if outputs.unlod:
        from ..extract_leaves import extract_leaves

        how: dict[str, Any] = {"suffix": outputs.suffix, "options": write_options(ctx), "threads": general.threads}
        return _one_by_one(functools.partial(extract_leaves, **how, **shared)), report_extracted
    from ..bake.flow import bake

    settings = bake_settings(
        ctx,
        suffix=outputs.suffix,
        raw=outputs.is_raw,
        streamed_sog=outputs.is_streamed_sog,
        converts=outputs.format_is_asked_for,
    )
    make: Callable[..., Baked | None] = bake
    if outputs.skip_existing is not None:
        from ..bake.skipping import bake_unless_there

        make = functools.partial(bake_unless_there, verify=outputs.skip_existing == VERIFY)
    resources = resources_of(ctx)
    if engine is not None:
        resources = dataclasses.replace(resources, memory=engine.memory)
    here = functools.partial(
        make, settings=settings, resources=resources, engine=engine, threads=general.threads, say=console.say, **shared
    )
    alone = _one_by_one(here)
    if engine is None:
        return alone, report_baked
    from ..bake.side_by_side import bake_side_by_side

    beside: Make = functools.partial(
        bake_side_by_side,
        make=make,
        settings=settings,
        engine=engine,
        resources=resources,
        bake_large=functools.partial(_outcome, here),
        **shared,
    )
    return lambda pairs: (beside if len(pairs) > 1 else alone)(pairs), report_baked


def _one_by_one(make: Callable[..., Made]) -> Make:
    """Makes outputs of inputs one after the other."""
    return lambda pairs: (_outcome(make, *pair) for pair in pairs)


def _outcome(make: Callable[..., Made], source: Source, target: Place) -> Made | SparklodError:
    """What came of an input, so that one which fails does not stop the others."""
    try:
        return make(source, target)
    except SparklodError as error:
        return error
