"""Random options of every command; the options are read from the commands, so that new ones are tried too."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import click

from sparklod_cli import cli

from .. import laws
from ..case import Case, LawError, Rng
from ..command import command
from ..containers import FIXTURES, seeds
from ..mutate import pick
from .cameras import groups, tree

#: The seed of each input, by the name of the input in the case's folder.
INPUTS = {
    "scene.ply": "one.ply",
    "flat.ply": "flat.ply",
    "scene.splat": "golden/sh0.splat",
    "scene.sog": "golden/sh2-v1.sog",
    "broken.spz": "faults/tree-cycle.spz",
    "empty.spz": "faults/empty.spz",
}

#: Arguments to try as inputs.
FILES = ("tree.spz", "tree.spz", "tree.spz", *INPUTS, "scene.json", "path.csv", "expect.txt", "absent.ply", ".", "-")

#: Arguments to try as outputs, of pages, of plots, and of folders.
OUTPUTS = (
    *("out.spz", "out.ply", "out.splat", "out.npz", "out.bin", "out.png", "out.webp", "out.npy", "out.gif", "out.csv"),
    *("out.json", "out.html", "out.%04d.png", "out", "new/out.spz", "-", "", ".", "/dev/null", "tree.spz", "scene.ply"),
    *("out\x1b[31m.spz", "out\n::error::.spz", "n" * 300, "scene.json", "out.parquet", "out.xlsx", "out.%d.%d.png"),
)
PAGES = ("out.html", "out.html", "-", "", ".", "new/out.html", "/dev/null", "tree.spz", "expect.txt", "out\n.html")
PLOTS = ("out.png", "out.png", "-", "", ".", "new/out.png", "/dev/null", "tree.spz", "path.csv", "out\x1b[31m.png")
FOLDERS = ("new", "new/er", ".", "tree.spz", "")

#: Values to try, by the name of the option. Sizes and numbers of frames are small: taking long is not a fault here.
VALUES: dict[str, Sequence[str]] = {
    "size": ("16x12", "16x12", "1x1", "33x7", "0x5", "-1x5", "16", "16x12x3", "1e3x4", "\uff19x\uff19"),
    "orbit": ("1", "2", "3", "0", "-1"),
    "every": ("1", "7", "20", "1000000", "0"),
    "seconds": ("0.1", "0.05", "1e-300", "0", "nan"),
    "fps": ("30", "10", "1e-6", "0.001", "1e6", "0", "inf"),
    "threads": ("1", "2", "0", "257"),
    "jobs": ("1", "2", "0"),
    "workers": ("1", "2", "0"),
    "backend": ("numba", "numba", "none"),
    "budget": ("1", "10", "5%", "5%,10", "500k", "0", "-1", "1e3", "10,10", "101%"),
    "view": ("0,0,5:0,0,0", "0,0,0:0,0,0", "1e38,0,0:0,0,0", "0,1e-30,0:0,0,0", "0,0,5", "nan,0,0:0,0,0"),
    "keyframes": ("0,0,5:0,0,0 1,0,5:0,0,0", "0,0,5:0,0,0", "", "0,0,5:0,0,0 0,0,5:0,0,0"),
    "bandwidth": ("1Mbit", "1", "0", "1e300Gbit", "20Mbit", "-1Mbit", "1 kB"),
    "latency": ("0ms", "60ms", "1e9s", "-1ms", "1", "x"),
    "chunk_cache": ("1", "2", "0", "1000000000000"),
    "assertions": ("selected>0", "psnr_min>30", "5%:psnr>1", "nonsense", ""),
    "histogram": ("size", "opacity", "x", "nonsense"),
    "field": ("tree", "tree.leaves", "values", "findings.0", "nonsense", "", "a.b.c"),
    "world_transform": ("1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1", "0,0", "scene.json", "1e38,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1"),
    "background": ("black", "white", "transparent", "#12345", "#123456", "red"),
    "camera_path": tuple(groups()),
    "scene": ("scene.json", "path.csv", "absent.json"),
    "expect": ("expect.txt", "scene.json", "tree.spz"),
    "leaves_of": FILES,
    "rgba": FILES,
    "diff": FILES,
    "output": OUTPUTS,
    "html": PAGES,
    "plot": PLOTS,
    "output_dir": FOLDERS,
    "indices_out": FOLDERS,
}
VALUES |= {"look_at": VALUES["view"]}

#: Options that get no other values than these.
SMALL = ("size", "orbit", "threads", "jobs", "workers")

#: Values to try for all other options.
NUMBERS = (
    *("0", "1", "2", "0.5", "3", "10", "-1", "1e-300", "1e308", "nan", "inf", "1e999", "", "x", "9" * 400, "\x1b[31m"),
    *("1,2,3", "0,0,0", "0,0,0,5", "-1,-1,-1", "1e38,1e38,1e38", "1,2", "nan,0,0", "auto"),
)
SCENE = json.dumps({"instances": [{"file": "tree.spz"}, {"file": "tree.spz", "translation": [3, 0, 0]}]}).encode()
EXPECT = b"lod==true\ngrowth<=1.5\ntree.leaves==5\n"

#: Options that name an output file.
OUTPUT_OPTIONS = ("-o", "--output", "--html", "--plot")

#: Options that end a run before it does anything.
LEFT_OUT = {"version", "help"}


def make(rng: Rng) -> Case:
    """Picks a command, up to two inputs, and up to six options with values."""
    name = pick(rng, list(cli.COMMANDS))
    picked = cli.cli.get_command(click.Context(cli.cli), name)
    assert picked is not None
    options = [each for each in picked.params if isinstance(each, click.Option) and each.name not in LEFT_OUT]
    line = [name]
    for _ in range(int(rng.integers(7)) if options else 0):  # `help` has no options
        line += _option(rng, pick(rng, options))
    if rng.integers(3) == 0:
        line.append("--overwrite")
    if name in ("render", "traverse") and not any(each.startswith("--size") for each in line):
        line += ["--size", "16x12"]
    if name in ("render", "traverse") and rng.integers(2):
        line += ["--orbit", "2"]
    if name == "view":
        line += ["--export", "site"]  # it would serve until it is interrupted
    inputs = [pick(rng, FILES[: 3 if rng.integers(3) else None]) for _ in range(int(pick(rng, (1, 1, 1, 2, 0))))]
    line[1:1] = inputs
    files = {file: seeds()[seed] for file, seed in INPUTS.items()}
    files |= {"tree.spz": tree(), "scene.json": SCENE, "expect.txt": EXPECT}
    files |= {path: data for group in groups().values() for path, data in group.items()}
    files["path.csv"] = (FIXTURES / "cameras" / "sparklod.csv").read_bytes()
    what = " ".join(word[:40] for word in line)[:300]
    return Case(what, files, {"arguments": line, "replaced": _replaced(line, list(files))})


def _replaced(line: list[str], files: list[str]) -> list[str]:
    """The files that --overwrite may replace: those named as an output and not also as an input."""
    if "--overwrite" not in line:
        return []
    read = {"tree.spz"} if "scene.json" in line else set()
    outputs = {word for option, word in itertools.pairwise(line) if option in OUTPUT_OPTIONS}
    return [name for name in files if name in outputs and line.count(name) == 1 and name not in read]


def _option(rng: Rng, option: click.Option) -> list[str]:
    name = pick(rng, [*option.opts, *option.secondary_opts])
    if option.is_flag:
        return [name]
    if isinstance(option.type, click.Choice) and rng.integers(10):
        return [name, str(pick(rng, list(option.type.choices)))] if option.name != "backend" else [name, "numba"]
    values = VALUES.get(option.name or "", NUMBERS)
    return [name, pick(rng, values if rng.integers(10) or option.name in SMALL else NUMBERS)]


def check(case: Case, folder: Path) -> None:
    """The command ends as every command must; its outputs are whole, and exit code 2 leaves none."""
    before = set(folder.rglob("*"))
    done = command(case.run["arguments"])
    for path in sorted(set(folder.rglob("*")) - before):
        if done.code == 2:
            raise LawError(f"exit code 2, but {path.name[:40]!r} was made\n{case.what}\n{done.err}")
        if path.is_file():
            laws.check_output(path)
