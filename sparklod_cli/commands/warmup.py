"""`sparklod warmup`: compiles all kernels in advance."""

from __future__ import annotations

import json
import time

import click

from .. import __version__
from .command import GENERAL, Command, option
from .console import Console, count_of
from .options.common import processors_to_use, verbose_option

EXAMPLES = """
\b
Examples:
  sparklod warmup                                  # once, after pip install
  RUN pip install ./sparklod && sparklod warmup    # in a Dockerfile
  NUMBA_CACHE_DIR=.cache/numba sparklod warmup     # in CI, with that folder cached
"""


@click.command("warmup", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@option(
    "--jobs",
    heading=GENERAL,
    metavar="N",
    type=click.IntRange(1, 64),
    default=lambda: min(processors_to_use(), 4),
    show_default="processors, up to 4",
    help="Number of processes to compile in.",
)
@option("--json", "as_json", heading=GENERAL, is_flag=True, help="Print one JSON object on standard output.")
@option("-q", "--quiet", heading=GENERAL, is_flag=True, help="Print nothing but errors.")
@verbose_option("Print which kernels are missing.")
@click.version_option(__version__, package_name="sparklod")
def warmup(jobs: int, as_json: bool, quiet: bool, verbose: bool) -> None:
    """Compile all kernels for this machine, so that no later command has to.

    The inner loops of sparklod, its kernels, are compiled for the processor when they are first called. This command
    compiles all of them at once and keeps them in the cache that later commands read: beside the package or, where that
    is read-only, in your cache folder; NUMBA_CACHE_DIR names another one. Kernels that are in the cache stay there.
    """
    with Console(quiet=quiet, verbose=verbose) as console:
        from ..support import jit
        from ..warmup import missing, warm_up

        for unit in missing():
            console.detail(f"  {unit.name} must be compiled")
        start = time.perf_counter()
        compiled = warm_up(processes=jobs, progress=console.progress)
        seconds = time.perf_counter() - start
        console.say(
            f"compiled {count_of(compiled, 'kernel')} in {seconds:.1f} s, kept in {jit.CACHE_FOLDER}"
            if compiled
            else f"all kernels are in {jit.CACHE_FOLDER}"
        )
        if as_json:
            click.echo(json.dumps({"compiled": compiled, "seconds": round(seconds, 2), "cache": str(jit.CACHE_FOLDER)}))
