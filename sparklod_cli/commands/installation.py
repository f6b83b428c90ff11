"""Commands about the installation: `sparklod doctor`, `sparklod warmup` and `sparklod completion`.

The checks of doctor must work where nothing else does: packages are looked up by their metadata and tried in processes
of their own, as a broken one may end its process instead of raising.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import click
from click.shell_completion import get_completion_class

from .. import __version__
from ..system import machine
from ..system.errors import SparklodError, reason_of
from ..system.machine import DISTRIBUTION, install_hint, pip_install, required_by
from ..system.python_process import program_command
from ..system.setting_fields import setting, whole
from ..system.threads import processors
from ..system.untrusted import printable
from .command import Command, flag, values_of
from .console import Console, count_of, print_json, say
from .option_groups import JSON, QUIET, VERBOSE, processors_to_use

#: Beginning of the names of checks of extras.
EXTRA = "extra "

DOCTOR_EXAMPLES = """\
  sparklod doctor
  sparklod doctor --quiet || exit 1      # in CI
  sparklod doctor --json > doctor.json   # to attach to a report
"""


@dataclass(frozen=True)
class _Messages:
    as_json: bool = flag("Print one JSON object on standard output.", **JSON)
    quiet: bool = flag("Print problems only.", **QUIET)
    verbose: bool = flag("Print what is being checked.", **VERBOSE)


@click.command("doctor", cls=Command, options=_Messages, examples=DOCTOR_EXAMPLES)
@click.pass_context
def doctor(ctx: click.Context, /, **_: Any) -> None:
    """Check the installation: packages, extras, OpenGL, compiled kernels, threads and memory.

    A problem is something that baking needs; a note is something optional that is missing, or could be better. Each
    comes with a line on what to do. The exit status is 1 if there is a problem, else 0.
    """
    messages = values_of(ctx, _Messages)
    with Console(quiet=messages.quiet, verbose=messages.verbose) as console:
        checks = check_all(lambda name: console.detail(f"checking {name}"))
        problems = [check for check in checks if check.state == "problem"]
        if messages.as_json:
            about = {"ok": not problems, "checks": [dataclasses.asdict(check) for check in checks]}
            print_json(about, indent=2)
        else:
            shown = problems if messages.quiet else checks
            width = max((len(check.name) for check in shown), default=0)
            for check in shown:
                click.echo(printable(f"{check.state:<8}{check.name:<{width}}  {check.value}"))
                if check.advice:
                    click.echo(" " * (8 + width + 2) + printable(f"-> {check.advice}"))
        console.say(_summary(checks))
    ctx.exit(1 if problems else 0)


def _summary(checks: list[Check]) -> str:
    problems = sum(check.state == "problem" for check in checks)
    notes = [check.name for check in checks if check.state == "note"]
    extras = [name.removeprefix(EXTRA) for name in notes if name.startswith(EXTRA)]
    solve = f"{count_of(problems, 'problem')} to solve before baking works"
    parts = [solve if problems else "OK: everything that baking needs works"]
    if extras:
        parts.append(f"{count_of(len(extras), 'optional extra')} not installed ({', '.join(extras)})")
    if len(notes) > len(extras):
        parts.append(count_of(len(notes) - len(extras), "other note" if extras else "note"))
    return "; ".join(parts)


#: ok: works. note: something optional is missing, or could be better. problem: baking does not work.
State = Literal["ok", "note", "problem"]

#: Purposes of the extras but those of developers (dev, docs and test), for display.
PURPOSES = {
    "cloud": "files at addresses such as s3://bucket/scan.ply",
    "cluster": "build-lod on several processes or machines",
    "cuda": "pictures and --refine on NVIDIA cards",
    "parquet": "Parquet tables",
    "render": "figures, charts, and the backends osmesa and open3d of render",
    "video": ".mp4 animations",
}

#: Time limit of a child process, seconds; Open3D alone may load for a minute.
PATIENCE = 120

#: Available memory, bytes, below which only small scenes can be baked.
LITTLE_MEMORY = 1 << 30

#: Program of the child process that calls `_print_kernels`.
KERNELS = f"import {__name__} as doctor; doctor._print_kernels()"

#: Prints the card, its driver and the versions of its compilers, or exits with the reason why no card can be used.
CARD = "from sparklod_cli.render.cuda.card import print_card; print_card()"

#: Prints the encoder of videos.
FFMPEG = "import imageio_ffmpeg; print(imageio_ffmpeg.get_ffmpeg_exe())"


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
        advice: what to do about it; empty where nothing need be done.
    """

    name: str
    state: State
    value: str
    advice: str = ""


