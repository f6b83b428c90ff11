"""Options of bakes on several processes or machines."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import click

from ..command import option, with_options
from ..usage import exclude, given, is_given
from .common import Command, General

if TYPE_CHECKING:
    from ...bake.out_of_core.cluster_engine import ClusterEngine
    from ..console import Console

CLUSTER = "Cluster"

#: Parameters of this heading.
OF_CLUSTERS = ("scheduler", "workers")

#: Processes that one machine gets at most.
MAX_WORKERS = 256


def cluster_options(command: Command) -> Command:
    """Adds the options of this module; `cluster_of` takes what they are given."""
    return with_options(
        command,
        option(
            "--workers",
            heading=CLUSTER,
            metavar="N",
            type=click.IntRange(1, MAX_WORKERS),
            help="Bake on this many processes of this machine, which share --threads and --memory.",
        ),
        option(
            "--scheduler",
            heading=CLUSTER,
            metavar="ADDRESS",
            help="Bake on the Dask cluster whose scheduler has this address, as tcp://host:8786.",
        ),
    )


def check_cluster(ctx: click.Context) -> None:
    """Raises a `click.UsageError` where both a cluster that runs and a new one are asked for."""
    if is_given(ctx, "scheduler"):
        exclude(ctx, ["workers"], "--scheduler, whose workers run already")


@contextlib.contextmanager
def cluster_of(ctx: click.Context, general: General, console: Console) -> Iterator[ClusterEngine | None]:
    """The cluster that is asked for, as long as the context lasts; None where none is."""
    if not given(ctx, OF_CLUSTERS):
        yield None
        return
    from ...bake.out_of_core.cluster import ClusterSettings, cluster

    asked = ctx.params
    threads = general.threads if asked["scheduler"] is None or is_given(ctx, "threads") else None
    settings = ClusterSettings(asked["scheduler"], asked["workers"] or 1, threads)
    with cluster(settings, memory=asked["memory"], say=console.say) as engine:
        yield engine
