"""Expectation files of `inspect --expect`, as TOML and as JSON."""

from __future__ import annotations

from pathlib import Path

from ..case import Case, Rng
from ..command import command
from ..mutate import json_mutated, mutated, pick, text_mutated
from .cameras import tree

TOML = """max_bytes = 4_000
min_splats = 2
max_splats = 9
sh = 0
lod = true
max_growth = 1.8
[values]
"tree.leaves" = 6
tree.depth = {min = 1, max = 3}
tree.levels.0.nodes = 1
header.version = 3
format = "SPZ 3"
since = 1979-05-27
"""
JSON = (
    b'{"max_bytes": 4000, "min_splats": 2, "sh": 0, "lod": true, "max_growth": 1.8,'
    b' "values": {"tree.leaves": 6, "tree.depth": {"min": 1, "max": 3.5}, "header": {"version": 3}, "format": "SPZ 3"}}'
)


def make(rng: Rng) -> Case:
    """Changes a file of expectations about a small tree."""
    if rng.integers(2):
        name, data = "expect.json", json_mutated(rng, JSON)
    else:
        text = TOML.replace("since = 1979-05-27\n", "") if rng.integers(4) else TOML
        data = text_mutated(rng, text).encode("utf-8", "surrogatepass")
        name, data = "expect.toml", mutated(rng, data) if rng.integers(8) == 0 else data
    options = pick(rng, ([], ["--json"], ["--format", "github"], ["--check"], ["-q"]))
    return Case(name, {name: data, "tree.spz": tree()}, {"file": name, "options": options})


def check(case: Case, folder: Path) -> None:
    """The expectations hold or do not, or are refused with an error."""
    command(["inspect", "tree.spz", "--expect", case.run["file"], *case.run["options"]])