def _versions() -> Iterator[Check]:
    yield Check("sparklod", "ok", f"{__version__} in {Path(__file__).parents[1]}")
    system = f"{platform.system()} {platform.release()} on {platform.machine()}"
    yield Check("Python", "ok", f"{platform.python_version()}, {sys.executable}; {system}")


# Packages


def _packages() -> Iterator[Check]:
    if not _is_installed(DISTRIBUTION):
        value = "sparklod itself is not installed, so its requirements are unknown"
        yield Check("packages", "note", value, install_hint())
        return
    for one in required_by(DISTRIBUTION):
        advice = pip_install(one.requirement, options=["--upgrade"]) if one.missing else ""
        yield Check(one.name, "problem" if one.missing else "ok", one.state, advice)


def _extras() -> Iterator[Check]:
    for extra, purpose in PURPOSES.items() if _is_installed(DISTRIBUTION) else ():
        packages = list(required_by(DISTRIBUTION, extra))
        missing = any(package.missing for package in packages)
        advice = f"{install_hint(extra)}   # {purpose}" if missing else ""
        yield _optional(f"{EXTRA}{extra}", ", ".join(f"{each.name} {each.state}" for each in packages), advice)


# What is compiled, and what it runs on


def _print_kernels() -> None:
    """Import all modules of a bake, and print the state of the kernels as JSON."""
    from .. import warmup
    from ..bake.flow import bake  # noqa: F401
    from ..system import jit, machine_code

    folder, missing = jit.CACHE_FOLDER or next(iter(jit.READ_FOLDERS), None), warmup.missing()
    if missing or machine_code.shipped_library() is None:
        jit.load_compiler()
    about = {
        "folder": None if folder is None else str(folder.resolve()),
        "distrusted": jit.DISTRUSTED,
        "wanted": len(warmup.units()),
        "missing": len(missing),
    }
    print(json.dumps(about))


def _kernels() -> Iterator[Check]:
    _, out, error = _run(program_command(KERNELS))
    try:
        about = json.loads(out.splitlines()[-1])
    except (IndexError, ValueError):
        advice = (
            f"{install_hint(options=['--force-reinstall'])}   # in a new virtual environment, if that does not help"
        )
        yield Check("kernels", "problem", f"the modules of bakes cannot be imported: {error}", advice)
        return
    for text in about["distrusted"]:
        yield Check("kernel cache", "problem", *text.split("; ", 1))
    wanted, folder = about["wanted"], about["folder"]
    if folder is None:
        advice = "set NUMBA_CACHE_DIR to a folder that can be written to"
        yield Check("kernel cache", "note", "no folder can be written to, so every run compiles its kernels", advice)
    else:
        compiled = wanted - about["missing"]
        value = f"{compiled} of {wanted} kernels are compiled, {_size_of(Path(folder))} in {folder}"
        advice = "sparklod warmup   # compiles the others now, instead of when they are first used"
        yield _optional("kernel cache", value, advice if about["missing"] else "")
        old = [path for path in Path(folder).parent.glob("kernels-*") if path != Path(folder)]
        if old:
            value = f"{len(old)} of other versions of sparklod, {_size_of(*old)}"
            advice = f"delete the other kernels-* in {Path(folder).parent}, unless those versions are still used"
            yield _optional("old caches", value, advice)


def _processors() -> Iterator[Check]:
    usable, quota = processors(), machine.processor_quota()
    value, advice = f"{usable} of {os.cpu_count() or usable} can be used", ""
    if quota is not None and quota < usable:
        value += f", for the time of {quota:g}: a limit of the container"
        advice = f"--threads {max(1, round(quota))}, since more threads get no more time"
    yield _optional("processors", value, advice)


def _memory() -> Iterator[Check]:
    total, available = machine.total_memory(), machine.available_memory()
    if total is None or available is None:
        yield Check("memory", "ok", "this system does not say" if total is None else f"{total / 1e9:.1f} GB")
        return
    advice = "free some: a bake takes about three times the size of its PLY file" if available < LITTLE_MEMORY else ""
    yield _optional("memory", f"{available / 1e9:.1f} of {total / 1e9:.1f} GB are available", advice)


# What draws


def _opengl() -> Iterator[Check]:
    if not _is_installed("moderngl"):
        yield Check("OpenGL", "note", "not tried without moderngl", install_hint("render", package="moderngl"))
        return
    from ..render.opengl import PACKAGES, probe

    reasons = {kind: probe(kind) for kind in PACKAGES}
    value = ", ".join(f"{kind} draws" if not reason else f"{kind}: {reason}" for kind, reason in reasons.items())
    packages = " or ".join(PACKAGES.values())
    advice = f"on Debian and Ubuntu: apt install {packages}   # render --backend osmesa draws with it"
    yield _optional("OpenGL", value, advice if all(reasons.values()) else "")


