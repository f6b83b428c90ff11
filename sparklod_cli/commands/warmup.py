"""`sparklod warmup`: compiles all kernels in advance."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import click

from ..system.setting_fields import setting, whole
from .command import Command, flag, values_of
from .console import Console, count_of, print_json
from .option_groups import JSON, QUIET, VERBOSE, processors_to_use

EXAMPLES = """\
  sparklod warmup                                # once, after pip install
  RUN pip install ./sparklod && sparklod warmup  # in a Dockerfile
  NUMBA_CACHE_DIR=.cache/numba sparklod warmup   # in CI, with a cached folder
"""


@dataclass(frozen=True)
class _Options:
    as_json: bool = flag("Print one JSON object on standard output.", **JSON)
    quiet: bool = flag("Print nothing but errors.", **QUIET)
    verbose: bool = flag("Print which kernels are missing.", **VERBOSE)
    jobs: int = setting(
        "Number of processes to compile in.",
        whole(1, 64),
        lambda: min(processors_to_use(), 4),
        show_default="processors, up to 4",
    )


@click.command("warmup", cls=Command, options=_Options, examples=EXAMPLES)
@click.pass_context
def warmup(ctx: click.Context, /, **_: Any) -> None:
    """Compile all kernels for this machine, so that no later command has to.

    The inner loops of sparklod, its kernels, are compiled for the processor when they are first called. This command
    compiles all of them at once and keeps them in the cache that later commands read: beside the package or, where that
    is read-only, in your cache folder; NUMBA_CACHE_DIR names another one. Kernels that are in the cache stay there.
    """
    options = values_of(ctx, _Options)
    with Console(quiet=options.quiet, verbose=options.verbose) as console:
        from ..system import jit
        from ..warmup import missing, warm_up

        for unit in missing():
            console.detail(f"  {unit.name} must be compiled")
        start = time.perf_counter()
        compiled = warm_up(processes=options.jobs, progress=console.progress)
        seconds = time.perf_counter() - start
        folder = jit.CACHE_FOLDER or jit.READ_FOLDERS[0]
        console.say(
            f"compiled {count_of(compiled, 'kernel')} in {seconds:.1f} s, kept in {folder}"
            if compiled
            else f"all kernels are in {folder}"
        )
        if options.as_json:
            print_json({"compiled": compiled, "seconds": round(seconds, 2), "cache": str(folder)})
