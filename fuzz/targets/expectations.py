"""Files of `inspect --expect`, as text and as JSON, which is refused."""

from __future__ import annotations

from pathlib import Path

from ..case import Case, Rng
from ..command import command
from ..mutate import json_mutated, mutated, pick, text_mutated
from .cameras import tree

TEXT = """# of a small tree
bytes<=4kB
leaves>=2
sh==0
lod==true
growth<=1.8
tree.leaves==6
tree.levels.0.nodes==1
header.version!=4
format=="SPZ 3"
notes==["SH degree 4 is cut to 3"]
"""
#: In this format files are refused.
JSON = b'{"max_bytes": 4000, "min_splats": 2, "sh": 0, "lod": true, "max_growth": 1.8, "values": {"tree.leaves": 6}}'


def make(rng: Rng) -> Case:
    """Changes a file of expectations about a small tree."""
    if rng.integers(4) == 0:
        name, data = "expect.json", json_mutated(rng, JSON)
    else:
        data = text_mutated(rng, TEXT).encode("utf-8", "surrogatepass")
        name, data = "expect.txt", mutated(rng, data) if rng.integers(8) == 0 else data
    options = pick(rng, ([], ["--json"], ["--format", "github"], ["--check"], ["-q"]))
    return Case(name, {name: data, "tree.spz": tree()}, {"file": name, "options": options})


def check(case: Case, folder: Path) -> None:
    """The expectations hold or do not, or are refused with an error."""
    command(["inspect", "tree.spz", "--expect", case.run["file"], *case.run["options"]])