def _open3d() -> Iterator[Check]:
    if not _is_installed("open3d"):
        yield Check("Open3D", "note", "not tried, since it is not installed", install_hint("render", package="open3d"))
        return
    try:
        from ..render.open3d_backend import PACKAGES, command
    except ImportError as absent:  # numpy
        yield Check("Open3D", "note", f"not tried ({absent})", install_hint())
        return
    _, out, error = _run(command())  # it draws a splat before it looks for requests, of which there are none
    try:
        reason = json.loads(out.splitlines()[0]).get("error", "")
    except (IndexError, ValueError):
        reason = f"it has crashed: {error}"
    advice = f"on Debian and Ubuntu: apt install {PACKAGES}   # render --backend open3d draws with it" if reason else ""
    yield _optional("Open3D", reason or "draws", advice)


def _card() -> Iterator[Check]:
    if not _is_installed("numba-cuda"):
        has_driver = shutil.which("nvidia-smi") is not None
        value = "not tried without numba-cuda" if has_driver else "none: no driver is installed"
        yield _optional("NVIDIA card", value, install_hint("cuda") if has_driver else "")
        return
    code, out, error = _run(program_command(CARD))
    yield Check("NVIDIA card", "note" if code else "ok", error if code else out)


def _ffmpeg() -> Iterator[Check]:
    if _is_installed("imageio-ffmpeg"):
        code, out, error = _run(program_command(FFMPEG))
        advice = "install ffmpeg, or set IMAGEIO_FFMPEG_EXE to it   # .mp4 animations take it"
        yield _optional("ffmpeg", error if code else out, advice if code else "")


# What only the tests take


def _programs() -> Iterator[Check]:
    for name, command, packages in (("Node", "node", "nodejs npm"), ("Chromium", "chromium", "chromium")):
        advice = f"on Debian and Ubuntu: apt install {packages}   # only sparklod's own tests take it"
        program = shutil.which(command)
        if program is None:
            yield _optional(name, "is not installed", advice)
            continue
        code, out, error = _run([program, "--version"])
        value = f"{program} does not run: {error}" if code else f"{out}, {program}"
        yield _optional(name, value, advice if code else "")


def _optional(name: str, value: str, advice: str) -> Check:
    """Return the check of an optional part, a note if there is advice."""
    return Check(name, "note" if advice else "ok", value, advice)


def _is_installed(package: str) -> bool:
    with contextlib.suppress(metadata.PackageNotFoundError):
        return bool(metadata.version(package))
    return False


def _run(command: list[str]) -> tuple[int, str, str]:
    """Return the exit status of a program, its output, and the last line of its errors or else its end."""
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        return 1, "", f"no answer within {PATIENCE} seconds"
    except OSError as error:
        return 1, "", str(error)
    out, errors = (text.decode("utf-8", "replace").strip() for text in (done.stdout, done.stderr))
    ended = f"ended by signal {-done.returncode}" if done.returncode < 0 else f"exit status {done.returncode}"
    return done.returncode, out, errors.rpartition("\n")[2].strip() or ended


def _size_of(*folders: Path) -> str:
    total = 0
    for path in (path for folder in folders for path in folder.glob("*")):
        with contextlib.suppress(OSError):  # another process has just replaced it
            total += path.stat().st_size
    return f"{total / 1e6:.1f} MB"


#: The checks, the most important first.
CHECKS: dict[str, Callable[[], Iterator[Check]]] = {
    "versions": _versions,
    "packages": _packages,
    "kernels": _kernels,
    "processors": _processors,
    "memory": _memory,
    "extras": _extras,
    "OpenGL": _opengl,
    "Open3D": _open3d,
    "NVIDIA card": _card,
    "ffmpeg": _ffmpeg,
    "Node and Chromium": _programs,
}


def check_all(begun: Callable[[str], None] = lambda name: None) -> list[Check]:
    """Run all `CHECKS`; takes some seconds."""
    found: list[Check] = []
    for name, look in CHECKS.items():
        begun(name)
        try:
            found.extend(look())
        except Exception as error:  # doctor must work where things are broken in unexpected ways
            value = f"cannot be checked ({type(error).__name__}: {error})"
            found.append(Check(name, "note", value, "please report this, with what sparklod doctor --json prints"))
    return found


WARMUP_EXAMPLES = """\
  sparklod warmup                                # once, after pip install
  RUN pip install ./sparklod && sparklod warmup  # in a Dockerfile
  NUMBA_CACHE_DIR=.cache/numba sparklod warmup   # in CI, with a cached folder
"""


