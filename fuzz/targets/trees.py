"""Level-of-Detail trees of odd shapes or with broken child columns, in valid SPZ files, for all commands."""

from __future__ import annotations

from pathlib import Path

from fixtures import by_hand

from .. import laws, scenes
from ..case import Case, LawError, Rng
from ..command import command
from ..mutate import pick

KINDS = ("chain", "star", "pairs", "broom", "shuffled", "any")
LOD = 0x80  # the flag of SPZ's header that says there is a tree

#: Commands to run on a tree; T is replaced by its file.
INSPECT = (
    *("T --check", "T --json --stats --check", "T --html page.html", "T --stats --histogram size", "T --field tree"),
    *("T --check --fail-on warning --format github", "T --leaves-of T", "T --assert lod==true --assert growth<=1.5"),
)
TRAVERSE = (
    *("T --orbit 3 --no-timing", "T --look-at 0,0,5:0,0,0 --budget 10", "T --dolly --every 20 --precision float16"),
    *("T T --orbit 2 --per-instance --budget 30", "T --orbit 3 --bandwidth 1Mbit --latency 5ms --chunk-cache 1"),
    *("T --orbit 2 --indices-out cuts --padded -o t.csv", "T --look-at 0,0,0:0,0,1 --pixel-scale-limit 0 --json"),
    *("T --orbit 2 --outside-foveate 0 --summary", "T --orbit 2 --assert leaves>0 --lod-render-scale 0"),
)
OTHERS = ("convert T plain.ply", "convert T plain.spz --leaves", "convert T again.spz", "build-lod T -o again.spz")


def make(rng: Rng) -> Case:
    """Makes a tree of any shape, half of them broken, and picks a command; one tree in forty has several chunks."""
    kind = pick(rng, KINDS)
    large = rng.integers(40) == 0
    count = int(pick(rng, (66_000, 140_000) if large else (1, 2, 3, 4, 10, 50, 200, 1000, 3000)))
    tree = scenes.child_columns(rng, kind, count)
    is_broken = bool(rng.integers(2)) and not large
    if is_broken:
        tree = scenes.broken(rng, tree)
    streams = scenes.node_streams(rng, tree, plain=bool(rng.integers(3)))
    number = len(tree[0])
    if not large and rng.integers(3) == 0:
        data = by_hand.spz_zstd(number, 0, 12, LOD, streams)
    else:
        data = by_hand.spz_gzip(3, number, 0, int(pick(rng, (12, 12, 0, 24))), LOD, streams)
    line = pick(rng, [*(f"inspect {each}" for each in INSPECT), *(f"traverse {each}" for each in TRAVERSE), *OTHERS])
    what = f"{kind}{', broken' * is_broken}, {number:,} nodes, {line}"
    return Case(what, {"tree.spz": data}, {"arguments": line.replace("T", "tree.spz").split()})


def check(case: Case, folder: Path) -> None:
    """The command ends as every command must; outputs are whole, and a failure leaves none."""
    arguments = case.run["arguments"]
    done = command(arguments)
    for path in folder.iterdir():
        if path.is_file() and path.name not in case.files:
            if done.code not in (0, 3):
                raise LawError(f"exit code {done.code}, but {path.name} was written")
            laws.check_output(path)