@dataclass(frozen=True)
class _WarmupOptions:
    as_json: bool = flag("Print one JSON object on standard output.", **JSON)
    quiet: bool = flag("Print nothing but errors.", **QUIET)
    verbose: bool = flag("Print which kernels are missing.", **VERBOSE)
    jobs: int = setting(
        "Number of processes to compile in.",
        whole(1, 64),
        lambda: min(processors_to_use(), 4),
        show_default="processors, up to 4",
    )


@click.command("warmup", cls=Command, options=_WarmupOptions, examples=WARMUP_EXAMPLES)
@click.pass_context
def warmup(ctx: click.Context, /, **_: Any) -> None:
    """Compile all kernels for this machine, so that no later command has to.

    The inner loops of sparklod, its kernels, are compiled for the processor when they are first called. This command
    compiles all of them at once and keeps them in the cache that later commands read: beside the package or, where that
    is read-only, in your cache folder; NUMBA_CACHE_DIR names another one. Kernels that are in the cache stay there.
    """
    options = values_of(ctx, _WarmupOptions)
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


#: By shell, the variable of the folder with its settings, that folder below the home folder, the file in it, and the
#: line that loads the script. It names the program by its path, which a virtual environment need not have on PATH. The
#: folder completions of fish is not used, since fish reads it only for commands on PATH.
SHELLS = {
    "bash": ("", "", ".bashrc", '[ -x {program} ] && eval "$({program} completion bash)"'),
    "zsh": (
        "ZDOTDIR",
        "",
        ".zshrc",
        "[ -x {program} ] && {{ (( $+functions[compdef] )) || {{ autoload -Uz compinit && compinit -i; }}; "
        'eval "$({program} completion zsh)"; }}',
    ),
    "fish": (
        "XDG_CONFIG_HOME",
        ".config",
        "fish/conf.d/sparklod.fish",
        "test -x {program}; and {program} completion fish | source",
    ),
}

#: Where the scripts of click run the program by the name that was typed, or by its own.
CALLED = re.compile(r"(?<=_complete )((?:\S+=\(.*?\) )*)(?:\$1|sparklod)(?=\))")

#: Where the script of click gives up as the program is not on PATH.
GUARD = "(( ! $+commands[sparklod] )) && return 1"

COMPLETION_EXAMPLES = """\
  sparklod completion --install          # for the shell of $SHELL
  eval "$(sparklod completion bash)"     # in this shell only
"""


@click.command("completion", cls=Command, examples=COMPLETION_EXAMPLES)
@click.argument("shell", type=click.Choice(list(SHELLS)), required=False, metavar="[SHELL]")
@click.option("--install", is_flag=True, help="Add a line that loads the script to the settings of the shell.")
@click.pass_context
def completion(ctx: click.Context, shell: str | None, install: bool) -> None:
    """Print the script by which SHELL completes commands, options and file names.

    SHELL is that of the variable SHELL unless it is given. bash must be 4.4 or newer; the script for zsh needs its
    compinit, which --install calls if nothing has.
    """
    shell = shell or Path(os.environ.get("SHELL", "")).name
    if shell not in SHELLS:
        raise click.UsageError(f"the shell is not known from $SHELL; name one of {', '.join(SHELLS)}", ctx)
    if install:
        _install(shell)
        return
    kind = get_completion_class(shell)
    assert kind is not None
    script = kind(ctx.find_root().command, {}, "sparklod", "_SPARKLOD_COMPLETE").source()
    program = _program(shell)
    click.echo(CALLED.sub(lambda found: found[1] + program, script).replace(GUARD, ""))


def _program(shell: str) -> str:
    """Return the absolute path of the command sparklod, quoted for a shell."""
    started, beside = Path(sys.argv[0]), Path(sys.executable).with_name("sparklod")
    if started.name != beside.name:  # python -m sparklod_cli
        started = beside if beside.is_file() else Path(shutil.which(beside.name) or beside)
    path = os.path.abspath(shutil.which(started) or started)  # noqa: PTH100  # a link stays one: pipx moves its target
    if shell == "fish":
        return "'" + path.replace("\\", "\\\\").replace("'", "\\'") + "'"
    return shlex.quote(path)


def _install(shell: str) -> None:
    """Append the line that loads the script to the settings of a shell, unless it is there."""
    variable, folder, name, line = SHELLS[shell]
    line = line.format(program=_program(shell))
    path = Path(os.environ.get(variable) or Path.home() / folder) / name
    try:
        before = path.read_text("utf-8", "surrogateescape") if path.exists() else ""
        if line in before.splitlines():
            say(f"{path} loads the completion already")
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write("\n" * bool(before and not before.endswith("\n")) + line + "\n")
    except OSError as error:
        raise SparklodError(f"{path}: cannot be changed: {reason_of(error)}") from None
    say(f"{path} loads the completion from the next shell on")
